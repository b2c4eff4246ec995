"""Measures frames before the solve (sharpness, exposure, blank and duplicate frames), and selects frames to solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import UserError
from .color import srgb_to_linear
from .continuity import Features, quick_features, small_grey
from .display import PLAIN, Display

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 weights, for the luma of encoded values and the luminance of linear values."""

THUMB_WIDTH, THUMB_HEIGHT = 64, 36
BLANK_DEVIATION = 1.5 / 255.0
DUPLICATE_DIFFERENCE = 0.5 / 255.0
BLUR_RATIO = 0.7
# Minimum and maximum luma of a log clip: Canon Log has black at 0.073.
_LOG_BLACK, _LOG_WHITE = 0.06, 0.9
# Largest difference of the channels in a log clip. Measured: 0.20 in log, 0.31 to 0.58 in three display clips.
_LOG_SATURATION = 0.25
TARGET_SOLVED = 68
MAX_STEP_SECONDS = 0.4


@dataclass
class FrameMeasures:
    """Measurements of one working frame."""

    frame: int
    """Frame number in the shot."""
    sharpness: float
    """Variance of the Laplacian of luma, in squared 8-bit steps."""
    exposure: float
    """Mean luminance in stops above 18 % grey."""
    flags: list[str] = field(default_factory=list[str])
    """Any of blank, duplicate, corrupt."""
    thumb: NDArray[np.float32] = field(repr=False, default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    """[36, 64, 3] encoded colour in [0, 1]."""
    luma: NDArray[np.float32] = field(repr=False, default_factory=lambda: np.zeros((0, 0), np.float32))
    """Every other pixel of luma in [0, 1]."""
    features: Features | None = field(repr=False, default=None)
    """Image features for the detection of cuts."""
    brightest: float = 1.0
    """Largest value of a channel, 0 to 1."""
    tones: tuple[float, float] = (0.0, 1.0)
    """0.1 % and 99.9 % quantiles of luma, 0 to 1."""
    digest: str = ""
    """Hash of the pixels."""


def measure(frame: int, pixels: NDArray[Any], display: Display = PLAIN) -> FrameMeasures:
    """Measures a working frame, [H, W, 3] uint8 or uint16, encoded for `display`."""
    scale = 1.0 / (65535.0 if pixels.dtype == np.uint16 else 255.0)
    luma = (pixels @ LUMA) * np.float32(scale)
    inner = luma[1:-1, 1:-1]
    laplacian = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:] - 4.0 * inner
    thumb = thumbnail(pixels) * np.float32(scale)
    # The exposure counts values above white as white, so that a lamp that enters the picture does not change it.
    light = srgb_to_linear(np.minimum(display.straightened(thumb), np.float32(1.0)))
    luminance = float((light @ LUMA).mean())
    flags = ["blank"] if float(luma.std()) < BLANK_DEVIATION else []
    return FrameMeasures(
        frame=frame,
        sharpness=float(laplacian.var() * 255.0**2) if laplacian.size else 0.0,
        exposure=float(np.log2(max(luminance, 1e-6) / 0.18)),
        brightest=float(pixels.max() * scale),
        tones=tones_of(luma[::2, ::2]),
        flags=flags,
        thumb=thumb,
        features=quick_features(small_grey(pixels)),
        luma=np.ascontiguousarray(luma[::2, ::2]),
    )


def tones_of(luma: NDArray[np.float32]) -> tuple[float, float]:
    """0.1 % and 99.9 % quantiles of a luma picture [H, W]."""
    count = max(0, luma.size // 1000)
    ordered = np.partition(luma.ravel(), (count, luma.size - 1 - count))
    return float(ordered[count]), float(ordered[luma.size - 1 - count])


def looks_like_log(measures: Sequence[FrameMeasures]) -> tuple[float, float] | None:
    """Luma of the darkest and brightest tones of a clip, 0 to 1, if it looks like log footage; else None."""
    # Camera logs encode black at 7 to 13 % and unclipped highlights below 90 %. Pictures for a display usually reach
    # 3 % and 97 % in some frame, and have twice the saturation.
    usable = [m for m in measures if not m.flags and m.thumb.size]
    darkest = min((m.tones[0] for m in usable), default=0.0)
    brightest = max((m.tones[1] for m in usable), default=1.0)
    if darkest < _LOG_BLACK or brightest > _LOG_WHITE:
        return None
    saturation = np.median([np.quantile(np.ptp(m.thumb, axis=2), 0.99) for m in usable])
    return (darkest, brightest) if saturation <= _LOG_SATURATION else None


def thumbnail(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Block means [36, 64, 3] of a picture [H, W, 3], in the units of its pixels. Smaller pictures are not enlarged."""
    rows = _block_means(pixels.astype(np.float32), 0, THUMB_HEIGHT)
    return _block_means(rows, 1, THUMB_WIDTH).astype(np.float32)


def _block_means(values: NDArray[Any], axis: int, size: int) -> NDArray[Any]:
    """Means of at most `size` blocks of [H, W, 3] along an axis."""
    length = int(values.shape[axis])
    edges = np.linspace(0, length, min(size, length) + 1).astype(int)
    shape = [-1 if i == axis else 1 for i in range(3)]
    return np.add.reduceat(values, edges[:-1], axis=axis) / np.diff(edges).reshape(shape)


def flag_duplicate(current: FrameMeasures, last_distinct: FrameMeasures | None) -> bool:
    """Flags `current` if it repeats the last distinct frame. Returns True if it does."""
    if last_distinct is None or last_distinct.luma.shape != current.luma.shape:
        return False
    repeated = float(np.abs(current.luma - last_distinct.luma).mean()) < DUPLICATE_DIFFERENCE
    if repeated:
        current.flags.append("duplicate")
    return repeated


def automatic_step(count: int, fps: float) -> int:
    """Step that selects about 68 of `count` frames, at most 0.4 s apart."""
    # At larger gaps, feature tracks break.
    longest = max(1, round(fps * MAX_STEP_SECONDS)) if fps > 0 else 1
    steps = range(1, min(longest, max(1, count // 8)) + 1)
    return min(steps, key=lambda s: abs(np.log(max(1.0, count / s) / TARGET_SOLVED)))


def choose_solved(measures: Sequence[FrameMeasures], step: int) -> set[int]:
    """Frame numbers for the solve and the training: every `step`-th frame, and the first and last usable frame.

    A frame that is flagged or much blurrier than its surroundings is replaced by the sharpest usable frame within half
    a step.
    """
    if step < 1:
        raise UserError(f"step should be at least 1, got {step}")
    usable = [m for m in measures if not m.flags]
    if not usable:
        return set()
    chosen = {usable[0].frame, usable[-1].frame}
    reach = (step - 1) // 2
    for anchor in range(0, len(measures), step):
        window = [m for m in measures[max(0, anchor - reach) : anchor + reach + 1] if not m.flags]
        if window:
            best = max(window, key=lambda m: m.sharpness)
            measure = measures[anchor]
            chosen.add(
                measure.frame if measure in window and measure.sharpness >= BLUR_RATIO * best.sharpness else best.frame
            )
    return chosen
