"""The scene at t*: the run's field at that instant, and what is repaired of it, in this order.

1. Static baseline: what the field harms stands as it is on average.
2. Missing movers: what plate t* shows and the scene lacks is set where it stood.
3. Develop: the scene is fine-tuned as the static scene that it is.

A repair takes a scene and returns a scene of the same rows, with new ones behind them if it adds any; it writes into
neither. The first and the last ask: does plate t* gain, and do the other plates not lose? What that does not answer
with yes is left as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch

from ...scene import Scene
from ...train import LoadedRun
from ..frozen import FrozenGaussians
from ..views.source_views import MovingOf
from .develop import Check, DevelopConfig, develop
from .missing import MissingConfig, with_missing
from .static_baseline import StaticBaselineConfig, apply_static_baseline


@dataclass(frozen=True)
class Moment:
    """The instant that is made, and what there is to make it of."""

    run: LoadedRun
    """The trained run."""
    scene: Scene
    """The shot's cameras and frames."""
    t_star: int
    """Frame number at which time stands still."""
    moving: MovingOf
    """What moves in the clip's frames."""
    check: Check | None = None
    """Reports progress, and cancels."""


class Repair(Protocol):
    """One step from the run's field to the scene at t*."""

    @property
    def name(self) -> str:
        """Name of the step in records and debug pictures."""
        ...

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The repaired scene, of the same rows and those that it adds; `frozen` is not changed."""
        ...


@dataclass(frozen=True)
class StaticBaseline:
    """Closes what the field harms: see `static_baseline.py`."""

    config: StaticBaselineConfig = field(default_factory=StaticBaselineConfig)
    """How scene and baseline are compared."""
    name: str = "static baseline"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The scene with what harms it standing still."""
        return apply_static_baseline(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config)


@dataclass(frozen=True)
class Missing:
    """Adds what plate t* shows moving and the scene lacks: see `missing.py`."""

    config: MissingConfig = field(default_factory=MissingConfig)
    """How it is found and made."""
    name: str = "missing movers"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The scene with what it lacks behind its rows."""
        return with_missing(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config)


@dataclass(frozen=True)
class Develop:
    """Fine-tunes the scene on the plates: see `develop.py`."""

    config: DevelopConfig = field(default_factory=DevelopConfig)
    """How it is trained."""
    name: str = "develop"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The fine-tuned scene, which descends from `frozen`."""
        return develop(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config, moment.check)


def repairs(config: DevelopConfig) -> tuple[Repair, ...]:
    """All repairs, in their order."""
    return StaticBaseline(), Missing(), Develop(config)


def repaired(frozen: FrozenGaussians, moment: Moment, steps: Sequence[Repair]) -> FrozenGaussians:
    """The run's scene at t* after all steps; its `origin` says which of them changed each row last."""
    origin = torch.zeros(len(frozen.support), dtype=torch.uint8, device=frozen.support.device)
    for n, step in enumerate(steps):
        after = step.apply(frozen, moment)
        known = len(origin)
        origin = torch.cat([origin, origin.new_full((len(after.support) - known,), n + 1)])
        for name, value in after.state.items():
            if value is not frozen.state[name]:
                origin[:known][(value[:known] != frozen.state[name]).reshape(known, -1).any(1)] = n + 1
        frozen = after
    return replace(frozen, origin=origin)
