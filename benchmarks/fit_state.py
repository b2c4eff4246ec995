"""Fits the weights of `torch_backend/freeze/composite/state.py` on synthetic scenes with truth.

    python -m benchmarks.fit_state SCENE ... --results DIR [--seeds 0 1] [--every K] [--cross]

SCENE is a folder of benchmarks/synthetic; seeds 0 to 9 are for tuning. Its shot and an `auto` run for every training
seed are made in DIR if missing. For every instant and pose with truth, the evidence is computed as for a frozen frame.
The fit minimises the sum of two losses. The first is the mean squared error of a mixed frame, relative to the plate's.
The posterior mixes the plate and its fill, which is the frame with that plate withheld. The second loss is the
cross-entropy of the posterior with whether plate and truth differ. Afterwards the bias alone is chosen by the PSNR of
mixed frames. Prints the weights and the PSNR of frames mixed by them. `--cross` judges each scene by weights fitted on
the others.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.detail_clip import DetailClip
from benchmarks.detail_truth import scene_arguments, trained_scenes
from benchmarks.report.metrics import psnr_of
from benchmarks.report.truth import TruthScene
from benchmarks.sources import in_words
from torch_backend.freeze.composite.state import StateConfig, StateWeights, evidence, rejection
from torch_backend.freeze.frozen import OutputFrame
from torch_backend.freeze.views.reproject import blurred, resized
from torch_backend.freeze.views.target_view import target_view
from torch_backend.train import load_run

NAMES = [f.name for f in fields(StateWeights) if f.name != "bias"]
"""Names of the evidence, in the order of `Case.evidence`."""
LABEL_WEIGHT = 0.1
"""Weight of the cross-entropy relative to the squared error."""
DIFFERS = 0.03, 0.09
"""Display-referred differences of plate and truth at which the label `differs` leaves 0 and reaches 1."""
SHIFTS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Candidates added to the fitted bias; the highest PSNR of smoothed, mixed frames decides. The fit ignores smoothing
and ramp, and its cross-entropy weighs missed and needlessly rejected pixels equally."""
ALIKE = 0.02
"""dB of PSNR within which two biases count as equally good; the one that rejects less is taken."""
STEPS, RATE, DECAY = 150, 0.15, 1e-4
"""Steps and learning rate of Adam, and weight decay; weights are per standard deviation of the evidence."""


@dataclass
class Case:
    """All frames of one run. Pictures are [N, h, w, 3], display-referred, at the size of decisions."""

    name: str
    """Scene and training seed."""
    evidence: Tensor
    """[N, h, w, E] in the order of `NAMES`."""
    plate: Tensor
    """The plate of each pose."""
    filled: Tensor
    """The frozen frame with the plate of its pose withheld."""
    truth: Tensor
    """The scene at t*."""
    moving: Tensor
    """[N, h, w] bool: pixels that move."""
    unit: float
    """Pixels of decisions per pixel of a 640-pixel-wide frame."""

    def saving(self) -> Tensor:
        """[N, h, w] squared error saved by rejecting the plate, relative to the plate's mean squared error."""
        kept, gone = ((picture - self.truth).square().mean(-1) for picture in (self.plate, self.filled))
        return torch.stack([blurred(each, 1.0) for each in kept - gone]) / kept.mean()

    def differs(self) -> Tensor:
        """[N, h, w] in 0..1: degree to which plate and truth differ."""
        difference = torch.stack([blurred(each, 1.0).abs().amax(-1) for each in self.plate - self.truth])
        low, high = DIFFERS
        return ((difference - low) / (high - low)).clamp(0.0, 1.0)


def collect(truth: TruthScene, run: str, name: str, t_stars: Sequence[int], every: int) -> Case:
    """The case of a scene and run: its instants and every `every`-th pose."""
    clip = DetailClip(truth.shot, run, load_run(truth.shot, run, torch.device("cpu")).width)
    rows: list[tuple[Tensor, ...]] = []
    for t_star in t_stars:
        clip.frozen(t_star)  # develops outside `_row`, which computes no gradients
        for pose in [pose for pose in truth.poses(t_star, []) if pose != t_star][::every]:
            rows.append(_row(clip, truth, pose, t_star))
    found, plate, filled, target, moving = (torch.stack(column) for column in zip(*rows, strict=True))
    return Case(name, found, plate, filled, target, moving, clip.compositor.source_views.unit)


@torch.no_grad()
def _row(clip: DetailClip, truth: TruthScene, pose: int, t_star: int) -> tuple[Tensor, ...]:
    image = clip.splats(pose, t_star)
    filled = clip.view(pose, t_star, (pose,), image).picture
    compositor, frozen = clip.compositor, clip.frozen(t_star)
    output = OutputFrame(pose, *clip.camera(pose), float(t_star), float(pose))
    target = target_view(compositor.source_views, output, frozen, image, clip.width, clip.height)
    seen, instant = (compositor.source_views.seen(frame, target.points) for frame in (pose, t_star))
    found = evidence(compositor.source_views, target, pose, seen, instant, compositor.config.state)
    h, w = target.depth.shape
    pictures = (clip.plate(pose), filled, truth.truth(t_star, pose, clip.width, clip.height))
    moving = truth.regions(t_star, pose, clip.width, clip.height)["moving"]
    return (
        torch.stack([found[name] for name in NAMES], dim=-1), *(resized(each, w, h) for each in pictures),
        resized(moving.float(), w, h) > 0.5,
    )  # fmt: skip


def fit(cases: Sequence[Case]) -> StateWeights:
    """The weights fitted to all cases, weighted equally."""
    flat = [case.evidence.reshape(-1, len(NAMES)) for case in cases]
    every = torch.cat(flat)
    mean, deviation = every.mean(0), every.std(0).clamp_min(1e-3)
    samples = [((x - mean) / deviation, case.saving().flatten(), case.differs().flatten()) for x, case in
            zip(flat, cases, strict=True)]  # fmt: skip
    weights, bias = torch.zeros(len(NAMES), requires_grad=True), torch.tensor(-2.0, requires_grad=True)
    optimizer = torch.optim.Adam([weights, bias], lr=RATE)
    for _ in range(STEPS):
        loss = DECAY * weights.square().sum()
        for x, saving, differs in samples:
            odds = x @ weights + bias
            entropy = F.binary_cross_entropy_with_logits(odds, differs)
            loss = loss + (LABEL_WEIGHT * entropy - (torch.sigmoid(odds) * saving).mean()) / len(samples)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    weights = weights.detach() / deviation
    values = {name: round(float(value), 2) for name, value in zip(NAMES, weights, strict=True)}
    found = StateWeights(bias=round(float(bias.detach() - (weights * mean).sum()), 2), **values)
    shifted = [replace(found, bias=round(found.bias + shift, 2)) for shift in SHIFTS]
    reached = [float(np.mean([judged(case, each)["mixed whole"] for case in cases])) for each in shifted]
    return next(each for each, psnr in zip(shifted, reached, strict=True) if psnr >= max(reached) - ALIKE)


def judged(case: Case, weights: StateWeights) -> dict[str, float]:
    """{figure: value}: dB of the mix, of the plate alone and of the fill alone, whole and moving; share of the fill."""
    config = StateConfig(weights=weights)
    values = torch.tensor([getattr(weights, name) for name in NAMES])
    odds = case.evidence @ values + weights.bias
    share = torch.stack([rejection(blurred(each, config.smoothing * case.unit), config) for each in odds])[..., None]
    mixed = torch.lerp(case.plate, case.filled, share)
    found = {"let go": float(share.mean())}
    for name, picture in {"mixed": mixed, "plate": case.plate, "fill": case.filled}.items():
        error = (picture - case.truth).square().mean(-1)
        moving = [e[m] for e, m in zip(error, case.moving, strict=True) if m.any()]
        for region, errors in (("whole", [*error]), ("moving", moving)):
            found[f"{name} {region}"] = float(np.mean([psnr_of(float(each.mean())) for each in errors]))
    return found


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.set_defaults(every=2)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="training seeds")
    parser.add_argument("--cross", action="store_true", help="judge each scene by weights fitted on all other scenes")
    args = parser.parse_args(argv)
    cases = [
        collect(truth, run, f"{truth.name} s{seed}", args.t_star or truth.t_stars, args.every)
        for truth, runs in trained_scenes(args, args.seeds)
        for seed, run in runs.items()
    ]
    print(fit(cases))
    for case in cases:
        training_cases = [candidate for candidate in cases if candidate.name.split(" s")[0] != case.name.split(" s")[0]]
        figures = judged(case, fit(training_cases if args.cross and training_cases else cases))
        print(f"{case.name}: " + ", ".join(f"{name} {value:.2f}" for name, value in figures.items()), flush=True)


if __name__ == "__main__":
    sys.exit(main())
