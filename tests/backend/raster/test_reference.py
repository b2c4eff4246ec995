"""The float64 reference, compared with closed forms and a loop over pixels; its gradients, with finite differences."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torch_backend.raster import RasterSettings, rasterize, reference
from torch_backend.raster.reference import sh_basis


def pixel_alphas(scene, antialiased=False):
    """Textbook alphas [H, W, N] before threshold and clamp, and camera depths [N], computed per Gaussian."""
    tensors, K, viewmat = scene.tensors, scene.Ks[0].numpy(), scene.tensors["viewmats"][0].numpy()
    ys, xs = np.mgrid[: scene.height, : scene.width] + 0.5
    alphas, depths = [], []
    for mean, quat, log_scale, logit in zip(
        *(tensors[name].numpy() for name in ("means", "quats", "log_scales", "opacity_logits")), strict=True
    ):
        x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
        centre = (K @ (x / z, y / z, 1))[:2]
        u, v = (
            np.clip(at / z, (-0.15 * size - c) / f, (1.15 * size - c) / f)
            for at, size, f, c in ((x, scene.width, K[0, 0], K[0, 2]), (y, scene.height, K[1, 1], K[1, 2]))
        )
        J = np.array([[K[0, 0] / z, 0, -K[0, 0] * u / z], [0, K[1, 1] / z, -K[1, 1] * v / z]])
        R = viewmat[:3, :3] @ Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
        raw = J @ R @ np.diag(np.exp(2 * log_scale)) @ R.T @ J.T
        blurred = raw + 0.3 * np.eye(2)
        opacity = 1 / (1 + np.exp(-logit))
        if antialiased:
            opacity *= np.sqrt(np.linalg.det(raw) / np.linalg.det(blurred))
        offset = np.stack((xs, ys), -1) - centre
        alphas.append(opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(blurred), offset)))
        depths.append(z)
    return np.stack(alphas, -1), np.array(depths)


def blended(scene):
    """Blend `pixel_alphas` in a loop over pixels and Gaussians; a dict with names of RasterOutput, colours only."""
    alphas, depths = pixel_alphas(scene)
    height, width, n = alphas.shape
    colors, background = scene.tensors["colors"].numpy(), scene.tensors["background"].numpy()
    out = {
        "colors": np.zeros((height, width, len(background))),
        "alphas": np.zeros((height, width)),
        "depth_expected": np.zeros((height, width)),
        "depth_median": np.zeros((height, width)),
        "top_ids": np.zeros((height, width)),
        "top_weights": np.zeros((height, width)),
        "weight_sum": np.zeros(n),
        "weight_max": np.zeros(n),
    }
    for pixel in np.ndindex(height, width):
        left, median, top, top_weight = 1.0, None, -1, 0.0
        for i in np.argsort(depths, kind="stable"):
            if alphas[pixel][i] < 1 / 255 or left <= 1e-4:
                continue
            alpha = min(alphas[pixel][i], 0.99)
            weight, left = alpha * left, left * (1 - alpha)
            out["colors"][pixel] += weight * colors[i]
            out["depth_expected"][pixel] += weight * depths[i]
            out["weight_sum"][i] += weight
            out["weight_max"][i] = max(out["weight_max"][i], weight)
            if weight > top_weight:
                top, top_weight = i, weight
            if median is None and left <= 0.5:
                median = depths[i]
        out["colors"][pixel] += left * background
        out["alphas"][pixel] = 1 - left
        out["depth_expected"][pixel] = out["depth_expected"][pixel] / (1 - left) if left < 1 else 1e10
        out["top_ids"][pixel], out["top_weights"][pixel] = top, top_weight
        out["depth_median"][pixel] = median or (depths[top] if top >= 0 else 1e10)
    return out


def test_centre_pixel_of_one_gaussian_is_the_closed_form(tools):
    scene = tools.single(width=17, height=17, focal=20.0, scale=0.2, logit=0.7)
    out = scene.run("reference", with_depth=True, with_contributions=True)
    opacity = 1 / (1 + math.exp(-0.7))
    assert out.alphas[0, 8, 8].item() == pytest.approx(opacity, rel=1e-12)
    assert out.colors[0, 8, 8].tolist() == pytest.approx([0.8 * opacity, 0.4 * opacity, 0.2 * opacity])
    # sigma is 20 * 0.2 / 2 = 2 px; squared and blurred it is 4.3; the pixel is three pixels away.
    assert out.alphas[0, 8, 11].item() == pytest.approx(opacity * math.exp(-0.5 * 9 / 4.3), rel=1e-12)
    assert out.depth_expected[0, 8, 8].item() == pytest.approx(2.0)
    assert out.depth_median[0, 8, 8].item() == 2.0
    assert out.weight_max[0, 0].item() == pytest.approx(opacity)
    assert out.weight_sum[0, 0].item() == pytest.approx(out.alphas.sum().item())
    assert out.radii[0, 0].item() == math.ceil(math.sqrt(2 * math.log(255 * opacity) * 4.3))
    assert out.means2d[0, 0].tolist() == pytest.approx([8.5, 8.5])


@pytest.mark.parametrize("shift", [0.0, 2.5])
def test_images_contributions_and_top_ids_are_those_of_a_loop_over_pixels(tools, shift):
    # Three by two tiles, two of them cut by the image's border; with the shift, pixels reach the clamp and stop.
    scene = tools.cloud(60, 37, 21, seed=11, channels=4)
    scene.tensors["log_scales"] += 0.3 * shift
    scene.tensors["opacity_logits"] += shift
    for name in ("means", "quats", "log_scales", "opacity_logits"):  # with equal depths the first Gaussian is in front
        scene.tensors[name][50:] = scene.tensors[name][:10]
    out = scene.run("reference", with_depth=True, with_contributions=True, with_top=True)
    expected = blended(scene)
    assert (expected["alphas"].max() >= 1 - 1e-4) == (shift > 0)
    assert (expected["top_ids"] == -1).any() == (shift == 0)
    assert out.top_ids.dtype == torch.int32
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(out, name)[0].detach().numpy(), value, rtol=1e-9, atol=1e-12, err_msg=name)


def test_hits_of_a_tile_blend_in_steps_as_they_do_at_once(tools, monkeypatch):
    scene = tools.cloud(200, 37, 21, seed=12)
    scene.tensors["log_scales"] += 1
    options = {"with_depth": True, "with_contributions": True, "with_top": True}
    whole, whole_grads = scene.gradients("reference", **options)
    monkeypatch.setattr(reference, "_LANES", 16 * 16 * 7)
    steps, steps_grads = scene.gradients("reference", **options)
    for name, value in vars(whole).items():
        torch.testing.assert_close(getattr(steps, name), value, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(steps_grads, whole_grads, rtol=1e-9, atol=1e-12)


def test_graph_keeps_no_pairs_of_pixels_and_gaussians(tools):
    scene = tools.cloud(300, 128, 128)
    scene.tensors["log_scales"] += 2
    saved = 0

    def count(value):
        nonlocal saved
        saved += value.numel()
        return value

    with torch.autograd.graph.saved_tensors_hooks(count, lambda value: value):
        scene.run("reference")
    assert 0 < saved < 300 * 128 * 128 / 32


def test_harmonics_are_orthonormal_over_the_sphere():
    generator = torch.Generator().manual_seed(0)
    dirs = torch.nn.functional.normalize(torch.randn(400_000, 3, generator=generator, dtype=torch.float64), dim=-1)
    basis = sh_basis(dirs, 3)
    gram = 4 * math.pi * basis.T @ basis / len(dirs)
    assert (gram - torch.eye(16)).abs().max() < 0.02


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_those_of_finite_differences(tools, antialiased):
    # Wide, faint Gaussians keep every pixel away from threshold, clamp and stop, so that the function is smooth.
    scene = tools.cloud(3, 4, 3, seed=3, channels=4, degree=2)
    scene.tensors["means"] *= torch.tensor([0.1, 0.1, 1.0])
    scene.tensors["log_scales"] = scene.tensors["log_scales"] * 0.3 + 1.5
    scene.tensors["opacity_logits"] = scene.tensors["opacity_logits"] * 0.3
    scene.tensors["sh"] *= 0.2
    names = list(scene.tensors)
    settings = RasterSettings(antialiased=antialiased)

    def images(*values):
        out = rasterize(
            **dict(zip(names, values, strict=True)),
            Ks=scene.Ks,
            width=4,
            height=3,
            with_depth=True,
            backend="reference",
            settings=settings,
        )
        return out.colors, out.alphas, out.depth_expected

    alphas, _ = pixel_alphas(scene, antialiased)
    assert alphas.min() > 0.01
    assert alphas.max() < 0.9
    assert torch.autograd.gradcheck(
        images,
        tuple(scene.leaves(torch.float64).values()),
        eps=1e-6,
        atol=1e-7,
        rtol=1e-5,
        check_undefined_grad=False,
        check_batched_grad=False,
    )


def test_absgrad_sums_magnitudes_over_pixels(tools):
    scene = tools.single(width=17, height=17, focal=20.0)
    leaves = scene.leaves(torch.float64)
    out = scene.run("reference", leaves)
    out.colors[..., 0].sum().backward()
    # Symmetric about the mean: the signed sum cancels, the sum of absolute values does not.
    assert out.means2d_grad[0, 0] < 1e-12
    assert out.means2d_absgrad[0, 0] > 0.1
