"""Reads a finished scene with numpy and the product's PNG reader, without rendering.

scene.json               format version, cameras, instants, generator settings
frames/NNNNNN.png        the clip: 8-bit sRGB, frame n at time n, numbered from 1
masks/NNNNNN.npz         depth_mm, moving: of the clip's frame
truth/<t*>/NNNNNN.png    the scene frozen at t*, from the camera of frame NNNNNN
truth/<t*>/NNNNNN.npz    depth_mm, seen, moving: of that picture
truth/<t*>/behind/NNNNNN.png   in scenes of some kinds: the background behind the scene's thing

Masks and truth of a hard scene also hold thing_<name>, see regions.py.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_backend.footage.images import read_png

from .sizes import FORMAT_VERSION, OBJECT_PREFIX


@dataclass(frozen=True)
class Regions:
    """Depth and masks of one picture of the truth."""

    depth: NDArray[np.float32]
    """[H, W] metres along the camera's axis, to a millimetre; inf for sky."""
    moving: NDArray[np.bool_]
    """[H, W] the surface point moves in this view by more than `moving_px` at some frame of the clip."""
    seen: NDArray[np.bool_]
    """[H, W] the surface point is visible in the clip's own frame t*."""
    objects: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    """{name: [H, W]} things of a hard scene: glass, mirror and the nearby wall, swinging, arm, hair, the held things,
    and the region held."""

    @classmethod
    def of(cls, data: Mapping[str, NDArray]) -> Regions:
        """Regions from the arrays of an .npz file. Clip frames have no `seen`; all their pixels count as seen."""
        moving = data["moving"]
        objects = {name.removeprefix(OBJECT_PREFIX): data[name] for name in data if name.startswith(OBJECT_PREFIX)}
        seen = data["seen"] if "seen" in data else np.ones_like(moving)
        return cls(_metres(data["depth_mm"]), moving, seen, objects)


@dataclass(frozen=True)
class SyntheticScene:
    """A clip with exact cameras, and the truth at some instants. Frame numbers start at 1."""

    root: Path
    name: str
    seed: int
    kind: str
    """plain, or one of the other kinds in `sizes.KINDS`."""
    size: str
    width: int
    height: int
    fps: float
    frames: list[int]
    """Numbers of the clip's frames."""
    K: NDArray[np.float64]
    """[3, 3] pixels, centres at +0.5."""
    world_to_camera: dict[int, NDArray[np.float64]]
    """{frame: [4, 4]}, OpenCV axes, metres."""
    t_stars: list[int]
    """Instants with truth."""
    poses: list[int]
    """Frames whose cameras render each truth."""
    info: dict[str, Any]
    """All content of scene.json."""

    @classmethod
    def load(cls, path: str | Path) -> SyntheticScene:
        """A finished scene. FileNotFoundError if it is not finished, ValueError for another format version."""
        root = Path(path)
        record = root / "scene.json"
        if not record.is_file():
            raise FileNotFoundError(f"{root} is not a finished synthetic scene: it has no scene.json")
        data = json.loads(record.read_text(encoding="utf-8"))
        if data.get("version") != FORMAT_VERSION:
            raise ValueError(f"{record} has format version {data.get('version')}, this program reads {FORMAT_VERSION}")
        cameras = {c["frame"]: np.array(c["world_to_camera"]) for c in data["cameras"]}
        return cls(
            root,
            data["name"],
            data["seed"],
            data["kind"],
            data["size"],
            data["width"],
            data["height"],
            data["fps"],
            sorted(cameras),
            np.array(data["K"]),
            cameras,
            data["t_stars"],
            data["poses"],
            data,
        )

    def frame_path(self, frame: int) -> Path:
        """Path of the picture of a clip frame."""
        return self.root / "frames" / f"{frame:06d}.png"

    def truth_path(self, t_star: int, pose: int) -> Path:
        """Path of the picture of the scene frozen at `t_star`, from the camera of frame `pose`."""
        return self.root / "truth" / f"{t_star:06d}" / f"{pose:06d}.png"

    def frame(self, frame: int) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB."""
        return read_png(self.frame_path(frame))

    def truth(self, t_star: int, pose: int) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB."""
        return read_png(self.truth_path(t_star, pose))

    def regions(self, t_star: int, pose: int) -> Regions:
        """Depth and regions of a picture of the truth."""
        with np.load(self.truth_path(t_star, pose).with_suffix(".npz"), allow_pickle=False) as data:
            return Regions.of(data)

    def frame_regions(self, frame: int) -> Regions:
        """Depth and regions of a frame of the clip."""
        with np.load(self.root / "masks" / f"{frame:06d}.npz", allow_pickle=False) as data:
            return Regions.of(data)

    def behind(self, t_star: int, pose: int) -> NDArray[np.uint8] | None:
        """[H, W, 3] uint8 sRGB truth without the scene's thing, or with all held things in their other state; black
        away from it.

        None if the kind has none, or if the view does not show it.
        """
        path = self.truth_path(t_star, pose)
        path = path.parent / "behind" / path.name
        return read_png(path) if path.is_file() else None

    def frame_depth(self, frame: int) -> NDArray[np.float32]:
        """[H, W] depth of a clip frame in metres, inf for sky."""
        return self.frame_regions(frame).depth

    def frame_moving(self, frame: int) -> NDArray[np.bool_]:
        """[H, W] moving pixels of a clip frame, see Regions.moving."""
        return self.frame_regions(frame).moving

    def centres(self) -> NDArray[np.float64]:
        """[T, 3] exact camera centres in metres, in the order of `frames`."""
        views = np.array([self.world_to_camera[f] for f in self.frames])
        return -np.einsum("nji,nj->ni", views[:, :3, :3], views[:, :3, 3])


def _metres(depth_mm: NDArray[np.uint16]) -> NDArray[np.float32]:
    return np.where(depth_mm == 0, np.inf, depth_mm.astype(np.float32) / 1000.0).astype(np.float32)
