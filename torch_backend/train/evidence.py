"""Measures the residual of a trained run in its frames, and how far things travel: what its verdict is based on.

Where the low frequencies of a frame differ from the render at its own time, the run has something else there, whatever
its sharpness. Travel is that of the picture's surfaces over the clip, in pixels of the very view, at those times only
at which somebody saw them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from ..motion.mattes import MOVING, STILL
from ..scene import evenly_spaced
from ..torch_types import from_numpy, norm
from .losses import psnr
from .model import DynamicModel, render
from .movers import Mattes
from .trainer import Trainer

GRID = 4
"""Cells of the picture along each side, in which is told where something is."""
MOST = 32
"""Frames that are examined, evenly over the clip."""
BLUR = 0.0125
"""Radius of the two box filters before a difference counts, as a share of the width: 8 pixels of 640."""
UNEXPLAINED = 0.12
"""Difference of the low-passed pictures, of 1, above which a pixel is not explained."""
MOMENTS = 24
"""Times at which it is asked where a Gaussian is."""
MOVING_SHARE = 0.3
"""Share of a pixel that has to be of what moves before it is taken to travel."""
STILL_SHARE = 1 / 640
"""Travel below this share of the width counts as none."""


@dataclass(frozen=True)
class FrameEvidence:
    """One frame beside the render at its own time."""

    frame: int
    """Number in the clip."""
    held_out: bool
    """The run was not trained on it."""
    psnr_db: float
    """PSNR against the plate, without what is ignored; NaN if that is all of it."""
    unexplained: NDArray[np.float32]
    """[GRID, GRID] share of each cell's pixels that differ by more than `UNEXPLAINED`; rows from above."""
    travel: NDArray[np.float32]
    """[GRID, GRID] how far the surfaces of each cell travel, as a share of the width: the 97th percentile, so
    that a fifth of a percent of the picture counts."""
    moving: NDArray[np.float32]
    """[K] travel of the picture's pixels that travel at all, as a share of the width, every 16th."""
    still_unexplained: float | None = None
    """Share of the pixels that the motion matte calls still that differ; None without a matte."""
    matte_moving: float | None = None
    """Share of the pixels that the motion matte calls moving; None without a matte."""


def gather_evidence(
    trainer: Trainer, test: list[int], held_out: Tensor, mattes: Mattes | None = None
) -> list[FrameEvidence]:
    """Looks at up to `MOST` of a run's frames, held out or not; ascending.

    Args:
        trainer: its model is judged.
        test: scene indices of the frames held out.
        held_out: [I, H, W, 3] those frames.
        mattes: the shot's motion mattes, if there are any.
    """
    images = {i: held_out[n] for n, i in enumerate(test)}
    images |= {i: trainer.images[n] for n, i in enumerate(trainer.train_ids) if n not in trainer.soundness.unusable}
    every = sorted(images)
    picked = evenly_spaced(len(every), MOST)
    places = seen_places(trainer.model)
    known = set(test)
    found: list[FrameEvidence] = []
    for index in sorted({every[n] for n in picked} | known):
        trainer.report.check_cancelled()
        frame = trainer.scene.frames[index]
        matte = mattes(frame) if mattes is not None else None
        found.append(_inspect_frame(trainer, index, images[index], places, index in known, matte))
    return found


@torch.no_grad()
def seen_places(model: DynamicModel) -> Tensor:
    """[T, M, 3] where the open Gaussians are at `MOMENTS` times of the clip, scene units; NaN where nobody saw them."""
    rows = model.open_rows()
    count = len(model.centres)
    bins = evenly_spaced(count, MOMENTS)
    if model.field is None or not len(rows):
        return torch.zeros(len(bins), 0, 3, device=model.device)
    places: list[Tensor] = []
    for time_bin in bins:
        state = model.moved(rows, model.deltas(rows, model.centres[time_bin : time_bin + 1]))
        seen = model.gaussians.support[rows, time_bin]
        places.append(torch.where(seen[:, None], state["means"][rows], torch.nan))
    return torch.stack(places)


def travelled(places: Tensor, viewmat: Tensor, K: Tensor) -> Tensor:
    """[M] pixels that each of places [T, M, 3] travels in a view: the diagonal of the box around where it is seen.

    NaNs are left out; 0 for what is seen at fewer than two times, or is ever behind the camera.
    """
    camera = places @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[..., 2]
    known = torch.isfinite(depth)
    pixels = camera[..., :2] / depth.clamp_min(1e-6)[..., None] * K[[0, 1], [0, 1]]
    low = torch.where(known[..., None], pixels, torch.inf).amin(0)
    high = torch.where(known[..., None], pixels, -torch.inf).amax(0)
    fine = (known.sum(0) >= 2) & ((depth > 1e-2) | ~known).all(0)
    return torch.where(fine, norm(high - low, 1), 0.0)


@torch.no_grad()
def _inspect_frame(
    trainer: Trainer, index: int, image: Tensor, places: Tensor, held_out: bool, matte: NDArray[np.uint8] | None
) -> FrameEvidence:
    model, rows, width = trainer.model, trainer.model.open_rows(), trainer.width
    viewmat, K, time = trainer.viewmats[index], trainer.Ks[index], float(trainer.scene.times[index])
    motion = torch.zeros(len(model.gaussians), 2, device=trainer.device)  # how far, and whether at all
    if places.shape[1]:
        motion[rows, 0], motion[rows, 1] = travelled(places, viewmat, K) / width, 1.0
    out = render(
        model.state_at(time), model.sh_degree, viewmat, K, width, trainer.height, colors=motion,
        background=torch.cat([trainer.background, motion.new_zeros(2)]), with_depth=False, with_contributions=False,
    )  # fmt: skip
    shown = model.exposure.apply(out.colors[0, ..., :3], time)
    plate, ignored = image.to(trainer.device, torch.float32), trainer.ignored_at(index)
    if ignored is not None:  # nothing there is asked of the run
        plate = torch.where(ignored[..., None], shown, plate)
    off = unexplained(plate, shown)
    far, share = out.colors[0, ..., 3:].cpu().unbind(-1)
    travels = torch.where(share > MOVING_SHARE, far / share.clamp_min(MOVING_SHARE), 0.0).clamp_min(0.0)
    moving = travels[travels > STILL_SHARE].flatten()[::16]
    still = None if matte is None else _resized(matte == STILL, off.shape)
    lost = None if still is None or not still.any() else float(off[still].float().mean())
    return FrameEvidence(
        trainer.scene.frames[index], held_out, psnr(shown, plate, ignored), shares(off.float()), _cells(travels, 0.97),
        moving.numpy(), lost, None if matte is None else float((matte == MOVING).mean()),
    )  # fmt: skip


def unexplained(plate: Tensor, shown: Tensor) -> Tensor:
    """bool [H, W] on the CPU: where two display-referred pictures [H, W, 3] differ by more than edges and grain."""
    radius = max(1, round(BLUR * plate.shape[1]))
    off = (plate - shown).permute(2, 0, 1)[None]
    for _ in range(2):
        off = F.avg_pool2d(off, 2 * radius + 1, 1, radius, count_include_pad=False)
    return (off[0].abs().mean(0) > UNEXPLAINED).cpu()


def shares(values: Tensor) -> NDArray[np.float32]:
    """[GRID, GRID] mean of each cell of values [H, W]."""
    return F.adaptive_avg_pool2d(values[None, None], GRID)[0, 0].numpy().astype(np.float32)


def _cells(values: Tensor, share: float) -> NDArray[np.float32]:
    """[GRID, GRID] quantile of each cell of values [H, W]."""
    rows = [torch.stack([cell.flatten().quantile(share) for cell in row.tensor_split(GRID, 1)])
            for row in values.tensor_split(GRID, 0)]  # fmt: skip
    return torch.stack(rows).numpy().astype(np.float32)


def _resized(mask: NDArray[np.bool_], shape: torch.Size) -> Tensor:
    """bool [h, w] at another size, nearest."""
    values = from_numpy(mask.astype(np.float32))[None, None]
    return F.interpolate(values, size=tuple(shape), mode="nearest")[0, 0] > 0.5
