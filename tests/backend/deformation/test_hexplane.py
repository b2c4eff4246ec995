"""Host A (HexPlane): identity at the start, time over the whole plane, gradients compared with finite differences."""

import pytest
import torch

from torch_backend.deformation import HexPlane, HexPlaneConfig, Start, field_box, host, host_config

BOX = torch.tensor([[-1.0, -2.0, 0.5], [1.0, 2.0, 3.0]])


def field(**changes):
    config = HexPlaneConfig(features=4, resolution=8, time_nodes=5, width=16, **changes)
    return HexPlane(config, BOX, torch.Generator().manual_seed(0))


def points(count=9):
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    return BOX[0] + unit * (BOX[1] - BOX[0])


def stir(module):
    """Perturb all parameters, so that the zero heads and the flat time planes have an effect."""
    g = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=g, dtype=parameter.dtype)
    return module


def test_identity_at_construction():
    for t in (0.0, 0.3, 1.0):
        for delta in field()(points(), torch.tensor([t])).moved().values():
            assert not delta.any()


def test_shapes_and_sizes():
    deltas = field()(points(7), torch.tensor([0.5]))
    assert [tuple(d.shape) for d in deltas.moved().values()] == [(7, 3), (7, 4), (7, 3), (7,), (7, 1, 3)]


def test_ends_of_time_hit_the_end_nodes():
    """The published code passes [0, 1] to a sampler for [-1, 1] and never reaches half of the plane (issues #248,
    #251)."""
    module = field()
    with torch.no_grad():
        for plane in module.temporal:
            plane.copy_(torch.arange(5.0)[None, None, :, None].expand_as(plane))
    x = points(3)
    base = module.features_at(x, torch.tensor([1.0 / 4])) / 1.0
    assert torch.allclose(module.features_at(x, torch.tensor([0.0])), torch.zeros_like(base), atol=1e-6)
    assert torch.allclose(module.features_at(x, torch.tensor([1.0])), 64.0 * base, rtol=1e-4)


def test_stretched_axes_are_fine_where_the_gaussians_are():
    """People are 0.3 wide in a box of 40. Stretched axes give them over ten times as many nodes as 8 even nodes do."""
    g = torch.Generator().manual_seed(4)
    people, background = 0.3 * torch.randn(60, 3, generator=g), 20.0 * torch.randn(30, 3, generator=g)
    means = torch.cat([people, background])
    start = Start(means, field_box(means), means, 10, 0, torch.Generator().manual_seed(0))
    nodes = {}
    for stretch in (0.0, 2.0):
        field = host("hexplane").create(HexPlaneConfig(features=4, resolution=8, time_nodes=5, stretch=stretch), start)
        with torch.no_grad():  # the first plane counts nodes along x; all others are 1
            for n, plane in enumerate((*field.spatial, *field.temporal)):
                plane.copy_(torch.arange(8.0).expand_as(plane) if n == 0 else torch.ones_like(plane))
        at = field.features_at(people, torch.tensor([0.5]))[:, 0]
        nodes[stretch] = float((at.max() - at.min()).detach())
        again = host("hexplane").restore(field.config, field.state())
        assert torch.equal(again.features_at(means, torch.tensor([0.2])), field.features_at(means, torch.tensor([0.2])))
    assert nodes[2.0] > 10.0 * nodes[0.0]


def test_gradients_match_finite_differences_at_float64():
    module = stir(field()).double()
    module.box = BOX.double()
    x, t = points(5).double(), torch.tensor([0.37], dtype=torch.float64)
    parameters = [p for p in module.parameters() if p.numel() < 2000][:6]

    def loss(*_):
        return torch.stack([d.sin().sum() for d in module(x, t).moved().values()]).sum()

    for parameter in parameters:
        assert torch.autograd.gradcheck(loss, (parameter,), eps=1e-6, atol=1e-7, rtol=1e-4)


def test_means_get_no_gradient_through_the_lookup():
    x = points().requires_grad_()
    deltas = stir(field())(x, torch.tensor([0.5]))
    assert torch.stack([d.sum() for d in deltas.moved().values()]).sum().requires_grad
    assert torch.autograd.grad(sum(d.sum() for d in deltas.moved().values()), x, allow_unused=True)[0] is None


def test_published_means_get_gradient_through_the_lookup():
    module, _ = published()
    x = points().requires_grad_()
    module(x, torch.tensor([0.5])).means.square().sum().backward()
    step = 1e-3 * torch.nn.functional.normalize(x.grad, dim=1)
    with torch.no_grad():
        low, high = (module(x + sign * step, torch.tensor([0.5])).means.square().sum() for sign in (-1.0, 1.0))
    # Some steps cross into another cell of a plane.
    assert float(high - low) == pytest.approx(2.0 * float((x.grad * step).sum()), rel=0.2)


def test_smoothness_sees_every_axis():
    """4DGaussians' spatial term never smooths x; this one must notice a kink along any axis."""
    for plane_index in range(3):
        for axis in (2, 3):
            module = field()
            with torch.no_grad():
                for p in module.spatial:
                    p.fill_(0.3)
                flat = float(module.regularisation().detach())
                module.spatial[plane_index].select(axis, 4).add_(1.0)
            assert float(module.regularisation().detach()) > flat


def test_state_round_trip():
    one = stir(field())
    two = HexPlane(one.config, BOX + 1.0, torch.Generator().manual_seed(5))
    two.load_state(one.state())
    for a, b in zip(
        one(points(), torch.tensor([0.2])).moved().values(),
        two(points(), torch.tensor([0.2])).moved().values(),
        strict=True,
    ):
        assert torch.equal(a, b)


def test_empty_box_is_refused():
    with pytest.raises(ValueError, match="box"):
        HexPlane(HexPlaneConfig(), torch.zeros(2, 3), torch.Generator())


def published(iterations=33_000, harmonics=8):
    start = Start(points(), BOX, points(20) * 2.0, 30, harmonics, torch.Generator().manual_seed(0))
    return host("hexplane").create(host_config("hexplane", "reference", iterations), start), start


def test_the_published_field_moves_everything_from_the_start():
    module, start = published()
    deltas = module(points(7), torch.tensor([0.5])).moved()
    assert {n: tuple(d.shape[1:]) for n, d in deltas.items()} == {
        "means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (8, 3),
    }  # fmt: skip
    assert all(float(d.abs().max()) > 0 for d in deltas.values())
    assert torch.equal(module.box, torch.stack([start.points.amin(0), start.points.amax(0)]))
    assert module.temporal[0].shape[2] == 150


def test_the_published_field_reaches_only_the_upper_half_of_time():
    module, _ = published()
    with torch.no_grad():
        for plane in module.temporal:
            plane[:, :, :75] = 0.0
    still = module.features_at(points(), torch.tensor([0.0]))
    with torch.no_grad():
        for plane in module.temporal:
            plane[:, :, :74] = 7.0
    assert torch.equal(module.features_at(points(), torch.tensor([0.0])), still)
    assert torch.equal(
        module.features_at(points(), torch.tensor([0.5])), module.features_at(points(), torch.tensor([0.5]))
    )


def test_the_published_smoothness_never_sees_x():
    """Planes are stored as [second axis, first axis], and only differences along rows count, so x is never smoothed."""
    for plane_index, axis, counts in ((0, 3, False), (0, 2, True), (1, 3, False), (2, 2, True), (2, 3, False)):
        module, _ = published()
        with torch.no_grad():
            for p in module.spatial:
                p.fill_(0.3)
            flat = float(module.regularisation())
            module.spatial[plane_index].select(axis, 4).add_(1.0)
            assert (float(module.regularisation()) > flat + 1e-12) == counts


def test_published_rates_are_times_the_extent_and_end_with_20_000_steps_of_the_field():
    module, _ = published()
    groups = {g["name"]: g for g in module.parameter_groups()}
    assert groups["field"]["lr"] == pytest.approx(1.6e-3 * 1.1)
    assert groups["heads"]["lr_end"] == pytest.approx(1.6e-5 * 1.1)
    assert (groups["field"]["since"], groups["field"]["until"]) == pytest.approx((3 / 33, 23 / 33))
