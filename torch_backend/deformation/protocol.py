"""What a host of the method is: (means, times) -> deltas, with its own parameters, learning rates and regularisers.

A host stands in one file: a subclass of `Deformation`, a dataclass of its numbers, and a `HOST` that names both
(`registry.py` finds it).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..gaussians import PARAM_NAMES, Gaussians
from .geometry import near_identity, quat_product


class Deltas(NamedTuple):
    """Changes of M Gaussians at their times; None for what a host does not move.

    means [M, 3] scene units, quats [M, 4], log_scales [M, 3], opacity_logits [M], sh0 [M, 1, 3], shN [M, K - 1, 3].
    How they meet the canonical parameters is the host's `rules`; without a rule they are added.
    """

    means: Tensor
    quats: Tensor | None = None
    log_scales: Tensor | None = None
    opacity_logits: Tensor | None = None
    sh0: Tensor | None = None
    shN: Tensor | None = None  # noqa: N815 - the field's name

    def moved(self) -> dict[str, Tensor]:
        """Those that are there, by the name of the parameter they change."""
        return {name: delta for name, delta in self._asdict().items() if delta is not None}

    def detached(self) -> Deltas:
        """The same values without gradient."""
        deltas = (None if delta is None else delta.detach() for delta in self[1:])
        return Deltas(self.means.detach(), *deltas)


def split_deltas(deltas: Deltas, first: int) -> tuple[Deltas, Deltas]:
    """The deltas of the first `first` Gaussians, and of the others."""
    parts = [(None, None) if delta is None else (delta[:first], delta[first:]) for delta in deltas]
    return Deltas(*(part[0] for part in parts)), Deltas(*(part[1] for part in parts))  # type: ignore[arg-type]


Rule = Callable[[Tensor, Tensor], Tensor]
"""(canonical rows, their deltas) -> rows at the time."""

MIN_SCALE = 1e-5
"""Smallest standard deviation in scene units that `add_to_scale` leaves (the trainer's own limit)."""


def add_to_scale(log_scales: Tensor, delta: Tensor) -> Tensor:
    """log(exp(log_scales) + delta), the published rule of Deformable 3DGS and SC-GS.

    The sum can leave the domain; it is held at MIN_SCALE, where it passes no gradient.
    """
    return (log_scales.exp() + delta).clamp_min(MIN_SCALE).log()


def add_to_unit_quat(quats: Tensor, delta: Tensor) -> Tensor:
    """normalise(quats) + delta, Deformable 3DGS. Its rasteriser does not normalise the sum; ours does."""
    return F.normalize(quats, dim=1) + delta


def turn(quats: Tensor, delta: Tensor) -> Tensor:
    """The canonical rotation, then the one that `delta` says as a change from the identity quaternion."""
    return quat_product(near_identity(delta), F.normalize(quats, dim=1))


class Owned(NamedTuple):
    """A parameter per Gaussian that belongs to a host: what a row starts as, and its learning rates."""

    shape: tuple[int, ...]
    value: float
    lr: float
    lr_end: float


@dataclass
class HostConfig:
    """What every host's numbers say. Shares are of the run's length."""

    start: float = 1.0 / 3.0
    """Share of the run at which the field joins where all Gaussians move (behind the gate, the gate says when)."""
    detached: float = 0.0
    """Until this share the images move the Gaussians through the deformation, but not the field."""
    still: float = 1.0
    """Share of `support`'s price on motion (`supervision.stillness`) that the host's deltas pay."""

    def row_bytes(self) -> int:
        """Bytes that the deltas of one Gaussian hold on a GPU from the forward to the backward pass, results left out.
        A host says its own; this is that of ours with the most."""
        return 4800


@dataclass
class Start:
    """What a host is made from."""

    means: Tensor
    """[N, 3] canonical means of the Gaussians that it will move, scene units."""
    box: Tensor
    """[2, 3] robust bounds of them, with a margin."""
    points: Tensor
    """[P, 3] the solve's points."""
    frames: int
    """How many frames are trained."""
    harmonics: int
    """K - 1, how many SH bases beyond the constant one a Gaussian has."""
    generator: torch.Generator
    """Source of every random draw."""
    time_nodes: Callable[[], int] = lambda: 0
    """How many nodes a time axis needs for what these Gaussians do; 0: it cannot be told. Renders dozens of frames to
    find out, so only a host that has such an axis should ask."""


@dataclass
class Rehearsal:
    """What a host's pre-stage trains with, before the run's own steps."""

    points: Tensor
    """[P, 3] where to start."""
    colors: Tensor
    """[P, 3] display-referred colours of the points."""
    times: list[float]
    """Normalised times of the training frames."""
    steps: int
    """How many steps to take."""
    loss: Callable[[dict[str, Tensor], int], Tensor]
    """(parameters of a set of Gaussians at the frame's time, SH degree 0; frame) -> photometric loss."""
    generator: torch.Generator
    """Source of every random draw."""


class Deformation(nn.Module):
    """A host of the method. `config` is its dataclass of numbers. Ours never move means through the field."""

    config: Any
    rules: Mapping[str, Rule]
    """How deltas meet canonical parameters, by parameter; what is not named is added."""
    owned: Mapping[str, Owned]
    """Parameters per Gaussian that belong to the host, by name; calls get their rows as `own`."""

    def __init__(self) -> None:
        super().__init__()
        self.rules, self.owned = {}, {}

    def forward(self, means: Tensor, times: Tensor, own: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians: canonical means [M, 3] in scene units, times [M] or [1] in [0, 1], owned rows."""
        raise NotImplementedError

    def training_time(self, time: float, progress: float, generator: torch.Generator) -> float:
        """The time at which a training frame of `time` is to be asked for; all Gaussians share a draw."""
        return time

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Optimiser groups: params, lr (start), lr_end, name; the rate falls between the shares `since` and `until`."""
        raise NotImplementedError

    def regularisation(self, progress: float = 1.0, generator: torch.Generator | None = None) -> Tensor:
        """Scalar that keeps the field plausible, already weighted; `progress` is the share of the run that is done."""
        return next(self.parameters()).new_zeros(())

    def rehearse(self, stage: Rehearsal) -> None:
        """The host's pre-stage, `rehearsal` of the run's steps long. Only hosts with `rehearsal` > 0 are asked."""
        raise NotImplementedError

    @property
    def apart(self) -> bool:
        """On a GPU many Gaussians at one time and a few at others are cheaper in two calls than in one."""
        return False

    @property
    def recordable(self) -> bool:
        """Is a step's work the same at every step, but for the numbers it is told, and does it ask a GPU nothing? Then
        it is recorded, and launched at once (`train.recorder`)."""
        return False

    @property
    def rehearsal(self) -> float:
        """Share of the run that the pre-stage takes; 0: there is none."""
        return 0.0

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint, names starting with `field.`."""
        return {f"field.{name}": value.detach() for name, value in self.state_dict().items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `state`; RuntimeError names what does not fit."""
        self.load_state_dict({k.removeprefix("field."): v for k, v in tensors.items() if k.startswith("field.")})


@dataclass(frozen=True)
class HostSpec:
    """A host as `registry.py` finds it: a module's `HOST`."""

    name: str
    """What the command line and config.json call it."""
    settings: type
    """Dataclass of its numbers, a HostConfig; the defaults are our configuration."""
    reference: Callable[[int], Any]
    """Iterations of the run -> the published numbers, schedules as shares of the run."""
    create: Callable[[Any, Start], Deformation]
    """A new field from its numbers."""
    restore: Callable[[Any, dict[str, Tensor]], Deformation]
    """The field of a checkpoint, from its numbers and the checkpoint's tensors."""
    warm_up: Callable[[Any], None] = lambda settings: None
    """Compiles, from the main thread of a run on the CPU, what a field of these numbers will call."""


def field_box(means: Tensor) -> Tensor:
    """Box [2, 3] that a field should resolve for the Gaussians means [M, 3]: robust bounds and a margin."""
    low, high = np.quantile(means.cpu().numpy(), (0.01, 0.99), axis=0)
    low, high = (torch.as_tensor(bound, dtype=torch.float32, device=means.device) for bound in (low, high))
    margin = 0.15 * (high - low).clamp_min(1e-2)
    return torch.stack([low - margin, high + margin])


def rate_scale(published: int, iterations: int) -> float:
    """Factor on a grid's published learning rates in a run shorter than the published one: the root of the ratio.

    Adam moves a parameter by about a rate per step: in a short run at the rates of a long one a grid ends far from
    where that one does, and a comparison would flatter ours. At least 1.
    """
    return max(1.0, published / iterations) ** 0.5


def apply_deltas(
    model: Gaussians,
    rows: Tensor,
    deltas: Deltas | None,
    rules: Mapping[str, Rule] | None = None,
    canonical: bool = True,
) -> dict[str, Tensor]:
    """The model's parameters with `deltas` met at `rows` [M] by a host's `rules`; without deltas the canonical ones.

    canonical: whether gradients reach the canonical parameters; if not, they reach the deltas alone.
    """
    state: dict[str, Tensor] = {n: model.params[n] if canonical else model.params[n].detach() for n in PARAM_NAMES}
    if deltas is None or len(rows) == 0:
        return state
    # Indexing costs ten times the sum; where all move there is nothing to index. A GPU would have to be asked.
    whole = len(rows) == len(model) and rows.device.type == "cpu" and bool((rows[1:] > rows[:-1]).all())
    for name, delta in deltas.moved().items():
        rule = (rules or {}).get(name)
        if whole:
            state[name] = state[name] + delta if rule is None else rule(state[name], delta)
        elif rule is None:
            state[name] = state[name].index_add(0, rows, delta)
        else:
            state[name] = state[name].index_copy(0, rows, rule(state[name][rows], delta))
    return state
