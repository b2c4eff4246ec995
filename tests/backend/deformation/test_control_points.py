"""Host C (control points): skinning compared with hand-computed values, penalties, and nodes that are added later."""

import math

import pytest
import torch

from torch_backend.deformation.control_points import (
    ControlPoints,
    ControlPointsConfig,
)
from torch_backend.deformation.geometry import near_identity
from torch_backend.deformation.node_energies import acceleration_energy, arap_energy, elastic_energy
from torch_backend.deformation.registry import host_config
from torch_backend.gaussians.rotations import rotation_matrices

BOX = torch.tensor([[-2.0] * 3, [2.0] * 3])


def field(places, **changes):
    g = torch.Generator().manual_seed(0)
    return ControlPoints(ControlPointsConfig(width=16, depth=2, **changes), torch.tensor(places), BOX, 10, g)


def let_nodes_do(module, frame=(0.0, 0, 0, 0), shift=(0.0, 0, 0)):
    """Make all nodes move alike: the heads output constants."""
    with torch.no_grad():
        for head in module.heads.values():
            head.weight.zero_()
        module.heads["means"].bias.copy_(torch.tensor(shift))
        module.heads["quats"].bias.copy_(torch.tensor(frame))
    return module


def test_shares_are_those_of_the_paper():
    module = field([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], hyper=1)
    with torch.no_grad():
        module.log_radii.copy_(torch.tensor([0.5, 1.0, 2.0, 1.0]).log())
        module.weights.copy_(torch.tensor([0.0, 1.0, 0.0, 0.0]))
        module.hyper.zero_()
    x, hyper = torch.tensor([[0.2, 0.1, 0.0]]), torch.tensor([[0.3]])
    index, share = module._skin(x, hyper)
    want = {}
    for k, (place, radius, logit) in enumerate([((0, 0), 0.5, 0), ((1, 0), 1.0, 1), ((0, 1), 2.0, 0)]):
        squared = (0.2 - place[0]) ** 2 + (0.1 - place[1]) ** 2 + 0.3**2
        want[k] = math.exp(-squared / (2 * radius**2)) / (1 + math.exp(-logit)) + 1e-7
    total = sum(want.values())
    got = dict(zip(index[0].tolist(), share[0].tolist(), strict=True))
    assert got == pytest.approx({k: v / total for k, v in want.items()}, rel=1e-5)


def test_a_node_turns_what_follows_it_about_itself():
    half = math.tan(math.pi / 8)  # (1, 0, 0, tan(a / 2)) is a rotation by a about z
    module = let_nodes_do(field([[1.0, 0, 0]]), frame=(0.0, 0, 0, half), shift=(0.0, 0.5, 0))
    x = torch.tensor([[2.0, 0, 0], [1.0, 0, 0]])
    deltas = module(x, torch.tensor([0.3]))
    root = math.sqrt(0.5)
    assert (x + deltas.means)[0].tolist() == pytest.approx([1 + root, 0.5 + root, 0], abs=1e-5)
    assert (x + deltas.means)[1].tolist() == pytest.approx([1, 0.5, 0], abs=1e-5)
    turned = module.rules["quats"](torch.tensor([[1.0, 0, 0, 0]] * 2), deltas.quats)
    assert rotation_matrices(turned)[0, 0].tolist() == pytest.approx([root, -root, 0], abs=1e-5)


def test_hyper_coordinates_say_whom_to_follow():
    """Two Gaussians at one place can follow different nodes; SC-GS adds the hyper dimensions for this case."""
    module = field([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], hyper=1)
    with torch.no_grad():
        module.log_radii.fill_(math.log(0.2))
        module.hyper.copy_(torch.tensor([[0.0], [0.0], [1.0], [1.0]]))
    x = torch.tensor([[0.15, 0, 0]]).repeat(2, 1)
    index, share = module._skin(x, torch.tensor([[0.0], [1.0]]))
    for row, pair in ((0, {0, 1}), (1, {2, 3})):
        kept = {int(k): float(s) for k, s in zip(index[row], share[row].tolist(), strict=True)}
        assert sum(s for k, s in kept.items() if k in pair) > 0.999


@pytest.mark.parametrize("configuration", ["default", "reference"])
def test_blending_is_linear_blend_skinning_of_the_nodes(configuration):
    """Compared with the sum over nodes as in SC-GS, in float64."""
    g = torch.Generator().manual_seed(3)
    config = host_config("control_points", configuration, 1000)
    module = ControlPoints(config, torch.randn(40, 3, generator=g), BOX, 10, g)
    with torch.no_grad():
        for head in module.heads.values():
            head.weight.normal_(std=0.1, generator=g)
        module.weights.normal_(generator=g)
    x, hyper, times = (
        torch.randn(30, 3, generator=g),
        torch.randn(30, config.hyper, generator=g),
        torch.rand(30, generator=g),
    )
    got = module(x, times, {"hyper": hyper})
    index, share = module._skin(x, hyper)
    moved, turned = torch.zeros(30, 3, dtype=torch.float64), torch.zeros(30, 4, dtype=torch.float64)
    for m in range(30):
        for k, s in zip(index[m].tolist(), share[m].double(), strict=True):
            place = module.places[k : k + 1]
            motion = module.node_motion(place, times[m : m + 1])
            rotation = rotation_matrices(near_identity(motion.frame.double()))[0]
            moved[m] += s * (rotation @ (x[m] - place[0]).double() + place[0] + motion.shift[0])
            turned[m] += s * motion.quats[0].double()
    torch.testing.assert_close((x + got.means).double(), moved, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(got.quats.double(), turned, rtol=1e-5, atol=1e-5)


def test_hyper_coordinates_learn_and_places_do_not():
    module = field([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with torch.no_grad():
        module.heads["means"].weight.normal_(generator=torch.Generator().manual_seed(1))
    x = torch.rand(5, 3, requires_grad=True)
    hyper = torch.full((5, 2), -0.01, requires_grad=True)
    module(x, torch.tensor([0.4]), {"hyper": hyper}).means.square().sum().backward()
    assert float(hyper.grad.abs().sum()) > 0
    assert float(module.hyper.grad.abs().sum()) > 0
    assert float(module.log_radii.grad.abs().sum()) > 0
    assert x.grad is None
    assert not module.places.requires_grad


def test_equal_nodes_and_far_gaussians_are_finite():
    module = field([[0.0, 0, 0]] * 5)
    hyper = torch.full((2, 2), -0.01, requires_grad=True)
    deltas = module(torch.tensor([[0.0, 0, 0], [1e4, 0, 0]]), torch.tensor([0.0, 1.0]), {"hyper": hyper})
    total = torch.stack([d.square().sum() for d in deltas.moved().values()]).sum()
    (total + module.regularisation(0.1, torch.Generator().manual_seed(0))).backward()
    assert bool(torch.isfinite(total))
    assert bool(torch.isfinite(hyper.grad).all())
    assert all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in module.parameters())


def test_rigid_motion_costs_no_arap_and_stretching_does():
    g = torch.Generator().manual_seed(2)
    places = 0.3 * torch.rand(60, 3, generator=g)
    turn = rotation_matrices(torch.nn.functional.normalize(torch.tensor([[1.0, 0.2, -0.3, 0.5]]), dim=1))[0]
    moved = places @ turn.T + 1.0
    assert float(arap_energy(places, moved)) < 1e-8
    stretched = places * torch.tensor([1.5, 1.0, 1.0])
    # The best rotation leaves a residual on every edge: above zero, below the full stretch.
    assert 1e-3 < float(arap_energy(places, stretched)) < 60 * 10 * 0.3**2


def test_arap_leaves_far_neighbours_beyond_the_third_out():
    line = torch.arange(6.0)[:, None] * torch.tensor([[1.0, 0, 0]])
    moved = line.clone()
    moved[5, 1] = 4.0
    # The three nearest neighbours of node 0 are nodes 1, 2 and 3; node 5 is not among them.
    only = arap_energy(line[:5], moved[:5])
    assert float(only) < 1e-8
    assert float(arap_energy(line, moved)) > 0.1


def test_penalties_are_finite_at_collapsed_nodes():
    paths = torch.zeros(8, 12, 3, requires_grad=True)
    (elastic_energy(paths) + acceleration_energy(paths[:3]) + arap_energy(paths[0], paths[1])).backward()
    assert bool(torch.isfinite(paths.grad).all())


def test_elastic_and_acceleration_pull_the_right_way():
    times = torch.linspace(0, 1, 8)
    paths = torch.zeros(8, 3, 3)
    paths[:, 1, 0] = 1.0 + times
    paths[:, 2, 1] = 3.0
    paths.requires_grad_()
    elastic_energy(paths).backward()
    assert paths.grad[7, 1, 0] > 0  # the edge is longest at the end: gradient descent shortens it
    assert paths.grad[0, 1, 0] < 0
    path = torch.tensor([[[0.0, 0, 0]], [[0.0, 1, 0]], [[0.0, 0, 0]]], requires_grad=True)
    acceleration_energy(path).backward()
    assert path.grad[1, 0, 1] > 0


def test_arap_follows_the_published_schedule():
    module = ControlPoints(
        host_config("control_points", "reference", 80_000), torch.rand(20, 3), BOX, 10, torch.Generator().manual_seed(0)
    )
    weight = {share: module._arap_weight(share / 80) for share in (11, 15, 17.5, 20, 29, 31)}
    assert weight == pytest.approx({11: 1e-4, 15: 1e-4, 17.5: 10**-4.5, 20: 1e-5, 29: 1e-5, 31: 0.0}, rel=1e-6)
    assert module.rehearsal == pytest.approx(0.125)


def test_empty_scene_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        ControlPoints(ControlPointsConfig(), torch.zeros(0, 3), BOX, 10, torch.Generator())
