"""Adding and removing Gaussians: copied state, reset state, and invariants of a split."""

import pytest
import torch

from torch_backend.gaussians import Densifier, DensifyConfig, Gaussians
from torch_backend.gaussians.model import PARAM_NAMES, pack_bits, unpack_bits


def small_model(count=6, bins=11, sh=4):
    g = torch.Generator().manual_seed(0)
    params = {
        "means": torch.randn(count, 3, generator=g),
        "quats": torch.randn(count, 4, generator=g),
        "log_scales": torch.randn(count, 3, generator=g) * 0.3 - 2.0,
        "opacity_logits": torch.randn(count, generator=g),
        "sh0": torch.randn(count, 1, 3, generator=g),
        "shN": torch.randn(count, sh - 1, 3, generator=g),
    }
    model = Gaussians(params, bins)
    model.support = torch.rand(count, bins, generator=g) > 0.5
    model.open[::2] = True
    return model


def adam(model):
    return torch.optim.Adam([{"params": [p], "lr": 0.01, "name": n} for n, p in model.params.items()])


@pytest.mark.parametrize("bins", [2, 8, 9, 64, 75])
def test_bitmap_packs_and_unpacks(bins):
    flags = torch.rand(13, bins, generator=torch.Generator().manual_seed(bins)) > 0.5
    assert torch.equal(unpack_bits(pack_bits(flags), bins), flags)


def test_rebuild_inherits_gate_support_and_moments():
    model = small_model()
    optimizer = adam(model)
    sum(p.square().sum() for p in model.params.values()).backward()
    optimizer.step()
    before = {n: optimizer.state[p]["exp_avg"].clone() for n, p in model.params.items()}
    support, is_open, means = model.support.clone(), model.open.clone(), model.params["means"].detach().clone()
    rows, fresh = torch.tensor([5, 0, 0]), torch.tensor([False, False, True])
    model.rebuild(rows, fresh, optimizer)
    assert torch.equal(model.params["means"], means[rows])
    assert torch.equal(model.support, support[rows])
    assert torch.equal(model.open, is_open[rows])
    for name, parameter in model.params.items():
        moment = optimizer.state[parameter]["exp_avg"]
        assert torch.equal(moment[:2], before[name][rows[:2]])
        assert not moment[2].any()
    sum(p.square().sum() for p in model.params.values()).backward()
    optimizer.step()
    assert not torch.equal(model.params["means"], means[rows])


def covariance(model, rows):
    p = model.params
    w, x, y, z = torch.nn.functional.normalize(p["quats"][rows], dim=1).detach().unbind(1)
    from scipy.spatial.transform import Rotation

    R = torch.from_numpy(Rotation.from_quat(torch.stack([x, y, z, w], 1).numpy()).as_matrix()).float()
    S = torch.diag_embed(p["log_scales"][rows].detach().exp() ** 2)
    return R @ S @ R.transpose(1, 2)


def test_split_keeps_mean_second_moment_and_mass():
    model = small_model()
    optimizer = adam(model)
    densifier = Densifier(DensifyConfig(budget=7, start=0.0, stop=1.0, prune_opacity=0.0, max_scale=1e9), len(model))
    gradient = torch.zeros(6)
    gradient[3] = 1.0
    densifier.observe(gradient, torch.ones(6))
    mean, cov = model.params["means"][3].detach().clone(), covariance(model, torch.tensor([3]))[0]
    peak = float(torch.sigmoid(model.params["opacity_logits"].detach()[3]))
    assert densifier.step(model, optimizer, 6, 0.9999) == (1, 0)
    assert len(model) == 7
    children = torch.tensor([5, 6])
    means = model.params["means"][children].detach()
    torch.testing.assert_close(means.mean(0), mean)
    spread = means - mean
    mixture = covariance(model, children).mean(0) + (spread[:, :, None] * spread[:, None, :]).mean(0)
    torch.testing.assert_close(mixture, cov, rtol=1e-4, atol=1e-6)
    opacity = torch.sigmoid(model.params["opacity_logits"][children]).detach()
    # Two children, with one axis 1.6 times shorter, keep the parent's mass.
    assert float(opacity.sum()) / 1.6 == pytest.approx(peak, rel=1e-4)


def test_budget_is_never_exceeded_and_nan_is_pruned():
    model = small_model(count=20)
    optimizer = adam(model)
    with torch.no_grad():
        model.params["means"][4] = float("nan")
        model.params["opacity_logits"][7] = -9.0
    densifier = Densifier(DensifyConfig(budget=23, start=0.0, stop=1.0), 20)
    densifier.observe(torch.rand(20), torch.ones(20))
    split, pruned = densifier.step(model, optimizer, 20, 0.99)
    assert pruned >= 2
    assert len(model) <= 23
    assert split > 0
    assert torch.isfinite(model.params["means"]).all()


def test_host_parameters_survive_growth_and_checkpoints():
    model = small_model()
    hyper = model.adopt("hyper", (2,), -0.01)
    with torch.no_grad():
        hyper += torch.arange(6.0)[:, None]
    model.hidden[3, 5] = True
    optimizer = adam(model)
    hyper.grad = torch.ones_like(hyper)
    optimizer.step()
    values, moments = hyper.detach().clone(), optimizer.state[hyper]["exp_avg"].clone()
    parent = torch.tensor([0, 3, 3, 5])
    model.rebuild(parent, torch.tensor([False, False, True, False]), optimizer)
    grown = model.params["hyper"]
    assert torch.equal(grown.detach(), values[parent])
    assert torch.equal(optimizer.state[grown]["exp_avg"][[0, 1, 3]], moments[[0, 3, 5]])
    assert not bool(optimizer.state[grown]["exp_avg"][2].any())
    assert torch.nonzero(model.hidden).tolist() == [[1, 5], [2, 5]]
    assert torch.equal(model.host_params(torch.tensor([2]))["hyper"], grown[2:3])
    again = Gaussians.from_state(model.state(), 11)
    assert torch.equal(again.params["hyper"], grown)
    assert torch.equal(again.hidden, model.hidden)
    assert list(again.params)[: len(PARAM_NAMES)] == list(PARAM_NAMES)
    with pytest.raises(ValueError, match="hyper"):
        again.adopt("hyper", (), 0.0)
