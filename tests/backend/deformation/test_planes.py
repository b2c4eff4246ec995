"""The compiled planes of each implementation, compared with torch's grid_sample and autograd in float64.

The CPU's planes run on the CPU. The GPU's planes run on Warp's cpu device everywhere, and on a GPU if there is one.
tests/backend/raster/test_device_text.py runs the code that a GPU compiles of them on the CPU.
"""

import math

import pytest
import torch

from torch_backend.deformation import HexPlane, HexPlaneConfig, planes, planes_cuda

BODIES = {"cpu": (planes, "cpu"), "fibers": (planes_cuda, "cpu"), "gpu": (planes_cuda, "cuda")}
"""Map from implementation to (module, device)."""
BOUNDS = {"cpu": (1e-5, 1e-4), "fibers": (2e-6, 1e-5), "gpu": (2e-6, 1e-5)}
"""Map from implementation to the relative error bound of (values and plane gradients, point gradients)."""
no_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def on_every_body(*rows):
    """Test parameters (implementation, *row); the CPU's implementation needs a multiple of 16 features."""
    return [
        pytest.param(body, *row, marks=no_gpu if body == "gpu" else ())
        for body in BODIES
        for row in rows
        if body != "cpu" or row[0] % 16 == 0
    ]


def fields(features=16, levels=(1, 2), time_nodes=7, **more):
    """The same field in float32 and float64, with random planes; `published`, so that points receive gradients."""
    leaves = []
    for dtype in (torch.float32, torch.float64):
        config = HexPlaneConfig(
            features=features, resolution=9, levels=levels, time_nodes=time_nodes, published=True, **more
        )
        field = HexPlane(config, torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), torch.Generator().manual_seed(0))
        g = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for plane in field._by_level():
                plane += 0.3 * torch.randn(plane.shape, generator=g)
        leaves.append(field.to(dtype))
    return leaves


def points(count=301):
    """[count, 4] inside and outside [-1, 1]; the first points lie on nodes and on the border."""
    where = 1.2 * torch.randn(count, 4, generator=torch.Generator().manual_seed(2))
    where[:4] = torch.tensor([[-1.0, -1, -1, -1], [1, 1, 1, 1], [0, 0.25, -0.5, 0], [1, -1, 1, 0]])
    return where


def on(device, field):
    return [p.detach().to(device).requires_grad_() for p in field._by_level()]


def relative(value, truth):
    return float((value.detach().cpu().double() - truth.detach()).norm() / truth.detach().norm())


@pytest.mark.parametrize(
    ("body", "features", "levels", "time_nodes"),
    on_every_body((16, (1, 2), 7), (5, (1,), 7), (48, (1, 2), 2), (8, (1,), 1)),
)
def test_samples_and_every_gradient_match_float64(body, features, levels, time_nodes):
    module, device = BODIES[body]
    ours, exact = fields(features, levels, time_nodes)
    where, (bound, bound_of_points) = points(), BOUNDS[body]
    got = module.features(where.to(device), on(device, ours))
    want = exact.features_at(where[:, :3].double(), where[:, 3].double())
    assert got.shape == (len(where), features * len(levels))
    assert relative(got, want) <= bound
    # On a node or the border, the gradient of a point is one-sided, and rounding decides the side.
    ours_at, leaves = where[4:].to(device).requires_grad_(), on(device, ours)
    exact_at, time = (where[4:, part].double().requires_grad_() for part in (slice(0, 3), 3))
    pull = torch.randn(len(ours_at), got.shape[1], generator=torch.Generator().manual_seed(3))
    module.features(ours_at, leaves).backward(pull.to(device))
    exact.features_at(exact_at, time).backward(pull.double())
    for p, q in zip(leaves, exact._by_level(), strict=True):
        assert p.grad.stride() == p.stride()
        assert relative(p.grad, q.grad) <= bound
    assert relative(ours_at.grad[:, :3], exact_at.grad) <= bound_of_points
    if time_nodes > 1:
        assert relative(ours_at.grad[:, 3], time.grad) <= bound_of_points
    else:
        assert not ours_at.grad[:, 3].any()
    outside = (where[4:].abs() > 1).all(1)
    assert bool(outside.any()) and not ours_at.grad.cpu()[outside].any()


@pytest.mark.parametrize(("body", "features"), on_every_body((16,), (5,)))
def test_the_penalty_and_its_gradient_match_float64(body, features):
    module, device = BODIES[body]
    ours, exact = fields(features, time_l1=0.1, smooth_space=0.3, smooth_time=0.2)
    leaves = on(device, ours)
    got = module.penalty(leaves, [*[(0.3, 0.0, 0.0)] * 3, *[(0.2, 0.0, 0.1)] * 3] * 2)
    want = exact.regularisation()
    assert relative(got, want) <= 1e-6
    (3.0 * got).backward()
    (3.0 * want).backward()
    for p, q in zip(leaves, exact._by_level(), strict=True):
        assert relative(p.grad, q.grad) <= BOUNDS[body][0]


def test_the_penalty_bends_along_rows_on_both_bodies():
    ours, _ = fields()
    weights = [(0.3, 0.7, 0.2)] * 12
    leaves, reference = on("cpu", ours), on("cpu", ours)
    got, want = planes_cuda.penalty(leaves, weights), planes.penalty(reference, weights)
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-6)
    got.backward()
    want.backward()
    for p, q in zip(leaves, reference, strict=True):
        torch.testing.assert_close(p.grad, q.grad, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("module", "shape"),
    [(planes, (1, 16, 2, 2)), *((planes_cuda, s) for s in ((1, 16, 2, 2), (1, 4, 1, 1), (1, 4, 3, 1)))],
)
def test_planes_of_few_nodes_bend_where_they_have_three(module, shape):
    leaf = torch.rand(shape, generator=torch.Generator().manual_seed(5))
    leaf = leaf.contiguous(memory_format=torch.channels_last).requires_grad_()
    value = module.penalty([leaf], [(1.0, 1.0, 0.0)])
    value.backward()
    bends = shape[2] >= 3
    assert (float(value.detach()) > 0.0) == bends == bool(leaf.grad.any())


def test_any_number_of_threads_gives_the_same_bits():
    where, (field, _) = points(501), fields()
    results = []
    for threads in (1, 2, 3, 8):
        ours, at = on("cpu", field), where.clone().requires_grad_()
        value = planes.features(at, ours, threads)
        (value.square().sum() + planes.penalty(ours, [(1.0, 0.5, 0.2)] * 12, threads)).backward()
        results.append(torch.cat([value.detach().flatten(), *(p.grad.flatten() for p in (at, *ours))]))
    assert all(torch.equal(results[0], repeated) for repeated in results[1:])


@pytest.mark.parametrize("module", [planes, planes_cuda])
@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf])
def test_non_finite_point_is_clamped_to_the_border(module, odd):
    ours, _ = fields()
    leaves, where = on("cpu", ours), torch.full((3, 4), odd, requires_grad=True)
    value = module.features(where, leaves)
    rim = module.features(torch.full((3, 4), 1.0 if odd > 0 else -1.0), leaves)
    assert torch.equal(value, rim)
    value.sum().backward()
    assert not where.grad.any() and all(bool(p.grad.isfinite().all()) for p in leaves)


@pytest.mark.parametrize(("body", "features"), on_every_body((16,)))
def test_no_points_at_all(body, features):
    module, device = BODIES[body]
    ours, _ = fields(features)
    leaves = on(device, ours)
    value = module.features(torch.zeros(0, 4, device=device), leaves)
    value.sum().backward()
    assert value.shape == (0, 32) and not any(bool(p.grad.any()) for p in leaves)


def test_unsupported_planes_fall_back_to_torch():
    (ours, exact), (odd, _) = fields(), fields(features=5)
    assert planes.supports(ours._by_level()) and not planes.supports(exact._by_level())
    with pytest.raises(ValueError, match="16"):
        planes.features(torch.zeros(1, 4), odd._by_level())
    with pytest.raises(ValueError, match="16"):
        planes.penalty(odd._by_level(), [(1.0, 1.0, 1.0)] * 12)
    assert odd.features_at(torch.zeros(3, 3), torch.zeros(3)).shape == (3, 10)
    assert float(odd.regularisation().detach()) > 0.0


def test_a_field_gives_its_planes_to_the_compiled_body():
    ours, _ = fields()
    where = points()
    assert torch.equal(ours.features_at(where[:, :3], where[:, 3]), planes.features(where, ours._by_level()))
