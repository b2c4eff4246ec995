"""Cameras of a matchmove file against the product's solve: `python -m benchmarks.matchmove SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic. Blender writes its true camera as Alembic and as USD. The product's command
lines then solve the clip three times: without a camera file, and with the cameras of each file, read by Blender's
importer. Each solve trains one run per seed, with every 8th frame held out. The table has the residual in pixels, the
distance of the cameras from the true ones after the best similarity, and the PSNR of the held-out frames. The residual
is also given over the keypoints that the product's solve triangulates: it adjusts cameras to them and keeps fewer.
Finished solves and runs are not repeated, so seeds can be added later.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np

from benchmarks.sources import ROOT, Log, child_environ, in_words, last_words
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.make import find_bpy
from benchmarks.synthetic.shot import import_clip, similarity_to_exact
from torch_backend.contract import RunFolder, read_json
from torch_backend.shot import SHOT_SUFFIX, Shot, write_json

SOURCES = {"solve": "our solve", "abc": "Alembic", "usdc": "USD"}
"""Source of the cameras (file ending) -> name in the table."""
HEADINGS = (
    "| scene | cameras | residual, px | points | same keypoints, px: mean and median (our solve) | focal length, px "
    "| position error, mm | rotation error, degrees | held out, dB |"
)


def camera_file(scene: SyntheticScene, folder: Path, ending: str, bpy: Path) -> Path:
    """FOLDER/camera.ENDING with the true camera of a scene, written if missing."""
    file = folder / f"camera.{ending}"
    if not file.exists():
        source = folder / "camera.json"
        frames = [[number, scene.world_to_camera[number].tolist()] for number in scene.frames]
        lens = {"width": scene.width, "height": scene.height, "fps": scene.fps, "K": scene.K.tolist()}
        write_json(source, {**lens, "frames": frames})
        _run([bpy, ROOT / "benchmarks" / "synthetic" / "write_camera_bpy.py", source, file])
    return file


def solved(scene: SyntheticScene, folder: Path, source: str, bpy: Path) -> Shot:
    """A shot of the scene's clip with cameras from one of `SOURCES`."""
    shot = import_clip(scene, folder / f"{source}{SHOT_SUFFIX}", Log())
    if source == "solve":
        _backend("solve", shot.root)
    else:
        file = camera_file(scene, folder, source, bpy)
        words = ["solve", shot.root, "--cameras", file]
        _run([bpy, "-P", ROOT / "splannequin_addon" / "run_in_bpy.py", *words])
    return shot


def compared(shot: Shot, ours: Shot) -> str:
    """Mean and median residual over the keypoints triangulated by both solves; those of `ours` in brackets."""
    printed = _run([sys.executable, "-P", "-m", "benchmarks.synthetic.residuals", shot.colmap, ours.colmap])
    one, second = ({(name, x, y): error for name, x, y, error in rows} for rows in json.loads(printed))
    both = sorted(one.keys() & second.keys())
    found = [f"{np.mean(e):.3f}, {np.median(e):.3f}" for e in ([each[key] for key in both] for each in (one, second))]
    return f"{found[0]} ({found[1]})"


def row_of(scene: SyntheticScene, folder: Path, source: str, args: argparse.Namespace) -> dict[str, Any]:
    """Figures of one source of cameras: the solve, and the held-out PSNR of one training per seed."""
    shot = solved(scene, folder, source, find_bpy(args.bpy))
    solve, alike = read_json(shot.solve / "solve.json"), similarity_to_exact(scene, shot)
    row: dict[str, Any] = {
        "residual_px": solve["reprojection_error_px"],
        "points": solve["points"],
        "same_keypoints": compared(shot, Shot.open(folder / f"solve{SHOT_SUFFIX}")),
        "focal_px": solve["focal_px"],
        "position_mm": 1e3 * alike.rms,
        "rotation_deg": alike.rotation_error_deg,
        "heldout_psnr_db": [],
    }
    size = ["--preset", "preview", "--holdout", 8, "--iterations", args.iterations, "--max-gaussians", args.gaussians]
    for seed in args.seeds:
        run = f"seed{seed}"
        _backend("train", shot.root, "--run", run, "--seed", seed, *size)
        row["heldout_psnr_db"].append(read_json(RunFolder(shot.run(run)).summary)["heldout_psnr_db"])
    write_json(folder / f"{source}.json", row)
    return row


def _backend(*words: Any) -> None:
    """Runs a command of the backend."""
    _run([sys.executable, "-P", "-m", "torch_backend", *words])


def _run(words: Sequence[Any]) -> str:
    """Runs a child process; returns its output. RuntimeError with its last line if it fails."""
    env = child_environ(SPLANNEQUIN_BACKEND_PYTHON=sys.executable)
    done = subprocess.run([str(word) for word in words], env=env, capture_output=True)
    if done.returncode:
        raise RuntimeError(last_words(done.stderr.decode("utf-8", "replace")))
    return done.stdout.decode("utf-8", "replace")


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Prints a row for each scene and source of cameras."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--bpy", help="Python with bpy, or its environment (default: that of the set-up)")
    args = parser.parse_args(argv)
    print(HEADINGS, "|---|---|---:|---:|---|---:|---:|---:|---:|", sep="\n", flush=True)
    for path in args.scenes:
        scene = SyntheticScene.load(path)
        folder = args.results.absolute() / f"matchmove-{scene.size}-{scene.name}"
        folder.mkdir(parents=True, exist_ok=True)
        for source, name in SOURCES.items():
            row = row_of(scene, folder, source, args)
            decibels = ", ".join(f"{value:.2f}" for value in row["heldout_psnr_db"])
            figures = [f"{row['residual_px']:.3f}", row["points"], row["same_keypoints"], f"{row['focal_px']:.2f}"]
            figures += [f"{row['position_mm']:.1f}", f"{row['rotation_deg']:.3f}", decibels]
            print(f"| {scene.name} | {name} |", " | ".join(map(str, figures)), "|", flush=True)


if __name__ == "__main__":
    sys.exit(main())
