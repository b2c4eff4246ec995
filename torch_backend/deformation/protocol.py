"""What a host is: (means, times) -> deltas, with its own parameters, learning rates and regularisers."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from torch import Tensor

from ..gaussians import PARAM_NAMES, Gaussians


class Deltas(NamedTuple):
    """Changes of M Gaussians at their times, added before activation (method-hosts 1.1, "Application").

    means [M, 3] scene units, quats [M, 4], log_scales [M, 3], opacity_logits [M], sh0 [M, 1, 3].
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor


class Deformation(Protocol):
    """A host of the method."""

    def __call__(self, means: Tensor, times: Tensor) -> Deltas:
        """Deltas of M Gaussians: canonical means [M, 3] in scene units, times [M] in [0, 1]."""
        ...

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Optimiser groups: params, lr (start), lr_end, name."""
        ...

    def regularisation(self) -> Tensor:
        """Scalar that keeps the field plausible, already weighted."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint."""
        ...

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `state`; KeyError or ValueError names what does not fit."""
        ...


def apply_deltas(model: Gaussians, rows: Tensor, deltas: Deltas | None) -> dict[str, Tensor]:
    """The model's parameters with `deltas` added at `rows` [M]; without deltas the canonical ones.

    quats: the delta is added before normalisation, which the rasteriser does.
    """
    state: dict[str, Tensor] = {name: model.params[name] for name in PARAM_NAMES}
    if deltas is None or len(rows) == 0:
        return state
    for name, delta in deltas._asdict().items():
        state[name] = state[name].index_add(0, rows, delta)
    return state
