"""Residual motion in a frozen shot: `python -m benchmarks.detail_flow SHOT --results DIR`.

SHOT is a trained shot folder, which stays unchanged. Along the clip's poses, at 640 pixels, frame n + 1 of the frozen
shot is warped to frame n by the frozen depth and the cameras. Two figures follow, for regions that move in the clip and
for still ones:

- honesty: 99th percentile of the residual optical flow in pixels, over textured pixels. A mover that still moves in
  the frozen shot has more flow than still pixels of the same frames.
- steadiness: mean absolute difference of the two frames, of 255.

The same is measured of the plates (where movers do move) and of the Gaussians alone. Writes flow-NAME.json and strips
of the worst frames to DIR: frame n, warped frame n + 1, residual flow (black 0, white 2 pixels), moving regions.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor

from benchmarks.detail import common_arguments, name_of, save_strip
from benchmarks.detail_clip import DetailClip, open_clip
from benchmarks.detail_figures import (
    FLOW_WIDTH,
    MOVER_MATTE,
    Flow,
    Histogram,
    dilate,
    induced_places,
    inside,
    sampled,
    seen_again,
    still_pixels,
    textured,
    unexplained_flow,
    unsteadiness,
)
from benchmarks.report.metrics import known_mean
from benchmarks.report.setting import plain
from benchmarks.sources import in_words
from torch_backend.shot import write_json

WHAT = ("plate", "splats", "delivered")
"""Pictures whose flow is measured."""
PERCENT = 99.0
ALLOWED = 0.25
"""Allowed excess in pixels of the flow of moving regions over still ones."""
HIDDEN_MARGIN = 4
"""Margin in pixels around points visible in only one of two frames."""
LEAST = 200
"""Least number of pixels of a region in one frame for a percentile."""


@dataclass
class Shown:
    """One frozen frame of the path."""

    frame: int
    depths: dict[str, Tensor]
    """{each of `WHAT`: [H, W] frozen depth}; plates may add a surface to it."""
    pictures: dict[str, Tensor]
    """{each of `WHAT`: [H, W, 3] picture}."""
    matte: Tensor
    """[H, W] motion matte of the frame, 0..1."""
    matte_t_star: Tensor
    """[H, W] motion matte of t*, warped to this frame."""


class Sums:
    """Flow and difference of one of `WHAT`, accumulated over frames by region."""

    def __init__(self) -> None:
        self.flow = {region: Histogram() for region in ("moving", "still")}
        self._steady = {region: [0.0, 0] for region in self.flow}

    def add(self, region: str, flow: Tensor, difference: Tensor) -> None:
        """Adds values [V] of one frame's region."""
        self.flow[region].add(flow)
        self._steady[region][0] += float(difference.sum())
        self._steady[region][1] += len(difference)

    def figures(self) -> dict[str, Any]:
        """{region: {p99_px, unsteady_255, pixels, textured}}, and the excess of moving over still."""
        found: dict[str, Any] = {}
        for region, (total, count) in self._steady.items():
            found[region] = {
                "p99_px": self.flow[region].percentile(PERCENT),
                "unsteady_255": 255.0 * total / count if count else None,
                "pixels": count,
                "textured": self.flow[region].count,
            }
        moving, still = (found[region]["p99_px"] for region in ("moving", "still"))
        found["excess_px"] = None if moving is None or still is None else moving - still
        return found


def show(clip: DetailClip, frame: int, t_star: int) -> Shown:
    """The frame with all compared pictures, depths and mattes."""
    view = clip.view(frame, t_star)
    frame_matte, matte_t_star = clip.mattes(frame, t_star, view)
    pictures = {"plate": clip.plate(frame), "splats": view.splats, "delivered": view.picture}
    depths = {"plate": view.detailed.depth, "splats": view.image.depth, "delivered": view.detailed.depth}
    return Shown(frame, depths, pictures, frame_matte, matte_t_star)


@dataclass
class Pair:
    """Correspondence of two neighbouring frames. Masks are bool [H, W] in pixels of the first."""

    places: Tensor
    """[H, W, 2] of the first frame's pixels in the second, by frozen depth and cameras."""
    both: Tensor
    """Points visible in both frames."""
    moving: Tensor
    """Visible points that move in either frame or moved at t*, except near points visible in only one frame."""
    still: Tensor
    """Visible points that are still in both frames and at t*, with the same exception."""


def lay_over(clip: DetailClip, a: Shown, b: Shown, what: str) -> Pair:
    """Correspondence of frames a and b, by the depth of one of `WHAT`."""
    places, depth = induced_places(a.depths[what], *clip.camera(a.frame), *clip.camera(b.frame))
    both = seen_again(places, depth, b.depths[what]) & inside(places, clip.width, clip.height, 4.0)
    second_matte, matte_t_star_b = (sampled(matte, places, nearest=True) for matte in (b.matte, b.matte_t_star))
    matte = torch.stack([a.matte, second_matte]).amax(0)
    mover = torch.stack([a.matte_t_star, matte_t_star_b]).amax(0) > MOVER_MATTE
    inner = ~dilate(~both, HIDDEN_MARGIN)
    return Pair(places, both, inner & ((matte > MOVER_MATTE) | mover), inner & still_pixels(matte, mover))


def judge_pair(flow: Flow, clip: DetailClip, a: Shown, b: Shown, sums: dict[str, Sums]) -> dict[str, Any]:
    """Figures of frames a and b, also added to `sums`: {what: {moving, still, excess: px}}."""
    row: dict[str, Any] = {"frame": a.frame, "next": b.frame}
    for what in WHAT:
        pair = lay_over(clip, a, b, what)
        masks = {"moving": pair.moving, "still": pair.still}
        one, two = a.pictures[what], b.pictures[what]
        left, judged = unexplained_flow(flow, one, two, pair.places, pair.both), textured(one)
        difference = unsteadiness(one, two, pair.places)
        found: dict[str, float | None] = {}
        for region, mask in masks.items():
            sums[what].add(region, left[mask & judged], difference[mask])
            enough = int((mask & judged).sum()) >= LEAST
            found[region] = float(left[mask & judged].quantile(PERCENT / 100.0)) if enough else None
        moving, still = found["moving"], found["still"]
        found |= {f"{region}_share": float(mask.float().mean()) for region, mask in masks.items()}
        row[what] = {**found, "excess": None if moving is None or still is None else moving - still}
    return row


def judge_flow(clip: DetailClip, t_star: int, pairs: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """All figures of one freeze along a path of pairs of neighbouring frames."""
    flow, sums = Flow(), {what: Sums() for what in WHAT}
    rows = []
    last: Shown | None = None
    for n, (first, second) in enumerate(pairs):
        a = last if last is not None and last.frame == first else show(clip, first, t_star)
        last = show(clip, second, t_star)
        rows.append(judge_pair(flow, clip, a, last, sums))
        figures = ", ".join(f"{w} {plain(rows[-1][w]['moving'])} / {plain(rows[-1][w]['still'])}" for w in WHAT)
        print(f"[{n + 1}/{len(pairs)}] t* {t_star}, frames {first}, {second}: {figures} px moving / still", flush=True)
    return {"t_star": t_star, "clip": {what: total.figures() for what, total in sums.items()}, "frames": rows}


def worst_frames(rows: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """The frames with the greatest excess of moving over still regions, worst first."""
    judged = [row for row in rows if row["delivered"]["excess"] is not None]
    return sorted(judged, key=lambda row: -row["delivered"]["excess"])[:count]


def save_worst(clip: DetailClip, freeze: dict[str, Any], folder: Path, count: int) -> None:
    """Writes strips of the worst frames: frame n, warped frame n + 1, residual flow, moving regions.

    Removes strips of an earlier run at the same instant.
    """
    flow = Flow()
    for old in folder.glob(f"t{freeze['t_star']:06d}_*.png"):
        old.unlink()
    for row in worst_frames(freeze["frames"], count):
        a, b = (show(clip, row[name], freeze["t_star"]) for name in ("frame", "next"))
        pair, one, two = lay_over(clip, a, b, "delivered"), a.pictures["delivered"], b.pictures["delivered"]
        left = unexplained_flow(flow, one, two, pair.places, pair.both) * (textured(one) & (pair.moving | pair.still))
        overlay = torch.stack([pair.moving, pair.still, torch.zeros_like(pair.still)], dim=2) * 0.5
        strip = [
            one,
            torch.where(pair.both[..., None], sampled(two, pair.places), one),
            (left / 2.0)[..., None].expand(-1, -1, 3),
            one * 0.5 + overlay,
        ]
        name = f"t{freeze['t_star']:06d}_{100 * row['delivered']['excess']:05.0f}_{row['frame']:06d}.png"
        save_strip(folder / name, strip)


def table(name: str, freezes: Sequence[dict[str, Any]]) -> list[str]:
    """Markdown rows of the clip's figures, one per t* and picture."""
    header = [name, "residual flow, moving, px", "still, px", "excess", "mean excess of frames"]
    header += [f"frames over {ALLOWED}", "worst frame", "difference, moving, / 255", "still, / 255"]
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]
    for freeze in freezes:
        for what in WHAT:
            of, more = freeze["clip"][what], excesses(freeze, what)
            cells = [plain(v) for v in (of["moving"]["p99_px"], of["still"]["p99_px"], of["excess_px"])]
            cells += [plain(known_mean(more)), f"{sum(v > ALLOWED for v in more)} of {len(more)}"]
            cells += [
                plain(max(more, default=None)),
                *(plain(of[region]["unsteady_255"]) for region in ("moving", "still")),
            ]
            lines.append(f"| t* {freeze['t_star']}, {what} | " + " | ".join(cells) + " |")
    return lines


def excesses(freeze: dict[str, Any], what: str) -> list[float]:
    """Excess in pixels of moving over still regions, for each frame with both."""
    return [row[what]["excess"] for row in freeze["frames"] if row[what]["excess"] is not None]


def pairs_of(clip: DetailClip, args: argparse.Namespace) -> list[tuple[int, int]]:
    """Pairs of neighbouring frames: all or those starting at `--frames`, every `--every`-th of them."""
    frames = clip.frames
    pairs = [pair for pair in itertools.pairwise(frames) if not args.frames or pair[0] in args.frames]
    if not pairs:
        raise ValueError(f"none of --frames has a next one: the clip has {frames[0]} to {frames[-1]}")
    return pairs[:: args.every]


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    common_arguments(parser)
    args = parser.parse_args(argv)
    clip = open_clip(args.shot, args.run, FLOW_WIDTH, args.develop == "on")
    pairs, since = pairs_of(clip, args), time.perf_counter()
    freezes = [judge_flow(clip, t_star, pairs) for t_star in args.t_star or clip.instants()]
    name = name_of(args.shot)
    for freeze in freezes if not args.no_strips else ():
        save_worst(clip, freeze, args.results / f"flow-{name}", args.worst)
    result = {"version": 1, "shot": str(args.shot), "run": args.run, "develop": args.develop, "freezes": freezes}
    result["motion_from"] = clip.motion_from
    write_json(args.results / f"flow-{name}.json", result | {"seconds": time.perf_counter() - since})
    print("\n".join(["", *table(name, freezes), "", f"What moves: {clip.motion_from}."]))


if __name__ == "__main__":
    sys.exit(main())
