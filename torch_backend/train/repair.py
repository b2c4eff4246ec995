"""Repairs of a run: what is not finite is dropped or mended between steps, named in a warning, and training goes on.

A step that is not finite changes nothing (`FusedAdam`), and the rasteriser culls what is not finite; so one bad number
does no harm at once. But it stays: a NaN in an opacity leaves out every further step, and one in a position is never
seen again in any loss. So

- a Gaussian with a parameter that is not finite is dropped: its neighbours and the next round of growth fill the hole;
- a quaternion without length, whose Gaussian is culled and gets no gradient, becomes the identity;
- a number of a host's own per Gaussian becomes what a new Gaussian starts with;
- a number of the field becomes what it was when the field was last seen in order; where that is not known, the median
  of its tensor: 0 among weights, the neutral 1 in planes of time, a usual radius among radii;
- a number of the exposure or the poses becomes 0, which is no correction;
- a field that throws what it moves out of its place goes back to what it was as a whole, at half the learning rates: a
  Gaussian outside the picture gets no gradient that would bring it back;
- Gaussians that a sound field throws out of place are dropped at every round of growth. The field hides them so from
  all frames but the few that they fit; in a long run they would become the tenth for which the field is reset, again
  and again;
- Adam's moments start at 0 wherever a number was mended, and wherever they are not finite themselves.

What would leave less than half of the Gaussians is no repair: the run ends in words.
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

_FEW = 0.01
"""Share of the Gaussians up to which a gradient that is not finite is their own fault, and not the frame's or field's.
"""
_THROWN = 0.1
"""Share of the moving Gaussians that a field in order may throw at any instant..."""
_FAR, _LEAST_FAR = 6.0, 1.0
"""...by more than this many times their median distance from their middle, and scene units, or than the scene's extent:
somebody may walk as far as what moves reaches, and an apple swing by many times its own size. In a healthy run of a
preview the upper tenth moves by at most 0.05 of that distance; one that came apart threw it hundreds of times as far
at some instants, and that extent, in which far background counts, was no bound (docs/decisions.md)."""
_MOMENTS = ("exp_avg", "exp_avg_sq")
_STATE = "memory."
"""What its names in a checkpoint begin with."""


def unstable(step: int) -> JobError:
    """What is said when a run cannot go on."""
    return JobError(
        f"Training became unstable at step {step} (the loss, its gradient or the model is not finite).",
        "The last good checkpoint is kept; train again with a smaller width or another seed.",
        ExitCode.TRAIN,
    )


class FieldMemory:
    """A field's parameters as they were when it was last seen in order, and the time before, on its device.

    Between two looks it heeds every step: a field that comes apart does so at some instants first, and a look sees the
    last step's instant alone. Only good for as long as the field has the same nodes and box: `keep` it anew when they
    change.
    """

    def __init__(self, extent: float, device: torch.device) -> None:
        self.extent = extent
        """Of the scene, in its units: farther than this is always out of place."""
        self._kept: list[dict[str, Tensor]] = []  # the newest last
        # They stay where they lie: a recorded step reads the one and writes the other (`recorder`).
        self._reach = torch.full((), math.inf, device=device)
        self._worst = torch.zeros((), device=device)
        self.rates = 1.0
        """Share of the learning rates it began with that a field has after it was put back."""

    @torch.no_grad()
    def keep(self, field: Deformation | None, means: Tensor) -> None:
        """Copies the parameters of a field that is in order, and takes measure of what it moves, means [M, 3]."""
        named = {} if field is None else dict(field.named_parameters())
        if not self._kept or {n: p.shape for n, p in named.items()} != {n: p.shape for n, p in self._kept[-1].items()}:
            # Both at once: what a card holds later does not grow by them.
            self._kept = [{name: p.detach().clone() for name, p in named.items()} for _ in range(2)]
        else:
            self._kept.append(self._kept.pop(0))
            for name, p in named.items():
                self._kept[-1][name].copy_(p)
        self._worst.zero_()
        self._reach.fill_(math.inf)
        if len(means):
            around = norm(means - means.median(0).values, 1).median()
            self._reach.copy_((_FAR * around).clamp(min(_LEAST_FAR, self.extent), self.extent))

    def state(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint: with them a run that was resumed puts back and drops what an unbroken one does."""
        kept = {f"{_STATE}kept.{n}.{name}": p for n, one in enumerate(self._kept) for name, p in one.items()}
        return {f"{_STATE}reach": self._reach, f"{_STATE}worst": self._worst, **kept}

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `state` told."""
        own = {name.removeprefix(_STATE): t for name, t in tensors.items() if name.startswith(_STATE)}
        self._reach.copy_(own["reach"])
        self._worst.copy_(own["worst"])
        device, kept = self._reach.device, [f"kept.{n}." for n in range(2)]
        found = [
            {name.removeprefix(start): t.to(device, copy=True) for name, t in own.items() if name.startswith(start)}
            for start in kept
        ]
        self._kept = found if any(found) else []

    @torch.no_grad()
    def heed(self, shift: Tensor) -> None:
        """A step's `shift` [M, 3] of the means it moves, scene units; what is not finite is for `repair`."""
        if len(shift):
            self._worst.copy_(torch.maximum(self._worst, self.thrown(shift).float().mean()))

    def thrown(self, shift: Tensor) -> Tensor:
        """bool [M]: Gaussians that the field moves out of place, by `shift` [M, 3] in scene units."""
        return shift.abs().amax(1) > self._reach

    def of(self, name: str, p: Tensor) -> Tensor | None:
        """What parameter `name` was; None if not known."""
        kept = self._kept[-1].get(name) if self._kept else None
        return kept if kept is not None and kept.shape == p.shape else None

    @torch.no_grad()
    def put_back(self, field: Deformation, optimizer: torch.optim.Optimizer) -> str:
        """Puts the field back if at some step since the last look it threw too much of what it moves too far.

        It goes back to the look before the last: what was kept last may have begun to come apart. Halves the learning
        rates of what the field owns. Returns what was done, in words.
        """
        if not self._kept:
            return ""
        worst = float(self._worst)
        self._worst.zero_()
        if not worst > _THROWN:
            return ""
        named, before = dict(field.named_parameters()), self._kept[0]
        if {n: p.shape for n, p in named.items()} != {n: p.shape for n, p in before.items()}:
            return ""
        self.rates *= 0.5
        for name, p in named.items():
            p.copy_(before[name])
            self._kept[1][name].copy_(p)
            optimizer.state.pop(p, None)
        owned = {id(p) for p in named.values()}
        for group in optimizer.param_groups:
            if any(id(p) in owned for p in group["params"]):
                group["lr_start"], group["lr_end"] = 0.5 * group["lr_start"], 0.5 * group["lr_end"]
        share = f"{100.0 * worst:.0f} % of what moves"
        return f"put the field back to what it was, at half the learning rates ({share} was thrown out of its place)"


@torch.no_grad()
def repair(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, memory: FieldMemory, step: int
) -> str:
    """Drops or mends what is not finite in the model and in Adam's moments.

    Returns what was done, in words; nothing if all was sound (asked on the device, one answer read back). JobError if
    too few Gaussians are left.
    """
    if _sound(model, optimizer):
        return ""
    messages = _repair_gaussians(model, optimizer, densifier, step)
    named = {} if model.field is None else dict(model.field.named_parameters())
    for name, p in named.items():
        bad, before = ~torch.isfinite(p), memory.of(name, p)
        if bool(bad.any()):
            sound = p[~bad]
            messages.append(f"mended {_counted(int(bad.sum()), 'number')} of {name}")
            _mend(p, bad, before if before is not None else sound.median() if len(sound) else 0.0, optimizer)
    known = {id(p) for p in (*model.gaussians.params.values(), *named.values())}
    for group in optimizer.param_groups:
        for p in (p for p in group["params"] if id(p) not in known and not bool(torch.isfinite(p).all())):
            bad = ~torch.isfinite(p)
            name = "exposure" if p is model.exposure.values else "the poses"
            messages.append(f"mended {_counted(int(bad.sum()), 'number')} of {name}")
            _mend(p, bad, 0.0, optimizer)
    count = sum(_clear_moments(optimizer, p) for group in optimizer.param_groups for p in group["params"])
    if count:
        messages.append(f"cleared {_counted(count, 'moment')} of Adam")
    return ", ".join(messages)


@torch.no_grad()
def drop_offenders(model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier) -> str:
    """Drops the Gaussians whose own gradient was not finite in the step that was left out, in words; none if many."""
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
def drop_thrown(
    model: DynamicModel, optimizer: torch.optim.Optimizer, densifier: Densifier, memory: FieldMemory
) -> int:
    """Drops the Gaussians that the field throws out of their place at one of `MOMENTS` times; returns how many."""
    rows = model.open_rows()
    dropped = torch.zeros(len(model.gaussians), dtype=torch.bool, device=model.device)
    for n in evenly_spaced(len(model.centres), MOMENTS):
        deltas = model.deltas(rows, model.centres[n : n + 1]) if len(rows) else None
        if deltas is not None:
            dropped[rows] |= memory.thrown(deltas.means)
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
    # The norm of the largest number: NaN and infinity stay what they are, in one pass and without copies.
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
        messages.append(f"dropped {_counted(count, 'Gaussian')} ({_names(names)} not finite)")
        _drop(model, optimizer, densifier, dropped)
        params = model.gaussians.params
    flat = params["quats"].abs().amax(1) <= QUAT_MIN
    if bool(flat.any()):
        messages.append(f"mended {_counted(int(flat.sum()), 'Gaussian')} (quats without length)")
        identity = params["quats"].new_tensor([1.0, 0.0, 0.0, 0.0])
        _mend(params["quats"], flat[:, None].expand(-1, 4), identity.expand(len(flat), 4), optimizer)
    own: Mapping[str, Owned] = {} if model.field is None else model.field.owned
    for name, owned in own.items():
        rows = _bad_rows(params[name])
        if bool(rows.any()):
            messages.append(f"mended {_counted(int(rows.sum()), 'Gaussian')} ({name} not finite)")
            _mend(params[name], ~torch.isfinite(params[name]), owned.value, optimizer)
    return messages


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
