"""The lens with which each frame was undistorted, for pictures of any size, including zooms and fisheyes.

`lens.Lens` maps both ways and serves a whole clip. `PlateLens` only maps undistorted pixels to original pixels, but
supports every lens model of a solve, with one lens per frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import meshgrid
from ..cameras import imported
from ..cameras.stored import damaged, load_cameras, load_record
from ..shot import Shot
from .lens import load_lens
from .map_lens import ST_MAP, MapLens

_ROWS = 64


@dataclass(frozen=True)
class PlateLens:
    """A lens, and the pinhole camera of the frames undistorted with this lens."""

    lens: imported.Lens
    """Lens of the original working frames."""
    pinhole: tuple[float, float, float, float]
    """fx, fy, cx, cy of the undistorted frames, pixels."""

    @property
    def is_none(self) -> bool:
        """True if original and undistorted frames are the same."""
        fx, fy, cx, cy, *bend = self.lens.params
        is_undistorted = self.lens.model != "OPENCV_FISHEYE" and not any(bend)
        return is_undistorted and bool(np.allclose((fx, fy, cx, cy), self.pinhole, rtol=1e-9, atol=0.0))

    def where(self, width: int, height: int) -> NDArray[np.float32]:
        """Position [height, width, 2] in the original picture of each pixel of the undistorted plate of the same size.

        x and y in pixels, centres at +0.5.
        """
        # Two scales: rounding to whole pixels may change the aspect ratio of the working frames.
        ratio = np.array([width / self.lens.width, height / self.lens.height])
        fx, fy, cx, cy = self.pinhole
        out = np.empty((height, width, 2), np.float32)
        x = ((np.arange(width) + 0.5) / ratio[0] - cx) / fx
        for top in range(0, height, _ROWS):
            y = ((np.arange(top, min(top + _ROWS, height)) + 0.5) / ratio[1] - cy) / fy
            out[top : top + _ROWS] = self._original(*meshgrid(x, y)) * ratio
        return out

    def _original(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [..., 2] of the original working frame for points at depth 1, by COLMAP's lens models."""
        fx, fy, cx, cy, *bend = self.lens.params
        k = np.array([*bend, *[0.0] * 8])
        square = x * x + y * y
        if self.lens.model == "OPENCV_FISHEYE":
            r = np.sqrt(square)
            angle = np.arctan(r)
            a2 = angle * angle
            bent = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
            scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-12)
            u, v = x * scale, y * scale
        else:
            scale = 1.0 + square * (k[0] + square * (k[1] + square * k[4]))
            if self.lens.model == "FULL_OPENCV":
                scale = scale / (1.0 + square * (k[5] + square * (k[6] + square * k[7])))
            u = x * scale + 2.0 * k[2] * x * y + k[3] * (square + 2.0 * x * x)
            v = y * scale + 2.0 * k[3] * x * y + k[2] * (square + 2.0 * y * y)
        return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def load_plate_lenses(shot: Shot) -> dict[int, PlateLens | MapLens]:
    """The lens of every solved frame, by frame number. Frames with the same lens share the object.

    Raises JobError (SOLVE) if the shot is not solved, its files are damaged, or an earlier version solved it with a
    zoom or a fisheye and did not store the lenses.
    """
    record, path = load_record(shot), load_cameras(shot)
    recorded = record.get("lenses")
    if recorded is None or record.get("camera_model") == ST_MAP:
        one = load_lens(shot)
        if isinstance(one, MapLens):
            return dict.fromkeys((frame.frame for frame in path.frames), one)
        lens = imported.Lens("OPENCV", one.width, one.height, (*one.focal, *one.centre, one.k1, one.k2, one.p1, one.p2))
        return dict.fromkeys((frame.frame for frame in path.frames), PlateLens(lens, one.intrinsics))
    try:
        known = [
            imported.lens_from_colmap(str(x["model"]), path.width, path.height, [float(p) for p in x["params"]])
            for x in recorded
        ]
        index = [int(n) for n in record["lens_of_frame"]]
        shared: dict[tuple[int, tuple[float, ...]], PlateLens] = {}
        lenses: dict[int, PlateLens | MapLens] = {}
        for frame, n in zip(path.frames, index, strict=True):
            fx, fy, cx, cy = frame.K
            lenses[frame.frame] = shared.setdefault((n, tuple(frame.K)), PlateLens(known[n], (fx, fy, cx, cy)))
        return lenses
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise damaged(shot.solve_record, error) from error
