"""The scene at t*: the run's deformation field evaluated at that instant, then repaired in three steps.

1. Static baseline: Gaussians whose motion does harm get their mean state.
2. Missing movers: Gaussians are added for movers that plate t* shows and the scene lacks.
3. Develop: the scene is fine-tuned as a static scene.

A repair returns a new scene with the same rows, followed by the rows that it adds. It does not change its input. The
first and the last repair only keep changes that improve plate t* without making the other plates worse.
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
    """The instant to repair, and the data to repair it with."""

    run: LoadedRun
    """The trained run."""
    scene: Scene
    """The shot's cameras and frames."""
    t_star: int
    """Frame number of the frozen instant."""
    moving: MovingOf
    """Motion mattes of the clip's frames."""
    check: Check | None = None
    """Callback that reports progress and raises to cancel."""


class Repair(Protocol):
    """One step from the run's field to the scene at t*."""

    @property
    def name(self) -> str:
        """Name of the step in records and debug pictures."""
        ...

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The repaired scene: the same rows, followed by added ones. `frozen` is not changed."""
        ...


@dataclass(frozen=True)
class StaticBaseline:
    """Closes Gaussians whose motion does harm: see `static_baseline.py`."""

    config: StaticBaselineConfig = field(default_factory=StaticBaselineConfig)
    """Parameters of the comparison of scene and baseline."""
    name: str = "static baseline"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The scene in which Gaussians whose motion does harm are closed."""
        return apply_static_baseline(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config)


@dataclass(frozen=True)
class Missing:
    """Adds movers that plate t* shows and the scene lacks: see `missing.py`."""

    config: MissingConfig = field(default_factory=MissingConfig)
    """Parameters to find missing movers, and the size of their Gaussians."""
    name: str = "missing movers"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The scene with Gaussians of missing movers appended after its rows."""
        return with_missing(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config)


@dataclass(frozen=True)
class Develop:
    """Fine-tunes the scene on the plates: see `develop.py`."""

    config: DevelopConfig = field(default_factory=DevelopConfig)
    """Parameters of the fine-tuning."""
    name: str = "develop"
    """As in `Repair`."""

    def apply(self, frozen: FrozenGaussians, moment: Moment) -> FrozenGaussians:
        """The fine-tuned scene; its `descent` is `frozen`."""
        return develop(moment.run, moment.scene, frozen, moment.t_star, moment.moving, self.config, moment.check)


def repairs(config: DevelopConfig) -> tuple[Repair, ...]:
    """All repairs, in the order in which they are applied."""
    return StaticBaseline(), Missing(), Develop(config)


def repaired(frozen: FrozenGaussians, moment: Moment, steps: Sequence[Repair]) -> FrozenGaussians:
    """The run's scene at t* after all steps; its `origin` holds the number of the step that changed each row last."""
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
