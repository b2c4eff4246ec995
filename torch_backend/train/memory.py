"""How much of a card's memory a run will take, by arithmetic, and how it is made to fit before it starts.

The figures are bytes of the tensors that live at once in a training step (`tests/backend/card/test_card.py` holds them
against what a pretended card counts). `_FIXED` stands for torch, its libraries and the compiled kernels, `_WASTE` for
memory that the allocator cannot use; neither was measured on a card. A run that does not fit is made smaller in the
order of what that costs: the frames wait in host memory; the field works in pieces and computes them again on the way
back; fewer Gaussians.
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
"""Gaussians that the field works on at a time where memory is short."""
LEAST_PIECE = 8_192
"""Smaller pieces save nothing that counts."""
LEAST = 2_000
"""Fewer Gaussians than this are no run."""
_FIXED = 450_000_000
"""Of a card: libraries, kernels, small tensors."""
_WASTE = 1.15
"""Memory that the allocator reserves, as a multiple of the memory in use."""
_MOVED = 14
"""Numbers of a Gaussian that a field moves."""
_TILES = 12
"""Tiles that a Gaussian meets, those out of view counted in: of the benchmark's scenes, rounded up."""
_RASTER_BYTES = 240
"""Of a Gaussian in a frame: its record, order, keys, the sort's scratch, figures, the gradient before projection."""
_PIXEL_BYTES = 230
"""Of a pixel in a step: colours, alphas, depths, the target, SSIM's four blurs and three gradients, and theirs."""


@dataclass(frozen=True)
class MemoryPlan:
    """What of a run fits."""

    gaussians: int
    """Most that it may have."""
    pieces: int | None
    """Gaussians that the field works on at a time; None: all."""
    on_card: bool
    """Do the frames lie on the card?"""
    sentence: str
    """What was made smaller, and why; empty if it is as requested."""


def gaussian_bytes(config: TrainConfig, bins: int) -> int:
    """Of one Gaussian in a step: parameters with gradient, two moments and the mean of the last steps, the harmonics
    once more with their gradient, its raster work and hits, and the bitmaps of `bins` time bins."""
    harmonics = 3 * (config.sh_degree + 1) ** 2
    numbers = 11 + harmonics
    hits = math.ceil(_TILES * 4 / 3) * HIT_BYTES
    return 4 * (5 * numbers + 2 * harmonics) + _RASTER_BYTES + hits + 2 * min(bins, MAX_BINS) + 40


def moving_bytes(config: TrainConfig, whole: bool) -> int:
    """Of one Gaussian that the field moves: what has met its deltas, with gradients, and the field's own work, if the
    `whole` field works at once."""
    return 4 * 4 * _MOVED + (config.field.row_bytes() if whole else 0)


def peak_bytes(
    config: TrainConfig, pixels: int, bins: int, gaussians: int, *, whole: bool = True, frames: int = 0
) -> int:
    """Most bytes of tensors that a step takes.

    Args:
        pixels: of a training image.
        bins: time bins of the support bitmap: trained frames, at most 256.
        gaussians: how many there are; all of them may be on trial at once.
        whole: does the field work on all of them at once?
        frames: bytes of the training images, if they lie on the card.
    """
    total = frames + pixels * _PIXEL_BYTES + gaussians * gaussian_bytes(config, bins)
    if config.method != "static":
        total += gaussians * moving_bytes(config, whole)
        total += 0 if whole else min(gaussians, PIECE) * 2 * config.field.row_bytes()
    return total


def plan_memory(
    config: TrainConfig, size: tuple[int, int], bins: int, frames: int, free: int, gaussians: int = 0
) -> MemoryPlan:
    """How a run fits into `free` bytes of a card.

    Args:
        size: (width, height) px of the training images.
        bins: trained frames.
        frames: bytes of all images.
        free: bytes.
        gaussians: how many there are and will be; 0: as many as the configuration's budget.

    JobError if it cannot be made small enough.
    """
    budget, pixels = gaussians or config.densify.budget, size[0] * size[1]
    room = (free - _FIXED) / _WASTE
    moves = config.method != "static" and budget > PIECE
    for on_card, whole in ((True, True), (False, True), (False, False)):
        fits = peak_bytes(config, pixels, bins, budget, whole=whole, frames=frames * on_card) <= room
        if fits and (not on_card or frames <= free // 2) and (whole or moves):
            pieces = None if whole else PIECE
            text = (
                "" if whole else f"{_asked(budget, size, free)}: what moves is computed in pieces, which takes longer."
            )
            return MemoryPlan(budget, pieces, on_card, text)
    base = peak_bytes(config, pixels, bins, 0)
    each, rest = _each(config, bins, room - base)
    fewer = min(int(rest / each), budget) // 1000 * 1000
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
        f"{_asked(budget, size, free)}: there will be {fewer:,} at most, which shows less detail. To have them all, "
        "close other programs that use the card, choose a smaller width, or train on the processor.",
    )  # fmt: skip


def _each(config: TrainConfig, bins: int, room: float) -> tuple[float, float]:
    """(bytes that one more Gaussian takes, bytes left for them): with the field in pieces, if they are many."""
    fixed, moves = gaussian_bytes(config, bins), config.method != "static"
    if not moves:
        return fixed, room
    whole = fixed + moving_bytes(config, True)
    if room / whole <= PIECE:
        return whole, room
    return fixed + moving_bytes(config, False), room - PIECE * 2 * config.field.row_bytes()


def _asked(budget: int, size: tuple[int, int], free: int) -> str:
    return (
        f"The graphics card has {free / 1e9:.1f} GB free, which is little for {budget:,} Gaussians on images of "
        f"{size[0]} x {size[1]} px"
    )


def free_bytes(device: torch.device) -> int:
    """Bytes of a card that are free for tensors, with what torch holds and does not use."""
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
