"""Host B (MLP): the published shape, the published composition rules, and the corrected ones."""

import math

import pytest
import torch

from torch_backend.deformation.geometry import quat_product
from torch_backend.deformation.mlp import Mlp, MlpConfig, blurred, encode
from torch_backend.deformation.protocol import MIN_SCALE, add_to_scale, add_to_unit_quat, turn
from torch_backend.deformation.registry import host_config

BOX = torch.tensor([[-2.0, -2, 0], [2, 2, 4]])


def test_encoding_is_the_value_then_octaves_of_sines_and_cosines():
    got = encode(torch.tensor([[0.3, -0.2]]), 2)
    want = [
        0.3,
        -0.2,
        *(math.sin(k * v) for v in (0.3, -0.2) for k in (1, 2)),
        *(math.cos(k * v) for v in (0.3, -0.2) for k in (1, 2)),
    ]
    assert got[0].tolist() == pytest.approx(want, abs=1e-6)


def test_the_published_network_has_its_published_size():
    field = Mlp(host_config("mlp", "reference", 40_000), BOX, 10, torch.Generator().manual_seed(0))
    sizes = [(layer.in_features, layer.out_features) for layer in field.trunk.layers]
    assert sizes == [(84, 256), *[(256, 256)] * 4, (340, 256), (256, 256), (256, 256)]
    assert {name: head.out_features for name, head in field.heads.items()} == {"means": 3, "quats": 4, "log_scales": 3}
    assert field.config.start == pytest.approx(0.075)


def test_published_scales_are_added_after_exp_and_clamped():
    logs = torch.tensor([[0.1, 0.2, 0.3]]).log().requires_grad_()
    got = add_to_scale(logs, torch.tensor([[0.05, 0.0, -0.4]]))
    assert got.exp()[0].tolist() == pytest.approx([0.15, 0.2, MIN_SCALE])
    got.sum().backward()
    assert logs.grad[0, 2] == 0.0
    assert bool(torch.isfinite(logs.grad).all())


def test_published_rotations_are_added_to_the_unit_quaternion():
    got = add_to_unit_quat(torch.tensor([[2.0, 0, 0, 0]]), torch.tensor([[0.0, 0.5, 0, 0]]))
    assert got[0].tolist() == [1.0, 0.5, 0.0, 0.0]


def test_our_rotations_are_products():
    half = math.sqrt(0.5)
    got = turn(torch.tensor([[3.0, 3.0, 0, 0]]), torch.tensor([[0.0, 0, 1.0, 0]]))
    want = quat_product(torch.tensor([[half, 0, half, 0]]), torch.tensor([[half, half, 0, 0]]))
    torch.testing.assert_close(got, want)
    assert float(got.norm()) == pytest.approx(1.0)


def test_six_dof_starts_static_with_nonzero_gradients():
    field = Mlp(MlpConfig(six_dof=True), BOX, 10, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for head in field.heads.values():
            head.weight.zero_()
    deltas = field(torch.rand(6, 3), torch.tensor([0.5]))
    assert float(deltas.means.detach().abs().max()) < 1e-6
    deltas.means.square().sum().add(deltas.means.sum()).backward()
    grad = field.heads["means"].bias.grad
    assert bool(torch.isfinite(grad).all())
    assert float(grad.abs().sum()) > 0


def test_the_blur_of_time_is_of_frames_and_ends():
    g = torch.Generator().manual_seed(0)
    draws = torch.tensor([blurred(0.5, 20.0, 0.0, 0.1, 0.5, g) for _ in range(2000)])
    assert float(draws.mean()) == pytest.approx(0.5, abs=1e-3)
    assert float(draws.std()) == pytest.approx(0.1 / 20, rel=0.1)
    half = torch.tensor([blurred(0.5, 20.0, 0.25, 0.1, 0.5, g) for _ in range(2000)])
    assert float(half.std()) == pytest.approx(0.05 / 20, rel=0.1)
    assert blurred(0.5, 20.0, 0.5, 0.1, 0.5, g) == 0.5
    ours = Mlp(MlpConfig(), BOX, 10, g)
    assert ours.training_time(0.5, 0.0, g) == 0.5


def test_opacity_and_colour_stay():
    assert set(Mlp(MlpConfig(), BOX, 10, torch.Generator()).forward(torch.rand(2, 3), torch.zeros(1)).moved()) == {
        "means", "quats", "log_scales",
    }  # fmt: skip


def test_means_get_no_gradient_through_the_network():
    x = torch.rand(4, 3, requires_grad=True)
    for config in (MlpConfig(head_std=0.1), MlpConfig(head_std=0.1, six_dof=True)):
        deltas = Mlp(config, BOX, 10, torch.Generator().manual_seed(1))(x, torch.tensor([0.2]))
        assert torch.autograd.grad(deltas.means.sum(), x, allow_unused=True)[0] is None
