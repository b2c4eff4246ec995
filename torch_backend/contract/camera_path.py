"""A pinhole camera over frames, as JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import UserError
from .files import read_json
from .typed import CONTRACT_VERSION, check_version, from_dict

CAMERA_FACTS_KEY = "splannequin"
"""Key of a transforms.json for facts from Blender that nerfstudio's format does not have: `world`;
`is_numbered_as_shot`, true if the numbers of pictures are certainly frame numbers of the shot; `notes`, a list of
[sentence, hint] for the artist."""
SCENE_WORLD = "scene"
"""Value of `world` for cameras in the axes and units of a Blender scene."""


@dataclass
class CameraFrame:
    """One pose of a camera path."""

    frame: int
    """Frame number of the clip (or of the Blender scene, for a path from Blender)."""
    viewmat: list[float]
    """16 floats, world-to-camera, row-major, OpenCV axes, solve units."""
    K: list[float]
    """fx, fy, cx, cy in pixels of the path's width and height."""
    source: str = "registered"
    """registered (by the mapper, or imported), localised (against the model), interpolated, or blender."""

    def __post_init__(self) -> None:
        if len(self.viewmat) != 16 or len(self.K) != 4:
            raise UserError(f"camera frame {self.frame}: viewmat needs 16 numbers and K needs 4")
        if not all(math.isfinite(v) for v in (*self.viewmat, *self.K)):
            raise UserError(f"camera frame {self.frame}: viewmat or K is not finite")


@dataclass
class CameraPath:
    """A pinhole camera over frames: the result of a solve, or a path from Blender."""

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    frames: list[CameraFrame]
    """Poses by ascending frame number."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def to_json(self) -> dict[str, Any]:
        """Plain types, for `json.dump`."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> CameraPath:
        """Inverse of `to_json`; ValueError on an unknown version or malformed frames."""
        check_version(data, "camera path")
        missing = {"width", "height", "frames"} - set(data)
        if missing:
            raise UserError(f"camera path has no {min(missing)}")
        frames = [from_dict(CameraFrame, f) for f in data["frames"]]
        numbers = [f.frame for f in frames]
        if numbers != sorted(set(numbers)):
            raise UserError("camera path should list its frames once each, in ascending order")
        if not (int(data["width"]) > 0 and int(data["height"]) > 0):
            raise UserError(f"camera path is {data['width']} x {data['height']} pixels: both should be above 0")
        return CameraPath(int(data["width"]), int(data["height"]), frames)

    @staticmethod
    def load(path: str | Path) -> CameraPath:
        """Reads a path; FileNotFoundError or ValueError names the file."""
        data = read_json(path)
        try:
            return CameraPath.from_json(data)
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise UserError(f"{path} is not a camera path: {error}") from error
