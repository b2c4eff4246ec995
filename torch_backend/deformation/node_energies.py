"""Energies of control points' motion: how far it is from rigid, elastic and smooth (SC-GS)."""

from __future__ import annotations

from torch import Tensor

from ..torch_types import norm
from .geometry import nearest, rigid_rotations

_EDGES, _SURE_EDGES, _EDGE_RADIUS = 10, 3, 0.1
"""ARAP: neighbours of a node; those always kept; the others only if nearer than this, scene units."""


def arap_energy(before: Tensor, after: Tensor) -> Tensor:
    """Sum over nodes and edges of |e' - R e|^2: before, after [M, 3] at two times.

    Edges lead to the 10 nearest nodes of `before`; beyond the third only within 0.1. R is each node's best rotation,
    without gradient; nodes with collapsed edges are left out.
    """
    count = min(_EDGES, len(before) - 1)
    index = nearest(before, before, count + 1)[:, 1:]
    old, new = before[index] - before[:, None], after[index] - after[:, None]
    valid = norm(old.detach(), 2) < _EDGE_RADIUS
    valid[:, :_SURE_EDGES] = True
    rotation, usable = rigid_rotations(old.detach(), new.detach(), valid)
    gap = (new - old @ rotation.transpose(1, 2)).square().sum(2)
    return (gap * (valid & usable[:, None])).sum()


def elastic_energy(paths: Tensor) -> Tensor:
    """Variance over T times of the edges to the 2 nearest nodes, each by its own value: paths [T, M, 3]."""
    index = nearest(paths[0], paths[0], min(3, paths.shape[1]))[:, 1:]
    edges = paths[:, index] - paths[:, :, None]
    # The added 1e-20 keeps the root's gradient finite where two nodes meet.
    variance = (edges.square().sum(3) + 1e-20).sqrt().var(0)
    return (variance / (variance.detach() + 1e-8)).mean()


def acceleration_energy(paths: Tensor) -> Tensor:
    """Mean |x(t - d) + x(t + d) - 2 x(t)|, each by its own value: paths [3, M, 3]."""
    length = ((paths[0] + paths[2] - 2.0 * paths[1]).square().sum(1) + 1e-20).sqrt()
    return (length / (length.detach() + 1e-8)).mean()
