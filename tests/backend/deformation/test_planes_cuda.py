"""The GPU's planes against torch's grid_sample at float64: on Warp's cpu device everywhere, on a GPU if there is one.

What a GPU compiles of them, run on the CPU: tests/backend/raster/test_device_text.py.
"""

import math
import re

import pytest
import torch

from torch_backend.deformation import HexPlane, HexPlaneConfig, planes, planes_cuda
from torch_backend.native import initialised_warp

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


def fields(features=16, levels=(1, 2), time_nodes=7, **more):
    """The same field twice, with planes that nothing repeats in: float32 and float64. Published: points are pulled."""
    made = []
    for dtype in (torch.float32, torch.float64):
        config = HexPlaneConfig(
            features=features, resolution=9, levels=levels, time_nodes=time_nodes, published=True, **more
        )
        field = HexPlane(config, torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), torch.Generator().manual_seed(0))
        g = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for plane in field._by_level():
                plane += 0.3 * torch.randn(plane.shape, generator=g)
        made.append(field.to(dtype))
    return made


def points(count=301):
    """[count, 4] in and beyond [-1, 1]; the first lie on nodes and rims."""
    where = 1.2 * torch.randn(count, 4, generator=torch.Generator().manual_seed(2))
    where[:4] = torch.tensor([[-1.0, -1, -1, -1], [1, 1, 1, 1], [0, 0.25, -0.5, 0], [1, -1, 1, 0]])
    return where


def on(device, field):
    return [p.detach().to(device).requires_grad_() for p in field._by_level()]


def relative(value, truth):
    return float((value.detach().cpu().double() - truth.detach()).norm() / truth.detach().norm())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("features", "levels", "time_nodes"), [(16, (1, 2), 7), (5, (1,), 7), (48, (1, 2), 2), (8, (1,), 1)]
)
def test_samples_and_every_gradient_match_float64(device, features, levels, time_nodes):
    ours, exact = fields(features, levels, time_nodes)
    where = points()
    got = planes_cuda.features(where.to(device), on(device, ours))
    want = exact.features_at(where[:, :3].double(), where[:, 3].double())
    assert got.shape == (len(where), features * len(levels))
    assert relative(got, want) <= 1e-6
    # On a node and on the rim a point's slope is one-sided, and rounding decides which side.
    here, leaves = where[4:].to(device).requires_grad_(), on(device, ours)
    there, time = (where[4:, part].double().requires_grad_() for part in (slice(0, 3), 3))
    pull = torch.randn(len(here), got.shape[1], generator=torch.Generator().manual_seed(3))
    planes_cuda.features(here, leaves).backward(pull.to(device))
    exact.features_at(there, time).backward(pull.double())
    for p, q in zip(leaves, exact._by_level(), strict=True):
        assert p.grad.stride() == p.stride()
        assert relative(p.grad, q.grad) <= 2e-6
    assert relative(here.grad[:, :3], there.grad) <= 1e-5
    if time_nodes > 1:
        assert relative(here.grad[:, 3], time.grad) <= 1e-5
    else:
        assert not here.grad[:, 3].any()
    outside = (where[4:].abs() > 1).all(1)
    assert bool(outside.any()) and not here.grad.cpu()[outside].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("features", [16, 5])
def test_the_penalty_and_its_gradient_match_float64(device, features):
    ours, exact = fields(features, time_l1=0.1, smooth_space=0.3, smooth_time=0.2)
    leaves = on(device, ours)
    got = planes_cuda.penalty(leaves, [*[(0.3, 0.0, 0.0)] * 3, *[(0.2, 0.0, 0.1)] * 3] * 2)
    want = exact.regularisation()
    assert relative(got, want) <= 1e-6
    (3.0 * got).backward()
    (3.0 * want).backward()
    for p, q in zip(leaves, exact._by_level(), strict=True):
        assert relative(p.grad, q.grad) <= 1e-6


def test_the_penalty_bends_along_rows_as_on_the_processor():
    ours, _ = fields()
    weights = [(0.3, 0.7, 0.2)] * 12
    leaves, others = on("cpu", ours), on("cpu", ours)
    got, want = planes_cuda.penalty(leaves, weights), planes.penalty(others, weights)
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-6)
    got.backward()
    want.backward()
    for p, q in zip(leaves, others, strict=True):
        torch.testing.assert_close(p.grad, q.grad, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("shape", [(1, 16, 2, 2), (1, 4, 1, 1), (1, 4, 3, 1)])
def test_planes_of_few_nodes_bend_where_they_have_three(shape):
    leaf = torch.rand(shape, generator=torch.Generator().manual_seed(5))
    leaf = leaf.contiguous(memory_format=torch.channels_last).requires_grad_()
    value = planes_cuda.penalty([leaf], [(1.0, 1.0, 0.0)])
    value.backward()
    bends = shape[2] >= 3
    assert (float(value.detach()) > 0.0) == bends == bool(leaf.grad.any())


@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf])
def test_a_point_that_is_nowhere_stays_on_the_rim(odd):
    ours, _ = fields()
    leaves, where = on("cpu", ours), torch.full((3, 4), odd, requires_grad=True)
    value = planes_cuda.features(where, leaves)
    rim = planes_cuda.features(torch.full((3, 4), 1.0 if odd > 0 else -1.0), leaves)
    assert torch.equal(value, rim)
    value.sum().backward()
    assert not where.grad.any() and all(bool(p.grad.isfinite().all()) for p in leaves)


@pytest.mark.parametrize("device", DEVICES)
def test_no_points_at_all(device):
    ours, _ = fields()
    leaves = on(device, ours)
    value = planes_cuda.features(torch.zeros(0, 4, device=device), leaves)
    value.sum().backward()
    assert value.shape == (0, 32) and not any(bool(p.grad.any()) for p in leaves)


def test_what_it_does_not_take_is_refused_and_what_the_self_test_refused_is_torchs(monkeypatch):
    ours, exact = fields()
    taken = ours._by_level()
    assert planes_cuda.supports(taken)
    assert not planes_cuda.supports(exact._by_level())
    assert not planes_cuda.supports([p.detach().contiguous() for p in taken])
    with pytest.raises(ValueError, match="float32 on one device"):
        planes_cuda.features(torch.zeros(1, 4), exact._by_level())
    with pytest.raises(ValueError, match="float32 on one device"):
        planes_cuda.penalty(exact._by_level(), [(1.0, 1.0, 1.0)] * 12)
    monkeypatch.setattr(planes_cuda, "refused", "a kernel does not build or run on it")
    assert not planes_cuda.supports(taken)
    assert HexPlaneConfig().row_bytes() > 1024  # torch's path keeps every sample
    monkeypatch.undo()
    assert HexPlaneConfig().row_bytes() + 4 * 10 * 16 * 2 == 4 * (12 * 16 * 2 + 64 * 15)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_field_on_a_card_is_given_to_it():
    ours, _ = fields()
    field, where = ours.to("cuda"), points().cuda()
    got = field.features_at(where[:, :3], where[:, 3])
    assert torch.equal(got, planes_cuda.features(where, field._by_level()))


@pytest.mark.parametrize("arch", [75, 90, 120])
def test_kernels_compile_for_gpus_that_are_not_here(tmp_path, arch):
    wp = initialised_warp()
    module = planes_cuda.kernels(16).samples.module
    wp.compile_aot_module(module, arch=arch, module_dir=str(tmp_path), use_ptx=True)
    (made,) = tmp_path.rglob("*.ptx")
    text = made.read_text(errors="replace")
    # A thread reads four channels at once, adds by atomics, and keeps nothing outside its registers.
    assert len(re.findall(r"ld\.(global\.)?v4", text)) == 24 and text.count("atom.global.add.f32") == 24
    assert "ld.local" not in text
