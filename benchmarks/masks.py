"""Cameras of a clip of which a share moves on its own, with a mask of it and without.

    python -m benchmarks.masks [--share 0.3 0.5 0.7] [--width 320 640] [--frames 30] [--seed 0] [--without]

The room of the solve's tests, ray-cast through its lens; patterned boards go to and fro before it, as large as it takes
to cover the share of the picture. Prints, against the true path, after the similarity that fits best: median error of
rotation in degrees, of position in percent of the path's length, of the focal length in percent. Needs the packages of
the tests.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.solve import Stopwatch, align, rotation_degrees
from tests.backend.solved_room import FOCAL, RADIAL, WIDTH, handheld, the_room
from torch_backend.cameras.poses import camera_centre
from torch_backend.contract import CameraPath, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import write_png
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot

BOARDS = 4


class Boards:
    """Patterned boards that go to and fro, each its own way; positions are shares of the picture."""

    def __init__(self, size: tuple[int, int], share: float, frames: int, seed: int) -> None:
        """size: (width, height) in pixels; share: of the picture that they cover, in the mean of the frames."""
        rng = np.random.default_rng(seed)
        self.size, self.frames = size, frames
        grid = np.stack(np.meshgrid(np.linspace(0.2, 0.8, BOARDS // 2), [0.3, 0.7]), -1).reshape(-1, 2)
        self.middles = grid + rng.uniform(-0.08, 0.08, grid.shape)
        self.sways, self.phases = rng.uniform(0.05, 0.15, grid.shape), rng.uniform(0.0, 6.3, grid.shape)
        small = rng.integers(0, 256, (BOARDS, size[1] // 3, size[0] // 3, 3), np.uint8)
        self.patterns = [cv2.resize(one, (2 * size[0], 2 * size[1]), interpolation=cv2.INTER_CUBIC) for one in small]
        low, high = 0.0, 1.0
        for _ in range(20):
            self.half = 0.5 * (low + high)
            covered = np.mean([self.on(n).mean() for n in range(0, frames, 3)])
            low, high = (self.half, high) if covered < share else (low, self.half)

    def _at(self, n: int, board: int) -> NDArray[np.float64]:
        """[2] pixels: its middle in a frame."""
        way = 6.3 * 1.5 * n / self.frames + self.phases[board]
        return (self.middles[board] + self.sways[board] * np.sin(way)) * self.size

    def _inside(self, n: int, board: int) -> NDArray[np.bool_]:
        (width, height), (x, y) = self.size, self._at(n, board)
        columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
        half = self.half * width / 2, self.half * height / 2
        return (abs(rows - y) < half[1])[:, None] & (abs(columns - x) < half[0])

    def on(self, n: int) -> NDArray[np.bool_]:
        """[H, W]: where a board is."""
        return np.any([self._inside(n, board) for board in range(BOARDS)], axis=0)

    def over(self, picture: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
        """A frame with the boards before it."""
        width, height = self.size
        for board, pattern in enumerate(self.patterns):
            x, y = np.rint(self._at(n, board)).astype(int)
            shown = np.roll(pattern, (y, x), axis=(0, 1))[:height, :width]
            picture = np.where(self._inside(n, board)[..., None], shown, picture)
        return picture


def make(folder: Path, width: int, share: float, frames: int, seed: int) -> tuple[Path, Path, list[NDArray], float]:
    """(clip, masks, true world-to-camera poses [4, 4], share that is covered); writes both as pictures."""
    scale, rng, room, poses = width / WIDTH, np.random.default_rng(seed + 1), the_room(), handheld(frames)
    size = width, width * 3 // 4
    boards = Boards(size, share, frames, seed)
    clip, masks = folder / "clip", folder / "mask"
    clip.mkdir(parents=True)
    masks.mkdir()
    covered: list[float] = []
    for n, pose in enumerate(poses):
        K = (FOCAL * scale, FOCAL * scale, size[0] / 2, size[1] / 2)
        picture, on = boards.over(room.render(pose, K, RADIAL, size), n), boards.on(n)
        noisy = np.clip(np.rint(picture + rng.normal(0.0, 1.0, picture.shape)), 0, 255).astype(np.uint8)
        write_png(clip / f"f.{101 + n}.png", noisy)
        write_png(masks / f"m.{101 + n}.png", np.repeat(np.where(on, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
        covered.append(float(on.mean()))
    return clip, masks, poses, float(np.mean(covered))


def judge(shot: Shot, poses: list[NDArray], focal: float) -> dict[str, Any]:
    """Errors of the registered cameras."""
    record = read_json(shot.solve_record)
    found = [f for f in CameraPath.load(shot.cameras).frames if f.source == "registered"]
    ours = [np.reshape(f.viewmat, (4, 4)) for f in found]
    true = [poses[f.frame - 101] for f in found]
    centres, there = (np.array([camera_centre(pose) for pose in group]) for group in (ours, true))
    scale, rotation, shift = align(centres, there)
    length = np.linalg.norm(np.diff([camera_centre(pose) for pose in poses], axis=0), axis=1).sum()
    off = np.linalg.norm(scale * centres @ rotation.T + shift - there, axis=1)
    # Of the world there is one rotation that is nobody's: the mean over the cameras.
    u, _, vt = np.linalg.svd(sum(t[:3, :3].T @ o[:3, :3] for o, t in zip(ours, true, strict=True)))
    world = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turned = [rotation_degrees(o[:3, :3] @ world.T, t[:3, :3]) for o, t in zip(ours, true, strict=True)]
    return {
        "registered": len(found),
        "rotation_median_deg": round(float(np.median(turned)), 3),
        "position_median_percent": round(100.0 * float(np.median(off) / length), 3),
        "focal_percent": round(100.0 * (record["focal_px"] / focal - 1.0), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, nargs="+", default=[0.3, 0.5, 0.7])
    parser.add_argument("--width", type=int, nargs="+", default=[320, 640])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", action="store_true", help="solve without the mask, too")
    args = parser.parse_args()
    for width in args.width:
        for share in args.share:
            with tempfile.TemporaryDirectory() as folder:
                clip, masks, poses, covered = make(Path(folder), width, share, args.frames, args.seed)
                for mask in (str(masks), "") if args.without else (str(masks),):
                    shot = Shot.create(Path(folder) / f"room{bool(mask)}.splannequin")
                    row: dict[str, Any] = {"width": width, "covered": round(covered, 3), "mask": bool(mask)}
                    try:
                        import_footage(shot, str(clip), FootageConfig(step=1), Stopwatch())
                        solve_shot(shot, SolveConfig(people_mask=mask), Stopwatch())
                        row |= judge(shot, poses, FOCAL * width / WIDTH)
                    except JobError as error:
                        row["refused"] = error.message
                    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
