"""One normalised scene from a solved shot: cameras, sparse points, training images, time.

All later stages work in scene units. The origin is the median of the camera centres, and the 95th percentile of their
distance from it is 1. Learning rates, near planes and thresholds therefore mean the same in every shot. `Scene.scale`
and `Scene.centre` convert back to solve units: x_solve = x_scene / scale + centre.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .cameras.stored import damaged, load_cameras, load_points
from .contract import ExitCode, JobError, Reporter, UserError, frame_file
from .footage.display import PLAIN, Display, display_of
from .footage.images import read_frame
from .footage.importing import load_frames
from .motion.mattes import load_surface
from .native import default_threads
from .shot import Shot, make_folder, need_disk
from .torch_types import from_numpy


@dataclass
class Scene:
    """Cameras and points of a shot in scene units (see module). F delivered frames, P points."""

    frames: list[int]
    """[F] frame numbers of the clip, ascending: every source frame of the range."""
    seconds: np.ndarray
    """[F] float64, time of each frame since the first of the range."""
    times: np.ndarray
    """[F] float64, the same normalised to [0, 1] over the trained range."""
    viewmats: Tensor
    """[F, 4, 4] float32 world-to-camera, OpenCV, scene units."""
    Ks: Tensor
    """[F, 3, 3] float32 in pixels of `width` x `height`."""
    width: int
    """Width in pixels of the working frames."""
    height: int
    """Height in pixels of the working frames."""
    solved: list[int]
    """Indices into `frames`, ascending, of frames with a registered pose that the step keeps for training."""
    points: Tensor
    """[P, 3] float32 sparse points, scene units."""
    colors: Tensor
    """[P, 3] float32 display-referred colour of the points, 0 to 1."""
    scale: float
    """Scene units per solve unit."""
    centre: np.ndarray
    """[3] float64, origin of the scene in solve units."""
    folder: Path
    """Folder of the undistorted working frames."""
    display: Display = PLAIN
    """Display of the working frames: how pixel values relate to light."""

    def image_path(self, index: int) -> Path:
        """Path of the undistorted working frame at `index` into `frames`."""
        return self.folder / frame_file(self.frames[index], ".png")

    def time_of_frame(self, frame: float) -> float:
        """Normalised time of a (possibly fractional) frame number, clamped to the range."""
        return float(np.interp(frame, self.frames, self.times))

    def nearest(self, frame: float) -> int:
        """Index of the frame nearest to a (possibly fractional) frame number; the earlier of two equally near ones."""
        return int(np.abs(np.asarray(self.frames, np.float64) - frame).argmin())

    def camera_centres(self) -> Tensor:
        """Camera centres [F, 3] in scene units."""
        return -(self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:])[..., 0]

    def from_solve(self, viewmats: np.ndarray) -> Tensor:
        """World-to-camera matrices [..., 4, 4] converted from solve units to scene units, float32."""
        return from_numpy(_in_scene(viewmats, self.scale, self.centre)).float()

    def camera_at(self, width: int, height: int) -> Tensor:
        """`Ks` rescaled to another image size, [F, 3, 3]."""
        return resize_intrinsics(self.Ks, self.width, self.height, width, height)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Up to `most` evenly spaced integers from 0 to count - 1, ascending, with both ends."""
    numbers = np.linspace(0, count - 1, min(most, count)).round().astype(np.int64)
    return sorted({int(number) for number in numbers})


def resize_intrinsics(Ks: Tensor, width: int, height: int, new_width: int, new_height: int) -> Tensor:
    """Intrinsics [C, 3, 3] of the same camera with another image size in pixels (pixel centres at +0.5)."""
    ratio = torch.tensor([[new_width / width], [new_height / height], [1.0]], dtype=Ks.dtype)
    return Ks * ratio


def load_scene(shot: Shot) -> Scene:
    """The scene of a solved shot. JobError if it is not solved, is damaged, or cannot be normalised."""
    path, sparse, table = load_cameras(shot), load_points(shot), frame_table(shot)
    frames = [camera.frame for camera in path.frames]
    if not set(frames) <= set(table):
        raise damaged(shot.cameras, f"frame {min(set(frames) - set(table))} was not imported")
    viewmats = np.array([camera.viewmat for camera in path.frames], dtype=np.float64).reshape(-1, 4, 4)
    solved = [i for i, c in enumerate(path.frames) if c.source == "registered" and table[c.frame]["solve"]]
    if len(solved) < 3:
        raise JobError(f"Only {len(solved)} frames have a solved camera.", "Solve the shot again.", ExitCode.SOLVE)
    xyz, rgb = sparse["xyz"].astype(np.float64), sparse["rgb"]
    scale, centre = _normalisation(viewmats[solved], xyz)
    seconds = np.array([table[f]["seconds"] for f in frames], dtype=np.float64)
    seconds -= seconds[0]
    start, end = seconds[solved[0]], seconds[solved[-1]]
    if not end > start:
        raise JobError("All solved frames have the same time stamp.", "Import the clip again.", ExitCode.FOOTAGE)
    return Scene(
        frames=frames,
        seconds=seconds,
        times=np.clip((seconds - start) / (end - start), 0.0, 1.0),
        viewmats=from_numpy(_in_scene(viewmats, scale, centre)).float(),
        Ks=torch.tensor([[[c.K[0], 0, c.K[2]], [0, c.K[1], c.K[3]], [0, 0, 1]] for c in path.frames]).float(),
        width=path.width,
        height=path.height,
        solved=solved,
        points=from_numpy((xyz - centre) * scale).float(),
        colors=from_numpy(rgb).float() / 255.0,
        scale=scale,
        centre=centre,
        folder=shot.frames,
        display=display_of(load_frames(shot)),
    )


def surface_of(scene: Scene) -> tuple[Tensor, Tensor, list[int]]:
    """Dense points of still surfaces: (points [S, 3] scene units, colours [S, 3] as `Scene.colors`, frame number of
    each). Empty for a shot that was solved before such points were stored.
    """
    found = load_surface(Shot(scene.folder.parent))
    points = (found.xyz.astype(np.float64) - scene.centre) * scene.scale
    return from_numpy(points).float(), from_numpy(found.rgb).float() / 255.0, found.frames.tolist()


def frame_table(shot: Shot) -> dict[int, dict[str, Any]]:
    """Frame number -> its row of frames.json. JobError if the file is missing or damaged."""
    return {int(row["frame"]): row for row in load_frames(shot)["frames"]}


def _in_scene(viewmats: np.ndarray, scale: float, centre: np.ndarray) -> np.ndarray:
    """World-to-camera matrices [..., 4, 4] after the world was moved by -centre and scaled."""
    moved = np.array(viewmats, dtype=np.float64)
    moved[..., :3, 3] = scale * (moved[..., :3, 3] + moved[..., :3, :3] @ centre)
    return moved


def _normalisation(viewmats: np.ndarray, points: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and centre of the cameras [S, 4, 4]. A percentile keeps an outlier camera from shrinking the scene."""
    centres = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    centre = np.median(centres, axis=0)
    extent = float(np.percentile(np.linalg.norm(centres - centre, axis=1), 95))
    depth = float(np.median(np.linalg.norm(points - centre, axis=1))) if len(points) else 0.0
    if not np.isfinite(extent) or extent <= 1e-4 * max(depth, 1e-12):
        raise JobError(
            "The camera hardly moves in this clip, so depth cannot be estimated.",
            "Use footage in which the camera travels.",
            ExitCode.SOLVE,
        )
    return 1.0 / extent, centre


def split_frames(solved: list[int], holdout: int, phase: int = 0) -> tuple[list[int], list[int]]:
    """(training, held-out) indices: every `holdout`-th solved frame is held out, never the first or last; 0: none."""
    if holdout <= 0:
        return list(solved), []
    if holdout < 2:
        raise UserError(f"holdout is {holdout}: it should be 0 or at least 2")
    test = [i for n, i in enumerate(solved) if n % holdout == phase % holdout and 0 < n < len(solved) - 1]
    held_out = set(test)
    return [i for i in solved if i not in held_out], test


_DECODERS = 8
"""Largest number of frames decoded at the same time. Each one needs some tens of megabytes."""
IMAGE_MEMORY_BYTES = 1 << 30
"""Largest size of the training images held in memory, in bytes. Larger sets are mapped from a file."""


def load_images(
    scene: Scene,
    indices: list[int],
    width: int,
    height: int,
    report: Reporter | None = None,
    folder: Path | None = None,
    read: Callable[[int], Tensor] | None = None,
) -> Tensor:
    """Working frames `indices` at a training size, [I, height, width, 3] float16 in [0, 1] of the scene's display.

    float16 keeps more than 8 bits over [0, 1] and halves the memory of a long clip. More than `IMAGE_MEMORY_BYTES` of
    images are mapped from an unnamed file in `folder`, unless that is None. The file vanishes with the process.
    JobError if the disk has no room for it.

    Several frames are decoded at a time. `read` replaces the decoder: index into `Scene.frames` -> [height, width, 3]
    in [0, 1]. It is called for one frame after the other, in the clip's order.
    """
    shape = len(indices), height, width, 3
    if folder is None or 2 * math.prod(shape) <= IMAGE_MEMORY_BYTES:
        images = torch.empty(*shape, dtype=torch.float16)
    else:
        images = _mapped(folder, shape)

    def load(n: int) -> None:
        index = indices[n]
        if read is not None:
            images[n] = read(index)
        else:
            images[n] = read_image(scene.image_path(index), width, height, scene.display)

    order = range(len(indices)) if read is None else sorted(range(len(indices)), key=lambda n: indices[n])
    pool = ThreadPoolExecutor(1 if read is not None else min(default_threads(), _DECODERS), "frames in")
    try:
        for done, (n, loaded) in enumerate([(n, pool.submit(load, n)) for n in order], start=1):
            loaded.result()
            if report:
                report.check_cancelled()
                report.progress("loading frames", done, len(indices), f"frame {scene.frames[indices[n]]}")
    finally:
        pool.shutdown(cancel_futures=True)
    return images


def _mapped(folder: Path, shape: tuple[int, ...]) -> Tensor:
    """float16 tensor mapped from a temporary file in `folder`, which vanishes with the process."""
    size = 2 * math.prod(shape)
    make_folder(folder)
    need_disk(folder, size, "The file of training frames that do not fit into memory")
    with tempfile.TemporaryFile(dir=folder, prefix="frames-") as file:
        if hasattr(os, "posix_fallocate"):  # a disk that fills up later would kill the process
            os.posix_fallocate(file.fileno(), 0, size)
        return from_numpy(np.memmap(file, dtype=np.float16, mode="r+", shape=shape))


def read_image(path: Path, width: int, height: int, display: Display = PLAIN) -> Tensor:
    """One image, in values of `display`, resized to [height, width, 3] float32 in [0, 1]. Errors as `read_frame`."""
    pixels = read_frame(path)
    limit = 65535.0 if pixels.dtype == np.uint16 else 255.0
    values = pixels.astype(np.float32) / limit
    if values.shape[:2] == (height, width):
        return from_numpy(values)
    image = from_numpy(display.straightened(values)).permute(2, 0, 1)[None]
    exact = image.shape[-2] % height == 0 and image.shape[-1] % width == 0
    mode, antialias = ("area", False) if exact else ("bicubic", True)
    image = torch.nn.functional.interpolate(image, (height, width), mode=mode, antialias=antialias)
    return from_numpy(display.bent(image[0].permute(1, 2, 0).numpy())).clamp(0.0, 1.0)
