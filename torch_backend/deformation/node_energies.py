"""Energies of control point motion that penalise non-rigid, stretching and accelerated motion (SC-GS)."""

from __future__ import annotations

from torch import Tensor

from ..torch_types import norm
from .geometry import nearest, rigid_rotations

_EDGES, _SURE_EDGES, _EDGE_RADIUS = 10, 3, 0.1
"""ARAP: number of neighbours of a node; number that is always used; maximum distance of the others, scene units."""


def arap_energy(before: Tensor, after: Tensor) -> Tensor:
    """As-rigid-as-possible energy: sum over nodes and edges of |e' - R e|^2, for nodes before, after [M, 3].

    Edges connect a node to its 10 nearest nodes in `before`, beyond the third only within 0.1 scene units. R is the
    best-fitting rotation of each node, without gradient. Nodes with collapsed edges are left out.
    """
    count = min(_EDGES, len(before) - 1)
    index = nearest(before, before, count + 1)[:, 1:]
    old, new = before[index] - before[:, None], after[index] - after[:, None]
    valid = norm(old.detach(), dim=2) < _EDGE_RADIUS
    valid[:, :_SURE_EDGES] = True
    rotation, usable = rigid_rotations(old.detach(), new.detach(), valid)
    gap = (new - old @ rotation.transpose(1, 2)).square().sum(2)
    return (gap * (valid & usable[:, None])).sum()


def elastic_energy(paths: Tensor) -> Tensor:
    """Mean over edges to the 2 nearest nodes of v / v.detach(), where v is the variance of the edge's length over the T
    times of paths [T, M, 3]. Every edge has the same weight."""
    index = nearest(paths[0], paths[0], min(3, paths.shape[1]))[:, 1:]
    edges = paths[:, index] - paths[:, :, None]
    # Adding 1e-20 keeps the gradient of the square root finite where two nodes coincide.
    variance = (edges.square().sum(3) + 1e-20).sqrt().var(0)
    return (variance / (variance.detach() + 1e-8)).mean()


def acceleration_energy(paths: Tensor) -> Tensor:
    """Mean over nodes of a / a.detach() with a = |x(t - d) + x(t + d) - 2 x(t)|, for paths [3, M, 3]."""
    length = ((paths[0] + paths[2] - 2.0 * paths[1]).square().sum(1) + 1e-20).sqrt()
    return (length / (length.detach() + 1e-8)).mean()
