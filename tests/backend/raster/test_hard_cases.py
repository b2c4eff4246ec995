"""Difficult rasteriser inputs on every implementation; `benchmarks/raster_cases.py` states the error bounds."""

import math

import pytest
import torch

from benchmarks.raster_cases import CASES, size
from benchmarks.raster_errors import BODIES, PER_GAUSSIAN, compare
from torch_backend.raster import RasterSettings
from torch_backend.train import losses

pytestmark = pytest.mark.filterwarnings("error")
on_every_body = pytest.mark.parametrize("body", [body for body in BODIES if body != "reference32"])
on_compiled_bodies = pytest.mark.parametrize("body", [body for body in BODIES if not body.startswith("reference")])


def assert_sane(out, grads):
    for name in ("colors", "alphas", "means2d", "weight_sum", "weight_max", "means2d_grad", "means2d_absgrad"):
        value = getattr(out, name)
        assert value is None or torch.isfinite(value).all(), name
    if out.alphas.numel():
        assert out.alphas.min() >= 0
        assert out.alphas.max() <= 1
    for name, grad in grads.items():
        assert grad is not None, name
        assert torch.isfinite(grad).all(), name


def assert_case(case, body):
    """Assert that the implementation meets the case's bounds in `CASES` against the reference, and all values are
    finite."""
    bound, errors = CASES[case], compare(size(case, body), body)
    assert_sane(errors.out, errors.grads)
    assert_sane(errors.reference, errors.reference_grads)
    assert errors.flips <= bound.flips
    assert errors.psnr >= bound.psnr
    if bound.gradient is not None:
        assert errors.gradient <= bound.gradient, errors.gradients
    return errors


@on_compiled_bodies
@pytest.mark.parametrize("case", CASES)
def test_every_case_is_within_its_bounds(case, body):
    assert_case(case, body)


# ------------------------------------------------------------------------------------------- NaN, Inf


@on_every_body
def test_poisoned_gaussians_are_culled_without_affecting_the_rest(tools, body):
    scene = size("NaN and infinities in every input", body)
    scene.tensors["means"][20:23, 0] = torch.tensor([math.nan, math.inf, -math.inf]).double()
    flat = torch.cat([scene.tensors[name].reshape(40, -1) for name in PER_GAUSSIAN], 1)
    poisoned = ~flat.isfinite().all(1)
    assert poisoned.sum() == 17
    out, grads = scene.gradients(body, with_contributions=True)
    assert (out.radii[0][poisoned] == 0).all()
    assert (out.radii[0][~poisoned] > 0).any()
    assert (out.weight_sum[0][poisoned] == 0).all()
    assert (out.means2d[0][poisoned] == 0).all()
    clean = scene.tensors | {name: scene.tensors[name][~poisoned] for name in PER_GAUSSIAN}
    expected, expected_grads = tools.Scene(clean, scene.Ks, 24, 18).gradients(body)
    assert torch.allclose(out.colors, expected.colors, atol=1e-6)
    for name in PER_GAUSSIAN:
        assert (grads[name][poisoned] == 0).all(), name
        assert torch.allclose(grads[name][~poisoned], expected_grads[name], rtol=1e-4, atol=1e-5), name


@on_every_body
def test_ssim_sees_no_nan_of_a_poisoned_scene(body):
    # Convolution spreads one NaN over a square; a culled Gaussian produces none.
    scene = size("NaN and infinities in every input", body)
    _, dtype, device = BODIES[body]
    leaves = scene.leaves(dtype, device)
    image = scene.run(body, leaves).colors[0, ..., :3]
    loss = losses.photometric(image, torch.full_like(image, 0.5), 0.2)
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves.values())


def test_images_smaller_than_the_ssim_window_use_only_l1():
    for height, width in ((10, 30), (30, 10), (1, 1)):
        image = torch.full((height, width, 3), 0.25, requires_grad=True)
        loss = losses.photometric(image, torch.full_like(image, 0.75), 0.2)
        loss.backward()
        assert loss.item() == pytest.approx(0.5)
        assert torch.isfinite(image.grad).all()


# ------------------------------------------------------------------------------------------- scales and covariance


@on_every_body
def test_infinite_and_enormous_scales_are_culled(tools, body):
    scene = tools.cloud(12, 24, 18, seed=3, with_contributions=True)
    scene.tensors["log_scales"][:6] = torch.tensor([math.inf, 1e30, 89.0, 40.0, 29.0, 20.0]).double()[:, None]
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    assert (out.radii[0, :6] == 0).all()
    assert (out.weight_sum[0, :6] == 0).all()
    assert all((grads[name][:6] == 0).all() for name in PER_GAUSSIAN if name in grads)
    assert (out.radii[0, 6:] > 0).any()


@on_every_body
def test_what_overflows_and_is_culled_gets_zero_gradients(tools, body):
    # Found by the property tests: a determinant that overflows float32 has an infinite derivative, and 0 * inf is NaN.
    scene = tools.cloud(6, 16, 16, settings=RasterSettings(threads=1, antialiased=True))
    scene.tensors["means"][2:5] = torch.tensor([0.0, 0.0, 0.1]).double()
    huge = torch.tensor([[18.4, 18.4, -1.0], [29.0, 29.0, 29.0], [18.4, -1.0, -1.0]]).double()
    scene.tensors["log_scales"][2:5] = huge
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    assert (out.radii[0, 2:5] == 0).all()
    assert all((grads[name][2:5] == 0).all() for name in PER_GAUSSIAN if name in grads)


@on_every_body
def test_a_point_is_as_wide_as_the_low_pass(tools, body):
    # sigma^2 = 0.3 px^2: the alpha of the pixel next to the mean is opacity * exp(-1 / 0.6).
    scene = tools.single(9, 9, mean=(0.5 / 16 * 2, 0.5 / 16 * 2, 2.0), scale=1e-9, logit=2.0)
    scene.Ks = tools.camera(9, 9, 16.0, 4.0, 4.0)
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    opacity = 1 / (1 + math.exp(-2.0))
    assert out.alphas[0, 4, 4].item() == pytest.approx(opacity, rel=1e-5)
    assert out.alphas[0, 4, 5].item() == pytest.approx(opacity * math.exp(-0.5 / 0.3), rel=1e-4)
    assert out.radii[0, 0] == math.ceil(math.sqrt(2 * math.log(255 * opacity) * 0.3))


@on_every_body
def test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased(tools, body):
    # The covariance before the blur is 1e-20 px^2: the ratio of determinants underflows, so its lower bound applies.
    scene = tools.single(9, 9, mean=(0.5 / 16 * 2, 0.5 / 16 * 2, 2.0), scale=1e-11, logit=9.0)
    scene.Ks = tools.camera(9, 9, 16.0, 4.0, 4.0)
    out, grads = scene.gradients(body, settings=RasterSettings(antialiased=True))
    assert_sane(out, grads)
    assert out.alphas[0, 4, 4].item() == pytest.approx(0.005 / (1 + math.exp(-9.0)), rel=1e-4)
    assert (grads["log_scales"].abs() < 1e-6).all()


# ------------------------------------------------------------------------------------------- quaternions


@on_every_body
@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (1e-20, 0.0, 0.0, 1e-20), (0.0, -9e-7, 0.0, 0.0)])
def test_zero_quaternion_is_culled(tools, quat, body):
    scene = tools.single(quat=quat)
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    assert (out.alphas == 0).all()
    assert out.radii[0, 0] == 0


@on_every_body
@pytest.mark.parametrize("length", [1e-5, 1e37])
def test_length_of_a_quaternion_does_not_matter(tools, length, body):
    scene = tools.cloud(30, 20, 18)
    expected = scene.run(body)
    scene.tensors["quats"] *= length / scene.tensors["quats"].norm(dim=-1, keepdim=True)
    errors = compare(scene, body)
    assert_sane(errors.out, errors.grads)
    assert errors.psnr >= 100
    assert errors.gradient <= 1e-3 or length >= 1e30  # gradients of 1e-37 are denormal numbers
    assert torch.allclose(errors.out.colors, expected.colors, atol=1e-4)
    along = torch.linalg.vecdot(errors.grads["quats"].double().cpu(), scene.tensors["quats"])
    assert along.abs().max() < 1e-3


# ------------------------------------------------------------------------------------------- camera


@on_every_body
def test_near_plane(tools, body):
    for z, seen in ((0.5, True), (0.25, False), (0.2499, False), (0.0, False), (-0.5, False), (1e-38, False)):
        scene = tools.single(mean=(0.0, 0.0, z), scale=0.05)
        out, grads = scene.gradients(body, settings=RasterSettings(near=0.25))
        assert_sane(out, grads)
        assert bool((out.alphas > 0).any()) is seen, z
        assert bool(out.radii[0, 0] > 0) is seen, z


def test_the_case_of_the_frustums_edge_has_gaussians_beyond_the_clamp():
    scene = size("elongated at and beyond the frustum's edge", "cpu")
    unclamped = (scene.tensors["means"][:, 0] / scene.tensors["means"][:, 2]).abs() > 1.5
    assert unclamped.sum() > 10


@on_every_body
def test_no_gradient_passes_the_frustum_clamp(tools, body):
    # Outside the clamp, u is constant: the covariance depends on the mean only through its depth.
    scene = tools.single(16, 16, focal=16.0, mean=(1.4, 0.3, 1.5), scale=0.6)
    scene.tensors["log_scales"] += torch.tensor([0.0, 0.2, 0.5])
    assert abs(1.4 / 1.5) > 0.65
    errors = compare(scene, body)
    assert float(errors.reference_grads["means"].norm()) > 1e-3
    assert errors.gradients["means"] < 1e-4


@on_every_body
def test_a_crop_with_the_principal_point_aside_is_the_crop_of_the_image(tools, body):
    # x / z = 0.81 is inside the image, but outside a clamp about the image's centre.
    scene = tools.single(64, 16, focal=32.0, mean=(0.81 * 2, 0.1, 2.0), scale=0.3)
    scene.tensors["log_scales"] += torch.tensor([-0.5, -0.5, 1.5])
    scene.Ks = tools.camera(64, 16, 32.0, 34.0, 8.0)
    whole = scene.run(body)
    crop = tools.Scene(scene.tensors, tools.camera(32, 16, 32.0, 2.0, 8.0), 32, 16).run(body)
    assert (crop.colors - whole.colors[:, :, 32:]).abs().max() < 1e-4
    assert crop.alphas.max() > 0.1


@on_every_body
def test_overscan_changes_no_pixel_within_it(tools, body):
    """The slope of a large Gaussian far outside the frame is clamped by the frame's frustum, independent of
    overscan."""
    across, down = 4, 2
    scene = tools.single(32, 16, focal=16.0, mean=(1.6 * 1.5, 0.1, 1.5), scale=0.6)
    scene.tensors["log_scales"] += torch.tensor([0.3, 0.2, 0.8])
    plain = scene.run(body)
    camera = tools.camera(32 + 2 * across, 16 + 2 * down, 16.0, 16.0 + across, 8.0 + down)
    wide = tools.Scene(scene.tensors, camera, 32 + 2 * across, 16 + 2 * down)
    settings = RasterSettings(threads=2, overscan=(float(across), float(down)))
    inner = wide.run(body, settings=settings).colors[:, down : down + 16, across : across + 32]
    assert plain.alphas.max() > 0.01
    assert (inner - plain.colors).abs().max() < 1e-5


# ------------------------------------------------------------------------------------------- opacity and colour


@on_every_body
def test_opacity_at_its_ends(tools, body):
    for logit in (-100.0, -math.inf):
        out, grads = tools.single(logit=logit).gradients(body)
        assert_sane(out, grads)
        assert (out.alphas == 0).all()
    for logit in (15.0, 100.0, math.inf):
        out, grads = tools.single(logit=logit, scale=3.0).gradients(body)
        assert_sane(out, grads)
        assert out.alphas.max().item() == pytest.approx(0.99, abs=1e-6)


@on_every_body
def test_no_gradient_passes_the_alpha_clamp(tools, body):
    scene = tools.single(width=1, height=1, logit=8.0, scale=3.0)
    _, grads = scene.gradients(body)
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert (grads[name] == 0).all(), name
    assert (grads["colors"] != 0).all()


@on_every_body
def test_pixel_stops_once_it_is_opaque(body):
    errors = assert_case("forty opaque layers", body)
    # 0.015^2 is above the threshold, 0.015^3 below: the third Gaussian counts, the fourth does not.
    assert (errors.out.weight_sum[0] > 0).tolist() == [True] * 3 + [False] * 37
    assert (errors.grads["colors"][3:] == 0).all()


@on_every_body
def test_faint_gaussians_lose_their_gradient_where_they_can_be_counted(tools, body):
    # After a reset to 0.01, alpha exceeds 1/255 only within 1.37 sigma; at 0.0039 nowhere. Training can detect this:
    # radius and weight are 0. Without the threshold, gradients would reach beyond 3 sigma, differently in each
    # implementation.
    faint, dead = math.log(0.01 / 0.99), math.log(0.0039 / 0.9961)
    out, grads = tools.single(17, 17, focal=20.0, scale=0.3, logit=faint).gradients(body, with_contributions=True)
    sigma = math.sqrt((20 * 0.3 / 2) ** 2 + 0.3)
    reach = math.sqrt(2 * math.log(2.55)) * sigma
    ys, xs = torch.meshgrid(torch.arange(17) - 8.0, torch.arange(17) - 8.0, indexing="ij")
    assert torch.equal(out.alphas[0].cpu() > 0, xs.square() + ys.square() < reach**2)
    assert grads["opacity_logits"] != 0
    out, grads = tools.single(17, 17, focal=20.0, scale=0.3, logit=dead).gradients(body, with_contributions=True)
    assert out.radii[0, 0] == 0
    assert out.weight_sum[0, 0] == 0
    assert (grads["opacity_logits"] == 0).all()


@on_every_body
def test_opaque_gaussians_reach_beyond_three_sigma(tools, body):
    # The extent depends on the opacity: 3.33 sigma for an opaque Gaussian.
    scene = tools.single(41, 9, focal=20.0, scale=0.6, logit=20.0)
    out = scene.run(body)
    sigma = math.sqrt(6.0**2 + 0.3)
    assert out.alphas[0, 4, 20 + math.floor(3.25 * sigma)].item() == pytest.approx(
        math.exp(-0.5 * (math.floor(3.25 * sigma) / sigma) ** 2), rel=1e-3
    )
    assert out.radii[0, 0] == math.ceil(math.sqrt(2 * math.log(255.0)) * sigma)


@on_every_body
def test_black_harmonics_can_become_brighter_but_not_darker(tools, body):
    scene = tools.single(width=3, height=3)
    del scene.tensors["colors"]
    scene.tensors["sh"] = torch.full((1, 1, 3), -5.0).double()
    for sign, moved in ((-1.0, True), (1.0, False)):
        _, dtype, device = BODIES[body]
        leaves = scene.leaves(dtype, device)
        out = scene.run(body, leaves)
        assert (out.colors == 0).all()
        (sign * out.colors.sum()).backward()
        assert bool((leaves["sh"].grad != 0).all()) is moved


@on_every_body
def test_colours_have_no_ceiling(tools, body):
    scene = tools.single(3, 3, logit=9.0, scale=3.0)
    scene.tensors["colors"] *= 1e4
    assert scene.run(body).colors.max().item() == pytest.approx(0.99 * 0.8e4, rel=1e-4)
    del scene.tensors["colors"]
    scene.tensors["sh"] = torch.full((1, 1, 3), 1e4).double()
    expected = 0.99 * (1e4 / math.sqrt(4 * math.pi) + 0.5)
    assert scene.run(body).colors.max().item() == pytest.approx(expected, rel=1e-4)


@on_every_body
def test_equal_depths_keep_the_order_of_the_inputs(body):
    out = assert_case("equal depths", body).out
    assert (out.colors[..., 0] > out.colors[..., 1]).all()
    assert (out.colors[..., 1] > out.colors[..., 2]).all()


# ------------------------------------------------------------------------------------------- images and counts


@on_every_body
@pytest.mark.parametrize("degree", [None, 2])
def test_no_gaussians(tools, degree, body):
    scene = tools.cloud(0, 20, 12, degree=degree, with_depth=True, with_contributions=True)
    out, grads = scene.gradients(body)
    assert torch.allclose(out.colors, scene.tensors["background"].to(out.colors).expand(1, 12, 20, 3))
    assert (out.depth_median == 1e10).all()
    assert (out.depth_expected == 1e10).all()
    assert out.weight_sum.shape == out.radii.shape == (1, 0)
    assert out.means2d.shape == (1, 0, 2)
    assert all(grads[name].shape == value.shape for name, value in scene.tensors.items())
    assert (grads["viewmats"] == 0).all()


@on_every_body
def test_nothing_in_view(tools, body):
    scene = tools.cloud(50, 20, 12, with_depth=True, with_contributions=True)
    scene.tensors["means"][:, 2] = -3.0
    out, grads = scene.gradients(body)
    assert torch.allclose(out.colors, scene.tensors["background"].to(out.colors).expand(1, 12, 20, 3))
    assert (out.radii == 0).all()
    assert (out.alphas == 0).all()
    assert all((grads[name] == 0).all() for name in grads if name != "background")
    assert (grads["background"] != 0).any()


@on_every_body
def test_no_cameras(tools, body):
    scene = tools.cloud(10, 20, 12, with_depth=True, with_contributions=True)
    scene.tensors["viewmats"], scene.Ks = scene.tensors["viewmats"][:0], scene.Ks[:0]
    out, grads = scene.gradients(body)
    assert out.colors.shape == (0, 12, 20, 3)
    assert out.radii.shape == out.weight_sum.shape == (0, 10)
    assert all((grad == 0).all() for grad in grads.values())


@on_every_body
def test_a_tall_image_needs_more_tile_spans_than_are_kept(tools, body):
    # Counting and emitting must agree on every (Gaussian, tile) pair, with and without stored spans.
    count, height = (12, 64) if body == "cuda" else (300, 480)
    scene = _column(tools, count, height)
    errors = compare(scene, body)
    assert_sane(errors.out, errors.grads)
    assert errors.psnr >= 90
    total = errors.out.alphas.double().sum().item()
    assert errors.out.weight_sum.double().sum().item() == pytest.approx(total, rel=1e-4)


def _column(tools, count, height):
    """Gaussians that each cover 12 columns and all rows."""
    scene = tools.cloud(count, 12, height, seed=17)
    scene.tensors["log_scales"][:] = torch.tensor([0.3, 1.5, 0.0]).double()
    scene.tensors["quats"][:] = torch.tensor([1.0, 0, 0, 0]).double()
    scene.tensors["opacity_logits"] -= 3.0
    return scene
