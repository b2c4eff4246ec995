"""Adam over all tensors of a model in one pass, which checks gradients, updates parameters and clamps their ranges.

The algorithm and the names of its state are those of `torch.optim.Adam` (Kingma & Ba 2015; no weight decay, no
amsgrad), so checkpoints fit both. A step with a gradient that is not finite changes nothing. On the CPU, compiled code
processes chunks on threads. On CUDA, a Warp kernel processes single elements, and nothing waits for the device.
"""

import contextlib
import dataclasses
import functools
import inspect
import math
import weakref
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import INTEGER, POINTER, Snippet, func_native, initialised_warp, launch_on
from ..torch_types import norm

_CHUNK = 4096
"""Elements per unit of work."""
_WHOLE, _REAL = 9, 8
"""Columns of the integer and the float table, which have one row per segment (tensor).

Integers: addresses of p, g, m and v, number of elements, row width (0: no rows), first chunk, address of the step
count, address of a learning rate factor per element (0: none). If p is 0, g is only checked for finite values.
Floats: rate, 1 - b1, 1 - b2, eps, low, high, rate / (1 - b1^t), 1 / sqrt(1 - b2^t)."""

_KERNELS = Path(__file__).with_name("kernels")


def _source(name: str) -> str:
    text = kernel_text(_KERNELS / name)
    return text.replace("@CHUNK@", str(_CHUNK)).replace("@WHOLE@", str(_WHOLE)).replace("@REAL@", str(_REAL))


@functools.lru_cache(maxsize=1)
def _snippet() -> Snippet:
    fields = {
        **dict.fromkeys(("whole", "real", "bad", "visible"), POINTER),
        **dict.fromkeys(("segments", "chunks"), INTEGER),
    }
    return Snippet("adam", fields, _source("adam.cpp"))


def warm_up() -> None:
    """Compiles the CPU code, or loads it from the cache. Call it from the main thread."""
    _snippet().warm_up()


@functools.lru_cache(maxsize=1)
def _kernel() -> Any:
    """Warp kernel of `adam.cu`, for CUDA. Tests also run it on Warp's CPU device."""
    initialised_warp()

    def adam_element(
        wholes: wp.uint64, reals: wp.uint64, flag: wp.uint64, visible: wp.uint64, segments: wp.int32, stage: wp.int32,
        tid: wp.int32,
    ): ...  # fmt: skip

    native = func_native(_source("adam.cu"))(adam_element)

    def entry(
        wholes: wp.uint64, reals: wp.uint64, flag: wp.uint64, visible: wp.uint64, segments: wp.int32, stage: wp.int32
    ):
        native(wholes, reals, flag, visible, segments, stage, wp.tid())

    module = wp.get_module(f"{__name__}.kernel")
    return wp.Kernel(entry, key="adam", module=module, options={"enable_backward": False})


def all_finite(tensors: Sequence[Tensor], threads: int | None = None) -> bool:
    """True if all values of dense float32 CPU `tensors` are finite. Uses `threads` threads (default: all cores)."""
    whole: list[int] = []
    chunks = 0
    for values in tensors:
        whole += (0, values.data_ptr(), 0, 0, values.numel(), 0, chunks, 0, 0)
        chunks += -(-values.numel() // _CHUNK)
    table = torch.tensor(whole, dtype=torch.int64, device="cpu")
    bad = torch.zeros(1, dtype=torch.int32, device="cpu")
    _snippet().run(
        threads, 0, whole=table.data_ptr(), real=table.data_ptr(), bad=bad.data_ptr(), visible=0,
        segments=len(tensors), chunks=chunks,
    )  # fmt: skip
    return not int(bad)


class FusedAdam(torch.optim.Optimizer):
    """Adam like `torch.optim.Adam(params, lr, betas, eps)`, for float32 parameters on one device.

    Additional options of a parameter group:

    - `rows=True`: the first axis is the Gaussian; `step(visible=...)` skips invisible rows and their moments.
    - `clamp=(low, high)`: the parameters are clamped to this range.
    - `lr_unit_distance`: a row's learning rate is multiplied by max(1, L2 norm of the row) / `lr_unit_distance`. Means
      at different distances from the cameras' centre, the scene's origin, then move by equally many pixels. 0: the same
      rate for all rows.

    `applied` is 0-dim bool on the parameters' device: True if the last step was applied.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        threads: int | None = None,
        kernel: bool | None = None,
    ) -> None:
        """`threads`: CPU threads (default: all cores). `kernel`: use the Warp kernel (default: only on a GPU)."""
        usual = {"rows": False, "clamp": (-math.inf, math.inf), "lr_unit_distance": 0.0}
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, **usual})
        self.threads, self.kernel = threads, kernel
        self.applied = torch.tensor(True, device="cpu")
        self._plan: _Plan | None = None
        self._recorded: StepTable | None = None

    # The next two methods bypass torch's decorator, which excludes methods from torch.compile. At its first call, it
    # would import the compiler: 1.5 to 1.9 s and 68 MB in every process that trains or develops.
    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """See `torch.optim.Optimizer.add_param_group`."""
        inspect.unwrap(torch.optim.Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """See `torch.optim.Optimizer.zero_grad`."""
        inspect.unwrap(torch.optim.Optimizer.zero_grad)(self, set_to_none)

    @contextlib.contextmanager
    def recording(self, device: torch.device) -> Generator["StepTable"]:
        """Context in which a GPU step is recorded and not carried out (`recorder`).

        Yields the step's table, which `send` transfers before each replay. All parameters of the step must have been
        updated by an earlier step.
        """
        rows = sum(len(group["params"]) for group in self.param_groups) + _GUARDS
        sent = torch.zeros(rows * (_WHOLE + _REAL // 2), dtype=torch.int64, device=device)
        self._recorded = StepTable(sent)
        try:
            yield self._recorded
        finally:
            self._recorded = None

    def send(self, table: "StepTable") -> None:
        """Transfers the table of a recorded step to the GPU, with the current learning rates."""
        rows = len(table.values) // (_WHOLE + _REAL // 2)
        real = table.values[rows * _WHOLE :].view(np.float32).reshape(rows, _REAL)
        real[rows - len(table.group_of) :] = self._rates()[table.group_of]
        values: Tensor = torch.from_numpy(table.values)  # pyright: ignore[reportUnknownMemberType]
        # Only a copy from pinned memory runs asynchronously.
        values = values.pin_memory() if table.sent.device.type == "cuda" else values
        table.sent[: len(values)].copy_(values, non_blocking=True)

    def _rates(self) -> NDArray[np.float32]:
        """[groups, _REAL] floats of a segment in each group; the last two columns are 0."""
        rates = [
            (g["lr"], 1.0 - g["betas"][0], 1.0 - g["betas"][1], g["eps"], *g["clamp"], 0.0, 0.0)
            for g in self.param_groups
        ]
        return np.array(rates, np.float32)

    @torch.no_grad()
    def step(self, closure: None = None, *, visible: Tensor | None = None, guard: Sequence[Tensor] = ()) -> None:  # type: ignore[override]
        """Updates every parameter that has a gradient, unless a gradient or a value of `guard` is not finite.

        visible: bool [N] Gaussians whose rows are updated; None: all. ValueError for a `closure`, and for parameters
        that are not float32 or not on one device.
        """
        if closure is not None:
            raise ValueError("FusedAdam takes no closure")
        found = [(p, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        if not found:
            return
        device = found[0][0].device
        kernel = device.type != "cpu" if self.kernel is None else self.kernel
        rows = None if visible is None else visible.contiguous().view(torch.uint8)
        if kernel:
            bad = torch.zeros(1, dtype=torch.int32, device=device)
            self._run_kernel(found, guard, bad, rows)
            self.applied = bad[0] == 0
            return
        whole: list[int] = []
        real: list[float] = []
        kept: list[Tensor] = []  # keeps tensors alive whose addresses are in the tables
        chunks = 0
        for value in guard:
            value = value.detach().float().reshape(-1)
            kept.append(value)
            whole += (0, value.data_ptr(), 0, 0, value.numel(), 0, chunks, 0, 0)
            real += (0.0,) * _REAL
            chunks += -(-value.numel() // _CHUNK)
        steps: list[Tensor] = []
        for p, group in found:
            self._check(p, device)
            m, v, t = self._state_of(p)
            # The compiled code walks p, g, m and v as flat memory, so their layouts must agree.
            grad = p.grad if p.grad.stride() == p.stride() else torch.empty_like(p).copy_(p.grad)
            factor = _factors(p, group)
            kept += [grad] if factor is None else [grad, factor]
            steps.append(t)
            lr, (b1, b2), (low, high) = group["lr"], group["betas"], group["clamp"]
            width = p.numel() // max(1, len(p)) if group["rows"] else 0
            whole += (p.data_ptr(), grad.data_ptr(), m.data_ptr(), v.data_ptr(), p.numel(), width, chunks, t.data_ptr())
            whole.append(0 if factor is None else factor.data_ptr())
            count = float(t) + 1.0
            scale = lr / (1.0 - b1**count), 1.0 / math.sqrt(1.0 - b2**count)
            real += (lr, 1.0 - b1, 1.0 - b2, group["eps"], low, high, *scale)
            chunks += -(-p.numel() // _CHUNK)
        bad = torch.zeros(1, dtype=torch.int32, device=device)
        self.applied = self._run_snippet(whole, real, bad, rows, chunks)
        if bool(self.applied):
            for t in steps:
                t += 1.0

    @staticmethod
    def _check(p: Tensor, device: torch.device) -> None:
        if p.dtype != torch.float32 or p.device != device:
            raise ValueError(f"FusedAdam takes float32 parameters on one device, got {p.dtype} on {p.device}")

    def _state_of(self, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(exp_avg, exp_avg_sq, step) of a parameter, converted to its device and memory layout."""
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=p.device)
            state["exp_avg"] = torch.zeros_like(p, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(p, memory_format=torch.preserve_format)
        for name in ("exp_avg", "exp_avg_sq"):
            if state[name].stride() != p.stride() or state[name].device != p.device:
                state[name] = torch.empty_like(p).copy_(state[name])
        if state["step"].device != p.device:
            state["step"] = state["step"].to(p.device)
        return state["exp_avg"], state["exp_avg_sq"], state["step"]

    def _run_snippet(
        self, whole: list[int], real: list[float], bad: Tensor, visible: Tensor | None, chunks: int
    ) -> Tensor:
        table, numbers = (
            torch.tensor(values, dtype=kind, device="cpu")
            for values, kind in ((whole, torch.int64), (real, torch.float32))
        )
        # Stage 0 checks all gradients before stage 1 changes anything: a step is applied as a whole or not at all.
        for stage in (0, 1):
            _snippet().run(
                self.threads, stage, whole=table.data_ptr(), real=numbers.data_ptr(), bad=bad.data_ptr(),
                visible=0 if visible is None else visible.data_ptr(), segments=len(whole) // _WHOLE, chunks=chunks,
            )  # fmt: skip
            if int(bad):
                break
        return bad[0] == 0

    def _run_kernel(
        self, found: list[tuple[Any, dict[str, Any]]], guard: Sequence[Tensor], bad: Tensor, visible: Tensor | None
    ) -> None:
        """Runs the step on a GPU. Table entries other than gradients and rates are cached in a `_Plan`."""
        device, plan = bad.device, self._plan
        if plan is None or not plan.fits(found, self.state):
            for p, _ in found:
                self._check(p, device)
            plan = self._plan = _Plan.of(found, [self._state_of(p) for p, _ in found], self.param_groups)
        checked = [value.detach().float().reshape(-1) for value in guard]
        grads = [
            p.grad if p.grad.stride() == stride else torch.empty_like(p).copy_(p.grad)
            for (p, _), stride in zip(found, plan.strides, strict=True)
        ]
        factors = [_factors(p, group) for p, group in found]
        segments = len(checked) + len(grads)
        # One table needs only one transfer: the integers, followed by the floats, two per int64.
        table = np.zeros((segments, _WHOLE + _REAL // 2), np.int64).reshape(-1)
        whole = table[: segments * _WHOLE].reshape(segments, _WHOLE)
        real = table[segments * _WHOLE :].view(np.float32).reshape(segments, _REAL)
        chunks = 0
        for row, value in enumerate(checked):
            whole[row, 1], whole[row, 4], whole[row, 6] = value.data_ptr(), value.numel(), chunks
            chunks += -(-value.numel() // _CHUNK)
        whole[len(checked) :] = plan.whole
        whole[len(checked) :, 1] = [grad.data_ptr() for grad in grads]
        whole[len(checked) :, 8] = [0 if factor is None else factor.data_ptr() for factor in factors]
        whole[len(checked) :, 6] += chunks
        chunks += plan.chunks
        real[len(checked) :] = self._rates()[plan.group_of]
        if self._recorded is None:
            sent: Tensor = torch.from_numpy(table)  # pyright: ignore[reportUnknownMemberType]
            sent = (sent.pin_memory() if device.type == "cuda" else sent).to(device, non_blocking=True)
        else:
            sent = self._recorded.filled(table, plan.group_of)
        mask = 0 if visible is None else visible.data_ptr()
        wholes, reals = sent[: segments * _WHOLE], sent[segments * _WHOLE :].view(torch.float32)
        # Launches run in order: all gradients are checked, then step counts advance, then parameters change.
        for stage, threads in ((0, chunks * _CHUNK), (1, segments), (2, chunks * _CHUNK)):
            inputs = [wholes.data_ptr(), reals.data_ptr(), bad.data_ptr(), mask, segments, stage]
            launch_on(_kernel(), threads, inputs, device)


_GUARDS = 4
"""Maximum number of guarded values of a recorded step."""


@dataclass
class StepTable:
    """Table that a recorded step reads. The addresses stay those of the recording; learning rates are updated."""

    sent: Tensor
    """int64 table on the GPU, at least as long as `values`."""
    values: NDArray[np.int64] = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """The table in host memory."""
    group_of: NDArray[np.int64] = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """Parameter group of each of the table's last rows."""

    def filled(self, values: NDArray[np.int64], group_of: NDArray[np.int64]) -> Tensor:
        """Stores the table's values in host memory, and returns the GPU tensor that the step reads."""
        self.values, self.group_of = values, group_of
        return self.sent[: len(values)]


def _factors(p: Tensor, group: dict[str, Any]) -> Tensor | None:
    """Learning rate factor of each element of `p`, in its layout; None if the group has no `lr_unit_distance`."""
    if not group["lr_unit_distance"]:
        return None
    rows = p.detach().reshape(len(p), -1)
    factor = norm(rows, dim=1).clamp_min(1.0) / group["lr_unit_distance"]
    return torch.empty_like(p, memory_format=torch.preserve_format).copy_(factor.view(-1, *[1] * (p.dim() - 1)))


@dataclass
class _Plan:
    """The part of the tables that stays the same from step to step, for S parameters with gradients."""

    known: list[tuple[weakref.ref[Tensor], ...]]
    """[S] parameter, moments and step count. Weak references, so that replaced tensors are freed at once."""
    strides: list[tuple[int, ...]]
    """[S] strides of the parameters."""
    whole: NDArray[np.int64]
    """[S, _WHOLE] integers, without the addresses of gradients and factors."""
    group_of: NDArray[np.int64]
    """[S] parameter group of each parameter."""
    chunks: int
    """Total number of chunks."""

    @classmethod
    def of(
        cls,
        found: list[tuple[Any, dict[str, Any]]],
        states: list[tuple[Tensor, Tensor, Tensor]],
        groups: list[dict[str, Any]],
    ) -> "_Plan":
        rows: list[tuple[int, ...]] = []
        chunks = 0
        for (p, group), (m, v, t) in zip(found, states, strict=True):
            width = p.numel() // max(1, len(p)) if group["rows"] else 0
            rows.append((p.data_ptr(), 0, m.data_ptr(), v.data_ptr(), p.numel(), width, chunks, t.data_ptr(), 0))
            chunks += -(-p.numel() // _CHUNK)
        places = {id(group): place for place, group in enumerate(groups)}
        return cls(
            known=[tuple(map(weakref.ref, (p, *state))) for (p, _), state in zip(found, states, strict=True)],
            strides=[p.stride() for p, _ in found],
            whole=np.array(rows, np.int64),
            group_of=np.array([places[id(group)] for _, group in found], np.int64),
            chunks=chunks,
        )

    def fits(self, found: list[tuple[Any, dict[str, Any]]], state: Any) -> bool:
        """True if the plan was made for these parameters and states at their current addresses."""
        if len(found) != len(self.known):
            return False
        for (p, _), known, row in zip(found, self.known, self.whole.tolist(), strict=True):
            of = state.get(p, {})
            now = p, of.get("exp_avg"), of.get("exp_avg_sq"), of.get("step")
            if any(reference() is not value for reference, value in zip(known, now, strict=True)):
                return False
            if [value.data_ptr() for value in now] != [row[0], row[2], row[3], row[7]]:
                return False
        return True
