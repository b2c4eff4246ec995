"""How fast things move, before anything is let move: from what the static model gets wrong, frame by frame."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from ..scene import resize_intrinsics
from ..torch_types import weighted_gradient
from .model import render
from .run_view import RunView

_LOOKED_AT = 48
"""Most frames whose residual is examined."""


def correlation_of_movers(run: RunView) -> float | None:
    """`correlation_frames` of what the static model lacks at the open Gaussians that are likely to move."""
    residual, weight = signed_residual(run, torch.nonzero(run.model.gaussians.open).flatten())
    likely = likely_movers(residual, weight)
    return correlation_frames(residual[:, likely], weight[:, likely])


def signed_residual(run: RunView, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Residual of the static model at the Gaussians `rows` [M], per frame, at half the size.

    Returns (residual [I, M], weight [I, M]): mean of image - render over the pixels that a Gaussian paints, by
    alpha * T, grey, and the sum of those weights; 0 for frames that were not looked at.
    """
    excluded = run.excluded_frames
    frames = [n for n in range(len(run.train_ids)) if n not in excluded]
    if len(frames) > _LOOKED_AT:  # two stretches of neighbours: sparse frames would not show what is fast
        half = _LOOKED_AT // 2
        first, second = len(frames) // 4, 3 * len(frames) // 4
        frames = frames[first - half // 2 :][:half] + frames[second - half // 2 :][:half]
    model, (height, width) = run.model, (run.height // 2, run.width // 2)
    state = {name: p.detach() for name, p in model.gaussians.params.items()}
    residual = torch.zeros(len(run.train_ids), len(rows), device=model.device)
    weight = torch.zeros_like(residual)
    background = torch.cat([run.background, run.background.new_zeros(1)])
    for n in frames:
        index = run.train_ids[n]
        K = resize_intrinsics(run.Ks[index].cpu(), run.width, run.height, width, height)
        ink = torch.zeros(len(model.gaussians), 1, device=model.device, requires_grad=True)
        out = render(
            state, model.sh_degree, run.viewmats[index], K.to(model.device), width, height, colors=ink,
            background=background, with_depth=False, with_contributions=True,
        )  # fmt: skip
        image = run.images[n].to(model.device, torch.float32).permute(2, 0, 1)
        image = F.interpolate(image[None], (height, width), mode="area")[0].permute(1, 2, 0)
        lack = (image - model.exposure.apply(out.colors[0, ..., :3].detach(), run.times[n])).mean(-1).detach()
        ignored = run.ignored_at(index)
        if ignored is not None:
            lack = lack * (F.interpolate(ignored[None, None].float(), (height, width), mode="area")[0, 0] == 0.0)
        if out.weight_sum is None:
            raise RuntimeError("the frame was rendered without contributions")
        lacks = weighted_gradient(out.colors[0, ..., 3], ink, lack)
        weight[n] = out.weight_sum[0][rows]
        residual[n] = lacks[rows, 0] / weight[n].clamp_min(1e-6)
    return residual, weight


def likely_movers(residual: Tensor, weight: Tensor) -> Tensor:
    """Indices of the tenth of M Gaussians whose residual [I, M] is most alike two frames apart (least 64 of them).

    Noise is not alike, and what a static model merely fits badly is the same in all frames.
    """
    seen = (weight > 0.5).float()
    value = (residual - (residual * seen).sum(0) / seen.sum(0).clamp_min(1.0)) * seen
    pairs = (seen[2:] * seen[:-2]).sum(0)
    alike = torch.where(pairs >= 4, (value[2:] * value[:-2]).sum(0) / pairs.clamp_min(1.0), -torch.inf)
    return alike.topk(min(len(alike), max(64, len(alike) // 10))).indices


def correlation_frames(residual: Tensor, weight: Tensor) -> float | None:
    """How many frames it takes until half of a residual's agreement with itself one frame before is gone.

    Of residual [I, M] of M Gaussians over I frames, where weight [I, M] > 0.5, pooled. For a swing of period P it is
    near P / 6: linear interpolation between nodes that far apart misses 14 % of the swing at most. None where frames
    next to each other have nothing in common: no node would be too many. At most I / 2.
    """
    seen = (weight > 0.5).double()
    mean = (residual.double() * seen).sum(0) / seen.sum(0).clamp_min(1.0)
    value = (residual.double() - mean) * seen

    def agreement(lag: int) -> float | None:
        later, earlier = slice(lag, None), slice(None, len(value) - lag)
        pairs = float((seen[later] * seen[earlier]).sum())
        return float((value[later] * value[earlier]).sum()) / pairs if pairs else None

    alone, next_one = agreement(0), agreement(1)
    if not alone or next_one is None or next_one < 0.1 * alone:
        return None
    before = next_one
    for lag in range(2, max(3, len(value) // 2 + 1)):
        agreed = agreement(lag)
        if agreed is None:
            return float(lag - 1)
        if agreed < 0.5 * next_one:
            return lag - 1 + (before - 0.5 * next_one) / (before - agreed)
        before = agreed
    return len(value) / 2
