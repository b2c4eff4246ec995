"""The compiled planes against torch's grid_sample and autograd at float64."""

import pytest
import torch

from torch_backend.deformation import HexPlane, HexPlaneConfig, planes


def field(features=16, levels=(1, 2), dtype=torch.float32, seed=0, published=False):
    config = HexPlaneConfig(features=features, resolution=9, levels=levels, time_nodes=7, published=published)
    made = HexPlane(config, torch.tensor([[-1.0, -2, -1], [1, 1, 3]]), torch.Generator().manual_seed(seed))
    g = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for plane in [*made.spatial, *made.temporal]:
            plane += 0.3 * torch.randn(plane.shape, generator=g)
    return made.to(dtype)


def points(count=301):
    """Means inside and beyond the box, some exactly on nodes and rims, and times at both ends."""
    g = torch.Generator().manual_seed(2)
    means = 1.5 * torch.randn(count, 3, generator=g)
    means[:3] = torch.tensor([[-1.0, -2, -1], [1, 1, 3], [0, -0.5, 1]])
    times = torch.rand(count, generator=g)
    times[:2] = torch.tensor([0.0, 1.0])
    return means, times


@pytest.mark.parametrize("features", [16, 48])
def test_samples_and_their_gradients_match_float64(features):
    ours, exact = field(features), field(features, dtype=torch.float64)
    assert planes.supports(ours._by_level())
    assert not planes.supports(exact._by_level())
    means, times = points()
    got, want = ours.features_at(means, times), exact.features_at(means.double(), times.double())
    torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-5)  # products of planes round 1
    pull = torch.randn(got.shape, generator=torch.Generator().manual_seed(3))
    got.backward(pull)
    want.backward(pull.double())
    for p, q in zip(ours._by_level(), exact._by_level(), strict=True):
        assert float((p.grad - q.grad).norm()) <= 1e-5 * float(q.grad.norm())


@pytest.mark.parametrize("features", [16, 48])
def test_the_published_lookup_pulls_points_as_float64_does(features):
    ours, exact = field(features, published=True), field(features, dtype=torch.float64, published=True)
    means, times = points()
    # On a node and on the rim the slope is one-sided, and rounding decides which side.
    means, times = means[3:], times[3:]
    x, y = means.clone().requires_grad_(), means.double().requires_grad_()
    s, t = times.clone().requires_grad_(), times.double().requires_grad_()
    pull = torch.randn(len(means), 2 * features, generator=torch.Generator().manual_seed(3))
    ours.features_at(x, s).backward(pull)
    exact.features_at(y, t).backward(pull.double())
    assert float(y.grad.norm()) > 1.0
    assert float((x.grad - y.grad).norm()) <= 1e-4 * float(y.grad.norm())
    assert float((s.grad - t.grad).norm()) <= 1e-4 * float(t.grad.norm())
    outside = ((means < ours.box[0]) | (means > ours.box[1])).all(1)
    assert bool(outside.any())
    assert not x.grad[outside].any()


def test_penalty_and_its_gradient_match_float64():
    ours, exact = field(), field(dtype=torch.float64)
    got, want = ours.regularisation(), exact.regularisation()
    assert float(got.detach()) == pytest.approx(float(want.detach()), rel=1e-6)
    (3.0 * got).backward()
    (3.0 * want).backward()
    for p, q in zip(ours._by_level(), exact._by_level(), strict=True):
        assert float((p.grad - q.grad).norm()) <= 1e-5 * float(q.grad.norm())


def test_planes_of_two_nodes_do_not_bend():
    flat = torch.nn.Parameter(torch.rand(1, 16, 2, 2).contiguous(memory_format=torch.channels_last))
    value = planes.penalty([flat], [(1.0, 1.0, 0.0)])
    value.backward()
    assert float(value.detach()) == 0.0
    assert float(flat.grad.abs().max()) == 0.0


def test_any_number_of_threads_gives_the_same_bits():
    where = torch.rand(501, 4, generator=torch.Generator().manual_seed(4)) * 2.4 - 1.2
    results = []
    for threads in (1, 2, 3, 8):
        ours, at = field()._by_level(), where.clone().requires_grad_()
        value = planes.features(at, ours, threads)
        (value.square().sum() + planes.penalty(ours, [(1.0, 0.5, 0.2)] * 12, threads)).backward()
        results.append(torch.cat([value.detach().flatten(), *(p.grad.flatten() for p in (at, *ours))]))
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_a_gaussian_at_nan_stays_inside_the_planes():
    value = planes.features(torch.full((3, 4), float("nan")), field()._by_level())
    assert bool(torch.isfinite(value).all())


def test_no_points_at_all():
    ours = field()
    value = ours.features_at(torch.zeros(0, 3), torch.zeros(0))
    value.sum().backward()
    assert value.shape == (0, 32)
    assert float(ours.spatial[0].grad.abs().max()) == 0.0


def test_other_planes_are_refused_here_and_taken_by_torch():
    odd = field(features=5)
    with pytest.raises(ValueError, match="16"):
        planes.features(torch.zeros(1, 4), odd._by_level())
    with pytest.raises(ValueError, match="16"):
        planes.penalty(odd._by_level(), [(1.0, 1.0, 1.0)] * 12)
    assert odd.features_at(*points(3)).shape == (3, 10)
    assert float(odd.regularisation().detach()) > 0.0
