"""Estimates the speed of motion from the residual of the static model in each frame, before a field exists."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from ..scene import resize_intrinsics
from ..torch_types import weighted_gradient
from .model import render
from .run_view import RunView

_LOOKED_AT = 48
"""Maximum number of frames whose residual is examined."""


def correlation_of_movers(run: RunView) -> float | None:
    """Result of `correlation_frames` for the static model's residual at open Gaussians that are likely to move."""
    residual, weight = signed_residual(run, torch.nonzero(run.model.gaussians.open).flatten())
    likely = likely_movers(residual, weight)
    return correlation_frames(residual[:, likely], weight[:, likely])


def signed_residual(run: RunView, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Residual of the static model at the Gaussians `rows` [M], per frame, at half resolution.

    Returns (residual [I, M], weight [I, M]): mean over the channels and pixels of image - render, weighted by the
    Gaussian's blending weights (alpha * T), and the sum of these weights. Both are 0 for frames that are not examined.
    """
    excluded = run.excluded_frames
    frames = [n for n in range(len(run.train_ids)) if n not in excluded]
    if len(frames) > _LOOKED_AT:  # two ranges of consecutive frames, because sparse frames would miss fast motion
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
    """Indices of the tenth of the M Gaussians (at least 64) whose residual [I, M] correlates most two frames apart."""
    seen = (weight > 0.5).float()
    # Noise does not correlate. Badly fitted static surfaces do, and are removed with the mean over the frames.
    value = (residual - (residual * seen).sum(0) / seen.sum(0).clamp_min(1.0)) * seen
    pairs = (seen[2:] * seen[:-2]).sum(0)
    correlation = torch.where(pairs >= 4, (value[2:] * value[:-2]).sum(0) / pairs.clamp_min(1.0), -torch.inf)
    return correlation.topk(min(len(correlation), max(64, len(correlation) // 10))).indices


def correlation_frames(residual: Tensor, weight: Tensor) -> float | None:
    """Lag in frames at which the residual's autocorrelation falls to half of its value at lag 1; at most I / 2.

    The correlation is pooled over the residual [I, M] of M Gaussians in I frames, where weight [I, M] > 0.5. For an
    oscillation of period P, the lag is near P / 6: linear interpolation between nodes at this distance misses at most
    14 % of the amplitude. None if neighbouring frames do not correlate.
    """
    seen = (weight > 0.5).double()
    mean = (residual.double() * seen).sum(0) / seen.sum(0).clamp_min(1.0)
    value = (residual.double() - mean) * seen

    def agreement(lag: int) -> float | None:
        later, earlier = slice(lag, None), slice(None, len(value) - lag)
        pairs = float((seen[later] * seen[earlier]).sum())
        return float((value[later] * value[earlier]).sum()) / pairs if pairs else None

    variance, first = agreement(0), agreement(1)
    if not variance or first is None or first < 0.1 * variance:  # too fast: use as many nodes as possible
        return None
    before = first
    for lag in range(2, max(3, len(value) // 2 + 1)):
        agreed = agreement(lag)
        if agreed is None:
            return float(lag - 1)
        if agreed < 0.5 * first:
            return lag - 1 + (before - 0.5 * first) / (before - agreed)
        before = agreed
    return len(value) / 2
