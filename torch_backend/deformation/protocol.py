"""Protocol of a host, a deformation model (means, times) -> deltas with parameters, learning rates and regularisers.

A host is one file with a subclass of `Deformation`, a dataclass of its configuration, and a `HOST` that refers to both
(found by `registry.py`).
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
    """Changes of M Gaussians at their times; None for parameters that a host does not change.

    means [M, 3] in scene units, quats [M, 4], log_scales [M, 3], opacity_logits [M], sh0 [M, 1, 3], shN [M, K - 1, 3].
    The host's `rules` combine deltas with canonical parameters; without a rule, they are added.
    """

    means: Tensor
    quats: Tensor | None = None
    log_scales: Tensor | None = None
    opacity_logits: Tensor | None = None
    sh0: Tensor | None = None
    shN: Tensor | None = None  # noqa: N815 - the field's name

    def moved(self) -> dict[str, Tensor]:
        """All deltas that are not None, by parameter name."""
        return {name: delta for name, delta in self._asdict().items() if delta is not None}

    def detached(self) -> Deltas:
        """The same values without gradient."""
        deltas = (None if delta is None else delta.detach() for delta in self[1:])
        return Deltas(self.means.detach(), *deltas)


def split_deltas(deltas: Deltas, first: int) -> tuple[Deltas, Deltas]:
    """(deltas of the first `first` Gaussians, deltas of the others)."""
    parts = [(None, None) if delta is None else (delta[:first], delta[first:]) for delta in deltas]
    return Deltas(*(part[0] for part in parts)), Deltas(*(part[1] for part in parts))  # type: ignore[arg-type]


Rule = Callable[[Tensor, Tensor], Tensor]
"""Function (canonical values, deltas) -> deformed values."""

MIN_SCALE = 1e-5
"""Smallest standard deviation in scene units that `add_to_scale` returns, equal to the trainer's limit."""


def add_to_scale(log_scales: Tensor, delta: Tensor) -> Tensor:
    """log(exp(log_scales) + delta), at least log(MIN_SCALE), the published rule of Deformable 3DGS and SC-GS."""
    # The sum can be negative, which has no logarithm.
    return (log_scales.exp() + delta).clamp_min(MIN_SCALE).log()


def add_to_unit_quat(quats: Tensor, delta: Tensor) -> Tensor:
    """normalise(quats) + delta, as in Deformable 3DGS, whose rasteriser (unlike ours) does not normalise the sum."""
    return F.normalize(quats, dim=1) + delta


def turn(quats: Tensor, delta: Tensor) -> Tensor:
    """Canonical rotation, followed by the rotation of the normalised quaternion identity + `delta`."""
    return quat_product(near_identity(delta), F.normalize(quats, dim=1))


class Owned(NamedTuple):
    """Parameter per Gaussian that belongs to a host: shape and initial value of a row, and learning rates."""

    shape: tuple[int, ...]
    value: float
    lr: float
    lr_end: float


@dataclass
class HostConfig:
    """Settings that all hosts have. Shares are of the run's length."""

    start: float = 1.0 / 3.0
    """Share of the run at which the field is created if all Gaussians move. With the gate, the gate decides."""
    detached: float = 0.0
    """Share of the run until which the photometric loss trains the deformed Gaussians, but not the field."""
    still: float = 1.0
    """Factor of the price of motion (`supervision.stillness`) for this host's deltas."""

    def row_bytes(self) -> int:
        """Bytes per Gaussian that the field keeps on a GPU from forward to backward pass, without its outputs. Hosts
        override it; the default is the largest value of our hosts."""
        return 4800


@dataclass
class Start:
    """Inputs for the creation of a host's field."""

    means: Tensor
    """[N, 3] canonical means, in scene units, of the Gaussians that the field will move."""
    box: Tensor
    """[2, 3] robust bounds of those means, with a margin."""
    points: Tensor
    """[P, 3] points of the solve."""
    frames: int
    """Number of training frames."""
    harmonics: int
    """Number K - 1 of SH bases of a Gaussian beyond the constant one."""
    generator: torch.Generator
    """Random number generator of the run."""
    time_nodes: Callable[[], int] = lambda: 0
    """Returns the number of nodes that a time axis needs for the motion of these Gaussians; 0: unknown. It renders
    dozens of frames, so only a host with such an axis should call it."""


@dataclass
class Rehearsal:
    """Inputs of a host's pre-training, before the run's own steps."""

    points: Tensor
    """[P, 3] initial points."""
    colors: Tensor
    """[P, 3] display-referred colours of the points."""
    times: list[float]
    """Normalised times of the training frames."""
    steps: int
    """Number of steps."""
    loss: Callable[[dict[str, Tensor], int], Tensor]
    """Function (parameters of Gaussians at the frame's time, with SH degree 0; frame) -> photometric loss."""
    generator: torch.Generator
    """Random number generator of the run."""


class Deformation(nn.Module):
    """Deformation field of a host; `config` is its configuration.

    No gradient reaches the means through a field, except with HexPlane's option `published`.
    """

    config: Any
    rules: Mapping[str, Rule]
    """Rules that combine deltas with canonical parameters, by parameter name; others are added."""
    owned: Mapping[str, Owned]
    """Parameters per Gaussian that belong to the host, by name; calls receive their rows as `host_params`."""

    def __init__(self) -> None:
        super().__init__()
        self.rules, self.owned = {}, {}

    def forward(self, means: Tensor, times: Tensor, host_params: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians: canonical means [M, 3] in scene units, times [M] or [1] in [0, 1], owned rows."""
        raise NotImplementedError

    def training_time(self, time: float, progress: float, generator: torch.Generator) -> float:
        """Time at which the field is evaluated to train a frame of `time`; hosts may add noise to it."""
        return time

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Optimiser groups with params, lr (initial), lr_end, name, and the shares `since` and `until` of the decay."""
        raise NotImplementedError

    def regularisation(self, progress: float = 1.0, generator: torch.Generator | None = None) -> Tensor:
        """Weighted regularisation loss of the field, 0-dim; `progress` is the share of the run that is done."""
        return next(self.parameters()).new_zeros(())

    def rehearse(self, stage: Rehearsal) -> None:
        """Runs the host's pre-training. Only called for hosts with `rehearsal` > 0."""
        raise NotImplementedError

    @property
    def has_separate_calls(self) -> bool:
        """True if, on a GPU, many Gaussians at one time and few at other times are cheaper in two calls than in one."""
        return False

    @property
    def recordable(self) -> bool:
        """True if the field runs the same operations at every step and reads nothing back from a GPU. Steps are then
        recorded as CUDA graphs (`train.recorder`)."""
        return False

    @property
    def rehearsal(self) -> float:
        """Share of the run for pre-training; 0: none."""
        return 0.0

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint, names starting with `field.`."""
        return {f"field.{name}": value.detach() for name, value in self.state_dict().items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `state`. RuntimeError names tensors that do not fit."""
        self.load_state_dict({k.removeprefix("field."): v for k, v in tensors.items() if k.startswith("field.")})


@dataclass(frozen=True)
class HostSpec:
    """Description of a host. `registry.py` finds it as `HOST` of a module."""

    name: str
    """Name on the command line and in config.json."""
    settings: type
    """Class of its configuration, a HostConfig whose defaults are our configuration."""
    reference: Callable[[int], Any]
    """Function (iterations of the run) -> published configuration, with schedules as shares of the run."""
    create: Callable[[Any, Start], Deformation]
    """Creates a new field from a configuration."""
    restore: Callable[[Any, dict[str, Tensor]], Deformation]
    """Restores the field of a checkpoint from a configuration and the checkpoint's tensors."""
    warm_up: Callable[[Any], None] = lambda settings: None
    """Compiles the CPU kernels that a field with this configuration uses. Call it from the main thread."""


def field_box(means: Tensor) -> Tensor:
    """Bounds [2, 3] that a field should resolve for means [M, 3]: 1 % and 99 % quantiles with a margin."""
    # A few background Gaussians would enlarge the box, while most open ones are near.
    low, high = np.quantile(means.cpu().numpy(), (0.01, 0.99), axis=0)
    low, high = (torch.as_tensor(bound, dtype=torch.float32, device=means.device) for bound in (low, high))
    margin = 0.15 * (high - low).clamp_min(1e-2)
    return torch.stack([low - margin, high + margin])


def rate_scale(published: int, iterations: int) -> float:
    """Factor of a grid's published learning rates in a shorter run: the root of published / iterations, at least 1."""
    # Adam changes a parameter by about the learning rate per step. Unscaled, a grid would change too little in a short
    # run, and a comparison would favour our configuration.
    return max(1.0, published / iterations) ** 0.5


def apply_deltas(
    model: Gaussians,
    rows: Tensor,
    deltas: Deltas | None,
    rules: Mapping[str, Rule] | None = None,
    canonical: bool = True,
) -> dict[str, Tensor]:
    """The model's parameters after applying `deltas` to `rows` [M] by a host's `rules`; without deltas, the canonical
    parameters. canonical: whether gradients reach the canonical parameters, not only the deltas.
    """
    state: dict[str, Tensor] = {n: model.params[n] if canonical else model.params[n].detach() for n in PARAM_NAMES}
    if deltas is None or len(rows) == 0:
        return state
    # Indexing takes ten times as long as the sum, and is skipped if all rows move. On a GPU the test would synchronise.
    moves_all = len(rows) == len(model) and rows.device.type == "cpu" and bool((rows[1:] > rows[:-1]).all())
    for name, delta in deltas.moved().items():
        rule = (rules or {}).get(name)
        if moves_all:
            state[name] = state[name] + delta if rule is None else rule(state[name], delta)
        elif rule is None:
            state[name] = state[name].index_add(0, rows, delta)
        else:
            state[name] = state[name].index_copy(0, rows, rule(state[name][rows], delta))
    return state
