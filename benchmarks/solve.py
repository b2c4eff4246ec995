"""Solves clips and says how long it took and how good it is; against motion capture where there is any.

    python benchmarks/solve.py examples/sitting.mp4 --truth groundtruth.txt --times frames.txt --step 1 2 --out s.json

`--truth` is a TUM trajectory ("timestamp tx ty tz qx qy qz qw", camera to world), `--times` gives the timestamp of each
frame ("frame timestamp"). With a step above 1 the frames that it leaves out tell localisation from interpolation: both
are compared with the truth, or with one another where there is none.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_backend.contract import CameraPath, Reporter, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.shot import Shot
from torch_backend.solve import SolveConfig, solve_shot
from torch_backend.solve.poses import camera_centre, fill_poses


class Stopwatch(Reporter):
    """Reporter that keeps when each stage began."""

    def __init__(self) -> None:
        self.began = time.perf_counter()
        self.stages: dict[str, float] = {}
        self.warnings: list[str] = []

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        self.stages.setdefault(stage, time.perf_counter() - self.began)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)

    def seconds_by_stage(self) -> dict[str, float]:
        starts = [*self.stages.values(), time.perf_counter() - self.began]
        return {name: round(b - a, 2) for name, a, b in zip(self.stages, starts, starts[1:])}


def align(source: NDArray, target: NDArray) -> tuple[float, NDArray, NDArray]:
    """Scale, rotation, translation that take [N, 3] `source` nearest to `target` (Umeyama, PAMI 1991)."""
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd(t.T @ s / len(s))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    scale = float((d * np.diag(sign)).sum() / (s**2).sum() * len(s))
    return scale, rotation, mean_t - scale * rotation @ mean_s


def truth_centres(truth: Path, times: Path, frames: list[int]) -> NDArray[np.float64]:
    """[N, 3] metres: the motion-capture position at each frame's timestamp, interpolated."""
    path = np.loadtxt(truth)
    stamps = dict(np.loadtxt(times)[:, :2])
    at = np.array([stamps[float(frame)] for frame in frames])
    return np.stack([np.interp(at, path[:, 0], path[:, 1 + axis]) for axis in range(3)], axis=1)


def rmse(errors: NDArray) -> float:
    return float(np.sqrt((errors**2).mean())) if errors.size else float("nan")


def rotation_degrees(a: NDArray, b: NDArray) -> float:
    cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def judge(shot: Shot, truth: Path | None, times: Path | None) -> dict[str, Any]:
    """Errors of the path by how each pose was found, and of what interpolation would have given in their place."""
    path = CameraPath.load(shot.solve / "cameras.json")
    poses = [np.reshape(f.viewmat, (4, 4)) for f in path.frames]
    sources = np.array([f.source for f in path.frames])
    seconds = np.array([f["seconds"] for f in read_json(shot.frames / "frames.json")["frames"]])
    known = {i: p for i, p in enumerate(poses) if sources[i] == "registered"}
    filled = fill_poses(seconds, known)
    centres, guessed = (np.array([camera_centre(p) for p in group]) for group in (poses, filled))
    registered, localised = sources == "registered", sources == "localised"
    result: dict[str, Any] = {}
    if localised.any():
        step = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        gap = np.linalg.norm(centres - guessed, axis=1)[localised]
        turn = [rotation_degrees(poses[i], filled[i]) for i in np.flatnonzero(localised)]
        result["interpolated_against_localised"] = {
            "centre_median_in_frame_steps": round(float(np.median(gap) / np.median(step)), 3),
            "rotation_median_deg": round(float(np.median(turn)), 4),
            "rotation_max_deg": round(float(np.max(turn)), 4),
            "shift_median_px": round(float(np.median(np.radians(turn)) * path.frames[0].K[0]), 2),
        }
    if truth and times:
        target = truth_centres(truth, times, [f.frame for f in path.frames])
        scale, rotation, shift = align(centres[registered], target[registered])
        for name, points, chosen in (
            ("registered", centres, registered),
            ("localised", centres, localised),
            ("interpolated_instead", guessed, localised),
        ):
            errors = np.linalg.norm((scale * points @ rotation.T + shift - target)[chosen], axis=1)
            result[f"{name}_rmse_mm"] = round(1e3 * rmse(errors), 2) if errors.size else None
    return result


def run(clip: Path, step: int, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Imports and solves one clip; its figures."""
    shot = Shot.create(folder / f"{clip.stem}-{step}.splannequin")
    started = time.perf_counter()
    import_footage(shot, str(clip.absolute()), FootageConfig(step=step), Stopwatch())
    imported = time.perf_counter()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    watch = Stopwatch()
    result = solve_shot(shot, SolveConfig(camera_model=args.camera_model, features=args.features), watch)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "clip": clip.stem,
        "step": shot.info().step,
        **result,
        "import_seconds": round(imported - started, 2),
        "solve_seconds": round(time.perf_counter() - imported, 2),
        "colmap_cpu_seconds": round(after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime, 2),
        "seconds_by_stage": watch.seconds_by_stage(),
        "warnings": watch.warnings,
        **judge(shot, args.truth, args.times),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--step", nargs="+", type=int, default=[0])
    parser.add_argument("--camera-model", default="SIMPLE_RADIAL")
    parser.add_argument("--features", type=int, default=SolveConfig.features)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--times", type=Path)
    parser.add_argument("--keep", type=Path, help="folder for the shots; a temporary one otherwise")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        rows = [run(clip, step, args, folder) for clip in args.clips for step in args.step]
    text = json.dumps(rows, indent=1)
    print(text)
    if args.out:
        args.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
