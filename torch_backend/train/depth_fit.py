"""What the values of depth maps mean: the line, per frame, between them and the depth of the solve's points.

A map is linear in depth (a sensor, a metric network) or in inverse depth (disparity); both are tried over the whole
sequence. Each frame has its own line. Lines are drawn towards the sequence's common one by as much as their spread over
the clip and their own uncertainty say (empirical Bayes): a metric sequence has one line, a network that normalises each
picture has many, and a frame with few points takes the common one.

Values are regressed on the points' depth, not the other way round: points are exact to about 1 %, maps are not, and a
line through noisy abscissas is too flat. Least absolute deviations, since a point that something hides has the value of
what hides it. A redescending estimator would be wrong here: where most points lie on one wall, it takes all others for
errors.
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
"""Points from which on a frame has a line of its own."""
LEAST_SIGMA = 0.01
"""Least standard deviation of a fitted depth, as a share of the frame's median depth: the points' own error."""
_ROUNDS = 30
"""Reweighted least squares in which the deviations settle."""
_TO_SIGMA = 1.4826
"""Standard deviation over median deviation, of Gaussian errors."""
_UNEXPLAINED, _FAR, _CLOSE = 0.5, 0.15, 0.05
"""Maps fit the solve if at most half of their deviation is not explained by the points' depth, and half of the points
are off by less than 15 %: networks reach 5 to 12 %, maps of the same room mirrored 23 %. They also fit if that is less
than 5 %, since points that all lie at one depth explain nothing."""


@dataclass(frozen=True)
class FrameFit:
    """Of one frame: value -> (value - shift) / slope, which is depth or its inverse."""

    slope: float
    """Value per scene unit, or per 1 / scene unit."""
    shift: float
    """Value at depth, or inverse depth, 0."""
    sigma: float
    """Standard deviation of the fitted depth, or inverse depth, in scene units, or 1 / scene units."""
    points: int
    """Points of the solve that lie on the frame's map."""

    def of(self, values: NDArray[np.floating]) -> Array:
        """Depth, or inverse depth, that values stand for."""
        return (values.astype(np.float64) - self.shift) / self.slope

    def inverse_of(self, values: NDArray[np.float32], kind: str) -> NDArray[np.float32]:
        """Inverse depth of values, in 1 / scene units; 0 where a value is NaN, or means nothing before the camera."""
        fitted = np.nan_to_num(self.of(values), nan=0.0)
        is_positive = fitted > 1e-12
        safe = np.where(is_positive, fitted, 1.0)
        return np.where(is_positive, safe if kind == KINDS[1] else 1.0 / safe, 0.0).astype(np.float32)


@dataclass(frozen=True)
class SequenceFit:
    """Of a whole sequence."""

    kind: str
    """One of `KINDS`: what the maps are linear in."""
    frames: dict[int, FrameFit]
    """Fits of all requested frames, ascending."""
    residual: float
    """Median over the frames of the median relative error of their points."""
    unexplained: float
    """Share, 0 to 1, of the maps' mean deviation that the points' depth does not explain; median over the frames."""

    @property
    def fits(self) -> bool:
        """False if the maps do not belong to what the solve shows."""
        return self.residual < _CLOSE or (self.residual < _FAR and self.unexplained < _UNEXPLAINED)


def fit_sequence(samples: Samples) -> SequenceFit | None:
    """The fit of maps to points, of the kind that explains more. None if no frame has `LEAST_POINTS`."""
    enough = [frame for frame, (values, _) in samples.items() if len(values) >= LEAST_POINTS]
    if not enough:
        return None
    return min((_fit(samples, enough, kind) for kind in KINDS), key=lambda fit: fit.unexplained)


def _fit(samples: Samples, enough: list[int], kind: str) -> SequenceFit:
    def of(frame: int) -> tuple[Array, Array]:
        values, depths = samples[frame]
        return values, depths if kind == KINDS[0] else 1.0 / depths

    own = {frame: _line(*of(frame)) for frame in enough}
    lines = np.array([line for line, _ in own.values()])
    common = np.median(lines, axis=0)
    between = np.diag(np.square(_TO_SIGMA * np.median(np.abs(lines - common), axis=0)))
    fits: dict[int, FrameFit] = {}
    errors, unexplained = list[float](), list[float]()
    for frame in enough:
        line, covariance = own[frame]
        line = common + between @ np.linalg.pinv(between + covariance) @ (line - common)
        values, y = of(frame)
        fit = _frame_fit(line, 0.0, len(y))
        off = fit.of(values) - y
        sigma = max(LEAST_SIGMA * float(np.median(y)), _TO_SIGMA * float(np.median(np.abs(off))))
        fits[frame] = _frame_fit(line, sigma, len(y))
        errors.append(float(np.median(np.abs(off / y))))
        deviation = float(np.abs(values - np.median(values)).mean())
        unexplained.append(float(np.abs(off * fit.slope).mean()) / max(deviation, 1e-12))
    sigma = float(np.median([fit.sigma for fit in fits.values()]))
    wander = float(np.sqrt(between[1, 1])) / max(abs(float(common[0])), 1e-12)
    for frame in samples:
        if frame not in fits:
            fits[frame] = _frame_fit(common, float(np.hypot(sigma, wander)), len(samples[frame][0]))
    residual, share = float(np.median(errors)), float(np.median(unexplained))
    return SequenceFit(kind, dict(sorted(fits.items())), residual, share)


def _frame_fit(line: Array, sigma: float, points: int) -> FrameFit:
    slope = float(line[0])
    return FrameFit(slope if abs(slope) > 1e-12 else 1e-12, float(line[1]), sigma, points)


def _line(values: Array, y: Array) -> tuple[Array, Array]:
    """(line [2], its covariance [2, 2]): slope and shift of values [P] over y [P] by least absolute deviations."""
    rows = np.stack([y, np.ones_like(y)], axis=1)
    weight = np.ones_like(y)
    line = np.zeros(2)
    least = 1e-6 * max(float(np.abs(values - np.median(values)).mean()), 1e-12)
    for _ in range(_ROUNDS):
        weighted = rows * weight[:, None]
        line = np.asarray(np.linalg.lstsq(weighted.T @ rows, weighted.T @ values, rcond=None)[0], np.float64)
        weight = 1.0 / np.maximum(np.abs(values - rows @ line), least)
    sigma = _TO_SIGMA * float(np.median(np.abs(values - rows @ line)))
    # Of Gaussian errors a median's variance is pi / 2 times that of a mean.
    covariance = 0.5 * np.pi * sigma * sigma * np.linalg.pinv(rows.T @ rows)
    return line, np.asarray(covariance, np.float64)
