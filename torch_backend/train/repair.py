"""Repairs of a run between steps: values that are not finite are dropped or replaced, with a warning.

A step that is not finite changes nothing (`FusedAdam`), and the rasteriser culls Gaussians that are not finite. Without
a repair, however, a NaN in an opacity makes every later step fail, and a Gaussian with a NaN in its position stays
invisible to every loss. Values are repaired as follows:

- A Gaussian with a parameter that is not finite is dropped.
- A quaternion of zero length is set to the identity, and a host's parameter per Gaussian to its initial value.
- A parameter of the field is set to its last stored finite value, or to the median of its tensor.
- A parameter of the exposure or the poses is set to 0.
- A field that displaces many Gaussians too far is restored as a whole, at half the learning rates.
- Gaussians that a stable field displaces too far are dropped at every round of densification.
- Adam's moments are set to 0 where a value was repaired, and where they are not finite.

If a repair would leave less than half of the Gaussians, the run ends with an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..contract import ExitCode, JobError
from ..deformation import Deformation
from ..deformation.protocol import Owned
from ..gaussians import PARAM_NAMES, Densifier
from ..raster.constants import QUAT_MIN
from ..scene import evenly_spaced
from ..torch_types import norm
from .adam import all_finite
from .model import DynamicModel
from .movers import MOMENTS

# Largest share of Gaussians with a gradient that is not finite for which the Gaussians are dropped. A larger share
# indicates a fault of the frame or the field.
_FEW = 0.01
_MAX_TOO_FAR = 0.1
"""Largest share of the moving Gaussians that a stable field may displace too far at any time."""
# A Gaussian is displaced too far if it moves by more than 6 times the moving Gaussians' median distance from their
# median position. This bound is at least 1 scene unit and at most the scene's extent. A person may walk across the
# whole moving region, and an apple may swing by many times its size. In a stable preview run, the 90 % quantile of the
# displacement is at most 0.05 of that distance; in an unstable run, it was hundreds of times as large at some times.
# The scene's extent alone, which includes far background, did not detect that run (docs/decisions.md).
_FAR, _LEAST_FAR = 6.0, 1.0
_MOMENTS = ("exp_avg", "exp_avg_sq")
_STATE = "memory."
"""Prefix of the tensors of `FieldMemory` in a checkpoint."""


def unstable(step: int) -> JobError:
    """Error for a run that cannot continue because it is unstable at `step`."""
    return JobError(
        f"Training became unstable at step {step} (the loss, its gradient or the model is not finite).",
        "The last good checkpoint is kept; train again with a smaller width or another seed.",
        ExitCode.TRAIN,
    )


class FieldMemory:
    """Copies of a field's parameters at the last two inspections that found it stable, on the field's device.

    Between inspections, it checks the displacement at every step. An unstable field fails at some times first, and an
    inspection would only see the time of the last step. Copies are valid while the field has the same nodes and bounds;
    call `keep` when they change.
    """

    def __init__(self, extent: float, device: torch.device) -> None:
        self.extent = extent
        """Extent of the scene in scene units; a larger displacement is always too far."""
        self._kept: list[dict[str, Tensor]] = []  # the newest last
        # Never reallocated, since recorded steps read `_limit` and write `_worst` (`recorder`).
        self._limit = torch.full((), math.inf, device=device)
        self._worst = torch.zeros((), device=device)
        self.rates = 1.0
        """Factor of the field's learning rates, halved each time that the field is restored."""

    @torch.no_grad()
    def keep(self, field: Deformation | None, means: Tensor) -> None:
        """Copies the parameters of a stable field, and sets the bound from the means [M, 3] of the moving Gaussians."""
        named = {} if field is None else dict(field.named_parameters())
        if not self._kept or {n: p.shape for n, p in named.items()} != {n: p.shape for n, p in self._kept[-1].items()}:
            # Both copies are allocated at once, so that GPU memory does not grow later.
            self._kept = [{name: p.detach().clone() for name, p in named.items()} for _ in range(2)]
        else:
            self._kept.append(self._kept.pop(0))
            for name, p in named.items():
                self._kept[-1][name].copy_(p)
        self._worst.zero_()
        self._limit.fill_(math.inf)
        if len(means):
            around = norm(means - means.median(0).values, dim=1).median()
            self._limit.copy_((_FAR * around).clamp(min(_LEAST_FAR, self.extent), self.extent))

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint, with which a resumed run makes the same repairs as an uninterrupted one."""
        kept = {f"{_STATE}kept.{n}.{name}": p for n, copy in enumerate(self._kept) for name, p in copy.items()}
        return {f"{_STATE}reach": self._limit, f"{_STATE}worst": self._worst, **kept}

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `state`."""
        stored = {name.removeprefix(_STATE): t for name, t in tensors.items() if name.startswith(_STATE)}
        self._limit.copy_(stored["reach"])
        self._worst.copy_(stored["worst"])
        device, kept = self._limit.device, [f"kept.{n}." for n in range(2)]
        found = [
            {name.removeprefix(start): t.to(device, copy=True) for name, t in stored.items() if name.startswith(start)}
            for start in kept
        ]
        self._kept = found if any(found) else []

    @torch.no_grad()
    def observe(self, shift: Tensor) -> None:
        """Checks a step's displacement `shift` [M, 3] of the moving means, in scene units. NaNs do not count."""
        if len(shift):
            self._worst.copy_(torch.maximum(self._worst, self.is_too_far(shift).float().mean()))

    def is_too_far(self, shift: Tensor) -> Tensor:
        """bool [M] Gaussians whose displacement `shift` [M, 3], in scene units, is too far."""
        return shift.abs().amax(1) > self._limit

    def of(self, name: str, p: Tensor) -> Tensor | None:
        """Stored value of parameter `name`; None if it is missing or its shape is not that of `p`."""
        kept = self._kept[-1].get(name) if self._kept else None
        return kept if kept is not None and kept.shape == p.shape else None

    @torch.no_grad()
    def restore_stable(self, field: Deformation, optimizer: torch.optim.Optimizer) -> str:
        """Restores the field if it displaced too many Gaussians too far at any step since the last inspection.

        Halves the learning rates of the field's parameters. Returns a description for the user; empty if nothing was
        done.
        """
        if not self._kept:
            return ""
        worst = float(self._worst)
        self._worst.zero_()
        if not worst > _MAX_TOO_FAR:
            return ""
        # The older copy, because the newer one may already be unstable.
        named, before = dict(field.named_parameters()), self._kept[0]
        if {n: p.shape for n, p in named.items()} != {n: p.shape for n, p in before.items()}:
            return ""
        # Gaussians outside the image get no gradient that would bring them back, so the whole field is restored.
        self.rates *= 0.5
        for name, p in named.items():
            p.copy_(before[name])
            self._kept[1][name].copy_(p)
            optimizer.state.pop(p, None)
        owned = {id(p) for p in named.values()}
        for group in optimizer.param_groups:
            if any(id(p) in owned for p in group["params"]):
                group["lr_start"], group["lr_end"] = 0.5 * group["lr_start"], 0.5 * group["lr_end"]
        share = f"{100.0 * worst:.0f} % of the moving Gaussians"
        return f"restored the field, at half the learning rates ({share} had jumped away)"


@torch.no_grad()
def repair(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, memory: FieldMemory, step: int
) -> str:
    """Drops Gaussians, and replaces values of the model and of Adam's moments, that are not finite.

    Returns a description for the user; empty if all values are finite. This check runs on the device and reads back one
    value. JobError if too few Gaussians are left.
    """
    if _sound(model, optimizer):
        return ""
    messages = _repair_gaussians(model, optimizer, densifier, step)
    named = {} if model.field is None else dict(model.field.named_parameters())
    for name, p in named.items():
        bad, before = ~torch.isfinite(p), memory.of(name, p)
        if bool(bad.any()):
            sound = p[~bad]
            messages.append(f"repaired {_counted(int(bad.sum()), 'number')} of {name}")
            # Without a stored value, the median: near 0 for weights, the neutral 1 for time planes, a typical radius
            # for radii.
            _mend(p, bad, before if before is not None else sound.median() if len(sound) else 0.0, optimizer)
    known = {id(p) for p in (*model.gaussians.params.values(), *named.values())}
    for group in optimizer.param_groups:
        for p in (p for p in group["params"] if id(p) not in known and not bool(torch.isfinite(p).all())):
            bad = ~torch.isfinite(p)
            name = "exposure" if p is model.exposure.values else "the poses"
            messages.append(f"repaired {_counted(int(bad.sum()), 'number')} of {name}")
            _mend(p, bad, 0.0, optimizer)  # 0 is no correction
    count = sum(_clear_moments(optimizer, p) for group in optimizer.param_groups for p in group["params"])
    if count:
        messages.append(f"cleared {_counted(count, 'moment')} of Adam")
    return ", ".join(messages)


@torch.no_grad()
def drop_offenders(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier) -> str:
    """Drops the Gaussians whose gradient was not finite in a skipped step, unless they are too many (`_FEW`). Returns a
    description for the user; empty if none was dropped."""
    names = {n: _bad_rows(p.grad) for n, p in model.gaussians.params.items() if p.grad is not None}
    if not names:
        return ""
    dropped = torch.stack(list(names.values())).any(0)
    if not 0 < int(dropped.sum()) <= max(1, int(_FEW * len(dropped))):
        return ""
    message = f"dropped {_counted(int(dropped.sum()), 'Gaussian')} (gradient of {_names(names)} not finite)"
    _drop(model, optimizer, densifier, dropped)
    return message


@torch.no_grad()
def drop_displaced(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, memory: FieldMemory
) -> int:
    """Drops the Gaussians that the field displaces too far at any of `MOMENTS` times. Returns their number."""
    rows = model.open_rows()
    dropped = torch.zeros(len(model.gaussians), dtype=torch.bool, device=model.device)
    for n in evenly_spaced(len(model.centres), MOMENTS):
        deltas = model.deltas(rows, model.centres[n : n + 1]) if len(rows) else None
        if deltas is not None:
            # The field moves them out of view except in the few frames that they fit. In a long run they came to a
            # tenth of all, and the field was restored again and again: `final` of `kitchen` 30.55 to 31.28 dB without
            # them.
            dropped[rows] |= memory.is_too_far(deltas.means)
    count = int(dropped.sum())
    if count:
        _drop(model, optimizer, densifier, dropped)
    return count


def _sound(model: DynamicModel, optimizer: torch.optim.Optimizer) -> bool:
    params = [p for group in optimizer.param_groups for p in group["params"]]
    moments = [value for p in params for key, value in optimizer.state.get(p, {}).items() if key in _MOMENTS]
    values = [t for t in [*params, *moments] if t.numel()]
    turned = (model.gaussians.params["quats"].abs().amax(1) > QUAT_MIN).all()
    if all(t.device.type == "cpu" for t in values):
        return bool(turned) and all_finite(values)
    # The infinity norm propagates NaN and infinity, in one pass and without copies.
    return bool(torch.isfinite(torch.nn.utils.get_total_norm(values, math.inf)) & turned)


def _repair_gaussians(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, step: int
) -> list[str]:
    messages: list[str] = []
    params = model.gaussians.params
    names = {name: _bad_rows(params[name]) for name in PARAM_NAMES}
    dropped = torch.stack(list(names.values())).any(0)
    count = int(dropped.sum())
    if 2 * count > len(dropped):
        raise unstable(step)
    if count:
        # Neighbours and the next densification fill the hole.
        messages.append(f"dropped {_counted(count, 'Gaussian')} ({_names(names)} not finite)")
        _drop(model, optimizer, densifier, dropped)
        params = model.gaussians.params
    # The rasteriser culls a Gaussian whose quaternion has no length, so no gradient would repair it.
    flat = params["quats"].abs().amax(1) <= QUAT_MIN
    if bool(flat.any()):
        messages.append(f"repaired {_counted(int(flat.sum()), 'Gaussian')} (quats without length)")
        identity = params["quats"].new_tensor([1.0, 0.0, 0.0, 0.0])
        _mend(params["quats"], flat[:, None].expand(-1, 4), identity.expand(len(flat), 4), optimizer)
    host_params: Mapping[str, Owned] = {} if model.field is None else model.field.owned
    for name, owned in host_params.items():
        rows = _bad_rows(params[name])
        if bool(rows.any()):
            messages.append(f"repaired {_counted(int(rows.sum()), 'Gaussian')} ({name} not finite)")
            _mend(params[name], ~torch.isfinite(params[name]), owned.value, optimizer)
    return messages


def _drop(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, dropped: Tensor) -> None:
    rows = torch.nonzero(~dropped).flatten()
    model.gaussians.rebuild(rows, torch.zeros_like(rows, dtype=torch.bool), optimizer)
    densifier.gradient, densifier.seen = densifier.gradient[rows], densifier.seen[rows]


def _mend(p: Tensor, mask: Tensor, value: float | Tensor, optimizer: torch.optim.Optimizer) -> None:
    """Sets `p` to `value`, and Adam's moments to 0, where `mask` (same shape as `p`) is set."""
    p.copy_(torch.where(mask, value, p))
    for key in _MOMENTS:
        if key in optimizer.state.get(p, {}):
            optimizer.state[p][key][mask] = 0.0


def _clear_moments(optimizer: torch.optim.Optimizer, p: Tensor) -> int:
    """Sets both moments to 0 where one of them is not finite; returns the number of values."""
    moments = [value for key, value in optimizer.state.get(p, {}).items() if key in _MOMENTS]
    if not moments:
        return 0
    bad = torch.stack([~torch.isfinite(value) for value in moments]).any(0)
    for value in moments:
        value[bad] = 0.0
    return int(bad.sum())


def _bad_rows(values: Tensor) -> Tensor:
    """bool [N] rows of `values` [N, ...] with a value that is not finite."""
    return ~torch.isfinite(values.detach()).reshape(len(values), math.prod(values.shape[1:])).all(1)


def _names(bad: dict[str, Tensor]) -> str:
    return ", ".join(name for name, rows in bad.items() if bool(rows.any()))


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
