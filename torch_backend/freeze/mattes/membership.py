"""Which Gaussians a matte is of: mattes at some frames vote, and the vote is rendered at every pose."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...gaussians.neighbours import nearest
from ...raster import RasterSettings
from ...torch_types import from_numpy
from ...train.model import gathered, render
from ..frozen import FrozenGaussians
from ..views.reproject import inside, project

SEEN = 0.05
"""Pixels of a Gaussian that cameras have to see before mattes can say whether it is a member."""

RIM = 0.05
"""Gaussians that no lassoed frame shows can belong to the thing within this share of its diagonal from its members: a
back that the camera comes to see, but not the floor behind it. Things that a frame cuts off need a second lasso."""


def vote(frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, weights: Tensor) -> Tensor:
    """[N, C]: of what a camera sees of each Gaussian, the pixels in each of pictures [H, W, C].

    viewmat [4, 4] in scene units, K [3, 3] in pixels of the pictures. A Gaussian whose centre is outside of the picture
    is not seen: what reaches into it may be a hundredth of a large one.
    """
    device = frozen.support.device
    height, width, _ = weights.shape
    camera = viewmat.to(device), K.to(device)
    pixels, _ = project(frozen.state["means"], *camera)
    within = inside(pixels, width, height, soft=1e-3) > 0.0
    return gathered(frozen.state, *camera, width, height, weights.to(device)) * within[:, None]


def membership(votes: Tensor) -> Tensor:
    """[N, 2]: the share of each Gaussian that belongs to a thing, 0 if nobody saw it, and 1 if somebody did.

    `votes` [N, 2] are pixels within mattes, and all pixels.
    """
    within, whole = votes.unbind(1)
    known = whole > SEEN
    return torch.stack([torch.where(known, within / whole.clamp_min(1e-9), 0.0), known.to(within)], dim=1)


def rule_out(votes: Tensor, means: Tensor) -> Tensor:
    """Votes [N, 2] with one more against every Gaussian that nobody saw and that is farther than `RIM` from the thing.

    `means` [N, 3] are where the Gaussians are.
    """
    share, known = membership(votes).unbind(1)
    members = (share > 0.5).cpu()
    unseen = (known < 0.5).cpu()
    if not bool(members.any()) or not bool(unseen.any()):
        return votes
    places = means.detach().cpu().double().numpy()
    low, high = np.quantile(places[members.numpy()], (0.02, 0.98), axis=0)  # floaters are far from it
    core = places[members.numpy()]
    core = core[((core >= low) & (core <= high)).all(1)]
    if not len(core):
        return votes
    distance, _ = nearest(core, places[unseen.numpy()], 1, workers=-1)
    far = torch.zeros_like(unseen)
    far[unseen] = from_numpy(distance[:, 0] > RIM * float(np.linalg.norm(high - low)))
    return votes + torch.stack([torch.zeros_like(share), far.to(share)], dim=1)


@torch.no_grad()
def render_members(
    frozen: FrozenGaussians, members: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int,
    overscan: tuple[float, float] = (0.0, 0.0),
) -> Tensor:  # fmt: skip
    """[H, W, 2] in 0..1, on the CPU: `members` [N, 2] as one camera sees them, as shares of what is modelled.

    The first is a share of what is known: a pixel that is half unknown and half the thing is the thing.
    """
    device = frozen.support.device
    out = render(
        frozen.state, 0, viewmat.to(device), K.to(device), width, height, colors=members.to(device),
        with_contributions=False, settings=RasterSettings(overscan=overscan),
    )  # fmt: skip
    alpha, (members_of, known) = out.alphas[0], out.colors[0, ..., 3:].unbind(-1)
    shares = torch.stack([members_of / known.clamp_min(1e-4), known / alpha.clamp_min(1e-4)], dim=-1)
    return torch.where(alpha[..., None] > 1e-3, shares, 0.0).clamp(0.0, 1.0).cpu()
