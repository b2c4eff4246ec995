"""Measures residual and motion of a trained run in its frames, on which the verdict is based.

The residual compares low frequencies of a frame and of the render at its time. Motion is how far visible surfaces
travel over the clip, projected into the frame's camera. Only times at which a surface was seen count.
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
"""Number of cells along each side of the image, for each of which results are reported."""
MOST = 32
"""Maximum number of examined frames, evenly spaced over the clip; held-out frames are always examined."""
BLUR = 0.0125
"""Radius of the two box filters on the difference image, as a share of the width (8 pixels of 640)."""
UNEXPLAINED = 0.12
"""Low-pass filtered difference (0 to 1) above which a pixel counts as unexplained."""
MOMENTS = 24
"""Number of times at which Gaussian positions are sampled."""
MOVING_SHARE = 0.3
"""Minimum alpha contribution of moving Gaussians for a pixel to count as moving."""
STILL_SHARE = 1 / 640
"""Travel below this share of the width counts as zero."""


@dataclass(frozen=True)
class FrameEvidence:
    """Comparison of one frame with the render at its time."""

    frame: int
    """Frame number in the clip."""
    held_out: bool
    """True if the run was not trained on this frame."""
    psnr_db: float
    """PSNR against the training image, without ignored pixels; NaN if all are ignored."""
    unexplained: NDArray[np.float32]
    """[GRID, GRID] share of each cell's pixels that differ by more than `UNEXPLAINED`; top row first."""
    travel: NDArray[np.float32]
    """[GRID, GRID] 97th percentile of the surfaces' travel in each cell, as a share of the width."""
    moving: NDArray[np.float32]
    """[K] travel of every 16th moving pixel of the image, as a share of the width."""
    still_unexplained: float | None = None
    """Share of unexplained pixels among those that the motion matte marks as still; None without such pixels."""
    matte_moving: float | None = None
    """Share of pixels that the motion matte marks as moving; None without a matte."""


def gather_evidence(
    trainer: Trainer, test: list[int], held_out: Tensor, mattes: Mattes | None = None
) -> list[FrameEvidence]:
    """Evidence of up to `MOST` frames of a run and of all held-out frames, in ascending order.

    Args:
        trainer: run whose model is judged.
        test: scene indices of the held-out frames.
        held_out: [I, H, W, 3] images of the held-out frames.
        mattes: motion mattes of the shot; None without.
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
    """[T, M, 3] positions of the open Gaussians at `MOMENTS` times of the clip, scene units; NaN where unseen."""
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
    """[M] travel in pixels of each point of places [T, M, 3] in one view: the diagonal of its 2D bounding box.

    NaNs are left out. 0 for points that are seen at fewer than two times, or that are behind the camera at any time.
    """
    camera = places @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[..., 2]
    known = torch.isfinite(depth)
    pixels = camera[..., :2] / depth.clamp_min(1e-6)[..., None] * K[[0, 1], [0, 1]]
    low = torch.where(known[..., None], pixels, torch.inf).amin(0)
    high = torch.where(known[..., None], pixels, -torch.inf).amax(0)
    fine = (known.sum(0) >= 2) & ((depth > 1e-2) | ~known).all(0)
    return torch.where(fine, norm(high - low, dim=1), 0.0)


@torch.no_grad()
def _inspect_frame(
    trainer: Trainer, index: int, image: Tensor, places: Tensor, held_out: bool, matte: NDArray[np.uint8] | None
) -> FrameEvidence:
    model, rows, width = trainer.model, trainer.model.open_rows(), trainer.width
    viewmat, K, time = trainer.viewmats[index], trainer.Ks[index], float(trainer.scene.times[index])
    motion = torch.zeros(len(model.gaussians), 2, device=trainer.device)  # travel, and 1 for moving Gaussians
    if places.shape[1]:
        motion[rows, 0], motion[rows, 1] = travelled(places, viewmat, K) / width, 1.0
    out = render(
        model.state_at(time), model.sh_degree, viewmat, K, width, trainer.height, colors=motion,
        background=torch.cat([trainer.background, motion.new_zeros(2)]), with_depth=False, with_contributions=False,
    )  # fmt: skip
    rendered = model.exposure.apply(out.colors[0, ..., :3], time)
    plate, ignored = image.to(trainer.device, torch.float32), trainer.ignored_at(index)
    if ignored is not None:  # ignored pixels count as explained
        plate = torch.where(ignored[..., None], rendered, plate)
    is_unexplained = unexplained(plate, rendered)
    far, share = out.colors[0, ..., 3:].cpu().unbind(-1)
    travels = torch.where(share > MOVING_SHARE, far / share.clamp_min(MOVING_SHARE), 0.0).clamp_min(0.0)
    moving = travels[travels > STILL_SHARE].flatten()[::16]
    still = None if matte is None else _resized(matte == STILL, is_unexplained.shape)
    unexplained_share = None if still is None or not still.any() else float(is_unexplained[still].float().mean())
    # Above the 97th percentile of a cell lies 0.2 % of the image: a mover of that size still counts.
    return FrameEvidence(
        trainer.scene.frames[index], held_out, psnr(rendered, plate, ignored), shares(is_unexplained.float()),
        _cells(travels, 0.97), moving.numpy(), unexplained_share,
        None if matte is None else float((matte == MOVING).mean()),
    )  # fmt: skip


def unexplained(plate: Tensor, rendered: Tensor) -> Tensor:
    """bool [H, W] on the CPU, True where low frequencies of two images [H, W, 3] differ by more than `UNEXPLAINED`."""
    radius = max(1, round(BLUR * plate.shape[1]))
    difference = (plate - rendered).permute(2, 0, 1)[None]
    # Low frequencies only: their difference is wrong content, not lack of sharpness. Two boxes approximate a Gaussian.
    for _ in range(2):
        difference = F.avg_pool2d(difference, 2 * radius + 1, 1, radius, count_include_pad=False)
    return (difference[0].abs().mean(0) > UNEXPLAINED).cpu()


def shares(values: Tensor) -> NDArray[np.float32]:
    """[GRID, GRID] mean of each cell of values [H, W]."""
    return F.adaptive_avg_pool2d(values[None, None], GRID)[0, 0].numpy().astype(np.float32)


def _cells(values: Tensor, share: float) -> NDArray[np.float32]:
    """[GRID, GRID] quantile `share` of each cell of values [H, W]."""
    rows = [torch.stack([cell.flatten().quantile(share) for cell in row.tensor_split(GRID, 1)])
            for row in values.tensor_split(GRID, 0)]  # fmt: skip
    return torch.stack(rows).numpy().astype(np.float32)


def _resized(mask: NDArray[np.bool_], shape: torch.Size) -> Tensor:
    """The mask resized to `shape` by nearest neighbour."""
    values = from_numpy(mask.astype(np.float32))[None, None]
    return F.interpolate(values, size=tuple(shape), mode="nearest")[0, 0] > 0.5
