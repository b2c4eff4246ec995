"""Compares frozen frames of two states of this repository, on the same trained clips, by the same measures.

    python -m benchmarks.two_trees plan PLAN --clip SHOT ...          # instants and frames, drawn by a seed
    PYTHONPATH=TREE python TREE/.../two_trees.py draw PLAN DIR        # in each tree, with this very file
    python -m benchmarks.two_trees judge PLAN DIR DIR

`draw` only needs `benchmarks.detail_clip` from a tree, so it works with trees since 2026-11-23. Depth, and so the
correspondence of two neighbouring frames, is each tree's own; motion mattes are the shot's.
"""

from __future__ import annotations

import argparse
import json
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch

INSTANTS, PAIRS, SEED, WIDTH = 6, 2, 62, 640
SHOWN = ("still", "flicker", "moving_p50", "excess")
"""Compared figures of `ablate`: dB of still pixels; flicker of 255; median residual flow in px at 640; its excess."""


def plan(clips: list[Path]) -> dict[str, dict[str, list[tuple[int, int]]]]:
    """{shot: {instant: pairs of neighbouring frames}}."""
    from benchmarks.ablate.cases import clip_case, pairs_of

    found: dict[str, dict[str, list[tuple[int, int]]]] = {}
    for path in clips:
        case = clip_case(path, "main", SEED)
        found[str(path.absolute())] = {str(t): pairs_of(case, t, PAIRS, SEED) for t in case.t_stars[:INSTANTS]}
    return found


def draw(planned: dict[str, Any], folder: Path) -> None:
    """Renders the frames missing in the folder."""
    from benchmarks.detail_clip import DetailClip
    from torch_backend.shot import Shot

    folder.mkdir(parents=True, exist_ok=True)
    for shot, instants in planned.items():
        clip = DetailClip(Shot.open(shot), "main", WIDTH, True)
        for t_star, pairs in instants.items():
            for frame in (f for pair in pairs for f in pair if not _file(folder, shot, t_star, f).exists()):
                clip.frozen(int(t_star))
                view = clip.view(frame, int(t_star))
                np.savez(
                    _file(folder, shot, t_star, frame), picture=view.picture.numpy().astype(np.float16),
                    depth=view.detailed.depth.numpy(), motion=view.image.motion.numpy(),
                )  # fmt: skip


def judge(planned: dict[str, Any], folders: list[Path]) -> list[str]:
    """Lines with the figures of each clip and tree, and the difference of the trees over all instants."""
    from benchmarks.ablate.measures import judge_pair, summary
    from benchmarks.detail_clip import DetailClip
    from benchmarks.detail_figures import Flow
    from benchmarks.detail_flow import Shown, lay_over
    from torch_backend.shot import Shot

    flow, rows, lines = Flow(), dict[tuple[Path, str, str], dict[str, Any]](), list[str]()
    for shot, instants in planned.items():
        clip = DetailClip(Shot.open(shot), "main", WIDTH, False)
        for folder in folders:
            for t_star, pairs in instants.items():
                frames: list[dict[str, Any]] = []
                for pair in pairs:
                    views = [_read(_file(folder, shot, t_star, frame)) for frame in pair]
                    mattes = [clip.mattes(f, int(t_star), v) for f, v in zip(pair, views, strict=True)]
                    one, two = (
                        Shown(f, {"delivered": v.detailed.depth}, {"delivered": v.picture}, *m)
                        for f, v, m in zip(pair, views, mattes, strict=True)
                    )
                    laid, still = lay_over(clip, one, two, "delivered"), clip.still(pair[0], int(t_star), views[0])
                    frames.append(
                        judge_pair(flow, laid, still, views[0].picture, views[1].picture, clip.plate(pair[0]))
                    )
                rows[folder, shot, t_star] = summary({"frames": frames})
            known = [rows[folder, shot, t] for t in instants]
            means = (f"{name} {np.mean([r[name] for r in known if r[name] is not None]):.2f}" for name in SHOWN)
            lines.append(f"{Path(shot).stem} {folder.name}: {', '.join(means)}")
    for name in SHOWN:
        gaps = [
            after[name] - before[name]
            for shot, instants in planned.items() for t in instants
            for before, after in [(rows[folders[0], shot, t], rows[folders[1], shot, t])]
            if before[name] is not None and after[name] is not None
        ]  # fmt: skip
        lines.append(
            f"{name}: {np.mean(gaps):+.2f} ± {np.std(gaps):.2f} of {len(gaps)}, up in {sum(g > 0 for g in gaps)}"
        )
    return lines


def _file(folder: Path, shot: str, t_star: str, frame: int) -> Path:
    return folder / f"{Path(shot).stem}_{t_star}_{frame}.npz"


def _read(path: Path) -> Any:
    """A stored frame with the judged fields of `DetailClip.view`."""
    with np.load(path) as stored:
        picture, depth, motion = (
            torch.from_numpy(stored[n].astype(np.float32)) for n in ("picture", "depth", "motion")
        )
    kept = types.SimpleNamespace
    return kept(picture=picture, detailed=kept(depth=depth), image=kept(motion=motion))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("plan", "draw", "judge"))
    parser.add_argument("plan", type=Path)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--clip", type=Path, action="append", default=[], metavar="SHOT")
    args = parser.parse_args()
    if args.what == "plan":
        args.plan.write_text(json.dumps(plan(args.clip)))
        return
    planned = json.loads(args.plan.read_text())
    if args.what == "draw":
        draw(planned, args.folders[0])
    else:
        print("\n".join(judge(planned, args.folders)))


if __name__ == "__main__":
    sys.exit(main())
