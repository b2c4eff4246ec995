"""Rotations, rigid motions and point sampling for hosts. All values and gradients are finite."""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from ..kernel_text import kernel_text
from ..native import INTEGER, POINTER, Snippet
from ..torch_types import cross, determinant, norm, singular_values, split

# Squared angle below which quotients of sin and cos are computed by series. Closed forms lose precision in float32.
_SERIES = 0.25


def quat_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product [..., 4] of quaternions wxyz: rotation `b` followed by `a`."""
    w, x, y, z = a.unbind(-1)
    p, q, r, s = b.unbind(-1)
    return torch.stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ],
        dim=-1,
    )


def near_identity(change: Tensor) -> Tensor:
    """Unit quaternions [..., 4]: (1, 0, 0, 0) + `change`, normalised; the identity where the sum is 0."""
    identity = torch.zeros_like(change)
    identity[..., 0] = 1.0
    quats = identity + change
    return F.normalize(torch.where(quats.square().sum(-1, keepdim=True) < 1e-12, identity, quats), dim=-1)


def screw(points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    """Points [M, 3] after the rigid motions exp(turn, shift) of SE(3). `turn` [M, 3] is a rotation vector in radians.

    Deformable 3DGS divides by the angle and returns NaN at 0. This function uses series near 0.
    """
    a, b, c = _quotients(turn.square().sum(1, keepdim=True))
    rotated = points + a * cross(turn, points) + b * _double_cross(turn, points)
    return rotated + shift + b * cross(turn, shift) + c * _double_cross(turn, shift)


def _double_cross(turn: Tensor, v: Tensor) -> Tensor:
    return cross(turn, cross(turn, v))


def _quotients(s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(x) / x, (1 - cos(x)) / x^2 and (x - sin(x)) / x^3 for s = x^2."""
    near = s < _SERIES
    # Both branches of `where` must be finite, or the gradient would be NaN.
    t = torch.where(near, s, 0.0)
    x = torch.where(near, 1.0, s).sqrt()
    a = 1 - t / 6 * (1 - t / 20 * (1 - t / 42 * (1 - t / 72)))
    b = 0.5 * (1 - t / 12 * (1 - t / 30 * (1 - t / 56 * (1 - t / 90))))
    c = (1 - t / 20 * (1 - t / 42 * (1 - t / 72))) / 6
    return (
        torch.where(near, a, x.sin() / x),
        torch.where(near, b, (1 - x.cos()) / x.square()),
        torch.where(near, c, (x - x.sin()) / x**3),
    )


def farthest_points(features: Tensor, count: int) -> Tensor:
    """Indices int64 [<= count] of features [N, D] by farthest point sampling.

    Starts at the feature nearest to the mean. Stops early if only duplicates are left.
    """
    picked = [int((features - features.mean(0)).square().sum(1).argmin())]
    # By differences: matrix products would leave duplicates at small non-zero distances.
    distance = torch.cdist(features, features[picked], compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    while len(picked) < min(count, len(features)):
        index = int(distance.argmax())
        if not float(distance[index]) > 0.0:
            break
        picked.append(index)
        distance = torch.minimum(distance, norm(features - features[index], dim=1))
    return torch.tensor(picked, dtype=torch.long, device=features.device)


_MOST = 16
"""Maximum number of neighbours in the compiled search."""

_NEAREST = Path(__file__).with_name("kernels") / "nearest.cpp"


@functools.cache
def _search() -> Snippet:
    fields = {
        **dict.fromkeys(("queries", "points", "index"), POINTER),
        **dict.fromkeys(("count", "padded", "dims", "neighbours"), INTEGER),
    }
    return Snippet("nearest", fields, kernel_text(_NEAREST).replace("@MOST@", str(_MOST)))


def warm_up() -> None:
    """Compiles the search, or loads it from the cache. Call it from the main thread."""
    _search().warm_up()


@torch.no_grad()
def nearest(queries: Tensor, points: Tensor, count: int) -> Tensor:
    """Indices int64 [Q, count] of the points [P, D] nearest to queries [Q, D], nearest first; without gradient.

    Uses compiled code on the CPU, which returns the first points for queries that are NaN.
    """
    if queries.device.type == "cpu" and queries.dtype == torch.float32 and count <= min(_MOST, len(points)):
        # The kernel reads 16 points at once. Padded ones are so far away that none is ever nearest.
        padded = F.pad(points.float().t(), (0, -len(points) % 16), value=1e18).contiguous()
        queries, index = queries.contiguous(), torch.empty(len(queries), count, dtype=torch.long, device="cpu")
        _search().run(
            1 if len(queries) < 2048 else None, queries=queries.data_ptr(), points=padded.data_ptr(),
            index=index.data_ptr(), count=len(queries), padded=padded.shape[1], dims=len(padded), neighbours=count,
        )  # fmt: skip
        return index
    # cdist by matrix products is twice as fast as by differences, and precise enough near the origin.
    centre = points.mean(0)
    targets = points - centre
    chunks = split(queries - centre, 4096)
    found = [torch.cdist(chunk, targets).topk(count, dim=1, largest=False).indices for chunk in chunks]
    return torch.cat(found) if found else torch.zeros(0, count, dtype=torch.long, device=points.device)


def rigid_rotations(before: Tensor, after: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """(R [M, 3, 3], usable bool [M]): rotations that best map edges `before` to `after`, without gradient.

    before, after: [M, K, 3] edges of M nodes; valid: bool [M, K]. det R is +1. Nodes whose edges are collapsed or not
    finite are not usable and get the identity.
    """
    with torch.no_grad():
        kept = valid[..., None].to(before.dtype)
        covariance = (after * kept).transpose(1, 2) @ (before * kept)
        usable = torch.isfinite(covariance).all(-1).all(-1) & (covariance.square().sum((1, 2)) > 1e-24)
        eye = torch.eye(3, dtype=before.dtype, device=before.device)
        u, _, vh = singular_values(torch.where(usable[:, None, None], covariance, eye))
        flip = torch.ones_like(u[:, 0])
        # Without this sign, mirrored edges would give a reflection (Kabsch).
        flip[:, 2] = determinant(u @ vh).sign()
        return torch.where(usable[:, None, None], (u * flip[:, None, :]) @ vh, eye), usable
