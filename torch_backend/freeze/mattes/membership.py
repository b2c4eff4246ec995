"""Membership of Gaussians in a matte's object: mattes at some frames vote, and the votes are rendered at every pose."""

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
"""Smallest contribution of a Gaussian to the voting frames, in pixels, for its membership to be known."""

THICK = 0.1
"""Depth behind the visible surface, as a share of the surface's depth, above which a Gaussian is hidden: 0.3 m, a body,
at 3 m. With the depth error of 0.03 as threshold, an object's own Gaussians counted as hidden, and small objects
lost the parts that the lassoed frame hides (docs/benchmarks.md, "Mattes by pointing")."""

RIM = 0.25
"""Distance to the members, as a share of the object's diagonal, within which Gaussians that no lassoed frame shows may
belong to the object: a back that the camera reveals later, or an arm outside the frame, but not the wall behind. Values
from 0.05 to 0.5 differ by 0.005 (docs/benchmarks.md, "Mattes by pointing"). Longer hidden parts need a second lasso."""


def vote(frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, weights: Tensor, depth: Tensor) -> Tensor:
    """[N, C]: visible pixels of each Gaussian in a camera, weighted by each of the pictures `weights` [H, W, C].

    viewmat [4, 4] is in scene units, K [3, 3] in pixels of the pictures. `depth` [H, W] of the visible surface is along
    the camera's axis, scene units. Gaussians with centres outside the picture, or not `in_front`, get no votes.
    """
    device = frozen.support.device
    height, width, _ = weights.shape
    camera = viewmat.to(device), K.to(device)
    pixels, _ = project(frozen.state["means"], *camera)
    # Of a Gaussian with its centre outside, the picture may show only a hundredth.
    seen = (inside(pixels, width, height, soft=1e-3) > 0.0) & in_front(frozen, *camera, depth)
    return gathered(frozen.state, *camera, width, height, weights.to(device)) * seen[:, None]


def in_front(frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, depth: Tensor) -> Tensor:
    """[N] bool: False for Gaussians behind the visible surface at their pixel; `depth` [H, W] as in `vote`."""
    pixels, distances = project(frozen.state["means"], viewmat, K)
    surface = look_up(depth.to(pixels.device), pixels, "nearest")
    # Splats of a person are not opaque: a wall that shines through would become part of the person.
    return distances < surface * (1.0 + THICK)


def membership(votes: Tensor) -> Tensor:
    """[N, 2]: share of each Gaussian that belongs to the object (0 if unknown), and 1 if it is known, else 0.

    `votes` [N, 2] are the Gaussian's pixels inside mattes, and all its pixels. Gaussians with more than `SEEN` pixels
    are known.
    """
    inside, total = votes.unbind(1)
    known = total > SEEN
    return torch.stack([torch.where(known, inside / total.clamp_min(1e-9), 0.0), known.to(inside)], dim=1)


def rule_out(votes: Tensor, means: Tensor) -> Tensor:
    """Votes [N, 2] with a vote against each unknown Gaussian that is farther than `RIM` from the object's members.

    `means` [N, 3] are the Gaussians' centres.
    """
    share, known = membership(votes).unbind(1)
    members = (share > 0.5).cpu()
    is_unknown = (known < 0.5).cpu()
    if not bool(members.any()) or not bool(is_unknown.any()):
        return votes
    places = means.detach().cpu().double().numpy()
    low, high = np.quantile(places[members.numpy()], (0.02, 0.98), axis=0)  # excludes floaters
    core = places[members.numpy()]
    core = core[((core >= low) & (core <= high)).all(1)]
    if not len(core):
        return votes
    distance, _ = nearest(core, places[is_unknown.numpy()], 1, workers=-1)
    far = torch.zeros_like(is_unknown)
    far[is_unknown] = from_numpy(distance[:, 0] > RIM * float(np.linalg.norm(high - low)))
    return votes + torch.stack([torch.zeros_like(share), far.to(share)], dim=1)


@torch.no_grad()
def render_members(
    frozen: FrozenGaussians, members: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int,
    overscan: tuple[float, float] = (0.0, 0.0),
) -> Tensor:  # fmt: skip
    """[H, W, 2] in 0..1, on the CPU: `members` [N, 2], as returned by `membership`, rendered for one camera.

    The first channel is the object's share among known Gaussians, so a pixel that is half unknown and half object gets
    1. The second is the share of known Gaussians.
    """
    device = frozen.support.device
    out = render(
        frozen.state, 0, viewmat.to(device), K.to(device), width, height, colors=members.to(device),
        with_contributions=False, settings=RasterSettings(overscan=overscan),
    )  # fmt: skip
    alpha, (members_of, known) = out.alphas[0], out.colors[0, ..., 3:].unbind(-1)
    shares = torch.stack([members_of / known.clamp_min(1e-4), known / alpha.clamp_min(1e-4)], dim=-1)
    return torch.where(alpha[..., None] > 1e-3, shares, 0.0).clamp(0.0, 1.0).cpu()
