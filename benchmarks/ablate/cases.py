"""Cases of the ablation: synthetic scenes with truth, and clips, each with the instants at which it is judged."""

from __future__ import annotations

import itertools
import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.detail_clip import DetailClip
from benchmarks.detail_figures import FLOW_WIDTH
from benchmarks.detail_truth import trained
from benchmarks.report.truth import TruthScene
from benchmarks.sources import load_source
from torch_backend.shot import Shot
from torch_backend.train import load_run

TUNED_AT = {"sitting": (8, 36, 63)}
"""Clip -> instants used to tune today's rules; they are never drawn."""
INSTANTS = 6
"""Number of instants drawn for a clip."""
ITERATIONS, GAUSSIANS = 1500, 10_000
"""Training steps and most Gaussians of runs of scenes, the defaults of `benchmarks.detail_truth`."""


@dataclass
class Case:
    """One trained scene or clip."""

    name: str
    """Name in the table and in file names."""
    clip: DetailClip
    """Its run, plates and cameras."""
    t_stars: list[int]
    """Frame numbers of its instants, in the order in which they are judged."""
    truth: TruthScene | None
    """Rendered truth; None for a clip."""


def scene_case(folder: Path, seed: int, results: Path, lent: Path | None = None) -> Case:
    """A synthetic scene with a run of a training seed in `results`, trained if missing.

    `lent`: results of `benchmarks.detail_truth` to copy the shot from, or None. The shot is copied once per seed.
    """
    source = f"exact:{folder.absolute()}"
    name = f"{folder.parent.name}-{folder.name}"
    trained_shot = results / "shots" / f"{name}-exact.splannequin"
    theirs = None if lent is None else lent / "shots" / trained_shot.name
    if theirs is not None and theirs.is_dir() and not (trained_shot / f"copied-{seed}").is_file():
        shutil.copytree(theirs, trained_shot, dirs_exist_ok=True)
        (trained_shot / f"copied-{seed}").touch()
    truth = load_source(source, results)
    run = trained(truth, source, seed, ITERATIONS, GAUSSIANS)
    width = load_run(truth.shot, run, torch.device("cpu")).width
    return Case(f"{name} s{seed}", DetailClip(truth.shot, run, width), list(truth.t_stars), truth)


def clip_case(path: Path, run: str, seed: int) -> Case:
    """A trained clip with instants drawn by a seed from its training frames."""
    clip = DetailClip(Shot.open(path), run, FLOW_WIDTH)
    name = path.name.removesuffix(".splannequin")
    return Case(name, clip, drawn(name, clip.run.train_frames, seed), None)


def drawn(name: str, trained_frames: list[int], seed: int) -> list[int]:
    """`INSTANTS` frame numbers of a clip, drawn by a seed, without those used for tuning (`TUNED_AT`)."""
    free = [frame for frame in trained_frames if frame not in TUNED_AT.get(name, ())]
    return [free[n] for n in _sample(len(free), INSTANTS, name, seed)]


def pairs_of(case: Case, t_star: int, count: int, seed: int) -> list[tuple[int, int]]:
    """`count` pairs of neighbouring frames at which a clip's instant is judged, drawn by a seed, without t* itself."""
    frames = case.clip.frames
    free = [pair for pair in itertools.pairwise(frames) if t_star not in pair]
    return sorted(free[n] for n in _sample(len(free), count, f"{case.name} {t_star}", seed))


def _sample(count: int, most: int, name: str, seed: int) -> list[int]:
    """Up to `most` of the numbers below `count`, in random order."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return [int(n) for n in rng.permutation(count)[:most]]
