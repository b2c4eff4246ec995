"""Inputs that break rasterisers. Each runs on the CPU body and on the oracle."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_backend.raster import RasterSettings, rasterize

BODIES = ("cpu", "reference")
pytestmark = pytest.mark.filterwarnings("error")


def assert_sane(out, grads):
    for name in ("colors", "alphas", "means2d", "weight_sum", "weight_max", "means2d_grad", "means2d_absgrad"):
        value = getattr(out, name)
        assert value is None or torch.isfinite(value).all(), name
    assert out.alphas.min() >= 0
    assert out.alphas.max() <= 1
    for name, grad in grads.items():
        assert grad is not None, name
        assert torch.isfinite(grad).all(), name


def assert_bodies_agree(scene, tools, psnr=90.0, gradient=1e-3, flips=0.02):
    """Images agree, and so do gradients at the pixels (all but a share `flips`) on the same side of the alpha cut."""
    with torch.no_grad():
        same = (scene.run("cpu").alphas - scene.run("reference").alphas).abs() < 3e-4
    assert same.float().mean() >= 1 - flips
    cpu, cpu_grads = scene.gradients("cpu", same, with_contributions=True)
    ref, ref_grads = scene.gradients("reference", same, with_contributions=True)
    assert_sane(cpu, cpu_grads)
    assert_sane(ref, ref_grads)
    assert tools.psnr(cpu.colors, ref.colors) >= psnr
    for name, truth in ref_grads.items():
        assert (cpu_grads[name] - truth).norm() <= gradient * truth.norm() + 1e-6, name
    return cpu, cpu_grads


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "colors"])
def test_non_finite_gaussian_is_culled_and_the_others_stay(tools, name, bad, body):
    scene = tools.cloud(40, 24, 18)
    keep = torch.arange(40) != 7
    clean = {k: v[keep] if len(v) == 40 else v for k, v in scene.tensors.items()}
    expected, expected_grads = tools.Scene(clean, scene.Ks, 24, 18).gradients(body)
    scene.tensors[name].view(40, -1)[7, -1] = bad
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    if name in ("log_scales", "opacity_logits") and not math.isnan(bad) and (name, bad) != ("log_scales", math.inf):
        return  # a scale of 0 and an opacity of 0 or 1 are extreme, not wrong
    assert torch.allclose(out.colors, expected.colors, atol=1e-6)
    assert out.radii[0, 7] == 0
    for key, grad in grads.items():
        if len(grad) == 40:
            assert (grad[7] == 0).all(), key
            assert torch.allclose(grad[keep], expected_grads[key], rtol=1e-4, atol=1e-5), key


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_harmonics_are_culled(tools, bad, body):
    scene = tools.cloud(30, 20, 18, degree=1)
    scene.tensors["sh"][3, 2, 1] = bad
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    assert out.radii[0, 3] == 0
    assert all((grad[3] == 0).all() for grad in grads.values() if len(grad) == 30)


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (1e-20, 0.0, 0.0, 1e-20)])
def test_zero_quaternion_is_culled(tools, quat, body):
    scene = tools.single(quat=quat)
    out, grads = scene.gradients(body)
    assert_sane(out, grads)
    assert (out.alphas == 0).all()
    assert out.radii[0, 0] == 0


@pytest.mark.parametrize("length", [1e-5, 1e-3, 1e15])
def test_length_of_a_quaternion_does_not_matter(tools, length):
    scene = tools.cloud(30, 20, 18)
    expected = scene.run("cpu")
    scene.tensors["quats"] *= length / scene.tensors["quats"].norm(dim=-1, keepdim=True)
    out, grads = assert_bodies_agree(scene, tools, gradient=2e-3)
    assert torch.allclose(out.colors, expected.colors, atol=1e-5)
    assert torch.linalg.vecdot(grads["quats"].double(), scene.tensors["quats"]).abs().max() < 1e-3


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (16, 16), (17, 1), (1, 40), (33, 31)])
def test_odd_image_sizes(tools, shape, body):
    width, height = shape
    scene = tools.cloud(60, width, height, with_depth=True, with_contributions=True)
    out, grads = scene.gradients(body)
    assert out.colors.shape == (1, height, width, 3)
    assert out.alphas.shape == out.depth_expected.shape == out.depth_median.shape == (1, height, width)
    assert_sane(out, grads)
    if body == "cpu":
        assert tools.psnr(out.colors, scene.run("reference").colors) >= 90


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("degree", [None, 2])
def test_no_gaussians(tools, degree, body):
    scene = tools.cloud(0, 20, 12, degree=degree, with_depth=True, with_contributions=True)
    out, grads = scene.gradients(body)
    assert torch.allclose(out.colors, scene.tensors["background"].to(out.colors.dtype).expand(1, 12, 20, 3))
    assert (out.depth_median == 1e10).all()
    assert (out.depth_expected == 1e10).all()
    assert out.weight_sum.shape == out.radii.shape == (1, 0)
    assert out.means2d.shape == (1, 0, 2)
    assert all(grads[name].shape == value.shape for name, value in scene.tensors.items())
    assert (grads["viewmats"] == 0).all()


@pytest.mark.parametrize("body", BODIES)
def test_nothing_in_view(tools, body):
    scene = tools.cloud(50, 20, 12, with_depth=True, with_contributions=True)
    scene.tensors["means"][:, 2] = -3.0
    out, grads = scene.gradients(body)
    assert torch.allclose(out.colors, scene.tensors["background"].to(out.colors.dtype).expand(1, 12, 20, 3))
    assert (out.radii == 0).all()
    assert (out.alphas == 0).all()
    assert all((grads[name] == 0).all() for name in grads if name != "background")
    assert (grads["background"] != 0).any()


@pytest.mark.parametrize("body", BODIES)
def test_no_cameras(tools, body):
    scene = tools.cloud(10, 20, 12, with_depth=True, with_contributions=True)
    scene.tensors["viewmats"], scene.Ks = scene.tensors["viewmats"][:0], scene.Ks[:0]
    out, grads = scene.gradients(body)
    assert out.colors.shape == (0, 12, 20, 3)
    assert out.radii.shape == out.weight_sum.shape == (0, 10)
    assert all((grad == 0).all() for grad in grads.values())


def test_principal_point_off_centre_and_outside(tools):
    for cx, cy in ((3.0, 20.0), (-15.0, 9.0), (40.0, 30.0)):
        scene = tools.cloud(200, 32, 24, seed=2)
        scene.Ks = tools.camera(32, 24, 30.0, cx, cy)
        assert_bodies_agree(scene, tools)


def test_frustum_edge_jacobian_is_clamped_about_the_principal_point(tools):
    # Long Gaussians far off to the side and near: without the clamp their footprint explodes.
    scene = tools.cloud(200, 32, 24, seed=6)
    scene.Ks = tools.camera(32, 24, 24.0, 9.0, 14.0)
    scene.tensors["means"] *= torch.tensor([4.0, 4.0, 0.4])
    scene.tensors["means"][:, 2] -= 0.8
    scene.tensors["log_scales"] += 0.8
    scene.tensors["log_scales"][:, 0] += 1.0
    unclamped = (scene.tensors["means"][:, 0] / scene.tensors["means"][:, 2]).abs() > 1.5
    assert unclamped.sum() > 50
    assert_bodies_agree(scene, tools)


@pytest.mark.parametrize("body", BODIES)
def test_near_plane(tools, body):
    for z, seen in ((0.5, True), (0.4999, False), (0.0, False), (-0.5, False), (0.5001, True)):
        scene = tools.single(mean=(0.0, 0.0, z), scale=0.05)
        out, grads = scene.gradients(body, settings=RasterSettings(near=0.49995))
        assert_sane(out, grads)
        assert bool((out.alphas > 0).any()) is seen, z


@pytest.mark.parametrize("log_scale", [-50.0, -20.0, -8.0, 4.0, 12.0, 20.0, 29.0, 40.0])
def test_extreme_scales(tools, log_scale):
    for axes in ([0], [0, 1], [0, 1, 2]):
        scene = tools.cloud(12, 20, 18, seed=3)
        scene.tensors["log_scales"][:, axes] = log_scale
        for body in BODIES:
            assert_sane(*scene.gradients(body, with_contributions=True))
        if log_scale <= 12.0:
            assert tools.psnr(scene.run("cpu").colors, scene.run("reference").colors) >= 60


def test_long_thin_gaussians_keep_their_precision(tools):
    # 1 : 1000 needles across the image; expanding the conic in float32 would lose three digits.
    scene = tools.cloud(100, 64, 48, seed=8)
    scene.tensors["log_scales"] = torch.tensor([0.5, -6.5, -6.5]).double().expand(100, 3).clone()
    assert_bodies_agree(scene, tools, gradient=2e-3)


def test_opacity_at_its_ends(tools):
    for logit in (-100.0, -math.inf):
        for body in BODIES:
            out, grads = tools.single(logit=logit).gradients(body)
            assert_sane(out, grads)
            assert (out.alphas == 0).all()
    for logit in (15.0, 100.0, math.inf):
        scene = tools.single(logit=logit, scale=3.0)
        out, grads = assert_bodies_agree(scene, tools)
        assert out.alphas.max().item() == pytest.approx(0.99, abs=1e-6)


def test_no_gradient_passes_the_alpha_clamp(tools):
    scene = tools.single(width=1, height=1, logit=8.0, scale=3.0)
    for body in BODIES:
        _, grads = scene.gradients(body)
        for name in ("means", "quats", "log_scales", "opacity_logits"):
            assert (grads[name] == 0).all(), name
        assert (grads["colors"] != 0).all()


def test_pixel_stops_once_it_is_opaque(tools):
    scene = tools.single(width=4, height=4, logit=4.2, scale=5.0)
    n = 40
    for name in ("means", "quats", "log_scales", "opacity_logits", "colors"):
        scene.tensors[name] = scene.tensors[name].repeat(n, *[1] * (scene.tensors[name].dim() - 1))
    scene.tensors["means"][:, 2] = torch.linspace(2, 3, n)
    out, grads = assert_bodies_agree(scene, tools)
    # 0.015^2 is above the threshold, 0.015^3 below: the third Gaussian counts, the fourth does not.
    assert (out.weight_sum[0] > 0).tolist() == [True] * 3 + [False] * (n - 3)
    assert (grads["colors"][3:] == 0).all()


def test_ten_thousand_gaussians_in_one_pixel(tools):
    scene = tools.cloud(10_000, 7, 5, seed=1)
    scene.tensors["means"] = torch.tensor([0.0, 0.0, 3.0]) + 0.01 * scene.tensors["means"]
    scene.tensors["log_scales"] = torch.full((10_000, 3), -5.0).double()
    scene.tensors["opacity_logits"] = torch.full((10_000,), -4.5).double()
    assert_bodies_agree(scene, tools, psnr=80, gradient=5e-3)


def test_black_harmonics_can_become_brighter_but_not_darker(tools):
    scene = tools.single(width=3, height=3)
    del scene.tensors["colors"]
    scene.tensors["sh"] = torch.full((1, 1, 3), -5.0).double()
    for body in BODIES:
        for sign, moved in ((-1.0, True), (1.0, False)):
            leaves = scene.leaves()
            out = scene.run(body, leaves)
            assert (out.colors == 0).all()
            (sign * out.colors.sum()).backward()
            assert bool((leaves["sh"].grad != 0).all()) is moved


def test_equal_depths_keep_the_order_of_the_inputs(tools):
    scene = tools.single(width=3, height=3, logit=0.0, scale=2.0)
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        scene.tensors[name] = scene.tensors[name].repeat(3, *[1] * (scene.tensors[name].dim() - 1))
    scene.tensors["colors"] = torch.eye(3).double()
    out, _ = assert_bodies_agree(scene, tools)
    assert (out.colors[..., 0] > out.colors[..., 1]).all()
    assert (out.colors[..., 1] > out.colors[..., 2]).all()


NUMBERS = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, 1e-38, 1e-45, 1e8, -1e8, 1e30, math.inf, -math.inf, math.nan]),
    st.floats(-3, 3, width=32))


@settings(max_examples=150, deadline=None)
@given(values=st.lists(NUMBERS, min_size=28, max_size=28), degree=st.sampled_from([None, 0, 1]),
       antialiased=st.booleans())
def test_any_numbers_at_all_give_finite_images_and_gradients(values, degree, antialiased):
    flat = torch.tensor(values, dtype=torch.float32)
    parts = [flat[:6].reshape(2, 3), flat[6:14].reshape(2, 4), flat[14:20].reshape(2, 3), flat[20:22]]
    parts = [p.clone().requires_grad_() for p in parts]
    color = flat[22:28].reshape(2, 3)
    if degree is not None:
        color = color[:, None].repeat(1, (degree + 1) ** 2, 1)
    color = color.clone().requires_grad_()
    K = torch.tensor([[[9.0, 0, 3], [0, 8, 2], [0, 0, 1]]])
    out = rasterize(*parts, **{"colors" if degree is None else "sh": color}, viewmats=torch.eye(4)[None], Ks=K, width=7,
                    height=5, with_contributions=True, settings=RasterSettings(threads=1, antialiased=antialiased))
    assert torch.isfinite(out.alphas).all()
    assert torch.isfinite(out.colors).all()
    # A bounded loss: colours may be as large as float32 allows.
    (out.alphas.sum() + torch.tanh(out.colors).sum()).backward()
    for leaf in parts:
        assert not torch.isnan(leaf.grad).any()
    assert torch.isfinite(color.grad).all()


def test_wrong_arguments_are_named(tools):
    scene = tools.cloud(5, 8, 8)
    wrong = {
        "quats": scene.tensors["quats"][:, :3], "means": scene.tensors["means"][:, :2],
        "log_scales": scene.tensors["log_scales"][:4], "colors": scene.tensors["colors"][0],
        "background": torch.zeros(4), "viewmats": torch.eye(3)[None],
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            scene.run("cpu", scene.leaves() | {name: value})
    with pytest.raises(ValueError, match="finite"):
        scene.run("cpu", scene.leaves() | {"viewmats": torch.full((1, 4, 4), math.nan)})
    with pytest.raises(ValueError, match="K = 1, 4, 9 or 16"):
        scene.run("cpu", sh=torch.zeros(5, 5, 3))
    with pytest.raises(ValueError, match="backend"):
        scene.run("gpu")
    with pytest.raises(ValueError, match="near"):
        scene.run("cpu", settings=RasterSettings(near=0.0))
    with pytest.raises(ValueError, match="width"):
        rasterize(**scene.leaves(), Ks=scene.Ks, width=0, height=4)


def test_a_device_without_a_body_says_so(tools):
    scene = tools.cloud(5, 8, 8)
    leaves = {name: value.to("meta") for name, value in scene.tensors.items() if name != "viewmats"}
    with pytest.raises(NotImplementedError, match="meta"):
        scene.run("auto", leaves | {"viewmats": torch.eye(4)[None]})
