"""The compiled implementations, compared with the float64 reference: the CPU's, and the CUDA kernels on fibers and
GPU."""

import pytest
import torch

from benchmarks.raster_errors import BODIES, Scene, assert_gradients, camera, cloud, on_host, psnr, relative
from torch_backend.raster import RasterSettings

on_compiled_bodies = pytest.mark.parametrize("body", [body for body in BODIES if not body.startswith("reference")])


def ran(scene, body, where=1.0, **options):
    """Like `Scene.gradients`, with images on the CPU."""
    out, grads = scene.gradients(body, where, **options)
    return on_host(out), grads


@on_compiled_bodies
def test_room_matches_the_reference(small_room, body):
    # A pixel at the alpha threshold may fall on either side. Few do, and gradients are compared on the other pixels.
    with torch.no_grad():
        same = (on_host(small_room.run(body)).alphas - small_room.run("reference").alphas).abs() < 3e-5
    assert same.float().mean() > 0.998
    out, grads = ran(small_room, body, same, with_contributions=True)
    ref, ref_grads = small_room.gradients("reference", same, with_contributions=True)
    assert psnr(out.colors, ref.colors) >= 95
    assert_gradients(grads, ref_grads, 1e-4)
    assert (out.radii != ref.radii).sum() <= 1
    assert relative(out.means2d, ref.means2d) < 1e-6
    assert relative(out.weight_sum, ref.weight_sum) < 1e-4
    assert (out.weight_max - ref.weight_max).abs().max() < 5e-3
    assert relative(out.means2d_grad, ref.means2d_grad) < 1e-4
    assert relative(out.means2d_absgrad, ref.means2d_absgrad) < 1e-4
    # All alpha in the image is attributed to some Gaussian.
    assert out.weight_sum.double().sum().item() == pytest.approx(out.alphas.double().sum().item(), rel=1e-5)


@on_compiled_bodies
@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (2, False), (3, True)])
def test_harmonics_depth_and_pose(body, degree, antialiased):
    settings = RasterSettings(threads=2, antialiased=antialiased)
    scene = cloud(150, 37, 29, seed=degree, channels=5, degree=degree, with_depth=True, settings=settings)
    out, grads = ran(scene, body)
    ref, ref_grads = scene.gradients("reference")
    assert psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, 1e-3)
    solid = ref.alphas > 0.05
    assert ((out.depth_expected - ref.depth_expected).abs()[solid] < 1e-3).all()
    assert ((out.depth_median - ref.depth_median).abs() > 1e-3).float().mean() < 2e-3
    assert ((out.depth_median == 1e10) == (out.alphas == 0)).all()
    assert ((out.depth_expected == 1e10) == (out.alphas == 0)).all()


@on_compiled_bodies
@pytest.mark.parametrize("channels", [1, 21])
def test_any_number_of_channels(body, channels):
    scene = cloud(80, 33, 20, seed=channels, channels=channels)
    out, grads = ran(scene, body)
    ref, ref_grads = scene.gradients("reference")
    assert out.colors.shape == (1, 20, 33, channels)
    assert psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, 1e-3)


@on_compiled_bodies
@pytest.mark.parametrize("degree", [None, 2])
def test_cameras_of_a_batch_are_independent_and_their_gradients_add(body, degree):
    scene = cloud(80, 30, 22, seed=4, degree=degree, with_contributions=True, with_top=True)
    single = scene.tensors["viewmats"].clone()
    single[0, :3, 3] += torch.tensor([0.3, 0.1, 0.2])
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))[None] @ scene.tensors["viewmats"]
    views = torch.cat([scene.tensors["viewmats"], turned, single])
    Ks = torch.cat([scene.Ks, scene.Ks, camera(30, 22, 35.0, 12.0, 13.0)])
    batch = Scene(scene.tensors | {"viewmats": views}, Ks, 30, 22, scene.options)
    out, grads = ran(batch, body)
    ref, ref_grads = batch.gradients("reference", with_top=False)
    assert psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, 1e-3)
    assert relative(out.means2d_grad, ref.means2d_grad) < 1e-3
    for c in range(3):
        one = Scene(scene.tensors | {"viewmats": views[c : c + 1]}, Ks[c : c + 1], 30, 22, scene.options)
        single_render = on_host(one.run(body))
        for name in ("colors", "alphas", "radii", "means2d", "weight_sum", "weight_max", "top_ids", "top_weights"):
            assert torch.equal(getattr(out, name)[c], getattr(single_render, name)[0]), name


@on_compiled_bodies
def test_the_top_gaussian_is_the_one_with_the_largest_weight(body):
    scene = cloud(40, 41, 23, seed=6, channels=40)
    # With one channel per Gaussian and no background, the image equals the weights.
    scene.tensors |= {"colors": torch.eye(40).double(), "background": torch.zeros(40).double()}
    weights = scene.run("reference").colors
    scene.tensors |= {"colors": torch.rand(40, 3).double(), "background": torch.zeros(3).double()}
    out, plain = on_host(scene.run(body, with_top=True)), on_host(scene.run(body))
    largest, ids = weights.max(-1)
    clear = (largest - weights.topk(2).values[..., 1]) > 1e-4
    assert out.top_ids.dtype == torch.int32 and out.top_ids.shape == out.top_weights.shape == (1, 23, 41)
    assert clear.float().mean() > 0.5
    assert torch.equal(out.top_ids[clear].long(), ids[clear])
    assert (out.top_weights - largest).abs().max() < 5e-3
    assert ((out.top_weights - largest).abs() > 1e-5).float().mean() < 2e-3
    assert (out.alphas == 0).any()
    assert torch.equal(out.top_ids == -1, out.alphas == 0)
    assert torch.equal(out.top_weights == 0, out.alphas == 0)
    assert plain.top_ids is None and plain.top_weights is None and torch.equal(plain.colors, out.colors)


@on_compiled_bodies
def test_sh_degree_uses_the_first_bands_only(body):
    scene = cloud(60, 24, 17, degree=3)
    low, grads = ran(scene, body, sh_degree=2)
    scene.tensors["sh"] = scene.tensors["sh"][:, :9]
    high, high_grads = ran(scene, body)
    assert torch.equal(low.colors, high.colors)
    assert relative(grads["sh"][:, :9], high_grads["sh"]) < 1e-5
    assert (grads["sh"][:, 9:] == 0).all() and (grads["sh"][:, :9] != 0).any()


@on_compiled_bodies
def test_absgrad_can_be_left_out(body):
    scene = cloud(60, 24, 17)
    out, grads = ran(scene, body, settings=RasterSettings(threads=1, absgrad=False))
    full, full_grads = ran(scene, body, settings=RasterSettings(threads=1))
    assert (out.means2d_absgrad == 0).all()
    assert (full.means2d_absgrad >= full.means2d_grad * 0.999).all()
    assert relative(out.means2d_grad, full.means2d_grad) < 1e-5
    assert_gradients(grads, full_grads, 1e-5)
