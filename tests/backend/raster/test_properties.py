"""Properties that hold for every input, on generated inputs. SPLANNEQUIN_CASES=20000 sets the cases per property.

Examples are derandomised (tests/conftest.py): every run tests the same ones. The CUDA implementation gets few cases on
CPU fibers, which are slow. The reference is compared with the other implementations only.
"""

import dataclasses
import math
import os

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.raster_errors import BODIES, PER_GAUSSIAN, SAME_SIDE, Scene, camera, compare, scalar
from torch_backend.raster import RasterSettings
from torch_backend.raster.constants import ALPHA_MIN

REQUESTED_CASES = int(os.environ.get("SPLANNEQUIN_CASES", "0"))
SHARE = {"cpu": 1.0, "cuda": 0.1, "gpu": 0.5}
"""Cases per implementation relative to the CPU's, by speed."""


def for_all(strategy, usual):
    """Decorator of `holds(example, body)`: a test of every compiled implementation, with `usual` (or SPLANNEQUIN_CASES)
    examples times the implementation's share."""

    def decorate(holds):
        @pytest.mark.parametrize("body", [body for body in BODIES if body in SHARE])
        def test(body, generated):
            @settings(
                max_examples=max(5, round(SHARE[body] * (REQUESTED_CASES or usual))),
                suppress_health_check=list(HealthCheck),
            )
            @given(strategy)
            def each(example):
                generated()
                holds(example, body)

            each()

        return test

    return decorate


EXTREMES = [0.0, -0.0, 1e-45, -1e-45, 1e-38, 1e-8, 1e8, -1e8, 1e30, -1e30, 3e38, -3e38, math.inf, -math.inf, math.nan]
ANY = st.one_of(
    st.floats(width=32),
    st.sampled_from(EXTREMES),
    st.floats(-3, 3, width=32),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
UNIT = st.floats(-1, 1, width=32)
IN_VIEW = [
    *(0.0, 0.0, 2.0, 0.3, 0.2, 3.0),
    *(1.0, 0.0, 0.0, 0.0, 1.0, 0.2, 0.1, 0.3),
    *(-1.0, -1.0, -1.0, -1.0, -1.5, -1.0),
    *(1.0, 0.0, 0.8, 0.4, 0.2, 0.1, 0.5, 0.9),
]
"""Means, quaternions, log-scales, opacity logits and colours of two Gaussians."""
SIZES = st.sampled_from([(1, 1), (7, 5), (16, 16), (17, 3), (20, 18), (1, 33)])
NEAR = 0.0625
"""Near plane; a float32 number, so that all implementations cull by the same plane."""
POINTS = st.sampled_from([(0.5, 0.5), (0.1, 0.8), (-0.6, 0.5), (1.5, 1.4)])
"""Principal point as a fraction of the image size: centred, off centre, twice outside."""


@st.composite
def gaussians(draw):
    """(mean, quaternion, log-scales, logit) of one Gaussian; each of the last three may be extreme."""
    u = [draw(UNIT) for _ in range(3)]
    place = draw(st.sampled_from(["view", "view", "view", "behind", "plane", "through", "edge", "far", "pixel"]))
    depth = 2.5 + 1.5 * u[2]
    mean = {
        "view": (0.5 * u[0] * depth, 0.5 * u[1] * depth, depth),
        "behind": (u[0], u[1], -depth),
        "plane": (0.1 * u[0], 0.1 * u[1], NEAR * (1 + draw(st.sampled_from([-1e-6, 0.0, 1e-6, 0.1])))),
        "through": (0.3 * u[0], 0.3 * u[1], NEAR + 0.1 * (1 + u[2])),
        "edge": (draw(st.sampled_from([-1.0, 1.0])) * depth * (0.6 + 0.6 * abs(u[0])), u[1] * depth, depth),
        "far": (1e4 * u[0], 1e4 * u[1], 1e5),
        "pixel": (1e-3 * u[0], 1e-3 * u[1], 2.5),
    }[place]
    quat = draw(
        st.one_of(
            st.tuples(UNIT, UNIT, UNIT, UNIT),
            st.sampled_from(
                [(0.0,) * 4, (1.0, 0.0, 0.0, 0.0), (1e-7,) * 4, (0.0, 0.0, 1e-5, 0.0), (0.0, -3e18, 1e18, 0.0)]
            ),
        )
    )
    scale = st.one_of(st.floats(-4, -0.5, width=32), st.sampled_from([math.log(1e-8), -6.0, 1.0, 3.0, math.log(1e8)]))
    extreme = st.sampled_from([-100.0, -5.6, -5.5, 100.0, math.inf, -math.inf])
    logit = draw(st.one_of(st.floats(-3, 6, width=32), extreme))
    return mean, quat, (draw(scale), draw(scale), draw(scale)), logit


VIEWS = st.sampled_from([1, 1, 1, 2, 0])
BANDS = st.sampled_from([(None, 3), (0, 3), (1, 4), (2, 3)])
"""(degree of the harmonics, number of channels)."""
KINDS = gaussians()


@st.composite
def scenes(draw, least=0, most=6, kind=KINDS, views=VIEWS, sizes=SIZES, points=POINTS, bands=BANDS):
    """A scene of `least` to `most` Gaussians of `kind`, and its options."""
    rows = draw(st.lists(kind, min_size=least, max_size=most))
    width, height = draw(sizes)
    degree, channels = draw(bands)
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**20)))
    n, count = len(rows), draw(views)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    tensors = {
        name: torch.tensor([row[i] for row in rows], dtype=torch.float64).reshape(n, *shape)
        for i, (name, shape) in enumerate(
            (("means", (3,)), ("quats", (4,)), ("log_scales", (3,)), ("opacity_logits", ()))
        )
    }
    if degree is not None:
        tensors["sh"] = 0.5 * normal(n, (degree + 1) ** 2, 3)
    if degree is None or channels > 3:
        tensors["colors"] = normal(n, channels if degree is None else channels - 3)
    tensors["background"] = normal(channels)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    # depths stay exact, because the near plane cuts them
    viewmats[:, :2, 3] += 0.1 * normal(count, 2) * torch.arange(count)[:, None]
    tensors["viewmats"] = viewmats
    px, py = draw(points)
    Ks = camera(width, height, 0.9 * max(width, height), px * width, py * height).repeat(count, 1, 1)
    options = {
        "settings": RasterSettings(threads=draw(st.sampled_from([1, 2])), near=NEAR, antialiased=draw(st.booleans())),
        "with_depth": draw(st.booleans()),
        "with_contributions": True,
    }
    return Scene(tensors, Ks, width, height, options).rounded()


@st.composite
def good_gaussians(draw):
    """A Gaussian well inside the view, neither tiny nor huge."""
    u = [draw(UNIT) for _ in range(3)]
    depth = 2.5 + u[2]
    quat = draw(st.tuples(st.floats(0.125, 1, width=32), UNIT, UNIT, UNIT))
    scale = st.floats(-3.5, -0.5, width=32)
    return (
        (0.3 * u[0] * depth, 0.3 * u[1] * depth, depth),
        quat,
        (draw(scale), draw(scale), draw(scale)),
        draw(st.floats(-3, 4, width=32)),
    )


@st.composite
def good_scenes(draw, **options):
    """Scenes of `good_gaussians` with one camera and distinct depths, so that rounding cannot change the order."""
    scene = draw(scenes(least=1, kind=good_gaussians(), views=st.just(1), **options))
    order = scene.tensors["means"][:, 2].argsort()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order))
    scene.tensors["means"][:, 2] += 0.01 * rank
    return scene.rounded()


def run(scene, body):
    _, dtype, device = BODIES[body]
    leaves = scene.leaves(dtype, device)
    out = scene.run(body, leaves)
    scalar(out).backward()
    return out, {name: leaf.grad for name, leaf in leaves.items()}


def assert_sane(scene, out, grads):
    """Assert properties of one implementation's output that hold for every scene."""
    for name in ("colors", "alphas", "means2d", "weight_sum", "weight_max", "means2d_grad", "means2d_absgrad"):
        assert torch.isfinite(getattr(out, name)).all(), name
    if out.depth_expected is not None:
        assert torch.isfinite(out.depth_expected).all()
        assert torch.isfinite(out.depth_median).all()
        assert ((out.depth_median == 1e10) == (out.alphas == 0)).all()
        assert ((out.depth_expected == 1e10) == (out.alphas == 0)).all()
    assert (out.alphas >= 0).all()
    assert (out.alphas <= 1).all()
    assert (out.weight_max <= 0.99 + 1e-5).all()
    assert (out.weight_sum >= out.weight_max * (1 - 1e-5)).all()
    total, seen = out.weight_sum.double().sum().item(), out.alphas.detach().double().sum().item()
    assert total == pytest.approx(seen, rel=1e-4, abs=1e-6 * max(1, out.alphas.numel()))
    culled = out.radii == 0
    for name in ("weight_sum", "weight_max", "means2d", "means2d_grad", "means2d_absgrad"):
        assert (getattr(out, name)[culled] == 0).all(), name
    for name, grad in grads.items():
        assert grad is not None, name
        assert torch.isfinite(grad).all(), name
        if name in PER_GAUSSIAN:
            assert (grad[culled.all(0)] == 0).all(), name


def assert_alike(first, second, count, bound=2e-3):
    """Assert that two images of `count` Gaussians are equal within `bound`, except for alphas near the threshold of
    1/255."""
    gap = (first.alphas - second.alphas).abs()
    same = gap < SAME_SIDE
    assert (gap <= count * ALPHA_MIN + bound).all()
    assert ((first.colors - second.colors).abs()[same] <= bound * (1 + first.colors.abs().max())).all()


PATCHED = st.dictionaries(st.integers(0, 27), ANY, max_size=4).map(
    lambda new: [new.get(i, value) for i, value in enumerate(IN_VIEW)]
)
NUMBERS = st.one_of(PATCHED, st.lists(ANY, min_size=28, max_size=28))
"""Two Gaussians in view with up to four numbers replaced by arbitrary ones; or only arbitrary numbers."""


@for_all(st.tuples(NUMBERS, st.sampled_from([None, 0, 1]), st.booleans()), 80)
def test_any_numbers_give_sane_images_and_gradients(example, body):
    values, degree, antialiased = example
    flat = torch.tensor(values, dtype=torch.float64)
    color = flat[22:28].reshape(2, 3)
    tensors = {
        "means": flat[:6].reshape(2, 3),
        "quats": flat[6:14].reshape(2, 4),
        "log_scales": flat[14:20].reshape(2, 3),
        "opacity_logits": flat[20:22],
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
    }
    tensors["colors" if degree is None else "sh"] = (
        color if degree is None else color[:, None].repeat(1, (degree + 1) ** 2, 1)
    )
    scene = Scene(
        tensors,
        camera(7, 5, 9.0, 3.0, 2.0),
        7,
        5,
        {"settings": RasterSettings(threads=1, antialiased=antialiased), "with_contributions": True},
    )
    _, dtype, device = BODIES[body]
    leaves = scene.leaves(dtype, device)
    out = scene.run(body, leaves)
    assert torch.isfinite(out.alphas).all()
    assert torch.isfinite(out.colors).all()
    # A bounded loss: colours may be as large as float32 allows, and so would the gradients of positions be.
    (out.alphas.sum() + torch.tanh(out.colors).sum()).backward()
    for name, leaf in leaves.items():
        assert not torch.isnan(leaf.grad).any(), name
        assert torch.isfinite(leaf.grad).all() or color.nan_to_num().abs().max() > 1e6, name


@for_all(scenes(), 80)
def test_bodies_agree_with_the_reference_on_any_scene(scene, body):
    errors = compare(scene, body)
    assert_sane(scene, errors.out, errors.grads)
    gap = (errors.out.alphas.detach().cpu() - errors.reference.alphas.detach()).abs()
    assert (gap <= len(scene.tensors["means"]) * ALPHA_MIN + 2e-3).all()
    assert errors.image <= 2e-3


@for_all(good_scenes(), 80)
def test_gradients_agree_with_the_reference_on_good_scenes(scene, body):
    errors = compare(scene, body)
    assert errors.image <= 5e-4
    for name, truth in errors.reference_grads.items():
        difference = (errors.grads[name].cpu().double() - truth).norm()
        assert difference <= 2e-3 * truth.norm() + 1e-3, name


@for_all(st.tuples(good_scenes(), st.integers(0, 1000)), 50)
def test_order_of_the_gaussians_changes_nothing(example, body):
    scene, seed = example
    order = torch.randperm(len(scene.tensors["means"]), generator=torch.Generator().manual_seed(seed))
    shuffled = {k: v[order] if k in PER_GAUSSIAN else v for k, v in scene.tensors.items()}
    out, grads = run(scene, body)
    second, second_grads = run(Scene(shuffled, scene.Ks, scene.width, scene.height, scene.options), body)
    assert torch.allclose(out.colors, second.colors, rtol=1e-5, atol=1e-6)
    assert torch.equal(out.radii[:, order], second.radii)
    assert torch.allclose(out.weight_sum[:, order], second.weight_sum, rtol=1e-4, atol=1e-6)
    for name in PER_GAUSSIAN:
        if name in grads:
            scale = float(grads[name].abs().max())
            assert torch.allclose(grads[name][order], second_grads[name], rtol=1e-3, atol=1e-5 * (1 + scale)), name


FLAT = good_scenes(bands=st.sampled_from([(None, 3), (0, 3)]))
"""Without higher harmonics, which depend on the world's axes."""
TURNS = st.tuples(st.floats(0.125, 1, width=32), UNIT, UNIT, UNIT)


@for_all(st.tuples(FLAT, TURNS, st.tuples(UNIT, UNIT, UNIT)), 50)
def test_moving_the_world_and_the_camera_together_changes_nothing(example, body):
    scene, turn, shift = example
    turned = Rotation.from_quat(turn, scalar_first=True)
    R, t = torch.from_numpy(turned.as_matrix()), torch.tensor(shift, dtype=torch.float64)
    quats = turned * Rotation.from_quat(scene.tensors["quats"].numpy(), scalar_first=True)
    quats = torch.from_numpy(quats.as_quat(scalar_first=True))
    view = scene.tensors["viewmats"].clone()
    view[:, :3, :3] = view[:, :3, :3] @ R.T
    view[:, :3, 3] -= view[:, :3, :3] @ t
    moved = scene.tensors | {"means": scene.tensors["means"] @ R.T + t, "quats": quats, "viewmats": view}
    second = Scene(moved, scene.Ks, scene.width, scene.height, scene.options).run(body)
    assert_alike(scene.run(body), second, len(quats))


@for_all(st.tuples(good_scenes(), st.floats(-5, 5)), 50)
def test_scaling_the_world_scales_the_depth(example, body):
    scene, exponent = example
    factor = 10.0**exponent
    view = scene.tensors["viewmats"].clone()
    view[:, :3, 3] *= factor
    scaled = scene.tensors | {
        "means": scene.tensors["means"] * factor,
        "viewmats": view,
        "log_scales": scene.tensors["log_scales"] + math.log(factor),
    }
    near = [dataclasses.replace(scene.options["settings"], near=NEAR * f) for f in (1, factor)]
    options = [scene.options | {"with_depth": True, "settings": value} for value in near]
    first = Scene(scene.tensors, scene.Ks, scene.width, scene.height, options[0]).run(body)
    second = Scene(scaled, scene.Ks, scene.width, scene.height, options[1]).run(body)
    assert_alike(first, second, len(view) * len(scene.tensors["means"]))
    solid = (first.alphas > 0.2) & ((first.alphas - second.alphas).abs() < SAME_SIDE)
    assert torch.allclose(first.depth_expected[solid] * factor, second.depth_expected[solid], rtol=5e-3)


@for_all(good_scenes(sizes=st.just((34, 20)), points=st.just((0.5, 0.5))), 50)
def test_two_halves_make_the_image(scene, body):
    # Tiles and principal point change. Means are near the centre, so that no half clamps a Jacobian.
    scene.tensors["means"][:, 0] *= 0.25
    whole = scene.run(body)
    half = scene.width // 2
    parts = []
    for x in (0, half):
        K = scene.Ks.clone()
        K[:, 0, 2] -= x
        parts.append(Scene(scene.tensors, K, half, scene.height, scene.options).run(body))
    for name in ("colors", "alphas"):
        setattr(parts[0], name, torch.cat([getattr(p, name) for p in parts], 2))
    assert_alike(whole, parts[0], len(scene.tensors["means"]), 1e-3)
    both = parts[0].weight_sum + parts[1].weight_sum
    assert (whole.weight_sum - both).abs().max() <= whole.alphas.numel() * ALPHA_MIN * 0.25 + 1e-3


@st.composite
def fans(draw):
    """One long Gaussian anywhere in front of the camera, mostly outside the view."""
    depth = draw(st.floats(0.125, 4, width=32))
    mean = (draw(st.floats(-8, 8, width=32)) * depth, draw(st.floats(-8, 8, width=32)) * depth, depth)
    quat = draw(st.tuples(st.floats(0.125, 1, width=32), UNIT, UNIT, UNIT))
    return mean, quat, (draw(st.floats(-1, 2, width=32)), -4.0, -4.0), draw(st.floats(0, 6, width=32))


FANS = scenes(least=1, most=1, kind=fans(), views=st.just(1), points=st.sampled_from([(0.5, 0.5), (0.1, 0.8)]))


@for_all(FANS, 80)
def test_footprints_at_the_frustum_edge_are_bounded(scene, body):
    # sigma^2 <= |J|^2 s^2 + 0.3 with clamped x/z and y/z in J; the ellipse ends at most at sqrt(2 ln 255) sigma.
    out, grads = run(scene, body)
    assert_sane(scene, out, grads)
    (fx, _, cx), (_, fy, cy), _ = scene.Ks[0].tolist()
    z = scene.tensors["means"][0, 2].item()
    u = 0.15 * scene.width / fx + max(cx, scene.width - cx) / fx
    v = 0.15 * scene.height / fy + max(cy, scene.height - cy) / fy
    J2 = (fx / z) ** 2 * (1 + u * u) + (fy / z) ** 2 * (1 + v * v)
    largest = math.exp(scene.tensors["log_scales"].max().item())
    reach = math.sqrt(2 * math.log(255.0) * (J2 * largest**2 + 0.3))
    assert out.radii[0, 0] <= math.ceil(reach * (1 + 1e-5))
