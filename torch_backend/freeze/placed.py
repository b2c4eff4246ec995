"""Transforms Gaussians to the axes and units of a scene: means, rotations, scales and spherical harmonics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras.placement import Similarity
from ..cameras.poses import rotation_to_quat
from ..gaussians.ply import PlyGaussians
from ..raster.reference import sh_basis
from ..torch_types import from_numpy

_DIRECTIONS = 64
"""Number of sample directions for a band's rotation: several times the 7 functions of the third band."""
_CHUNK = 1 << 16
"""Number of Gaussians whose harmonics are rotated at once: their float64 copies take 25 MB."""


def placed(gaussians: PlyGaussians, transform: Similarity) -> PlyGaussians:
    """Gaussians transformed by a similarity: they look the same from an equally transformed camera.

    Args:
        gaussians: as stored, float32.
        transform: similarity from the Gaussians' space to the new space.

    Returns:
        float32 Gaussians; lengths of quaternions (wxyz) and the degree of harmonics are unchanged.
    """
    turn = rotation_to_quat(transform.rotation)
    sh = gaussians.sh
    if sh.shape[1] > 1 and not np.array_equal(transform.rotation, np.eye(3)):
        sh = rotated_harmonics(sh, transform.rotation)
    return PlyGaussians(
        transform.points(gaussians.means).astype(np.float32),
        _product(turn, gaussians.quats.astype(np.float64)).astype(np.float32),
        (gaussians.log_scales + math.log(transform.scale)).astype(np.float32),
        gaussians.opacity_logits,
        sh,
    )


def rotated_harmonics(sh: NDArray[np.float32], rotation: NDArray[Any]) -> NDArray[np.float32]:
    """Coefficients [N, K, 3] after the world is rotated by `rotation` [3, 3].

    A colour c(d) in direction d becomes c(rotation^T d). The constant band is unchanged. Every other band is multiplied
    by its own matrix.
    """
    result = sh.copy()
    degree = math.isqrt(sh.shape[1]) - 1
    matrices = band_rotations(rotation, degree)
    for first in range(0, len(sh), _CHUNK):
        part = sh[first : first + _CHUNK].astype(np.float64)
        for band, matrix in enumerate(matrices, start=1):
            rows = slice(band * band, (band + 1) * (band + 1))
            result[first : first + _CHUNK, rows] = np.einsum("ij,njc->nic", matrix, part[:, rows])
    return result


def band_rotations(rotation: NDArray[Any], degree: int) -> list[NDArray[np.float64]]:
    """Matrices [2l+1, 2l+1] of the bands l = 1 to `degree` that map coefficients to those of the rotated world.

    Each is the least-squares solution of Y(D) M = Y(rotation^T D) over evenly distributed directions D. A band is
    closed under rotation, so the residual is only rounding. Signs and order of M follow the rasteriser's basis.
    """
    directions = _fibonacci_sphere(_DIRECTIONS)
    before = _basis(directions @ np.asarray(rotation, np.float64), degree)  # rows d: (rotation^T d)^T = d^T rotation
    after = _basis(directions, degree)
    bands = [slice(band * band, (band + 1) * (band + 1)) for band in range(1, degree + 1)]
    solved = (np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0] for band in bands)
    return [np.asarray(matrix, np.float64) for matrix in solved]


def _basis(directions: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Real spherical harmonics [D, (degree+1)^2] of unit directions [D, 3], float64."""
    return sh_basis(from_numpy(directions), degree).to(torch.float64).numpy()


def _fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """Unit vectors [count, 3], evenly distributed: equal steps in height, rotated by the golden angle."""
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angles = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    radii = np.sqrt(1.0 - heights**2)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)


def _product(turn: NDArray[np.float64], quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hamilton products turn * quats of one quaternion [4] and many [N, 4], wxyz: `quats` rotates first."""
    w, v = turn[0], turn[1:]
    scalars, vectors = quats[:, :1], quats[:, 1:]
    return np.concatenate(
        [w * scalars - vectors @ v[:, None], w * vectors + scalars * v + np.cross(v, vectors)], axis=1
    )
