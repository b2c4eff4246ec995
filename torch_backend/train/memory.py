"""Computes the GPU memory that a run needs, and reduces a run that does not fit before it starts.

The figures are bytes of the tensors that exist at the same time in a training step. `tests/backend/card/test_card.py`
compares them with the count of a simulated GPU. A run that does not fit is reduced in this order: frames stay in host
memory; the field is evaluated in pieces that are recomputed in the backward pass; the number of Gaussians is lowered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..contract import ExitCode, JobError
from ..raster.hit_lists import HIT_BYTES
from ..supervision.support import MAX_BINS
from .config import TrainConfig

PIECE = 65_536
"""Number of Gaussians per call of the field where memory is short."""
LEAST_PIECE = 8_192
"""Least size of a piece. Smaller pieces save no significant memory."""
LEAST = 2_000
"""Least number of Gaussians of a run."""
# Fixed memory in bytes: torch, its libraries, the kernels and small tensors. An estimate, not measured on a GPU.
_FIXED = 450_000_000
# Memory that the allocator reserves through fragmentation, as a multiple of the memory in use. An estimate, too.
_WASTE = 1.15
_MOVED = 14
"""Number of values per Gaussian that a field changes."""
# Mean number of tiles per Gaussian, including Gaussians out of view, in the benchmark's scenes; rounded up.
_TILES = 12
_RASTER_BYTES = 240
"""Bytes per Gaussian in a frame: record, order, keys, scratch memory of the sort, statistics, projected gradients."""
_PIXEL_BYTES = 230
"""Bytes per pixel in a step: colours, alphas, depths, target, SSIM's four blurs, and gradients."""


@dataclass(frozen=True)
class MemoryPlan:
    """How a run fits into GPU memory."""

    gaussians: int
    """Maximum number of Gaussians."""
    pieces: int | None
    """Number of Gaussians per call of the field; None: all in one call."""
    on_card: bool
    """True if the frames are stored on the GPU."""
    sentence: str
    """What was reduced and why; empty if nothing visible to the user was reduced."""


def gaussian_bytes(config: TrainConfig, bins: int) -> int:
    """Bytes per Gaussian in a step.

    They cover parameters with gradient, two moments and the averaged parameters; a copy of the SH coefficients with
    gradient; the rasteriser's data and hits; and the bitmaps of `bins` time bins.
    """
    harmonics = 3 * (config.sh_degree + 1) ** 2
    numbers = 11 + harmonics
    # A list of hits has room for a third more than its largest demand (`hit_lists.py`).
    hits = math.ceil(_TILES * 4 / 3) * HIT_BYTES
    return 4 * (5 * numbers + 2 * harmonics) + _RASTER_BYTES + hits + 2 * min(bins, MAX_BINS) + 40


def moving_bytes(config: TrainConfig, is_single_call: bool) -> int:
    """Bytes per moving Gaussian: deformed parameters with gradients and, if all Gaussians are evaluated at once
    (`is_single_call`), the field's intermediate tensors."""
    return 4 * 4 * _MOVED + (config.field.row_bytes() if is_single_call else 0)


def peak_bytes(
    config: TrainConfig, pixels: int, bins: int, gaussians: int, *, is_single_call: bool = True, frames: int = 0
) -> int:
    """Peak bytes of the tensors in a step.

    Args:
        pixels: number of pixels of a training image.
        bins: time bins of the support bitmap: number of training frames, at most 256.
        gaussians: number of Gaussians; all may be on trial at the same time.
        is_single_call: whether the field is evaluated for all Gaussians at once.
        frames: bytes of the training images if they are stored on the GPU, otherwise 0.
    """
    total = frames + pixels * _PIXEL_BYTES + gaussians * gaussian_bytes(config, bins)
    if config.method != "static":
        total += gaussians * moving_bytes(config, is_single_call)
        total += 0 if is_single_call else min(gaussians, PIECE) * 2 * config.field.row_bytes()
    return total


def plan_memory(
    config: TrainConfig, size: tuple[int, int], bins: int, frames: int, free: int, gaussians: int = 0
) -> MemoryPlan:
    """Plans how a run fits into `free` bytes of GPU memory. JobError if it cannot be reduced enough.

    Args:
        size: (width, height) of the training images in pixels.
        bins: number of training frames.
        frames: bytes of all training images.
        free: free GPU memory in bytes.
        gaussians: fixed number of Gaussians; 0: the configured budget, which may be reduced.
    """
    budget, pixels = gaussians or config.densify.budget, size[0] * size[1]
    room = (free - _FIXED) / _WASTE
    moves = config.method != "static" and budget > PIECE
    for on_card, is_single_call in ((True, True), (False, True), (False, False)):
        fits = peak_bytes(config, pixels, bins, budget, is_single_call=is_single_call, frames=frames * on_card) <= room
        if fits and (not on_card or frames <= free // 2) and (is_single_call or moves):
            pieces = None if is_single_call else PIECE
            text = (
                ""
                if is_single_call
                else f"{_shortage(budget, size, free)}: motion is computed in pieces, which is slower."
            )
            return MemoryPlan(budget, pieces, on_card, text)
    base = peak_bytes(config, pixels, bins, 0)
    per_gaussian, available = _bytes_per_gaussian(config, bins, room - base)
    fewer = min(int(available / per_gaussian), budget) // 1000 * 1000
    if gaussians or fewer < LEAST:
        raise JobError(
            f"The graphics card has {free / 1e9:.1f} GB free, too little to train {budget:,} Gaussians on images of "
            f"{size[0]} x {size[1]} px.",
            "Close other programs that use the card, choose a smaller width or fewer Gaussians, or train on the "
            "processor.",
            ExitCode.TRAIN,
        )
    return MemoryPlan(
        fewer, PIECE if moves else None, False,
        f"{_shortage(budget, size, free)}: at most {fewer:,} are used, which shows less detail. To use all of them, "
        "close other programs that use the card, choose a smaller width, or train on the processor.",
    )  # fmt: skip


def _bytes_per_gaussian(config: TrainConfig, bins: int, room: float) -> tuple[float, float]:
    """(bytes per Gaussian, bytes available for Gaussians); with the field in pieces if more than `PIECE` fit."""
    fixed, moves = gaussian_bytes(config, bins), config.method != "static"
    if not moves:
        return fixed, room
    per_gaussian = fixed + moving_bytes(config, True)
    if room / per_gaussian <= PIECE:
        return per_gaussian, room
    return fixed + moving_bytes(config, False), room - PIECE * 2 * config.field.row_bytes()


def _shortage(budget: int, size: tuple[int, int], free: int) -> str:
    return (
        f"The graphics card has {free / 1e9:.1f} GB free, which is little for {budget:,} Gaussians on images of "
        f"{size[0]} x {size[1]} px"
    )


def free_bytes(device: torch.device) -> int:
    """Free GPU memory in bytes, including memory that torch has reserved but does not use."""
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
