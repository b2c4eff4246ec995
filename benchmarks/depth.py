"""Depth of frozen frames against truth: `python -m benchmarks.depth SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 for tuning, 100 to 109 for reporting). Its shot and an `auto`
run for each training seed are made in DIR if missing. The benchmark judges the depth that a take writes as Z, at plate
size, for every instant and pose with truth. Truth is the depth of the scene's triangles along the rays through the
pixel centres, in metres. Exact cameras have scale 1, solved ones the scale of their similarity.

Two regions are judged separately, by truth: `still`, and `moving` (people and what they move). Sky, glass and mirrors
are excluded. Figures pool the pixels of all frames of a scene:

- Median of |depth - truth| / truth, and the share of pixels beyond 1 %, inside surfaces: at least `INSIDE` pixels from
  every occlusion boundary and from the border of the region.
- F-score of occlusion boundaries at a tolerance of one pixel: see `occlusion_edges`.
- The shares of pixels inside surfaces whose error is below one and two of the standard deviations given by the frame
  (68 and 95 % for Gaussian errors).

Writes depth-NAME.json to DIR.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.detail import develop_argument
from benchmarks.detail_clip import DetailClip
from benchmarks.detail_figures import dilate
from benchmarks.detail_truth import scene_arguments, trained_scenes
from benchmarks.report.metrics import known_mean
from benchmarks.report.setting import plain
from benchmarks.report.truth import PANES
from benchmarks.sources import SyntheticTruth, in_words
from torch_backend.shot import write_json

INSIDE = 2
"""Distance in pixels from the nearest occlusion boundary at which a pixel counts as inside a surface."""
STEP = 1.05
"""Ratio of the depths of two neighbouring pixels above which one occludes the other."""
SAME_SLOPE = 0.5
"""A step in inverse depth is a slope, not an occlusion, if an adjacent step is at least this share of it."""
TOLERANCE = 1
"""Tolerance of a boundary's position in pixels, along rows and columns."""
NEAR_MOVER = 3
"""A boundary within this many pixels of a mover belongs to `moving`, any other to `still`."""
BEYOND = 0.01
"""Relative error above which a card placed by depth visibly passes through a surface."""
FARTHEST = 1000.0
"""Depth in metres to which all greater depths are clamped, including the sky's."""
REGIONS = ("still", "moving")


def occlusion_edges(depth: Tensor) -> Tensor:
    """bool [H, W]: pixels that occlude a neighbour in their row or column, from depth [H, W] in metres.

    The nearer of two neighbours is such a pixel if their depths differ by a factor of `STEP` and no adjacent step in
    inverse depth is nearly as large in the same direction. A large adjacent step means a slanted surface, or a boundary
    smeared over several pixels.
    """
    inverse = 1.0 / depth.clamp(1e-3, FARTHEST)
    return _edges_in_rows(inverse) | _edges_in_rows(inverse.T).T


def _edges_in_rows(inverse: Tensor) -> Tensor:
    step = inverse[:, 1:] - inverse[:, :-1]
    ratio = torch.maximum(inverse[:, 1:], inverse[:, :-1]) / torch.minimum(inverse[:, 1:], inverse[:, :-1])
    before, after = F.pad(step, (1, 0))[:, :-1], F.pad(step, (0, 1))[:, 1:]
    slope = torch.maximum(before * step.sign(), after * step.sign())
    occludes = (ratio > STEP) & (slope < SAME_SLOPE * step.abs())
    edges = torch.zeros_like(inverse, dtype=torch.bool)
    edges[:, 1:] |= occludes & (step > 0)
    edges[:, :-1] |= occludes & (step < 0)
    return edges


@dataclass
class Pooled:
    """Pooled values of one region of a scene: errors inside surfaces, and counts of boundary pixels."""

    errors: list[Tensor] = field(default_factory=list[Tensor])
    """Relative errors of depth, [P] per frame."""
    deviations: list[Tensor] = field(default_factory=list[Tensor])
    """Errors in standard deviations, [P] per frame; empty if frames have none."""
    found: int = 0
    """Number of boundary pixels of the frames within `TOLERANCE` of a true one."""
    shown: int = 0
    """Number of boundary pixels of the frames."""
    recalled: int = 0
    """Number of true boundary pixels within `TOLERANCE` of one of the frames."""
    true: int = 0
    """Number of true boundary pixels."""

    def add_boundary(self, depth: Tensor, truth: Tensor, region: Tensor) -> None:
        """Adds the boundary pixels of one frame in `region`."""
        true_edges, edges = occlusion_edges(truth), occlusion_edges(depth)
        self.found += int((edges & region & dilate(true_edges, TOLERANCE)).sum())
        self.shown += int((edges & region).sum())
        self.recalled += int((true_edges & region & dilate(edges, TOLERANCE)).sum())
        self.true += int((true_edges & region).sum())

    def add_surface(self, depth: Tensor, truth: Tensor, region: Tensor, sigma: Tensor | None) -> None:
        """Adds the pixels of one frame inside surfaces of `region`."""
        sky = ~torch.isfinite(truth)
        outside = occlusion_edges(truth) | sky | ~region
        inside = ~dilate(outside, INSIDE)
        error = (depth[inside] - truth[inside]).abs()
        self.errors.append(error / truth[inside])
        if sigma is not None:
            self.deviations.append(error / sigma[inside].clamp_min(1e-9))

    def figures(self) -> dict[str, float | None]:
        """median and beyond (shares), boundary_f, precision, recall, within_1_sigma, within_2_sigma; None for a figure
        without data."""
        errors = torch.cat(self.errors) if self.errors else torch.empty(0)
        deviations = torch.cat(self.deviations) if self.deviations else torch.empty(0)
        precision = self.found / self.shown if self.shown else None
        recall = self.recalled / self.true if self.true else None
        both = None if precision is None or recall is None else precision + recall
        return {
            "median": float(errors.median()) if len(errors) else None,
            "beyond": float((errors > BEYOND).float().mean()) if len(errors) else None,
            "boundary_f": None
            if both is None
            else (2.0 * (precision or 0.0) * (recall or 0.0) / both if both else 0.0),
            "precision": precision,
            "recall": recall,
            **{
                f"within_{n}_sigma": float((deviations < n).float().mean()) if len(deviations) else None for n in (1, 2)
            },
        }


def add_frame(
    pooled: dict[str, Pooled], depth: Tensor, truth: Tensor, moving: Tensor, left_out: Tensor, sigma: Tensor | None
) -> None:
    """Adds one frame to both of `REGIONS`: depth, truth and sigma [H, W] in metres, masks bool [H, W]."""
    near = dilate(moving, NEAR_MOVER)
    pooled["still"].add_surface(depth, truth, ~moving & ~left_out, sigma)
    pooled["moving"].add_surface(depth, truth, moving & ~left_out, sigma)
    pooled["still"].add_boundary(depth, truth, ~near & ~left_out)
    pooled["moving"].add_boundary(depth, truth, near & ~left_out)


def judge(
    truth: SyntheticTruth, run_name: str, t_stars: Sequence[int], every: int = 1, develop: bool = True
) -> dict[str, dict[str, float | None]]:
    """Region -> `Pooled.figures` of every `every`-th pose of the instants."""
    clip, pooled = DetailClip(truth.shot, run_name, 0, develop), {region: Pooled() for region in REGIONS}
    size = clip.width, clip.height
    metres = truth.metres_per_unit / clip.scene.scale
    for t_star in t_stars:
        for pose in truth.poses(t_star, [])[::every]:
            depth, sigma = clip.depth(pose, t_star, clip.view(pose, t_star))
            regions = truth.regions(t_star, pose, *size)
            left_out = torch.zeros_like(regions["moving"])
            for pane in PANES:
                left_out |= regions.get(pane, left_out)
            true = truth.depth(t_star, pose, *size)
            add_frame(pooled, depth * metres, true, regions["moving"], left_out, sigma * metres)
        print(f"{truth.name}, t* {t_star}: {_text(pooled['still'].figures())} still so far", flush=True)
    return {region: of.figures() for region, of in pooled.items()}


def _text(of: dict[str, float | None]) -> str:
    def said(name: str, unit: float, digits: int) -> str:
        value = of[name]
        return plain(value and unit * value, digits)

    cells = said("median", 100.0, 2), said("beyond", 100.0, 1), said("boundary_f", 1.0, 3), said("precision", 1.0, 3)
    shares = said("within_1_sigma", 100.0, 1), said("within_2_sigma", 100.0, 1)
    return " | ".join((*cells, said("recall", 1.0, 3), *shares))


def table(found: dict[str, dict[str, dict[str, float | None]]]) -> list[str]:
    """Figures by scene and region in Markdown."""
    head = (
        "| scene | region | median error, % | beyond 1 %, % | boundary F | precision | recall | in 1 sigma, % | in 2 |"
    )
    lines = [
        f"| {scene} | {region} | {_text(of)} |" for scene, regions in found.items() for region, of in regions.items()
    ]
    return [head, "|---|---|---:|---:|---:|---:|---:|---:|---:|", *lines]


def mean_of(found: Sequence[dict[str, dict[str, float | None]]]) -> dict[str, dict[str, float | None]]:
    """Mean of the figures of several trainings."""
    return {
        region: {name: known_mean(f[region][name] for f in found) for name in of} for region, of in found[0].items()
    }


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="training seeds")
    develop_argument(parser)
    args = parser.parse_args(argv)
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    for truth, runs in trained_scenes(args, args.seeds):
        of: dict[str, Any] = {}
        for seed, run in runs.items():
            of[f"seed {seed}"] = judge(truth, run, args.t_star or truth.t_stars, args.every, args.develop == "on")
        found[truth.name] = mean_of(list(of.values()))
        write_json(args.results / f"depth-{truth.name.replace(' ', '-')}.json", {"version": 1, **of})
    print("\n".join(["", *table(found)]))


if __name__ == "__main__":
    sys.exit(main())
