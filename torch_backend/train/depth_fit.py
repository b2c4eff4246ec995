"""Fits depth maps to the solve: a slope and a shift per frame between map values and depths of the solve's points.

A map is linear in depth (a sensor, a metric network) or in inverse depth (disparity). Both models are fitted to the
whole sequence, and the better one is used. Each frame has its own line, shrunk towards the sequence's common line
according to the spread between frames and the line's uncertainty (empirical Bayes).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..contract import DEPTH_KINDS as KINDS

Array = NDArray[np.float64]
Samples = Mapping[int, tuple[Array, Array]]
"""Frame -> (values [P] of its map, depths [P] of the solve's points there, above 0)."""
LEAST_POINTS = 20
"""Least number of points for a line per frame."""
LEAST_SIGMA = 0.01
"""Least standard deviation of a fitted depth, as a share of the frame's median depth: the points' own error."""
_ROUNDS = 30
"""Iterations of reweighted least squares."""
# Ratio of standard deviation to median absolute deviation, for normally distributed errors.
_TO_SIGMA = 1.4826
# Maps fit the solve if less than half of their deviation is unexplained by the points' depth, and the median relative
# error is below 15 %. Networks reach 5 to 12 %; mirrored maps of the same room reach 23 %. Maps also fit if the error
# is below 5 %, because points that all lie at one depth cannot explain any deviation.
_UNEXPLAINED, _FAR, _CLOSE = 0.5, 0.15, 0.05


@dataclass(frozen=True)
class FrameFit:
    """Fit of one frame: (value - shift) / slope is depth, or inverse depth, depending on the kind of the sequence."""

    slope: float
    """Change of the value per unit of depth, or of inverse depth."""
    shift: float
    """Value at depth, or inverse depth, 0."""
    sigma: float
    """Standard deviation of the fitted depth in scene units, or of inverse depth in 1 / scene units."""
    points: int
    """Number of the solve's points that lie on the frame's map."""

    def of(self, values: NDArray[np.floating]) -> Array:
        """Depth, or inverse depth, of map values."""
        return (values.astype(np.float64) - self.shift) / self.slope

    def inverse_of(self, values: NDArray[np.float32], kind: str) -> NDArray[np.float32]:
        """Inverse depth of map values, in 1 / scene units; 0 where a value is NaN or not in front of the camera."""
        fitted = np.nan_to_num(self.of(values), nan=0.0)
        is_positive = fitted > 1e-12
        safe = np.where(is_positive, fitted, 1.0)
        return np.where(is_positive, safe if kind == KINDS[1] else 1.0 / safe, 0.0).astype(np.float32)


@dataclass(frozen=True)
class SequenceFit:
    """Fit of a whole sequence."""

    kind: str
    """Quantity that the maps are linear in, one of `KINDS`."""
    frames: dict[int, FrameFit]
    """Fits of all requested frames, ascending."""
    residual: float
    """Median relative error of a frame's points; median over the frames."""
    unexplained: float
    """Share, 0 to 1, of the maps' mean deviation that the points' depth does not explain; median over the frames."""

    @property
    def fits(self) -> bool:
        """False if the maps do not match the solve."""
        return self.residual < _CLOSE or (self.residual < _FAR and self.unexplained < _UNEXPLAINED)


def fit_sequence(samples: Samples) -> SequenceFit | None:
    """Fit of the kind that explains more of the maps. None if no frame has `LEAST_POINTS` points."""
    enough = [frame for frame, (values, _) in samples.items() if len(values) >= LEAST_POINTS]
    if not enough:
        return None
    return min((_fit(samples, enough, kind) for kind in KINDS), key=lambda fit: fit.unexplained)


def _fit(samples: Samples, enough: list[int], kind: str) -> SequenceFit:
    def of(frame: int) -> tuple[Array, Array]:
        values, depths = samples[frame]
        return values, depths if kind == KINDS[0] else 1.0 / depths

    lines_by_frame = {frame: _line(*of(frame)) for frame in enough}
    lines = np.array([line for line, _ in lines_by_frame.values()])
    common = np.median(lines, axis=0)
    between = np.diag(np.square(_TO_SIGMA * np.median(np.abs(lines - common), axis=0)))
    fits: dict[int, FrameFit] = {}
    errors, unexplained = list[float](), list[float]()
    for frame in enough:
        line, covariance = lines_by_frame[frame]
        # A metric sequence gets one line, a network that normalises each image many, a frame with few points the common
        # one.
        line = common + between @ np.linalg.pinv(between + covariance) @ (line - common)
        values, y = of(frame)
        fit = _frame_fit(line, 0.0, len(y))
        residuals = fit.of(values) - y
        sigma = max(LEAST_SIGMA * float(np.median(y)), _TO_SIGMA * float(np.median(np.abs(residuals))))
        fits[frame] = _frame_fit(line, sigma, len(y))
        errors.append(float(np.median(np.abs(residuals / y))))
        deviation = float(np.abs(values - np.median(values)).mean())
        unexplained.append(float(np.abs(residuals * fit.slope).mean()) / max(deviation, 1e-12))
    sigma = float(np.median([fit.sigma for fit in fits.values()]))
    scale_deviation = float(np.sqrt(between[1, 1])) / max(abs(float(common[0])), 1e-12)
    for frame in samples:
        if frame not in fits:
            fits[frame] = _frame_fit(common, float(np.hypot(sigma, scale_deviation)), len(samples[frame][0]))
    residual, share = float(np.median(errors)), float(np.median(unexplained))
    return SequenceFit(kind, dict(sorted(fits.items())), residual, share)


def _frame_fit(line: Array, sigma: float, points: int) -> FrameFit:
    slope = float(line[0])
    return FrameFit(slope if abs(slope) > 1e-12 else 1e-12, float(line[1]), sigma, points)


def _line(values: Array, y: Array) -> tuple[Array, Array]:
    """(line [2], covariance [2, 2]): slope and shift of values [P] over y [P] by least absolute deviations."""
    # Values over depth, not depth over values: points are accurate to 1 %, maps less, and noisy abscissas would flatten
    # the line.
    rows = np.stack([y, np.ones_like(y)], axis=1)
    weight = np.ones_like(y)
    line = np.zeros(2)
    least = 1e-6 * max(float(np.abs(values - np.median(values)).mean()), 1e-12)
    # Absolute deviations, because an occluded point is paired with the value of its occluder. Where most points lie on
    # one wall, a redescending estimator would treat all others as outliers.
    for _ in range(_ROUNDS):
        weighted = rows * weight[:, None]
        line = np.asarray(np.linalg.lstsq(weighted.T @ rows, weighted.T @ values, rcond=None)[0], np.float64)
        weight = 1.0 / np.maximum(np.abs(values - rows @ line), least)
    sigma = _TO_SIGMA * float(np.median(np.abs(values - rows @ line)))
    # For normally distributed errors, the variance of a median is pi / 2 times that of a mean.
    covariance = 0.5 * np.pi * sigma * sigma * np.linalg.pinv(rows.T @ rows)
    return line, np.asarray(covariance, np.float64)
