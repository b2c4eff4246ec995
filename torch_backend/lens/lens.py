"""The lens of a solve: between pixels of the original frames and pixels of the undistorted ones, both ways.

COLMAP's models SIMPLE_RADIAL, RADIAL and OPENCV are one formula: (x, y) on the plane at depth 1 is moved to
(x, y) (1 + k1 r^2 + k2 r^4) plus tangential terms in p1 and p2, and then to pixels. numpy alone, float64: pycolmap
cannot be loaded beside OpenImageIO (see footage/images.py). The undistorted frames have the size and the principal
point of the original ones and a focal length of their own (`answers.undistortion`).
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
"""COLMAP model -> what its distortion parameters are, in their order."""
_MOST_STEPS = 60
_DONE_PX = 1e-9
"""Newton ends when no pixel is farther than this from where it should be."""
_WRONG_PX = 1e-6
_ALONG = 24
"""Points on each line from the middle to the border at which the picture is tested for a fold."""


NARROWEST_DEG, WIDEST_DEG = 12.0, 130.0
"""Range of plausible angles of view along the longer side: 171 mm to 8.4 mm on full frame. A focal length that nothing
in the clip holds runs off beyond them."""
LEAST_DEG, MOST_DEG = 8.0, 150.0
"""Beyond these it is refused: 257 mm, 4.8 mm."""
_MOST_STRETCH = 2.0
"""How much farther from the middle than straight lines have it a corner may lie, or how much less far."""


def view_deg(width: int, height: int, focal: float) -> float:
    """Angle of view in degrees along the longer side of a pinhole camera; 0 or 180 where there is no focal length."""
    if not np.isfinite(focal) or focal <= 0:
        return 0.0
    return float(np.degrees(2.0 * np.arctan(0.5 * max(width, height) / focal)))


def doubtful(width: int, height: int, focal: tuple[float, float], k1: float, k2: float = 0.0) -> str:
    """Why a lens that a solve found cannot be right: "narrow", "wide", "bent", or "" if it can.

    `focal` is fx, fy in pixels. A lens is bent if its radial terms fold the picture over before its corner, or stretch
    the corner out of all measure, or if its pixels are far from square.
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
    """A lens model and the pinhole camera of the frames that were undistorted with it."""

    width: int
    """Pixels of the working frames, original and undistorted."""
    height: int
    """Pixels."""
    focal: tuple[float, float]
    """fx, fy of the original frames, pixels."""
    plate_focal: tuple[float, float]
    """fx, fy of the undistorted frames, pixels."""
    centre: tuple[float, float]
    """Principal point of both, pixels, pixel centres at +0.5."""
    k1: float = 0.0
    """Radial."""
    k2: float = 0.0
    """Radial."""
    p1: float = 0.0
    """Tangential."""
    p2: float = 0.0
    """Tangential."""
    model: str = "OPENCV"
    """COLMAP's name, for sentences."""

    @property
    def is_none(self) -> bool:
        """True if the original frames are straight already."""
        return not any((self.k1, self.k2, self.p1, self.p2))

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of the undistorted frames, pixels."""
        return (*self.plate_focal, *self.centre)

    def to_original(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [N, 2] of the undistorted frame -> where they lie in the original one. No test for folds."""
        return self._bent((pixels - self.centre) / self.plate_focal)[0] * self.focal + self.centre

    def to_plate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [N, 2] of the original frame -> where they lie in the undistorted one, or beyond its border.

        The inverse of `to_original` by Newton's method to 1e-6 px and better. JobError (SOLVE) where there is none.
        """
        target = (pixels - self.centre) / self.focal
        ideal = target.copy()
        error = np.inf
        with np.errstate(all="ignore"):
            for _ in range(_MOST_STEPS):
                at, slope = self._bent(ideal)
                off = at - target
                error = float(np.abs(off * self.focal).max(initial=0.0))
                if not error > _DONE_PX:  # done, or not a number any more
                    break
                (a, b), (c, d) = np.moveaxis(slope, 0, -1)
                det = a * d - b * c
                ideal[:, 0] -= (d * off[:, 0] - b * off[:, 1]) / det
                ideal[:, 1] -= (a * off[:, 1] - c * off[:, 0]) / det
        if not error < _WRONG_PX:
            raise self._folded()
        return ideal * self.plate_focal + self.centre

    def check(self) -> None:
        """JobError (SOLVE) if the model folds over within the original frame or within the undistorted one.

        Both borders are walked round, and the lines from the middle to each of their points: where the picture keeps
        its orientation all along, each point is met once, and there is a way back.
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
        """Points [N, 2] at depth 1 as the lens bends them, and the derivative [N, 2, 2]: row result, column input."""
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
            f"The lens that the solve found ({self.model}, {numbers}) folds over towards the picture's corners: "
            "there is no way back through it.",
            "Solve the camera again with the other kind of lens.",
            ExitCode.SOLVE,
        )


def load_lens(shot: Shot) -> Lens | MapLens:
    """The lens of a solved shot, from solve.json and cameras.json. JobError (SOLVE) if they do not tell it."""
    record, path = load_record(shot), load_cameras(shot)
    if record.get("camera_model") == ST_MAP:
        try:
            return MapLens.from_params(path.width, path.height, record["lenses"][0]["params"], path.frames[0].K)
        except (ValueError, TypeError, KeyError, IndexError) as error:
            raise damaged(shot.solve_record, error) from error
    model, extra, focal = record.get("camera_model"), record.get("distortion"), record.get("focal_px")
    if model is None or extra is None or not focal:
        raise JobError(
            f"The solve of {shot.root.name} does not tell its lens.", "Solve the camera again.", ExitCode.SOLVE
        )
    if model not in _EXTRA or len(extra) != len(_EXTRA[model]):
        raise JobError(
            f"The lens of this solve is {model} with {len(extra)} numbers: there are no maps for it.",
            f"Known are {', '.join(_EXTRA)}.",
            ExitCode.SOLVE,
        )
    fx, fy, cx, cy = path.frames[0].K
    if any(abs(a - b) > 1e-3 for frame in path.frames for a, b in zip(frame.K, path.frames[0].K, strict=True)):
        raise JobError(
            "The focal length changes over this clip: no single map fits it.",
            "The maps are for lenses that do not zoom.",
            ExitCode.SOLVE,
        )
    # solve.json has the mean of fx and fy of the original frames; both were given the same zoom.
    zoom = 0.5 * (fx + fy) / float(focal)
    terms = {name: float(value) for name, value in zip(_EXTRA[model], extra, strict=True)}
    return Lens(path.width, path.height, (fx / zoom, fy / zoom), (fx, fy), (cx, cy), **terms, model=model)
