"""The lens of a solve: maps pixels of the original frames to pixels of the undistorted frames, and back.

COLMAP's models SIMPLE_RADIAL, RADIAL and OPENCV share one formula: the point (x, y) on the plane at depth 1 moves to
(x, y) (1 + k1 r^2 + k2 r^4) plus tangential terms in p1 and p2, and then to pixels. The code uses numpy only, in
float64, because pycolmap and OpenImageIO cannot be loaded in one process (see footage/images.py). The undistorted
frames keep the size and the principal point of the original frames; their focal length differs
(`answers.undistortion`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.stored import damaged, load_cameras, load_record
from ..contract import ExitCode, JobError
from ..shot import Shot
from .map_lens import ST_MAP, MapLens

_EXTRA = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
}
"""COLMAP model -> names of its distortion parameters, in COLMAP's order."""
_MOST_STEPS = 60
_DONE_PX = 1e-9
"""Newton's method stops when the largest error over all pixels is below this."""
_WRONG_PX = 1e-6
# Steps along each line from the middle to the border in the test for a fold.
_ALONG = 24


NARROWEST_DEG, WIDEST_DEG = 12.0, 130.0
"""Plausible angles of view along the longer side: 171 mm to 8.4 mm on full frame. A solve that cannot determine the
focal length ends outside of this range."""
LEAST_DEG, MOST_DEG = 8.0, 150.0
"""Angles of view outside of this range are an error: 257 mm, 4.8 mm."""
# Largest plausible factor by which the distortion moves a corner away from the middle, or towards it.
_MOST_STRETCH = 2.0


def view_deg(width: int, height: int, focal: float) -> float:
    """Angle of view in degrees along the longer side of a pinhole camera; 0 for an invalid focal length."""
    if not np.isfinite(focal) or focal <= 0:
        return 0.0
    return float(np.degrees(2.0 * np.arctan(0.5 * max(width, height) / focal)))


def doubtful(width: int, height: int, focal: tuple[float, float], k1: float, k2: float = 0.0) -> str:
    """Why the lens of a solve is implausible: "narrow", "wide", "bent", or "" if it is plausible.

    `focal` is fx, fy in pixels. "bent" means that the radial terms fold the picture within its corners or stretch the
    corners by more than `_MOST_STRETCH`, or that the pixels are far from square.
    """
    angle = view_deg(width, height, 0.5 * (focal[0] + focal[1]))
    if not angle >= NARROWEST_DEG:
        return "narrow"
    if angle > WIDEST_DEG:
        return "wide"
    corner = float(np.hypot(0.5 * width / focal[0], 0.5 * height / focal[1]))
    ideal = np.linspace(0.0, _MOST_STRETCH * corner, 1024)
    at = ideal * (1.0 + k1 * ideal**2 + k2 * ideal**4)
    falls = np.flatnonzero(np.diff(at) <= 0.0)
    reached = np.flatnonzero(at >= corner)
    folds = not len(reached) or (len(falls) > 0 and falls[0] < reached[0])
    if folds or ideal[reached[0]] * _MOST_STRETCH < corner or not 0.8 < focal[0] / focal[1] < 1.25:
        return "bent"
    return ""


@dataclass(frozen=True)
class Lens:
    """A lens model, and the pinhole camera of the frames undistorted with this model."""

    width: int
    """Pixels of the working frames, original and undistorted."""
    height: int
    """Pixels."""
    focal: tuple[float, float]
    """fx, fy of the original frames, pixels."""
    plate_focal: tuple[float, float]
    """fx, fy of the undistorted frames, pixels."""
    centre: tuple[float, float]
    """Principal point of original and undistorted frames, pixels, pixel centres at +0.5."""
    k1: float = 0.0
    """Radial coefficient of r^2."""
    k2: float = 0.0
    """Radial coefficient of r^4."""
    p1: float = 0.0
    """Tangential coefficient."""
    p2: float = 0.0
    """Tangential coefficient."""
    model: str = "OPENCV"
    """COLMAP's name of the model, for messages."""

    @property
    def is_none(self) -> bool:
        """True if the lens has no distortion."""
        return not any((self.k1, self.k2, self.p1, self.p2))

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of the undistorted frames, pixels."""
        return (*self.plate_focal, *self.centre)

    def to_original(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps pixels [N, 2] of the undistorted frame to pixels of the original frame. Does not test for folds."""
        return self._bent((pixels - self.centre) / self.plate_focal)[0] * self.focal + self.centre

    def to_plate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps pixels [N, 2] of the original frame to pixels of the undistorted frame, also beyond its border.

        Inverts `to_original` by Newton's method, with an error below 1e-6 px. Raises JobError (SOLVE) if the iteration
        does not converge.
        """
        target = (pixels - self.centre) / self.focal
        ideal = target.copy()
        error = np.inf
        with np.errstate(all="ignore"):
            for _ in range(_MOST_STEPS):
                at, slope = self._bent(ideal)
                offset = at - target
                error = float(np.abs(offset * self.focal).max(initial=0.0))
                if not error > _DONE_PX:  # converged, or NaN
                    break
                (a, b), (c, d) = np.moveaxis(slope, 0, -1)
                det = a * d - b * c
                ideal[:, 0] -= (d * offset[:, 0] - b * offset[:, 1]) / det
                ideal[:, 1] -= (a * offset[:, 1] - c * offset[:, 0]) / det
        if not error < _WRONG_PX:
            raise self._folded()
        return ideal * self.plate_focal + self.centre

    def check(self) -> None:
        """Raises JobError (SOLVE) if the model folds over within the original frame or within the undistorted one.

        Tests the lines from the middle to each point of both borders. The mapping is invertible if its Jacobian
        determinant is positive along all lines.
        """
        x, y = np.linspace(0.0, self.width, 2 * self.width + 1), np.linspace(0.0, self.height, 2 * self.height + 1)
        border = np.concatenate(
            [np.stack(np.broadcast_arrays(x, edge), 1) for edge in (0.0, float(self.height))]
            + [np.stack(np.broadcast_arrays(edge, y), 1) for edge in (0.0, float(self.width))]
        )
        for plate in (border, self.to_plate(border)):
            ideal = (plate - self.centre) / self.plate_focal
            lines = np.linspace(0.0, 1.0, _ALONG + 1)[:, None, None] * ideal
            slope = self._bent(lines.reshape(-1, 2))[1]
            if not np.linalg.det(slope).min() > 0.0:
                raise self._folded()

    def _bent(self, ideal: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distorted points [N, 2] at depth 1, and their derivative [N, 2, 2]: row result, column input."""
        x, y = ideal[:, 0], ideal[:, 1]
        square = x * x + y * y
        radial = 1.0 + square * (self.k1 + self.k2 * square)
        rise = 2.0 * self.k1 + 4.0 * self.k2 * square  # d radial / dx = rise * x
        at = np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (square + 2.0 * x * x),
                y * radial + 2.0 * self.p2 * x * y + self.p1 * (square + 2.0 * y * y),
            ],
            axis=1,
        )
        cross = rise * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        slope = np.empty((len(ideal), 2, 2))
        slope[:, 0, 0] = radial + rise * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        slope[:, 0, 1] = slope[:, 1, 0] = cross
        slope[:, 1, 1] = radial + rise * y * y + 2.0 * self.p2 * x + 6.0 * self.p1 * y
        return at, slope

    def _folded(self) -> JobError:
        numbers = ", ".join(f"{v:.3g}" for v in (self.k1, self.k2, self.p1, self.p2) if v)
        return JobError(
            f"The lens that the solve found ({self.model}, {numbers}) folds over towards the picture's corners, so "
            "its distortion cannot be inverted.",
            "Solve the camera again with the other kind of lens.",
            ExitCode.SOLVE,
        )


def load_lens(shot: Shot) -> Lens | MapLens:
    """The lens of a solved shot, from solve.json and cameras.json.

    Raises JobError (SOLVE) if the files do not define one supported lens for the whole clip.
    """
    record, path = load_record(shot), load_cameras(shot)
    if record.get("camera_model") == ST_MAP:
        try:
            return MapLens.from_params(path.width, path.height, record["lenses"][0]["params"], path.frames[0].K)
        except (ValueError, TypeError, KeyError, IndexError) as error:
            raise damaged(shot.solve_record, error) from error
    model, extra, focal = record.get("camera_model"), record.get("distortion"), record.get("focal_px")
    if model is None or extra is None or not focal:
        raise JobError(f"The solve of {shot.root.name} has no lens.", "Solve the camera again.", ExitCode.SOLVE)
    try:
        extra, focal = [float(value) for value in extra], float(focal)
    except (TypeError, ValueError) as error:
        raise damaged(shot.solve_record, error) from error
    if model not in _EXTRA or len(extra) != len(_EXTRA[model]):
        raise JobError(
            f"ST maps do not support the lens of this solve, {model} with {len(extra)} numbers.",
            f"Supported lenses: {', '.join(_EXTRA)}.",
            ExitCode.SOLVE,
        )
    fx, fy, cx, cy = path.frames[0].K
    if any(abs(a - b) > 1e-3 for frame in path.frames for a, b in zip(frame.K, path.frames[0].K, strict=True)):
        raise JobError(
            "The focal length changes over this clip: no single map fits it.",
            "ST maps need a lens that does not zoom.",
            ExitCode.SOLVE,
        )
    # solve.json stores the mean of fx and fy of the original frames. Undistortion scaled both by the same zoom.
    zoom = 0.5 * (fx + fy) / focal
    terms = dict(zip(_EXTRA[model], extra, strict=True))
    return Lens(path.width, path.height, (fx / zoom, fy / zoom), (fx, fy), (cx, cy), **terms, model=model)
