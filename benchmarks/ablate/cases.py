"""What the ablation is run on: synthetic scenes with truth, and clips, each with the instants it is judged at."""

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
"""Clip -> instants that today's rules were tuned at, which are never drawn."""
INSTANTS = 6
"""Instants of a clip that are drawn."""
ITERATIONS, GAUSSIANS = 1500, 10_000
"""How runs of scenes are trained, as `benchmarks.detail_truth` does by default."""


@dataclass
class Case:
    """One trained scene or clip."""

    name: str
    """As in the table and in names of files."""
    clip: DetailClip
    """Its run, plates and cameras."""
    t_stars: list[int]
    """Frame numbers of its instants, in the order in which they are judged."""
    truth: TruthScene | None
    """Rendered truth; None: a clip."""


def scene_case(folder: Path, seed: int, results: Path, lent: Path | None = None) -> Case:
    """A synthetic scene with a run of a training seed, in `results`, made there if it is not.

    `lent`: results of `benchmarks.detail_truth` whose shot is copied if it has the run and `results` has not.
    """
    source = f"exact:{folder.absolute()}"
    name = f"{folder.parent.name}-{folder.name}"
    own = results / "shots" / f"{name}-exact.splannequin"
    theirs = None if lent is None else lent / "shots" / own.name
    if theirs is not None and theirs.is_dir() and not (own / f"copied-{seed}").is_file():
        shutil.copytree(theirs, own, dirs_exist_ok=True)
        (own / f"copied-{seed}").touch()
    truth = load_source(source, results)
    run = trained(truth, source, seed, ITERATIONS, GAUSSIANS)
    width = load_run(truth.shot, run, torch.device("cpu")).width
    return Case(f"{name} s{seed}", DetailClip(truth.shot, run, width), list(truth.t_stars), truth)


def clip_case(path: Path, run: str, seed: int) -> Case:
    """A trained clip with instants drawn by a seed from the frames that it was trained on."""
    clip = DetailClip(Shot.open(path), run, FLOW_WIDTH)
    name = path.name.removesuffix(".splannequin")
    return Case(name, clip, drawn(name, clip.run.train_frames, seed), None)


def drawn(name: str, trained_frames: list[int], seed: int) -> list[int]:
    """`INSTANTS` frame numbers of a clip, drawn by a seed; none that anything was tuned at."""
    free = [frame for frame in trained_frames if frame not in TUNED_AT.get(name, ())]
    return [free[n] for n in _sample(len(free), INSTANTS, name, seed)]


def pairs_of(case: Case, t_star: int, count: int, seed: int) -> list[tuple[int, int]]:
    """`count` pairs of neighbouring frames that an instant of a clip is judged at, drawn by a seed; never t* itself."""
    frames = case.clip.frames
    free = [pair for pair in itertools.pairwise(frames) if t_star not in pair]
    return sorted(free[n] for n in _sample(len(free), count, f"{case.name} {t_star}", seed))


def _sample(count: int, most: int, name: str, seed: int) -> list[int]:
    """Up to `most` of the numbers below `count`, in the order in which they are drawn."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return [int(n) for n in rng.permutation(count)[:most]]
