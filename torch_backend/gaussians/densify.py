"""Densification within a budget: splits the Gaussians with the largest screen gradients, and prunes faint ones.

Differences from 3DGS: a Gaussian's gradient in a view is the sum of absolute values over its pixels, so that opposite
gradients do not cancel (AbsGS, Ye et al. 2024). Its score is the mean over the views that show it. Growth follows a
schedule towards a budget instead of a threshold, so the cost of a run is known before it starts. A Gaussian is split
along its longest axis into two that keep its second moment. Gaussians are not cloned in place, since both clones would
get the same gradient. Opacities are not reset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..torch_types import norm
from .model import Gaussians
from .rotations import rotation_matrices

PRUNE_STOP = 0.9
"""Share of the run at which pruning ends. In the last tenth, `train/average.py` averages the parameters, and restarts
when the number of Gaussians changes."""
_SHRINK = 1.6
"""Ratio of the parent's standard deviation along the split axis to a child's (3DGS densify_and_split)."""


@dataclass
class DensifyConfig:
    """Schedule and thresholds; iterations are shares of the run's length."""

    budget: int = 58_000
    """Maximum number of Gaussians. The default, for previews, is about one per pixel of a training image."""
    start: float = 0.06
    """Share of the run at which growth begins."""
    stop: float = 0.5
    """Share of the run at which growth ends; pruning continues until `PRUNE_STOP`."""
    every: int = 100
    """Iterations between two rounds. `config_from_params` sets it to a 30th of the run, 50 to 100."""
    prune_opacity: float = 0.01
    """Opacity below which Gaussians are pruned (3DGS: 0.005)."""
    max_scale: float = 0.5
    """Largest standard deviation above which Gaussians are pruned, as a multiple of their distance from the cameras'
    centre (at least 1 scene unit)."""
    min_gradient: float = 0.0
    """Mean absolute screen gradient below which Gaussians are not split."""


class Densifier:
    """Accumulates screen gradients between rounds, and carries out rounds of densification."""

    def __init__(self, config: DensifyConfig, count: int, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.device = torch.device(device)
        self.reset(count)

    def reset(self, count: int) -> None:
        """Resets the accumulated gradients to 0, for `count` Gaussians. Called after every round."""
        self.gradient = torch.zeros(count, device=self.device)
        self.seen = torch.zeros(count, device=self.device)

    @torch.no_grad()
    def observe(self, absgrad: Tensor, radii: Tensor) -> None:
        """Adds one view: |screen gradient| [N] in 1/px and screen radii [N] in px, 0 where culled."""
        visible = radii > 0
        self.gradient += torch.where(visible, absgrad, 0.0)
        self.seen += visible

    def target(self, initial: int, progress: float) -> int:
        """Number of Gaussians that the schedule allows at `progress` (0 to 1) of the run.

        initial + (budget - initial) * sqrt(s), with s from 0 at `start` to 1 at `stop`: half of the growth is done
        after a quarter of that time, so that new Gaussians still have most of the run to train.
        """
        c = self.config
        share = min(max((progress - c.start) / (c.stop - c.start), 0.0), 1.0)
        return round(initial + (max(c.budget, initial) - initial) * math.sqrt(share))

    @torch.no_grad()
    def step(
        self, model: Gaussians, optimizer: torch.optim.Optimizer, initial: int, progress: float, grow: bool = True
    ) -> tuple[int, int]:
        """Runs one round: prunes and, if `grow`, splits up to the scheduled number. Returns numbers (split, pruned)."""
        keep = self._keep(model)
        score = self.gradient / self.seen.clamp_min(1.0)
        room = self.target(initial, progress) - int(keep.sum())
        split = self._choose(score, keep, room if grow and progress < self.config.stop else 0)
        survivors = torch.nonzero(keep & ~split).flatten()
        parents = torch.nonzero(split).flatten()
        rows = torch.cat([survivors, parents, parents])
        fresh = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        fresh[len(survivors) :] = True
        pruned = int((~keep).sum())
        if len(parents) or pruned:
            model.rebuild(rows, fresh, optimizer)
            _separate(model, len(survivors), len(parents))
        self.reset(len(model))
        return len(parents), pruned

    def _keep(self, model: Gaussians) -> Tensor:
        p = model.params
        finite = torch.isfinite(p["means"]).all(1) & torch.isfinite(p["log_scales"]).all(1)
        finite &= torch.isfinite(p["quats"]).all(1) & torch.isfinite(p["opacity_logits"])
        opaque = torch.sigmoid(p["opacity_logits"]) > self.config.prune_opacity
        largest = p["log_scales"].amax(1)
        distance = norm(p["means"], dim=1)  # from the cameras' centre, the scene's origin
        return finite & opaque & (largest < math.log(self.config.max_scale) + torch.log(distance.clamp_min(1.0)))

    def _choose(self, score: Tensor, keep: Tensor, room: int) -> Tensor:
        chosen = torch.zeros_like(keep)
        eligible = keep & (self.seen > 0) & (score > self.config.min_gradient)
        count = min(room, int(eligible.sum()))
        if count > 0:
            ranked = torch.where(eligible, score, -torch.inf)
            chosen[ranked.topk(count).indices] = True
        return chosen


@torch.no_grad()
def _separate(model: Gaussians, first: int, count: int) -> None:
    """Turns pairs of copies into children that are separated along their longest axis.

    The first copies are the `count` rows from `first`; the second copies follow in the same order.
    """
    if not count:
        return
    p = model.params
    one, two = slice(first, first + count), slice(first + count, first + 2 * count)
    log_scales = p["log_scales"][one]
    longest = log_scales.argmax(1)
    turned = rotation_matrices(torch.nn.functional.normalize(p["quats"][one], dim=1))
    axis = torch.gather(turned, 2, longest[:, None, None].expand(-1, 3, 1))[..., 0]
    # The mixture of the two keeps the parent's second moment: s^2 = d^2 + (s / 1.6)^2.
    distance = log_scales.gather(1, longest[:, None]).exp() * math.sqrt(1.0 - _SHRINK**-2)
    shrunk = log_scales.scatter_add(1, longest[:, None], log_scales.new_full((count, 1), -math.log(_SHRINK)))
    # Each child has half the parent's mass on a shorter axis, so its peak opacity is 1.6 / 2 of the parent's.
    logit = torch.logit((torch.sigmoid(p["opacity_logits"][one]) * _SHRINK / 2).clamp(1e-4, 1.0 - 1e-4))
    for rows, sign in ((one, 1.0), (two, -1.0)):
        p["means"].data[rows] += sign * distance * axis
        p["log_scales"].data[rows] = shrunk
        p["opacity_logits"].data[rows] = logit
