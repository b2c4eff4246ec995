"""The support bitmap: per Gaussian, the time bins in which it contributed to a training frame.

It is filled at no cost from the rasteriser's sum of alpha * T, and inherited when a Gaussian is split. It determines
which states are anchored, the time at which a freeze evaluates a Gaussian, and which frozen pixels are guesses
(docs/architecture.md, "The method").
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..gaussians import Gaussians

MAX_BINS = 256
# Share of the depth by which a centre must lie behind the visible surface, beyond its own size, to count as hidden.
_DEPTH_TOLERANCE = 0.02
SEEN_WEIGHT = 0.1
"""Sum of alpha * T over a frame's pixels above which a Gaussian counts as seen in it."""


def bin_times(times: np.ndarray) -> Tensor:
    """Centres of the time bins, [B] float32 ascending: the trained times themselves, or 256 even bins if more."""
    distinct = np.unique(np.asarray(times, dtype=np.float64))
    if len(distinct) < 2:
        raise ValueError(f"{len(distinct)} distinct time: at least 2 are needed")
    if len(distinct) > MAX_BINS:
        distinct = (np.arange(MAX_BINS) + 0.5) / MAX_BINS
    return torch.as_tensor(distinct, device="cpu").float()


def bin_of(centres: Tensor, time: float) -> int:
    """Index of the bin nearest to `time`."""
    return int((centres - time).abs().argmin())


@torch.no_grad()
def mark_seen(model: Gaussians, time_bin: Tensor, weight_sum: Tensor) -> None:
    """Marks the Gaussians that contribute to a training frame; weight_sum [N] is the sum of alpha * T over its pixels.

    time_bin: int64 [1], on the model's device.
    """
    seen = weight_sum[:, None] > SEEN_WEIGHT
    # By tensors of indices, so that a recorded step can be replayed with another bin.
    model.support.index_copy_(1, time_bin, model.support.index_select(1, time_bin) | seen)


@torch.no_grad()
def mark_hidden(
    model: Gaussians,
    rows: Tensor,
    time_bin: Tensor,
    state: dict[str, Tensor],
    viewmat: Tensor,
    K: Tensor,
    depth: Tensor,
) -> None:
    """Marks the Gaussians of `rows` [M] that a frame cannot show: outside the frame, or behind its surface.

    The paper calls only those outside the frame hidden. Here, occluded ones are hidden, too.

    Args:
        time_bin: int64 [1], on the model's device.
        state: the Gaussians at the frame's time.
        viewmat: [4, 4]; K: [3, 3] px.
        depth: [H, W] median depth of the frame's render, 1e10 where it is empty.
    """
    height, width = depth.shape
    camera = state["means"].detach()[rows] @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = camera[:, 2]
    pixels = camera[:, :2] / z.clamp_min(1e-6)[:, None] * K.diagonal()[:2] + K[:2, 2]
    inside = (z > 1e-6) & (pixels >= 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    at = torch.nan_to_num(pixels).long()
    seen = depth.detach()[at[:, 1].clamp(0, height - 1), at[:, 0].clamp(0, width - 1)]
    size = state["log_scales"].detach()[rows].amax(1).exp()
    is_occluded = z > (1.0 + _DEPTH_TOLERANCE) * seen + size
    model.hidden[rows, time_bin] = ~inside | is_occluded


def nearest_supported(support: Tensor, bins: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Nearest supported bins before and after each bin, which may be the bin itself.

    Args:
        support: bool [M, B].
        bins: int64 [M].

    Returns:
        (left [M], has_left [M], right [M], has_right [M]). An index without a supported bin is the bin itself.
    """
    index = torch.arange(support.shape[1], device=support.device).expand_as(support)
    before = torch.where(support & (index <= bins[:, None]), index, -1).amax(1)
    after = torch.where(support & (index >= bins[:, None]), index, support.shape[1]).amin(1)
    has_left, has_right = before >= 0, after < support.shape[1]
    return torch.where(has_left, before, bins), has_left, torch.where(has_right, after, bins), has_right


def nearest_bin(support: Tensor, centres: Tensor, time: float) -> tuple[Tensor, Tensor]:
    """(bin [M], has_bin [M]): supported bin of each Gaussian that is nearest to `time`; ties go to the past."""
    distance = (centres - time).abs()
    cost = torch.where(support, distance, torch.inf)
    best = cost.argmin(1)
    return best, support.any(1)


def support_confidence(support: Tensor, is_open: Tensor, centres: Tensor, time: float, decay: float) -> Tensor:
    """Confidence in each Gaussian's state at `time`, [N] in [0, 1]; 0 for Gaussians that were never seen.

    It is 1 for static Gaussians. For moving Gaussians, it decays with the distance |dt| from the nearest supported bin
    as exp(-|dt| / decay), both in normalised time; distances up to half a bin count as 0.
    """
    known = support.view(torch.uint8).amax(1).float()  # takes a third of the time of any()
    rows = torch.nonzero(is_open).flatten()
    distance = torch.where(support[rows], (centres - time).abs(), torch.inf).amin(1)
    half_bin = 0.5 * float((centres[1:] - centres[:-1]).max())
    known[rows] = torch.exp(-(distance - half_bin).clamp_min(0.0) / decay)
    return known
