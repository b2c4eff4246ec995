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
from ..views.reproject import inside, look_up, project

SEEN = 0.05
"""Pixels of a Gaussian that cameras have to see before mattes can say whether it is a member."""

THICK = 0.1
"""Gaussians farther behind the surface than this share of its depth are behind the thing: 0.3 m, a body, at 3 m. At the
3 % by which depth is off, a thing's own Gaussians counted as hidden, and small things lost what the lassoed frame hid
(docs/benchmarks.md, "Mattes by pointing")."""

RIM = 0.25
"""Gaussians that no lassoed frame shows can belong to the thing within this share of its diagonal from its members: a
back that the camera comes to see, an arm that the frame cuts off, but not the wall behind. 0.05 to 0.5 differ by 0.005
(docs/benchmarks.md, "Mattes by pointing"). Things that are cut off farther need a second lasso."""


def vote(frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, weights: Tensor, depth: Tensor) -> Tensor:
    """[N, C]: of what a camera sees of each Gaussian, the pixels in each of pictures [H, W, C].

    viewmat [4, 4] in scene units, K [3, 3] in pixels of the pictures. `depth` [H, W] is that of what they show, along
    the camera's axis, scene units. A Gaussian whose centre is outside of the picture is not seen: what reaches into it
    may be a hundredth of a large one. One that is not `in_front` is not seen either.
    """
    device = frozen.support.device
    height, width, _ = weights.shape
    camera = viewmat.to(device), K.to(device)
    pixels, _ = project(frozen.state["means"], *camera)
    seen = (inside(pixels, width, height, soft=1e-3) > 0.0) & in_front(frozen, *camera, depth)
    return gathered(frozen.state, *camera, width, height, weights.to(device)) * seen[:, None]


def in_front(frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, depth: Tensor) -> Tensor:
    """[N] bool: False for Gaussians behind the surface that the frame shows at their pixel; `depth` [H, W] as in
    `vote`.

    Splats of a person are not opaque. A wall that shines through them would become a part of them.
    """
    pixels, away = project(frozen.state["means"], viewmat, K)
    surface = look_up(depth.to(pixels.device), pixels, "nearest")
    return away < surface * (1.0 + THICK)


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
