"""Cost of a frozen frame with plate detail: `python -m benchmarks.detail_cost SHOT --results DIR`.

SHOT is a trained shot folder, which stays unchanged. Its plates are enlarged by whole factors (also 1), with grain, to
numbered PNG files in a temporary folder. For one freeze, the Gaussians' render and plate detail are computed along the
clip's poses with two threads, and not written. Each size and number of frames runs in its own process, to report its
peak memory: memory must not grow with the number of frames. Writes cost-NAME.json to DIR. Run it on an idle machine;
the spread shows whether it was idle.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch

from benchmarks.detail import develop_argument, name_of
from benchmarks.detail_clip import DetailClip, open_clip
from benchmarks.sources import child_environ, in_words
from torch_backend.contract import frame_file, from_dict, read_json
from torch_backend.footage import FootageConfig
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.importing import import_key
from torch_backend.footage.opening import open_source
from torch_backend.footage.plates import Plates
from torch_backend.shot import Shot, write_json
from torch_backend.train.checkpoint import load_checkpoint, save_checkpoint

THREADS = 2
WIDTHS = (640, 1280, 3840)
ALLOWED = {640: 0.4, 1280: 1.5, 3840: 14.0}
"""Width of 16:9 frames -> allowed seconds per frame."""
PATHS = {640: (24, 150), 1280: (12, 48), 3840: (6, 18)}
"""Width -> numbers of frames along the path; memory must not grow with them."""
_REAL = 3
"""Number of plates before and after the path that are really enlarged. Others are rarely read and share files."""


def enlarged(shot: Shot, folder: Path, factor: int, poses: Sequence[int]) -> Shot:
    """A copy of the shot's solve and run whose footage is its frames, `factor` times as wide, as numbered PNG files.

    ValueError if the shot's plates cannot be read from that footage.
    """
    copy = folder / shot.root.name
    for part in ("solve", "runs"):
        shutil.copytree(shot.root / part, copy / part)
    shutil.copytree(shot.frames, copy / "frames")
    shutil.copy2(shot.root / "shot.json", copy / "shot.json")
    record = read_json(copy / "frames" / "frames.json")
    footage, frames = folder / "footage", [int(row["frame"]) for row in record["frames"]]
    footage.mkdir(parents=True)
    real = {frames[0], frames[len(frames) // 2], frames[-1], *_around(frames, poses)}
    rng = np.random.default_rng(0)
    for row in record["frames"]:
        name = frame_file(int(row["frame"]), ".png")
        if int(row["frame"]) in real:
            raw = copy / "frames" / row["file"]
            _enlarge(raw if raw.is_file() else copy / "frames" / name, footage / name, factor, rng)
    for frame in set(frames) - real:
        nearest = min(real, key=lambda existing: abs(existing - frame))
        os.link(footage / frame_file(nearest, ".png"), footage / frame_file(frame, ".png"))
    record |= {"source_size": [record["width"] * factor, record["height"] * factor], "extended": False}
    settings = {**record.get("config", {}), "working_height": record["height"]}
    config = from_dict(FootageConfig, settings)
    key = import_key(open_source(str(footage), config.fps, config.layer).info, config)
    record |= {"config": settings, "key": key, "bits": 8, "beside": ""}
    write_json(copy / "frames" / "frames.json", record)
    for checkpoint in (copy / "runs").glob("*/checkpoint.safetensors"):  # they were trained on the smaller pictures
        tensors, facts = load_checkpoint(checkpoint)
        save_checkpoint(checkpoint, tensors, {**facts, "pictures": key})
    enlarged_shot = Shot.open(copy)
    enlarged_shot.update(source=str(footage))
    note = Plates(enlarged_shot).note
    if note:
        raise ValueError(f"the enlarged plates are not read: {note}")
    return enlarged_shot


def _around(frames: Sequence[int], poses: Sequence[int]) -> list[int]:
    first, last = frames.index(poses[0]), frames.index(poses[-1])
    return list(frames[max(0, first - _REAL) : last + _REAL + 1])


def _enlarge(source: Path, target: Path, factor: int, rng: np.random.Generator) -> None:
    """Repeats each pixel `factor` x `factor` times and adds grain, as smooth pictures decode faster than footage."""
    pixels = read_png(source)
    pixels = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
    large = pixels.repeat(factor, 0).repeat(factor, 1).astype(np.int16)
    large += rng.integers(-2, 3, large.shape, dtype=np.int16)
    write_png(target, large.clip(0, 255).astype(np.uint8))


def measure(shot: Path, run: str, width: int, poses: Sequence[int], develop: bool) -> dict[str, Any]:
    """Seconds of each frame, and peak memory before and after. Call it in a new process."""
    import resource

    torch.set_num_threads(THREADS)
    clip = open_clip(shot, run, width, develop)
    t_star = clip.instants()[0]
    clip.frozen(t_star)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rows, sources = [], set[int]()
    for pose in poses:
        since = time.perf_counter()
        image = clip.splats(pose, t_star)
        splats = time.perf_counter() - since
        detailed = clip.detailed(pose, t_star, image)
        rows.append({"frame": pose, "splats": splats, "whole": time.perf_counter() - since})
        sources |= {int(frame) for frame in detailed.source.unique().tolist()} - {0}
        del image, detailed  # as a take does: each frame is freed before the next
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "width": clip.width,
        "height": clip.height,
        "plates": [clip.plates.width, clip.plates.height],
        "frames": rows,
        "sources": clip.compositor.config.sources,
        "plates_used": sorted(sources),
        "before_mb": _mb(before),
        "peak_mb": _mb(peak),
    }


def _mb(rss: int) -> float:
    """Megabytes of a ru_maxrss, which is in bytes on macOS and in KiB elsewhere."""
    return rss / 1e6 if sys.platform == "darwin" else rss * 1024 / 1e6


def in_child(shot: Shot, run: str, width: int, poses: Sequence[int], develop: bool = False) -> dict[str, Any]:
    """`measure` in a child process. RuntimeError with its last line of stderr if it fails."""
    work = json.dumps({"shot": str(shot.root), "run": run, "width": width, "poses": list(poses), "develop": develop})
    threads = {f"{library}_NUM_THREADS": str(THREADS) for library in ("OMP", "MKL", "OPENBLAS")}
    command = [sys.executable, "-P", "-m", "benchmarks.detail_cost", "--work", work]
    ran = subprocess.run(command, env=child_environ(**threads), capture_output=True, text=True)
    if ran.returncode:
        raise RuntimeError(f"{width} pixels could not be measured: {(ran.stderr.strip().splitlines() or ['-'])[-1]}")
    return json.loads(ran.stdout.splitlines()[-1])


def middle_poses(clip: DetailClip, count: int) -> list[int]:
    """`count` neighbouring frames from the middle of the clip."""
    frames = clip.frames
    first = max(0, (len(frames) - count) // 2)
    return frames[first : first + count]


def summary(found: dict[str, Any]) -> dict[str, Any]:
    """Median, least and greatest seconds per frame over the second half of the path, and those of the first frame.

    The first frames also load the nearby plates for all later ones.
    """
    whole = [row["whole"] for row in found["frames"]]
    later = whole[len(whole) // 2 :]
    splats = statistics.median(row["splats"] for row in found["frames"])
    return {"first": whole[0], "median": statistics.median(later), "least": min(later), "most": max(later),
            "splats": splats}  # fmt: skip


def table(sizes: Sequence[dict[str, Any]]) -> list[str]:
    """Markdown rows, one per size and number of frames."""
    header = ["size", "frames", "s per frame, median", "least", "most", "the first", "of it splats", "allowed"]
    header += ["peak MB", "before"]
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]
    for of in sizes:
        s, allowed = of["summary"], ALLOWED.get(of["width"])
        cells = [f"{s[name]:.2f}" for name in ("median", "least", "most", "first", "splats")]
        cells += ["–" if allowed is None else f"{allowed:g}", f"{of['peak_mb']:.0f}", f"{of['before_mb']:.0f}"]
        lines.append(f"| {of['width']}x{of['height']} | {len(of['frames'])} | {' | '.join(cells)} |")
    return lines


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path, nargs="?")
    parser.add_argument("--run", default="main", metavar="NAME")
    parser.add_argument("--results", type=Path, metavar="DIR")
    parser.add_argument(
        "--widths",
        type=int,
        nargs="+",
        default=list(WIDTHS),
        metavar="W",
        help="widths as multiples of the clip's width",
    )
    parser.add_argument(
        "--frames",
        type=int,
        nargs="+",
        metavar="N",
        help="number of frames along the path (default: depends on the width)",
    )
    develop_argument(parser)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.work:
        print(json.dumps(measure(**json.loads(args.work))))
        return
    if args.shot is None or args.results is None:
        parser.error("SHOT and --results are needed")
    sizes: list[dict[str, Any]] = []
    clip = open_clip(args.shot, args.run)
    for width in args.widths:
        if width % clip.scene.width:
            raise ValueError(f"{width} is no multiple of the clip's {clip.scene.width} pixels")
        with tempfile.TemporaryDirectory(prefix="splannequin-cost-") as folder:
            counts = args.frames or PATHS.get(width, (12, 36))
            poses = middle_poses(clip, max(counts))
            shot = enlarged(Shot.open(args.shot), Path(folder), width // clip.scene.width, poses)
            if args.develop == "on":  # in this process, whose memory is not reported: a take develops once
                large = DetailClip(shot, args.run)
                large.frozen(large.instants()[0], keep=True)
            for count in counts:
                found = in_child(shot, args.run, width, poses[:count], args.develop == "on")
                sizes.append(found | {"summary": summary(found)})
                print(f"{width}, {count} frames: {sizes[-1]['summary']}", flush=True)
    name = name_of(args.shot)
    write_json(args.results / f"cost-{name}.json", {"version": 1, "shot": str(args.shot), "sizes": sizes})
    print("\n".join(["", *table(sizes)]))


if __name__ == "__main__":
    sys.exit(main())
