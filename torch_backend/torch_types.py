"""Typed wrappers for untyped functions of torch: each is one call and a cast.

Torch does not annotate what it implements in C++ (`linalg`, `Tensor.norm`, `Tensor.tolist`, an autograd context). Type
checkers and editors therefore know nothing of an expression such as `x.norm(dim=1)`.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd import function
from torch.utils import checkpoint as _checkpoint

_Backward = TypeVar("_Backward", bound=Callable[..., Any])
_Result = TypeVar("_Result")


class AutogradContext(Protocol):
    """Context of `forward` and `backward` of a `torch.autograd.Function`. Functions may add attributes."""

    needs_input_grad: tuple[bool, ...]
    """For each input of `forward`, whether its gradient is needed."""

    @property
    def saved_tensors(self) -> tuple[Any, ...]:
        """Arguments of `save_for_backward`: tensors or None."""
        ...

    def save_for_backward(self, *tensors: Tensor | None) -> None:
        """Keeps inputs and outputs for `backward`."""
        ...

    def mark_non_differentiable(self, *tensors: Tensor) -> None:
        """Marks outputs that have no gradient."""
        ...

    def set_materialize_grads(self, value: bool) -> None:
        """False: `backward` gets None for an output without gradient, not zeros."""
        ...


def applied(autograd_function: type[torch.autograd.Function], *inputs: Any) -> Any:
    """Output of an autograd function; the caller declares its type."""
    return cast(Any, autograd_function).apply(*inputs)


def once_differentiable(backward: _Backward) -> _Backward:
    """`torch.autograd.function.once_differentiable` that keeps the argument names of `backward` for type checkers."""
    return cast(_Backward, function.once_differentiable(backward))


def checkpoint(body: Callable[..., _Result], *inputs: Any) -> _Result:
    """body(*inputs). The backward pass runs `body` again instead of storing intermediates; `body` must not draw random
    numbers."""
    run = cast(Callable[..., _Result], cast(Any, _checkpoint).checkpoint)
    return run(body, *inputs, use_reentrant=False, preserve_rng_state=False)


def backward(loss: Tensor, retain_graph: bool | None = None) -> None:
    """Adds the gradients of `loss` (0-dim) to all leaves that it depends on."""
    cast(Any, loss).backward(retain_graph=retain_graph)


def weighted_gradient(values: Tensor, leaf: Tensor, weights: Tensor) -> Tensor:
    """Gradient of sum(values * weights) with respect to `leaf`, in the shape of `leaf`.

    Same as `torch.autograd.grad` with `grad_outputs`, but that imports sympy to compare two shapes: 0.6 s per process.
    """
    (found,) = torch.autograd.grad((values * weights).sum(), leaf)
    return found


def on_gradient(values: Tensor, hook: Callable[[Tensor], None]) -> None:
    """Calls `hook` with the gradient of `values` whenever a backward pass has computed it."""
    cast(Any, values).register_hook(hook)


def norm(values: Tensor, *, dim: int, keepdim: bool = False) -> Tensor:
    """Euclidean (L2) norm along the axis `dim`, a keyword: `norm(x, 1)` would read as an L1 norm."""
    return cast(Any, values).norm(dim=dim, keepdim=keepdim)


def norm_1(values: Tensor, *, dims: tuple[int, ...]) -> Tensor:
    """Sum of magnitudes along axes."""
    return cast(Any, torch.linalg).vector_norm(values, 1, dim=dims)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product [..., 3]."""
    return cast(Any, torch.linalg).cross(a, b)


def determinant(matrices: Tensor) -> Tensor:
    """Determinants [...] of [..., K, K]."""
    return cast(Any, torch.linalg).det(matrices)


def singular_values(matrices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Singular value decomposition (U, S, Vh) of [..., K, K]."""
    return cast(Any, torch.linalg).svd(matrices)


def split(values: Tensor, sizes: int | Sequence[int], dim: int = 0) -> tuple[Tensor, ...]:
    """Views along `dim` of `sizes` rows each (the last may have fewer), or of several sizes."""
    return cast(Any, values).split(sizes, dim)


def unflatten(values: Tensor, dim: int, sizes: tuple[int, ...]) -> Tensor:
    """A view in which the axis `dim` is split into axes of these sizes."""
    return cast(Any, values).unflatten(dim, sizes)


def unique_with_inverse(values: Tensor) -> tuple[Tensor, Tensor]:
    """(distinct values [U] ascending, index int64 into them in the shape of `values`)."""
    return cast(Any, values).unique(return_inverse=True)


def floats(values: Tensor) -> list[float]:
    """Numbers of a tensor [K], read from its device."""
    return cast(Any, values).tolist()


def integers(values: Tensor) -> list[int]:
    """Numbers of an integer tensor [K], read from its device."""
    return cast(Any, values).tolist()


def from_numpy(array: "np.ndarray[Any, Any]") -> Tensor:
    """A CPU tensor that shares the array's memory."""
    return cast(Any, torch).from_numpy(array)


def matrix_exp(matrices: Tensor) -> Tensor:
    """Matrix exponentials [..., K, K]."""
    return cast(Any, torch.linalg).matrix_exp(matrices)


def norm_of_all(values: Tensor) -> Tensor:
    """Euclidean norm (0-dim) of all numbers together."""
    return cast(Any, values).norm()
