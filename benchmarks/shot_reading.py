"""Times what Blender's main thread spends on reading a long shot's folder, every second while a take grows.

    python -m benchmarks.shot_reading [--frames 5000] [--runs 3]

A Python with Blender's module (bpy). Makes a shot of files as the backend writes them, with a solve that is newer than
its runs and a take that gains a frame between readings; prints the median and the longest reading in milliseconds.
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def build(folder: Path, frames: int, runs: int) -> Path:
    """A shot of `frames` frames with `runs` runs and a take; returns the take's folder."""
    for part in ("frames", "solve", "takes/freeze", *(f"runs/r{n}" for n in range(runs))):
        (folder / part).mkdir(parents=True)
    numbers = range(1, frames + 1)
    _write(
        folder / "shot.json", {"version": 1, "name": "long", "first": 1, "last": frames, "width": 1280, "height": 720}
    )
    listed = [
        {"frame": n, "seconds": n / 24, "file": f"raw/{n:06d}.png", "solve": True, "sharpness": 9.123, "flags": []}
        for n in numbers
    ]
    _write(folder / "frames" / "frames.json", {"version": 1, "frames": listed})
    poses = [{"frame": n, "viewmat": [n / 7.0 + i for i in range(16)], "K": [1000.123] * 4} for n in numbers]
    for n in range(runs):
        _write(folder / f"runs/r{n}" / "config.json", {"solve": "other"})
        _write(folder / f"runs/r{n}" / "summary.json", {"run": f"r{n}", "gaussians": 1, "moving_share": 0.1})
        (folder / f"runs/r{n}" / "checkpoint.safetensors").write_bytes(b"\0" * 8)
    time.sleep(0.02)
    _write(folder / "solve" / "cameras.json", {"version": 1, "width": 1280, "height": 720, "frames": poses})
    _write(folder / "solve" / "solve.json", {"version": 1, "quality": "Good."})
    facts = {"take": "freeze", "run": "r0", "t_star_frame": 1, "width": 1280, "height": 720, "first": 1, "last": frames}
    _write(folder / "takes/freeze" / "take.json", facts)
    for n in numbers:
        (folder / "takes/freeze" / f"{n:06d}.exr").touch()
    return folder / "takes" / "freeze"


def _write(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data))


def main() -> int:
    """Builds the shot, reads it ten times."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--runs", type=int, default=3)
    args = parser.parse_args()
    sys.path.insert(0, str(ROOT / "splannequin_addon"))
    package = importlib.import_module("run_in_bpy").load_package()
    shots = importlib.import_module(f"{package.__name__}.splannequin_addon.shot.inventory")
    with tempfile.TemporaryDirectory(prefix="splannequin-reading-") as name:
        folder = Path(name) / "long.splannequin"
        take = build(folder, args.frames, args.runs)
        spent = []
        for n in range(10):
            (take / f"{args.frames + n + 1:06d}.exr").touch()
            began = time.perf_counter()
            state = shots.read(folder)
            spent.append(1000 * (time.perf_counter() - began))
            assert state.takes["freeze"]["frame_count"] == args.frames + n + 1
    print(f"{args.frames} frames, {args.runs} runs: first {spent[0]:.1f} ms, then median "
          f"{statistics.median(spent[1:]):.1f} ms, longest {max(spent[1:]):.1f} ms")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
