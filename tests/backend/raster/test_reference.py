"""The oracle itself: against closed forms, and its gradients against finite differences."""

import math

import pytest
import torch

from torch_backend.raster import RasterSettings, rasterize
from torch_backend.raster.reference import rotation_matrices, sh_basis


def test_centre_pixel_of_one_gaussian_is_the_closed_form(tools):
    scene = tools.single(width=17, height=17, focal=20.0, scale=0.2, logit=0.7)
    out = scene.run("reference", with_depth=True, with_contributions=True)
    opacity = 1 / (1 + math.exp(-0.7))
    assert out.alphas[0, 8, 8].item() == pytest.approx(opacity, rel=1e-12)
    assert out.colors[0, 8, 8].tolist() == pytest.approx([0.8 * opacity, 0.4 * opacity, 0.2 * opacity])
    # sigma in px: 20 * 0.2 / 2 = 2, squared and blurred 4.3; three pixels aside.
    assert out.alphas[0, 8, 11].item() == pytest.approx(opacity * math.exp(-0.5 * 9 / 4.3), rel=1e-12)
    assert out.depth_expected[0, 8, 8].item() == pytest.approx(2.0)
    assert out.depth_median[0, 8, 8].item() == 2.0
    assert out.weight_max[0, 0].item() == pytest.approx(opacity)
    assert out.weight_sum[0, 0].item() == pytest.approx(out.alphas.sum().item())
    assert out.radii[0, 0].item() == math.ceil(math.sqrt(2 * math.log(255 * opacity) * 4.3))
    assert out.means2d[0, 0].tolist() == pytest.approx([8.5, 8.5])


def test_front_covers_back_whatever_the_order_of_the_inputs(tools):
    scene = tools.single(logit=20.0, scale=5.0)
    shared = ("viewmats", "background")
    tensors = {k: v.repeat(2, *[1] * (v.dim() - 1)) for k, v in scene.tensors.items() if k not in shared}
    tensors["means"][:, 2] = torch.tensor([4.0, 2.0])
    tensors["colors"] = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]).double()
    scene.tensors |= tensors
    out = scene.run("reference", with_depth=True)
    assert out.colors[0, 8, 8].tolist() == pytest.approx([0.99, 0.0099, 0.0])
    assert out.depth_median[0, 8, 8].item() == 2.0
    assert out.depth_expected[0, 8, 8].item() == pytest.approx((0.99 * 2 + 0.0099 * 4) / 0.9999)


def test_harmonics_are_orthonormal_over_the_sphere():
    generator = torch.Generator().manual_seed(0)
    dirs = torch.nn.functional.normalize(torch.randn(400_000, 3, generator=generator, dtype=torch.float64), dim=-1)
    basis = sh_basis(dirs, 3)
    gram = 4 * math.pi * basis.T @ basis / len(dirs)
    assert (gram - torch.eye(16)).abs().max() < 0.02


def test_quaternions_of_any_length_give_rotations():
    quats = torch.tensor([[0.3, -0.4, 0.5, 0.1], [3e30, -4e30, 5e30, 1e30]], dtype=torch.float64)
    R = rotation_matrices(quats)
    assert torch.allclose(R[0], R[1])
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert torch.allclose(torch.linalg.det(R), torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_those_of_finite_differences(tools, antialiased):
    # Broad, faint Gaussians: no pixel near the cut, the clamp or the stop, so that differences see a smooth function.
    scene = tools.cloud(3, 4, 3, seed=3, channels=4, degree=2)
    scene.tensors["means"] *= torch.tensor([0.1, 0.1, 1.0])
    scene.tensors["log_scales"] = scene.tensors["log_scales"] * 0.3 + 1.5
    scene.tensors["opacity_logits"] = scene.tensors["opacity_logits"] * 0.3
    scene.tensors["sh"] *= 0.2
    names = list(scene.tensors)
    settings = RasterSettings(antialiased=antialiased)

    def images(*values):
        out = rasterize(**dict(zip(names, values, strict=True)), Ks=scene.Ks, width=4, height=3, with_depth=True,
                        backend="reference", settings=settings)
        return out.colors, out.alphas, out.depth_expected

    assert images(*scene.tensors.values())[1].min() > 0.1
    assert torch.autograd.gradcheck(images, tuple(scene.leaves(torch.float64).values()), eps=1e-6, atol=1e-7, rtol=1e-5,
                                    check_undefined_grad=False, check_batched_grad=False)


def test_absgrad_sums_magnitudes_over_pixels(tools):
    scene = tools.single(width=17, height=17, focal=20.0)
    leaves = scene.leaves(torch.float64)
    out = scene.run("reference", leaves)
    out.colors[..., 0].sum().backward()
    # Symmetric about the mean: the signed sum cancels, the absolute one does not.
    assert out.means2d_grad[0, 0] < 1e-12
    assert out.means2d_absgrad[0, 0] > 0.1
