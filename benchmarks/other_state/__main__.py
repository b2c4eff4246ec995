"""Compares the pixels that frozen frames reject of their own plates with hand-painted masks.

    python -m benchmarks.other_state SHOT ... --results DIR

SHOT is a trained shot folder of `sitting`, `kitchen` or `hall` (shared/footage), which stays unchanged. Every painted
pair of t* and frame gives IoU, precision and recall of the pixels rejected by the delivered frame, and of those that
motion mattes alone would reject. A further figure is the share of unchanged pixels that is rejected. Writes
other-state-NAME.json to DIR and, with `--pictures`, a picture of each pair. The pictures show the footage: those of
`kitchen` and `hall` must not enter the repository.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch

from benchmarks.detail import develop_argument, name_of, save_strip
from benchmarks.detail_clip import DetailClip, View, open_clip
from benchmarks.report.setting import plain
from benchmarks.sources import in_words
from torch_backend.shot import write_json

from .masks import CHANGED, CLIPS, SAME, Labels, Painted, load_masks, sha256_of
from .scores import LET_GO, METHODS, Row, judged, mean_counts, pooled_counts

FIGURES = ("iou", "precision", "recall", "extra_share")
"""Figures in the order of the table."""


def masks_of(clip: DetailClip, name: str | None) -> Painted:
    """The masks of a shot's footage. ValueError without masks, or if the painted video was a different one."""
    source = Path(clip.shot.info().source)
    masks = load_masks(name or source.stem)
    if source.is_file() and sha256_of(source) != masks.sha256:
        raise ValueError(f"{source} is not the video that was painted as {masks.clip}")
    return masks


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Means over frames, and figures of all pixels pooled, by `METHODS`."""
    return {
        name: {
            "mean": mean_counts([row.counts[name] for row in rows]),
            "pooled": pooled_counts(row.counts[name] for row in rows).figures(),
        }
        for name in METHODS
    }


def table(name: str, rows: Sequence[Row], summed: dict[str, Any]) -> list[str]:
    """Markdown table: a row per pair, then the means."""
    lines = [
        f"| {name} | " + " | ".join(f"{method}: IoU | precision | recall | extra" for method in METHODS) + " |",
        "|---|" + "---:|" * (len(FIGURES) * len(METHODS)),
    ]
    for row in rows:
        of = row.figures()
        lines.append(f"| t* {row.t_star}, frame {row.frame} | " + " | ".join(_cells(of[m]) for m in METHODS) + " |")
    for kind in ("mean", "pooled"):
        lines.append(f"| {kind} | " + " | ".join(_cells(summed[m][kind]) for m in METHODS) + " |")
    return lines


def _cells(figures: dict[str, float | None]) -> str:
    return " | ".join(plain(figures[name], 3) for name in FIGURES)


def picture(clip: DetailClip, row: Row, view: View, labels: Labels) -> list[torch.Tensor]:
    """Plate t*, the plate tinted by its labels and rejected pixels, the frozen frame: each [H, W, 3].

    Green: rightly rejected. Red: kept, though another state. Blue: rejected, though the same. Grey: not scored.
    """
    plate, label = clip.plate(row.frame), torch.from_numpy(labels)
    is_let_go = view.detailed.matte < LET_GO
    tints = [
        ((label == CHANGED) & is_let_go, (0.0, 1.0, 0.0)),
        ((label == CHANGED) & ~is_let_go, (1.0, 0.0, 0.0)),
        ((label == SAME) & is_let_go, (0.0, 0.2, 1.0)),
        ((label != SAME) & (label != CHANGED), (0.5, 0.5, 0.5)),
    ]
    shown = plate.clone()
    for where, tint in tints:
        shown[where] = 0.55 * shown[where] + 0.45 * torch.tensor(tint)
    return [clip.plate(row.t_star), shown, view.picture]


def run(clip: DetailClip, masks: Painted, pictures: Path | None) -> list[Row]:
    """All rows of a clip; prints each row once it is computed."""
    rows: list[Row] = []
    for row, view, labels in judged(clip, masks):
        rows.append(row)
        if pictures:
            save_strip(pictures / f"t{row.t_star:06d}_{row.frame:06d}.png", picture(clip, row, view, labels))
        ious = ", ".join(f"{name} {_cells(row.figures()[name])}" for name in METHODS)
        print(f"[{len(rows)}/{len(masks.pairs)}] t* {row.t_star}, frame {row.frame}: {ious}", flush=True)
    return rows


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shots", type=Path, nargs="+", metavar="SHOT")
    parser.add_argument("--run", default="main", metavar="NAME")
    parser.add_argument(
        "--clip", choices=CLIPS, help="clip whose masks are used (default: by the name of the shot's footage)"
    )
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--pictures", action="store_true", help="write a picture of each pair")
    develop_argument(parser)
    args = parser.parse_args(argv)
    for shot in args.shots:
        clip = open_clip(shot, args.run, develop=args.develop == "on")
        masks, name, since = masks_of(clip, args.clip), name_of(shot), time.perf_counter()
        rows = run(clip, masks, args.results / f"other-state-{name}" if args.pictures else None)
        summed = summary(rows)
        result = {"version": 1, "shot": str(shot), "run": args.run, "develop": args.develop, "clip": masks.clip}
        result |= {"rows": [row.figures() for row in rows], **summed, "seconds": time.perf_counter() - since}
        write_json(args.results / f"other-state-{name}.json", result)
        print("\n".join(["", *table(name, rows, summed), ""]))


if __name__ == "__main__":
    sys.exit(main())
