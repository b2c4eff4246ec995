"""Static baseline: closes Gaussians whose motion makes the frozen scene worse than a static scene.

A deformation field is trained to explain every frame at its own time. A frozen shot evaluates it where no loss
supervised it: at t*, from all other poses. For example, the field may fade the wall behind a person while she hides it.

The static baseline has the same Gaussians as the frozen scene, but its open Gaussians are at the mean of the times at
which they were seen. Both are compared with plate t*, and with the still pixels of other plates across the clip. A
Gaussian is closed (made static) if its motion raises the error of the other plates by more than it lowers the error of
plate t*. If the mattes show no motion at t* and the Gaussian only sways, a third of that increase is enough. A Gaussian
whose motion raises no error stays open.

For a Gaussian that moves farther than a sway, the advantage of the run at the plate's own time over the baseline is
subtracted from the error increase. Plate t* cannot judge objects that it sees from far away. For those, plates that see
them from near are compared on all pixels, and the run's advantage is always subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...gaussians.neighbours import nearest
from ...scene import Scene
from ...torch_types import from_numpy, norm
from ...train import LoadedRun
from ...train.model import gathered, render
from ...train.movers import mean_of
from ..frozen import FrozenGaussians, freeze_at
from ..views.reproject import project
from ..views.source_views import MARGIN, MovingOf
from ..views.working_plates import MEASURED_WIDTH, SEEN, VIEWS, WorkingPlates, showing, spread
from .undersampled import UNDERSAMPLED_RATIO


@dataclass(frozen=True)
class StaticBaselineConfig:
    """Parameters of the comparison of a frozen scene with its static baseline."""

    width: int = MEASURED_WIDTH
    """Largest width in pixels of the compared pictures; at most that of the working frames."""
    plates: int = VIEWS
    """Largest number of evenly spaced trained frames that are compared in addition to t*."""
    neighbours: int = 16
    """Number of nearest open Gaussians that are decided together."""
    doubted: float = 3.0
    """Factor by which the gain of plate t* must exceed the loss of the others for a Gaussian that only sways where the
    mattes are still at t*. The field also bends to an error of plate t*'s camera, for example at the edge of a desk."""
    sways: float = 4.0
    """Scene flow in pixels at width 640, from t* to a plate, above which a Gaussian counts as moving and not as
    swaying. The advantage of the run over the baseline at that plate's time is then subtracted. People who hold still
    sway by less, and their mean is as good."""
    nearer: float = 1.0 / UNDERSAMPLED_RATIO
    """Distance of a plate's camera, relative to that of t*'s, up to which the plate sees a Gaussian from near."""


def apply_static_baseline(
    run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int, moving: MovingOf,
    config: StaticBaselineConfig | None = None,
) -> FrozenGaussians:  # fmt: skip
    """A run's scene at t* in which Gaussians whose motion only does harm are closed.

    Args:
        frozen: the run's own Gaussians at t*, without appended ones.
        t_star: frame number. If it was not trained on, the nearest trained plates on either side replace plate t*.
        moving: motion mattes of the clip's frames.
    """
    config = config or StaticBaselineConfig()
    rows = run.model.open_rows()
    if not len(rows):
        return frozen
    plates = WorkingPlates(scene, config.width, moving, MARGIN, frozen.support.device)
    movers = (plates.moving_share(frozen, t_star) > 0.5).float()
    instant_frames = showing(run.train_frames, t_star)
    plate_frames = [frame for frame in spread(run.train_frames, config.plates) if frame not in instant_frames]
    candidates = rows[frozen.motion[rows] > 0.5]
    if not len(candidates):
        return frozen
    pair = _Pair(run, plates, frozen, with_still_means(run, frozen, candidates), candidates, movers, t_star, config)
    near = _nearest(frozen.state["means"][candidates], config.neighbours)
    # Decided with their neighbours: errors are noisy, and objects move as a whole.
    gain, harm = -pair.worse(instant_frames, near, still=False), pair.worse(plate_frames, near)
    least = torch.where((movers[candidates] > 0.5) | pair.moved, harm, config.doubted * harm)
    stays = (harm <= 0.0) | (gain > least)
    return frozen if bool(stays.all()) else with_still_means(run, frozen, candidates[~stays])


@torch.no_grad()
def with_still_means(run: LoadedRun, frozen: FrozenGaussians, rows: Tensor) -> FrozenGaussians:
    """A frozen scene in which `rows` [M] int64 of the run's Gaussians have their mean state and do not move."""
    mean, state = mean_of(run.model, rows), dict(frozen.state)
    for name, value in state.items():
        state[name] = value.index_copy(0, rows, mean[name])
    support, motion = (v.index_fill(0, rows, to) for v, to in ((frozen.support, 1.0), (frozen.motion, 0.0)))
    return replace(frozen, state=state, support=support, motion=motion)


class _Pair:
    """A frozen scene and its static baseline, which differ in `rows` [M].

    `movers` [N] is 1 for Gaussians on moving pixels of plate t*.
    """

    def __init__(
        self, run: LoadedRun, plates: WorkingPlates, frozen: FrozenGaussians, baseline: FrozenGaussians, rows: Tensor,
        movers: Tensor, t_star: int, config: StaticBaselineConfig,
    ) -> None:  # fmt: skip
        self.sways = config.sways * plates.width / 640
        """`StaticBaselineConfig.sways` in pixels of the compared plates."""
        places = frozen.state["means"][rows]
        self.from_near = config.nearer * norm(places - plates.centre(t_star), dim=-1)
        """[M] distance in scene units up to which a plate sees each of the rows from near."""
        self.run, self.plates, self.rows, self.scenes = run, plates, rows, (frozen, baseline)
        self.moved = torch.zeros(len(rows), dtype=torch.bool, device=movers.device)
        """bool [M]: True for Gaussians that move farther than a sway between t* and some compared plate."""
        self.marks = torch.stack([torch.zeros_like(movers).index_fill(0, rows, 1.0), movers], dim=1)

    def worse(self, frames: list[int], near: Tensor, still: bool = True) -> Tensor:
        """[M] per Gaussian: squared error of the scene minus that of the baseline over its pixels, mean over frames.

        A pixel's difference is divided among the Gaussians that contribute to it in either scene. Each Gaussian then
        gets the mean of its neighbours `near` [M, K].

        With `still`, only pixels that move neither in the frame nor in plate t* count, unless the frame sees the
        Gaussian from near. The run's advantage over the baseline at the frame's own time is subtracted for Gaussians
        that move farther than a sway or are seen from near.
        """
        sums, counts = torch.zeros(2, len(self.rows), device=self.marks.device)
        for frame in frames:
            worse, seen = self._attributed(frame, still).unbind(1)
            sees = seen[near].mean(1) > SEEN
            sums, counts = sums + torch.where(sees, worse[near].mean(1), 0.0), counts + sees
        return sums / counts.clamp_min(1.0)

    def _attributed(self, frame: int, still: bool) -> Tensor:
        """[M, 2] per row, in a frame: squared error of the scene minus that of the baseline, and visible pixels."""
        camera, plate = self.plates.camera(frame), self.plates.picture(frame)
        ignored = self.plates.ignored(frame)
        valid = torch.ones(plate.shape[:2], device=plate.device) > 0 if ignored is None else ~ignored
        renders = [self._render(scene, frame) for scene in self.scenes]
        scene_errors, baseline_errors = ((picture - plate).square().mean(-1) for picture, _ in renders)
        paint = (renders[0][1][..., 0] + renders[1][1][..., 0]).clamp_min(1e-2)
        masks = [valid]
        if still:
            rests = valid & (self.plates.matte(frame) < 0.5)
            for _, marks in renders:
                rests = rests & (marks[..., 1] < 0.1)
            masks.append(rests)
        run_gain = torch.zeros_like(scene_errors)
        then = freeze_at(self.run.model, self.plates.scene.time_of_frame(frame), 1.0) if still else None
        if then is not None:
            run_gain = (baseline_errors - (self._render(then, frame)[0] - plate).square().mean(-1)).clamp_min(0.0)
        stacked = torch.cat(
            [
                torch.stack(
                    [(scene_errors - baseline_errors) * mask / paint, mask.float(), run_gain * mask / paint], dim=-1
                )
                for mask in masks
            ],
            dim=-1,
        )
        first, second = (gathered(scene.state, *camera, stacked)[self.rows] for scene in self.scenes)
        sums = (first + second).reshape(len(self.rows), len(masks), 3)
        if then is None:
            return sums[:, 0, :2]
        near = norm(self.scenes[0].state["means"][self.rows] - self.plates.centre(frame), dim=-1) <= self.from_near
        # A face that is six pixels wide in plate t* matches it with its eyes in any position. Near plates judge it on
        # all pixels.
        sums = torch.where(near[:, None], sums[:, 0], sums[:, 1])
        moved = self._travel(then, frame) > self.sways
        self.moved |= moved & (sums[:, 1] > SEEN)
        # Mattes miss sways and whole arms. There the mean always fits better, although the plate shows another time.
        sums[:, 0] -= sums[:, 2] * (near | moved)
        return sums[:, :2]

    def _travel(self, then: FrozenGaussians, frame: int) -> Tensor:
        """[M] image motion of the rows from t* to a frame's own time, in pixels of that frame."""
        viewmat, K, _, _ = self.plates.camera(frame)
        pixels_now, pixels_then = (
            project(scene.state["means"][self.rows], viewmat, K)[0] for scene in (self.scenes[0], then)
        )
        return norm(pixels_now - pixels_then, dim=-1)

    @torch.no_grad()
    def _render(self, scene: FrozenGaussians, frame: int) -> tuple[Tensor, Tensor]:
        """(picture [H, W, 3] in 0..1, marks [H, W, 2]) of a scene from the camera of a frame, on a grey background."""
        grey = torch.tensor([0.5, 0.5, 0.5, 0.0, 0.0], device=self.marks.device)
        out = render(
            scene.state, scene.sh_degree, *self.plates.camera(frame), background=grey, colors=self.marks,
            with_contributions=False,
        )  # fmt: skip
        time = self.plates.scene.time_of_frame(frame)
        return self.run.model.exposure.apply(out.colors[0, ..., :3], time).clamp(0.0, 1.0), out.colors[0, ..., 3:]


def _nearest(means: Tensor, count: int) -> Tensor:
    """[M, K] int64: indices of the `count` nearest of means [M, 3] to each, including itself."""
    count = min(count, len(means))
    places = means.cpu().numpy()
    found = nearest(places, places, count)[1]
    return from_numpy(np.ascontiguousarray(found, np.int64)).to(means.device)
