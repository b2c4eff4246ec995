"""Scene flow: moves the Gaussians of a frozen scene to the clip's other frames with the run's deformation field."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ...gaussians.model import PARAM_NAMES
from ...scene import Scene
from ...train import LoadedRun
from ..frozen import FrozenGaussians, freeze_at

HIDDEN = -20.0
"""Opacity logit that makes a Gaussian invisible."""
# Number of frames whose changes are cached: about 3 MB each for 25,000 open Gaussians.
_KEPT = 90


class SceneFlow:
    """Scene flow from a scene frozen at t* to the clip's frames.

    Gaussians that were closed at t* (`static_baseline.py`) do not move. The run's own Gaussians come first in the
    scene. Gaussians appended after them (`missing.py`) are only visible at t*.
    """

    def __init__(self, run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int) -> None:
        self.run, self.scene = run, scene
        rows = run.model.open_rows()
        self.rows = rows[frozen.motion[rows] > 0.5]
        """[M] int64, rows of the run's Gaussians that move."""
        self.t_star = t_star
        """Frame number."""
        self._known = len(run.model.gaussians)
        self._changes: dict[int, dict[str, Tensor]] = {}
        self._at_t_star = self._field(t_star)

    def moved(self, state: dict[str, Tensor], frame: int) -> dict[str, Tensor]:
        """The frozen or developed `state`, moved to a frame; differentiable."""
        moved = dict(state)
        if frame == self.t_star:
            return moved
        if len(self.rows):
            change = self._change(frame)
            moved = {name: value.index_add(0, self.rows, change[name]) for name, value in moved.items()}
        if len(moved["means"]) > self._known:
            opacity = moved["opacity_logits"]
            is_run_row = torch.arange(len(opacity), device=opacity.device) < self._known
            moved["opacity_logits"] = torch.where(is_run_row, opacity, HIDDEN)
        return moved

    @torch.no_grad()
    def _change(self, frame: int) -> dict[str, Tensor]:
        """Change of the deltas from t* to a frame, for the rows that move."""
        if frame not in self._changes:
            then, now = self._field(frame), self._at_t_star
            self._changes[frame] = {name: then[name] - now[name] for name in PARAM_NAMES}
            while len(self._changes) > _KEPT:
                del self._changes[next(iter(self._changes))]
        return self._changes[frame]

    @torch.no_grad()
    def _field(self, frame: int) -> dict[str, Tensor]:
        state = freeze_at(self.run.model, self.scene.time_of_frame(frame), 1.0).state
        return {name: state[name][self.rows] for name in PARAM_NAMES}


class MovingScene:
    """The scene in every frame of the clip: the run's scene, or a developed instant moved by scene flow."""

    def __init__(
        self, run: LoadedRun, scene: Scene, frozen: FrozenGaussians | None = None, t_star: int | None = None
    ) -> None:
        """`frozen` is the scene at frame `t_star`. If it is None or not developed, the run's scene is used."""
        self.run, self.scene, self.developed = run, scene, None
        self.rows = run.model.open_rows()
        """[M] int64, rows of the scene's Gaussians that move."""
        self._travel = None
        if frozen is not None and frozen.descent is not None:
            assert t_star is not None
            self.developed, self._travel = frozen, SceneFlow(run, scene, frozen.descent, t_star)
            self.rows = self._travel.rows

    def at(self, frame: int) -> FrozenGaussians:
        """The scene in a frame."""
        if self.developed is None or self._travel is None:
            return freeze_at(self.run.model, self.scene.time_of_frame(frame), 1.0)
        return replace(self.developed, state=self._travel.moved(self.developed.state, frame))
