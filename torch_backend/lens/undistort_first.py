"""Undistorts frames before the solve if an ST map defines the lens."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ..contract import Reporter
from ..footage.display import display_of
from ..footage.images import read_frame, write_png
from ..shot import Shot, make_folder
from .map_lens import ST_MAP, MapLens
from .undistort import Undistorter, of_frames

_WRITERS = 2


class UndistortedFrames:
    """A folder of working frames undistorted by an ST map."""

    folder: Path
    """Folder of the pictures, which have the file names of the frames."""
    undistort: Undistorter
    """The undistortion that was applied."""
    focal_scale: float
    """Focal length of the undistorted frames over that of the original ones, both in pixels."""

    def __init__(self, shot: Shot, frames: dict[str, Any], lens: MapLens, folder: Path, report: Reporter) -> None:
        """Undistorts the frames listed in `frames` (frames.json) into `folder`.

        Raises JobError if the lens cannot be inverted, or Cancelled.
        """
        self.folder, self._lens = folder, lens
        across, down = lens.slopes_in_the_middle
        self.focal_scale = 2.0 / (across + down)
        self._where = lens.where(lens.width, lens.height)
        self.undistort = Undistorter(self._where)
        of_frame = of_frames(self.undistort, self._where, display_of(frames))
        make_folder(folder)

        def one(frame: dict[str, Any]) -> int:
            write_png(folder / Path(frame["file"]).name, of_frame(read_frame(shot.frames / frame["file"])))
            return frame["frame"]

        rows = frames["frames"]
        with ThreadPoolExecutor(_WRITERS) as pool:
            waiting = [pool.submit(one, frame) for frame in rows]
            try:
                for done, future in enumerate(waiting, start=1):
                    report.check_cancelled()
                    report.progress("solve: lens", done, len(rows), f"frame {future.result()}")
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise

    def answer_changes(self, scratch: Path) -> dict[str, Any]:
        """Fields of the worker's answer to replace, because the worker saw undistorted frames.

        Also rewrites the map in `scratch`.
        """
        file = scratch / "undistort_0.npz"
        with np.load(file, allow_pickle=False) as data:
            pinhole = data["pinhole"]
        np.savez(file, pinhole=pinhole, where=self._where, model=ST_MAP, params=np.array(self._lens.params))
        return {"camera_model": ST_MAP, "distortion": []}
