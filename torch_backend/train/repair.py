"""Repairs of a run: what is not finite is dropped or mended between steps, named in a warning, and training goes on.

A step that is not finite changes nothing (`FusedAdam`), and the rasteriser culls what is not finite; so one bad number
does no harm at once. But it stays: a NaN in an opacity leaves out every further step, and one in a position is never
seen again in any loss (docs/numerics.md). Nothing good is known that could be put in its place, so

- a Gaussian with a parameter that is not finite is dropped: its neighbours and the next round of growth fill the hole;
- a quaternion without length, whose Gaussian is culled and gets no gradient, becomes the identity;
- a number of a host's own per Gaussian becomes what a new Gaussian starts with;
- a number of the field or of the exposure becomes the median of its tensor: 0 among weights, the neutral 1 in planes
  of time, a usual radius among radii;
- Adam's moments start at 0 wherever a number was mended, and wherever they are not finite themselves.

What would leave less than half of the Gaussians, or of the field's numbers, is no repair: the run ends in words.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..contract import ExitCode, JobError
from ..gaussians import PARAM_NAMES, Densifier
from ..raster.constants import QUAT_MIN
from .model import DynamicModel

_FEW = 0.01
"""Share of the Gaussians up to which a gradient that is not finite is their own fault, and not the frame's or field's.
"""
_MOMENTS = ("exp_avg", "exp_avg_sq")


def unstable(step: int) -> JobError:
    """What is said when a run cannot go on."""
    return JobError(
        f"Training became unstable at step {step} (the loss, its gradient or the model is not finite).",
        "The last good checkpoint is kept; train again with a smaller width or another seed.",
        ExitCode.TRAIN,
    )


@torch.no_grad()
def repair(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, step: int) -> str:
    """Drops or mends what is not finite in the model and in Adam's moments.

    Returns what was done, in words; nothing if all was sound (asked on the device, one answer read back). JobError if
    too little is left.
    """
    if _sound(model, optimizer):
        return ""
    said = _repair_gaussians(model, optimizer, densifier, step)
    rest = {} if model.field is None else dict(model.field.named_parameters())
    bad = {name: ~torch.isfinite(p) for name, p in rest.items()}
    if 2 * sum(int(mask.sum()) for mask in bad.values()) > sum(p.numel() for p in rest.values()):
        raise unstable(step)
    rest["exposure"] = model.exposure.values
    bad["exposure"] = ~torch.isfinite(model.exposure.values)
    for name, mask in bad.items():
        if bool(mask.any()):
            sound = rest[name][~mask]
            _mend(rest[name], mask, float(sound.median()) if len(sound) else 0.0, optimizer)
            said.append(f"mended {_counted(int(mask.sum()), 'number')} of {name}")
    count = sum(_clear_moments(optimizer, p) for group in optimizer.param_groups for p in group["params"])
    if count:
        said.append(f"cleared {_counted(count, 'moment')} of Adam")
    return ", ".join(said)


@torch.no_grad()
def drop_offenders(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier) -> str:
    """Drops the Gaussians whose own gradient was not finite in the step that was left out, in words; none if many."""
    names = {n: _bad_rows(p.grad) for n, p in model.gaussians.params.items() if p.grad is not None}
    if not names:
        return ""
    dropped = torch.stack(list(names.values())).any(0)
    if not 0 < int(dropped.sum()) <= max(1, int(_FEW * len(dropped))):
        return ""
    said = f"dropped {_counted(int(dropped.sum()), 'Gaussian')} (gradient of {_names(names)} not finite)"
    _drop(model, optimizer, densifier, dropped)
    return said


def _sound(model: DynamicModel, optimizer: torch.optim.Optimizer) -> bool:
    params = [p for group in optimizer.param_groups for p in group["params"]]
    moments = [value for p in params for key, value in optimizer.state.get(p, {}).items() if key in _MOMENTS]
    # The norm of the largest number: NaN and infinity stay what they are, in one pass and without copies.
    largest = torch.nn.utils.get_total_norm([t for t in [*params, *moments] if t.numel()], math.inf)
    turned = (model.gaussians.params["quats"].abs().amax(1) > QUAT_MIN).all()
    return bool(torch.isfinite(largest) & turned)


def _repair_gaussians(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, step: int
) -> list[str]:
    said, params = [], model.gaussians.params
    names = {name: _bad_rows(params[name]) for name in PARAM_NAMES}
    dropped = torch.stack(list(names.values())).any(0)
    count = int(dropped.sum())
    if 2 * count > len(dropped):
        raise unstable(step)
    if count:
        said.append(f"dropped {_counted(count, 'Gaussian')} ({_names(names)} not finite)")
        _drop(model, optimizer, densifier, dropped)
        params = model.gaussians.params
    flat = params["quats"].abs().amax(1) <= QUAT_MIN
    if bool(flat.any()):
        said.append(f"mended {_counted(int(flat.sum()), 'Gaussian')} (quats without length)")
        identity = params["quats"].new_tensor([1.0, 0.0, 0.0, 0.0])
        _mend(params["quats"], flat[:, None].expand(-1, 4), identity.expand(len(flat), 4), optimizer)
    for name, owned in ({} if model.field is None else model.field.owned).items():
        rows = _bad_rows(params[name])
        if bool(rows.any()):
            said.append(f"mended {_counted(int(rows.sum()), 'Gaussian')} ({name} not finite)")
            _mend(params[name], ~torch.isfinite(params[name]), owned.value, optimizer)
    return said


def _drop(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, dropped: Tensor) -> None:
    rows = torch.nonzero(~dropped).flatten()
    model.gaussians.rebuild(rows, torch.zeros_like(rows, dtype=torch.bool), optimizer)
    densifier.gradient, densifier.seen = densifier.gradient[rows], densifier.seen[rows]


def _mend(p: Tensor, mask: Tensor, value: float | Tensor, optimizer: torch.optim.Optimizer) -> None:
    """Puts `value` where `mask` [as p] is set, and starts Adam's moments anew there."""
    p.copy_(torch.where(mask, value, p))
    for key in _MOMENTS:
        if key in optimizer.state.get(p, {}):
            optimizer.state[p][key][mask] = 0.0


def _clear_moments(optimizer: torch.optim.Optimizer, p: Tensor) -> int:
    """Starts both moments anew where one is not finite; returns at how many numbers."""
    moments = [value for key, value in optimizer.state.get(p, {}).items() if key in _MOMENTS]
    if not moments:
        return 0
    bad = torch.stack([~torch.isfinite(value) for value in moments]).any(0)
    for value in moments:
        value[bad] = 0.0
    return int(bad.sum())


def _bad_rows(values: Tensor) -> Tensor:
    """bool [N]: rows of [N, ...] with a number that is not finite."""
    return ~torch.isfinite(values.detach()).reshape(len(values), math.prod(values.shape[1:])).all(1)


def _names(bad: dict[str, Tensor]) -> str:
    return ", ".join(name for name, rows in bad.items() if bool(rows.any()))


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
