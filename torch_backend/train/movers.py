"""Movers by the shot's motion mattes, and the gate's decisions from them.

Flow finds movers that a photometric trial does not: on real clips the trial alone opened window reflections, and left
waving hands closed. Unknown counts as still. A shot without mattes is trained by the trial alone.
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
"""Times and cameras at which it is asked whether a Gaussian moves."""
_COVERED = 0.25
"""Share of a training pixel that has to move before the pixel does: at rims the matte is a pixel off."""

Mattes = Callable[[int], NDArray[np.uint8] | None]
"""Frame number -> what moves in it, [h, w] uint8: 0 still, 128 unknown, 255 moving; None where there is none."""


def load_movers(mattes: Mattes, scene: Scene, indices: list[int], width: int, height: int) -> Tensor | None:
    """bool [I, height, width]: what moves in frames `indices` of the scene; None if no frame has a matte.

    A frame without one stands still. JobError if a matte is damaged.
    """
    movers, found = torch.zeros(len(indices), height, width, dtype=torch.bool, device="cpu"), False
    for n, index in enumerate(indices):
        matte = mattes(scene.frames[index])
        if matte is not None:
            found = True
            moving = np.asarray(matte == MOVING, np.float32)
            share = np.asarray(cv2.resize(moving, (width, height), interpolation=cv2.INTER_AREA))
            movers[n] = from_numpy(share > _COVERED)
    return movers if found else None


@torch.no_grad()
def moving_frames(run: RunView, share: float) -> Tensor:
    """int [N]: in how many trained frames each Gaussian lies in what moves, by what it paints there.

    It counts where it is really seen, in front of what it stands before: at least `share` of its alpha * T over the
    frame's pixels falls on movers. Each frame is asked at its own time; those kept back or unusable are not.
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
    """bool [N]: Gaussians that the gate opens on trial: all that contribute or, with motion mattes, those that lie on
    moving pixels in several frames and in a large share of the frames that show them."""
    gate: GateConfig = run.config.gate
    candidates = painted(run.model.gaussians)
    if run.movers is None:
        return candidates
    moving = moving_frames(run, gate.moving_share)
    often = moving >= gate.moving_often * run.model.gaussians.support.sum(1)
    return candidates & often & (moving >= gate.moving_frames)


@torch.no_grad()
def harden(run: RunView) -> bool:
    """Closes for good what did not move; its mean change stays. False while nothing moves at all: the trial goes on."""
    model, config = run.model, run.config.gate
    rows = model.open_rows()
    change, mean = _changes(model, rows, pixels_per_unit(run, rows), config)
    # Gaussians on trial by their matte all move, so their stillest quarter cannot measure the noise.
    noise = config.noise if run.movers is None else 0.0
    stays = stays_open(model.gaussians, rows, change, config, noise)
    if not bool(stays.any()) and run.progress < config.give_up:
        return False
    _close(model, rows, ~stays, mean)
    return True


@torch.no_grad()
def close_strays(run: RunView) -> None:
    """In a long run, closes Gaussians that hardly contribute to movers any more; they keep their mean change.

    Splits of open Gaussians are open, and many of them paint still surfaces next to a mover.
    """
    model, (share, frames) = run.model, GateConfig.STRAY
    rows = model.open_rows()
    if run.movers is None or not len(rows) or run.config.iterations <= GateConfig.LONG:
        return
    _, mean = _changes(model, rows, torch.zeros(len(rows), device=model.device), run.config.gate)
    _close(model, rows, moving_frames(run, share)[rows] < frames, mean)


def _close(model: DynamicModel, rows: Tensor, strays: Tensor, mean: Deltas) -> None:
    """Closes those of `rows` [M] that are `strays`, bool [M], as they are with their `mean` change."""
    closed, moved = rows[strays], model.moved(rows, mean)
    for name, param in model.gaussians.params.items():
        if name in moved:
            param.data[closed] = moved[name][closed]
    model.gaussians.open[closed] = False


@torch.no_grad()
def mean_of(model: DynamicModel, rows: Tensor) -> dict[str, Tensor]:
    """Parameters of open Gaussians `rows` [M] at the mean of what they are when somebody sees them."""
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
    """[M] pixels of pictures `GateConfig.WIDTH` wide per scene unit, where a camera that saw each of `rows` is nearest.

    0 for what no asked camera saw.
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
