"""Motion mattes against rendered truth: `python -m benchmarks.movers SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 for tuning, 100 to 109 for reporting). Its shot with exact (or
solved) cameras and its mattes are made in DIR if missing. Prints, over all frames of the clip:

precision     share of the marked pixels that move, or are within `--margin` pixels of a moving pixel
moving, ...   recall: share of the true pixels that are marked, for all movers and for the small mover of a hard scene
worst         recall of that mover in its worst tenth of the frames, of frames that show at least `LEAST` pixels of it

A pixel is truly moving if its surface point is ever more than half a pixel elsewhere, so swaying people are included.
Writes movers-NAME.json with one row per frame to DIR.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.report.truth import OBJECT_REGIONS, TruthScene
from benchmarks.sources import in_words, load_source
from torch_backend.cameras.stored import load_cameras
from torch_backend.motion.mattes import MOVING, load_motion
from torch_backend.shot import write_json

MOVERS = ("moving", *(name for name in OBJECT_REGIONS if name not in ("glass", "mirror", "wall")))
"""Regions of truth that mattes should mark."""
LEAST = 50
"""Least pixels of a thing for a frame to count in its worst recall."""


def frame_row(matte: NDArray[np.uint8], regions: Mapping[str, NDArray[np.bool_]], margin: int) -> dict[str, Any]:
    """Pixel counts of one frame: `marked`, how many of them are `right`, and `found`: [marked, all] of each mover.

    Args:
        matte: [H, W] as returned by `load_motion`.
        regions: name -> [H, W] mask; `moving` is required.
        margin: pixels around moving pixels that may also be marked.
    """
    block = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    near = cv2.dilate(regions["moving"].astype(np.uint8), block) > 0
    marked = matte == MOVING
    found = {name: [int((marked & of).sum()), int(of.sum())] for name, of in regions.items() if name in MOVERS}
    return {"marked": int(marked.sum()), "right": int((marked & near).sum()), "found": found}


def judge(truth: TruthScene, margin: int) -> list[dict[str, Any]]:
    """One row per frame with a matte, see `frame_row`."""
    rows: list[dict[str, Any]] = []
    for frame in (camera.frame for camera in load_cameras(truth.shot).frames):
        matte = load_motion(truth.shot, frame)
        if matte is None:
            continue
        height, width = matte.shape
        regions = {name: mask.numpy() for name, mask in truth.frame_regions(frame, width, height).items()}
        rows.append({"frame": frame, **frame_row(matte, regions, margin)})
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Precision, recall of each mover, and recall of the thing in its worst frames; precision is None without marks."""
    marked, right = (sum(each[name] for each in rows) for name in ("marked", "right"))
    found: dict[str, float | None] = {"precision": right / marked if marked else None}
    for name in MOVERS:
        pairs = [each["found"][name] for each in rows if name in each["found"]]
        whole = sum(pair[1] for pair in pairs)
        if not whole:
            continue
        found[name] = sum(pair[0] for pair in pairs) / whole
        shares = sorted(pair[0] / pair[1] for pair in pairs if pair[1] >= LEAST)
        if name != "moving" and shares:
            found["worst"] = float(np.mean(shares[: max(1, len(shares) // 10)]))
    return found


def text(found: Mapping[str, float | None]) -> str:
    """The figures as one line."""
    return ", ".join(f"{name} {'–' if value is None else f'{value:.3f}'}" for name, value in found.items())


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--cameras", choices=("exact", "solved"), default="exact")
    parser.add_argument(
        "--margin",
        type=int,
        default=1,
        help="tolerance in pixels: marks this close to a moving object are not counted as errors",
    )
    args = parser.parse_args(argv)
    for folder in args.scenes:
        truth = load_source(f"{args.cameras}:{folder.absolute()}", args.results.absolute())
        rows = judge(truth, args.margin)
        path = args.results / f"movers-{truth.name.replace(' ', '-')}.json"
        write_json(path, {"version": 1, "margin": args.margin, "frames": rows})
        print(f"{truth.name}: {text(summary(rows))}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
