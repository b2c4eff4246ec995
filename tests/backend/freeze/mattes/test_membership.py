"""Votes and membership of Gaussians, compared pixel by pixel with the rasteriser's reference implementation."""

import pytest
import torch

from torch_backend.freeze.frozen import FrozenGaussians
from torch_backend.freeze.mattes.membership import RIM, membership, render_members, rule_out, vote
from torch_backend.raster import rasterize

VIEW, K = torch.eye(4), torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])


def scene(means, scales, logits):
    n = len(means)
    state = {
        "means": torch.tensor(means),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        "log_scales": torch.tensor(scales).log()[:, None].repeat(1, 3),
        "opacity_logits": torch.tensor(logits),
        "sh0": torch.zeros(n, 1, 3),
        "shN": torch.zeros(n, 0, 3),
    }
    return FrozenGaussians(state, 0, torch.ones(n), torch.zeros(n))


def test_a_vote_is_the_share_of_what_is_seen():
    """Compared with float64 weights; each Gaussian is rendered in a separate channel."""
    frozen = scene([[0.0, 0.0, 2.0], [0.2, 0.1, 3.0], [-0.5, 0.0, 2.5]], [0.2, 0.3, 0.1], [2.0, 3.0, 0.5])
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(24, 32, 2, generator=generator)
    state = {name: frozen.state[name].double() for name in ("means", "quats", "log_scales", "opacity_logits")}
    each = rasterize(
        **state, colors=torch.eye(3).double(), viewmats=VIEW[None].double(), Ks=K[None].double(), width=32, height=24,
        backend="reference",
    ).colors[0]  # fmt: skip
    expected = torch.einsum("hwn,hwc->nc", each, weights.double())
    found = vote(frozen, VIEW, K, weights, torch.full((24, 32), 4.0)).double()
    assert torch.allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_gaussian_outside_the_picture_gets_no_vote():
    frozen = scene([[1.3, 0.0, 2.0], [0.0, 0.0, 2.0]], [0.5, 0.2], [3.0, 3.0])
    votes = vote(frozen, VIEW, K, torch.ones(24, 32, 1), torch.full((24, 32), 2.0))
    assert votes[0] == 0.0 < votes[1]


def test_a_wall_that_shines_through_a_person_is_none_of_them():
    """A person's front at depth 2, back at 2.15, and a wall at 3 with one Gaussian behind the person and one beside
    them."""
    means = [[0.0, 0.0, 2.0], [0.0, 0.0, 2.15], [0.0, 0.0, 3.0], [1.3, 0.0, 3.0]]
    frozen = scene(means, [0.2, 0.2, 0.2, 0.1], [0.0] * 4)
    person = torch.zeros(24, 32)
    person[4:20, 8:24] = 1.0
    pictures = torch.stack([person, torch.ones(24, 32)], dim=-1)
    votes = vote(frozen, VIEW, K, pictures, torch.where(person > 0.0, 2.0, 3.0))
    shares, known = membership(votes).unbind(1)
    assert shares[:2].tolist() == pytest.approx([1.0, 1.0], abs=0.05) and known[:2].tolist() == [1.0, 1.0]
    assert votes[2].tolist() == [0.0, 0.0], "nothing is said of what a person hides"
    assert known[3] == 1.0 and shares[3] < 0.05


def test_members_are_rendered_as_shares_of_what_is_known():
    frozen = scene([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]], [0.3, 0.6], [0.0, 4.0])
    votes = torch.tensor([[0.0, 0.0], [8.0, 10.0]])  # the first Gaussian was never seen
    members = membership(votes)
    assert members.tolist() == [[0.0, 0.0], [0.800000011920929, 1.0]]
    middle = render_members(frozen, members, VIEW, K, 32, 24)[12, 16]
    assert abs(float(middle[0]) - 0.8) < 1e-3 and 0.3 < float(middle[1]) < 0.7


def test_distant_unseen_gaussians_are_not_members():
    line = torch.stack([torch.linspace(0.0, 1.0, 101), torch.zeros(101), torch.zeros(101)], dim=1)
    means = torch.cat([line, torch.tensor([[1.0, 0.5 * RIM, 0.0], [1.0, 3.0 * RIM, 0.0], [0.5, 2.0, 0.0]])])
    votes = torch.zeros(104, 2)
    votes[:101] = 5.0
    votes[103] = torch.tensor([4.0, 4.0])  # seen, so its votes are kept
    known = membership(rule_out(votes, means))
    assert known[101].tolist() == [0.0, 0.0] and known[102].tolist() == [0.0, 1.0] and known[103].tolist() == [1.0, 1.0]
    assert torch.equal(rule_out(torch.zeros(104, 2), means), torch.zeros(104, 2))
