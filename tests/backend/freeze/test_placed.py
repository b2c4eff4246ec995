"""Gaussians transformed to a scene, compared with float64: shapes, colours in rotated directions, the same picture."""

import math

import numpy as np
import pytest
import torch

from torch_backend.cameras.placement import Similarity
from torch_backend.contract import Placement
from torch_backend.freeze.placed import placed, rotated_harmonics
from torch_backend.gaussians.ply import PlyGaussians
from torch_backend.raster import rasterize
from torch_backend.raster.reference import rotation_matrices, sh_basis


def rotation(seed: int) -> np.ndarray:
    """Uniformly distributed random rotation, [3, 3] float64."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def cloud(count: int, degree: int) -> PlyGaussians:
    chance, bases = np.random.default_rng(degree), (degree + 1) ** 2
    return PlyGaussians(
        (chance.standard_normal((count, 3)) * [1, 1, 0.3] + [0, 0, 5]).astype(np.float32),
        (chance.standard_normal((count, 4)) * 3).astype(np.float32),
        chance.uniform(-3, -1.5, (count, 3)).astype(np.float32),
        chance.uniform(-1, 3, count).astype(np.float32),
        (chance.standard_normal((count, bases, 3)) * 0.3).astype(np.float32),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_colours_in_turned_directions_are_those_of_before(degree, seed):
    """Compared with the definition c'(R d) = c(d) in float64, for directions that the fit did not use."""
    turn, sh = rotation(seed), cloud(50, degree).sh
    directions = np.random.default_rng(seed + 10).standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->dnc", sh_basis(torch.from_numpy(directions), degree).numpy(), sh.astype(np.float64))
    turned = sh_basis(torch.from_numpy(directions @ turn.T), degree).numpy()
    after = np.einsum("dk,nkc->dnc", turned, rotated_harmonics(sh, turn).astype(np.float64))
    np.testing.assert_allclose(after, before, atol=2e-6)  # coefficients are stored as float32


def test_two_turns_are_one_and_a_turn_back_undoes_it():
    first, second, sh = rotation(5), rotation(6), cloud(20, 3).sh
    np.testing.assert_allclose(
        rotated_harmonics(rotated_harmonics(sh, first), second), rotated_harmonics(sh, second @ first), atol=2e-6
    )
    np.testing.assert_allclose(rotated_harmonics(rotated_harmonics(sh, first), first.T), sh, atol=2e-6)


@pytest.mark.parametrize("scale", [0.02, 1.0, 37.5])
def test_shapes_are_turned_scaled_and_moved(scale):
    """Covariances become s^2 R C R^T, means become s R x + t."""
    was, turn, shift = cloud(40, 1), rotation(9), np.array([3.0, -700.0, 0.25])
    now = placed(was, Similarity(turn, scale, shift))
    np.testing.assert_allclose(now.means, scale * was.means.astype(np.float64) @ turn.T + shift, rtol=1e-6, atol=1e-5)

    def covariances(gaussians):
        r = rotation_matrices(torch.from_numpy(gaussians.quats).double()).numpy()
        return r * np.exp(2.0 * gaussians.log_scales.astype(np.float64))[:, None] @ r.transpose(0, 2, 1)

    wanted = scale**2 * turn @ covariances(was) @ turn.T
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariances(now) / size, wanted / size, atol=1e-5)
    np.testing.assert_array_equal(now.opacity_logits, was.opacity_logits)


@pytest.mark.parametrize("degree", [0, 3])
def test_the_moved_camera_sees_the_same_picture(degree):
    """Colour is compared, and depth in scene units."""
    was, where = cloud(300, degree), Similarity(rotation(4), 12.5, np.array([40.0, -9.0, 2.0]))
    K = torch.tensor([[[90.0, 0, 32], [0, 90.0, 24], [0, 0, 1]]])

    def seen(gaussians, viewmat):
        state = [torch.from_numpy(np.asarray(a)) for a in gaussians]
        return rasterize(
            *state[:4], sh=state[4], sh_degree=degree, viewmats=torch.from_numpy(viewmat).float(), Ks=K, width=64,
            height=48, with_depth=True,
        )  # fmt: skip

    first = seen(was, np.eye(4)[None])
    moved_picture = seen(placed(was, where), where.viewmats(np.eye(4)[None]))
    assert float((first.colors - moved_picture.colors).abs().mean()) < 2e-4
    solid = (first.alphas[0] > 0.5) & (moved_picture.alphas[0] > 0.5)
    ratio = (moved_picture.depth_expected[0] / first.depth_expected[0])[solid]
    assert abs(float(ratio.median()) / 12.5 - 1.0) < 1e-4


def test_placement_and_its_inverse_cancel():
    where = Similarity.of(Placement([0, -3, 0, 1, 3, 0, 0, 2, 0, 0, 3, -5, 0, 0, 0, 1]))
    assert where.scale == pytest.approx(3.0) and np.allclose(where.rotation @ where.rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(where.after(where.inverse()).matrix, np.eye(4), atol=1e-12)
    was = cloud(30, 3)
    back = placed(placed(was, where), where.inverse())
    for before, after in zip(was, back, strict=True):
        np.testing.assert_allclose(after, before, atol=3e-5)
    assert math.isclose(float(where.points(np.zeros(3))[2]), -5.0)
