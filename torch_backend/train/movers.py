"""Moving pixels by the shot's motion mattes, and the gate's decisions based on them.

Without mattes, the gate uses a photometric trial alone.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..deformation import Deltas, GateConfig, change_of, painted, stays_open
from ..motion.mattes import MOVING
from ..scene import Scene, evenly_spaced
from ..supervision.support import SEEN_WEIGHT
from ..torch_types import from_numpy
from .model import DynamicModel, gathered
from .run_view import RunView

MOMENTS = 16
"""Number of times and cameras at which a Gaussian's motion is sampled."""
# Moving share of a training pixel above which the pixel counts as moving; edges of mattes are off by about a pixel.
_COVERED = 0.25

Mattes = Callable[[int], NDArray[np.uint8] | None]
"""Frame number -> motion matte [h, w] uint8 (0 still, 128 unknown, 255 moving); None without a matte."""


def load_movers(mattes: Mattes, scene: Scene, indices: list[int], width: int, height: int) -> Tensor | None:
    """bool [I, height, width] moving pixels in frames `indices` of the scene; None if no frame has a matte.

    A frame without a matte has no moving pixels. JobError if a matte is damaged.
    """
    movers, found = torch.zeros(len(indices), height, width, dtype=torch.bool, device="cpu"), False
    for n, index in enumerate(indices):
        matte = mattes(scene.frames[index])
        if matte is not None:
            found = True
            # Unknown pixels (128) count as still.
            moving = np.asarray(matte == MOVING, np.float32)
            share = np.asarray(cv2.resize(moving, (width, height), interpolation=cv2.INTER_AREA))
            movers[n] = from_numpy(share > _COVERED)
    return movers if found else None


@torch.no_grad()
def moving_frames(run: RunView, share: float) -> Tensor:
    """int [N] number of training frames in which each Gaussian lies on moving pixels.

    A frame counts if more than `share` of the Gaussian's blending weights (alpha * T) in it fall on moving pixels, so
    occluded Gaussians do not count. Each frame is rendered at its time. Excluded frames are skipped.
    """
    if run.movers is None:
        raise ValueError("the shot has no motion mattes")
    model, height, width = run.model, run.height, run.width
    counts = torch.zeros(len(model.gaussians), dtype=torch.long, device=model.device)
    for n, index in enumerate(run.train_ids):
        movers = run.movers[n]
        if n in run.excluded_frames or not bool(movers.any()):
            continue
        run.report.check_cancelled()
        mask, state = movers.to(model.device, torch.float32), model.state_at(run.times[n])
        camera = run.viewmats[index], run.Ks[index], width, height
        on_movers, painted_weight = gathered(state, *camera, torch.stack([mask, torch.ones_like(mask)], -1)).unbind(1)
        counts += (painted_weight > SEEN_WEIGHT) & (on_movers > share * painted_weight)
    return counts


def on_trial(run: RunView) -> Tensor:
    """bool [N] Gaussians that the gate opens on trial.

    Without motion mattes these are all that contribute. With mattes they must also lie on moving pixels in several
    frames, and in a large share of the frames that show them.
    """
    gate: GateConfig = run.config.gate
    candidates = painted(run.model.gaussians)
    if run.movers is None:
        return candidates
    # On real clips, the trial alone opened window reflections and left waving hands closed.
    moving = moving_frames(run, gate.moving_share)
    # Walls that people pass are on moving pixels, too. Opening them cost 0.6 dB at far poses of one clip.
    often = moving >= gate.moving_often * run.model.gaussians.support.sum(1)
    return candidates & often & (moving >= gate.moving_frames)


@torch.no_grad()
def harden(run: RunView) -> bool:
    """Closes the Gaussians that did not move; they keep their mean change. Returns False and closes none if nothing
    moves before `give_up`."""
    model, config = run.model, run.config.gate
    rows = model.open_rows()
    change, mean = _changes(model, rows, pixels_per_unit(run, rows), config)
    # Gaussians opened by mattes all move, so the quarter that moves least cannot measure the noise.
    noise = config.noise if run.movers is None else 0.0
    stays = stays_open(model.gaussians, rows, change, config, noise)
    if not bool(stays.any()) and run.progress < config.give_up:
        return False
    _close(model, rows, ~stays, mean)
    return True


@torch.no_grad()
def close_still(run: RunView) -> None:
    """In a long run, closes Gaussians that hardly contribute to moving pixels any more; they keep their mean change."""
    model, (share, frames) = run.model, GateConfig.STAY_OPEN
    rows = model.open_rows()
    if run.movers is None or not len(rows) or run.config.iterations <= GateConfig.LONG:
        return
    _, mean = _changes(model, rows, torch.zeros(len(rows), device=model.device), run.config.gate)
    # Splits of open Gaussians are open: in a long run of `kitchen`, 60 % of them were on still surfaces beside movers.
    _close(model, rows, moving_frames(run, share)[rows] < frames, mean)


def _close(model: DynamicModel, rows: Tensor, is_still: Tensor, mean: Deltas) -> None:
    """Closes the Gaussians of `rows` [M] where `is_still`, bool [M], is set, after applying their `mean` change."""
    closed, moved = rows[is_still], model.moved(rows, mean)
    for name, param in model.gaussians.params.items():
        if name in moved:
            param.data[closed] = moved[name][closed]
    model.gaussians.open[closed] = False


@torch.no_grad()
def mean_of(model: DynamicModel, rows: Tensor) -> dict[str, Tensor]:
    """Parameters of open Gaussians `rows` [M] after their mean change over the times at which they are seen."""
    _, mean = _changes(model, rows, torch.zeros(len(rows), device=model.device), GateConfig())
    return {name: value.detach()[rows] for name, value in model.moved(rows, mean).items()}


def _changes(model: DynamicModel, rows: Tensor, pixels: Tensor, config: GateConfig) -> tuple[Tensor, Deltas]:
    """`change_of` at up to `MOMENTS` times of the clip."""
    count = len(model.centres)
    picked = evenly_spaced(count, MOMENTS)
    moments = [model.deltas(rows, model.centres[n : n + 1]) for n in picked]
    present = [moment for moment in moments if moment is not None]
    return change_of(model.gaussians, rows, present, pixels, config, model.gaussians.support[rows][:, picked].T)


def pixels_per_unit(run: RunView, rows: Tensor) -> Tensor:
    """[M] pixels per scene unit of the Gaussians `rows`, in the nearest camera that sees them.

    Pixels are those of images `GateConfig.WIDTH` wide. Fewer than 2 * `MOMENTS` cameras, evenly spaced, are sampled; 0
    if none of them sees the Gaussian.
    """
    means = run.model.gaussians.params["means"].detach()[rows]
    nearest = torch.full((len(rows),), torch.inf, device=run.device)
    frames = range(0, len(run.train_ids), max(1, len(run.train_ids) // MOMENTS))
    for frame in frames:
        view = run.viewmats[run.train_ids[frame]]
        depth = means @ view[2, :3] + view[2, 3]
        seen = run.model.gaussians.support[rows, run.bin_of_frame(frame)] & (depth > 1e-3)
        nearest = torch.where(seen, torch.minimum(nearest, depth), nearest)
    focal = run.Ks[run.train_ids[0], 0, 0] * (GateConfig.WIDTH / run.width)
    return torch.where(nearest.isfinite(), focal / nearest, 0.0)
