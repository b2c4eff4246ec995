"""The fused Adam, compared with torch's on both implementations: equal results, skipped rows, dropped steps,
checkpoints."""

import math
import subprocess
import sys
import weakref
from pathlib import Path

import pytest
import torch

from torch_backend.gaussians import Gaussians
from torch_backend.train.adam import FusedAdam, all_finite
from torch_backend.train.checkpoint import optimizer_state, restore_optimizer

ROOT = Path(__file__).parents[3]

BODIES = [pytest.param(False, id="snippet"), pytest.param(True, id="kernel")]
SHAPES = [(3001, 3), (3001,), (3001, 1, 3), (3001, 8, 3), (7,), (1, 16, 9, 11)]


def parameters(seed=0):
    g = torch.Generator().manual_seed(seed)
    created = [torch.nn.Parameter(torch.randn(shape, generator=g)) for shape in SHAPES]
    created[-1] = torch.nn.Parameter(created[-1].detach().contiguous(memory_format=torch.channels_last))
    return created


def groups(params):
    return [{"params": [p], "lr": 10.0 ** -(1 + n % 4), "rows": n < 4} for n, p in enumerate(params)]


def give_gradients(params, generator, scale=1.0):
    for p in params:
        spread = torch.exp(3 * torch.randn(p.shape, generator=generator))
        p.grad = scale * spread * torch.randn(p.shape, generator=generator)


@pytest.mark.parametrize("kernel", BODIES)
def test_sixty_steps_match_torch(kernel):
    ours, theirs = parameters(), [torch.nn.Parameter(p.detach().double()) for p in parameters()]
    fused = FusedAdam(groups(ours), eps=1e-15, kernel=kernel)
    reference = torch.optim.Adam([{k: v for k, v in g.items() if k != "rows"} for g in groups(theirs)], eps=1e-15)
    singles = parameters()
    single = torch.optim.Adam([{k: v for k, v in g.items() if k != "rows"} for g in groups(singles)], eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for step in range(60):
        give_gradients(ours, generator)
        for p, q, r in zip(ours, theirs, singles, strict=True):
            q.grad, r.grad = p.grad.double(), p.grad.clone()
        for optimizer in (fused, reference, single):
            for group in optimizer.param_groups:
                group["lr"] *= 0.99
            optimizer.step()
        assert bool(fused.applied), step
    for p, q, r in zip(ours, theirs, singles, strict=True):
        error, floor = ((x.detach().double() - q.detach()).abs().max() for x in (p, r))
        assert float(error) <= max(3.0 * float(floor), 1e-6)


@pytest.mark.parametrize("kernel", BODIES)
def test_a_row_twice_as_far_moves_twice_as_fast(kernel):
    unit_distance = 4.0
    ours = parameters()[:4]
    with torch.no_grad():
        for p in ours:  # from below one unit, which counts as one, to a hundred
            p.mul_(torch.logspace(-2, 2, len(p)).view(-1, *[1] * (p.dim() - 1)))
    theirs = [torch.nn.Parameter(p.detach().double()) for p in ours]
    fused = FusedAdam([{**g, "lr_unit_distance": unit_distance} for g in groups(ours)], eps=1e-15, kernel=kernel)
    reference = torch.optim.Adam([{k: v for k, v in g.items() if k != "rows"} for g in groups(theirs)], eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for _ in range(50):
        give_gradients(ours, generator)
        for p, q in zip(ours, theirs, strict=True):
            q.grad = p.grad.double()
        before = [q.detach().clone() for q in theirs]
        fused.step()
        reference.step()
        for q, was in zip(theirs, before, strict=True):
            length = was.reshape(len(was), -1).norm(dim=1).clamp_min(1.0).view(-1, *[1] * (was.dim() - 1))
            q.data = was + (q.data - was) * length / unit_distance
    for p, q in zip(ours, theirs, strict=True):
        assert float(((p.detach() - q.detach()).abs() / q.detach().abs().clamp_min(1.0)).max()) < 2e-5


@pytest.mark.parametrize("kernel", BODIES)
def test_rows_that_are_not_visible_stay_with_their_moments(kernel):
    params = parameters()
    optimizer = FusedAdam(groups(params), kernel=kernel)
    generator = torch.Generator().manual_seed(2)
    give_gradients(params, generator)
    optimizer.step()
    before = [(p.detach().clone(), {k: v.clone() for k, v in optimizer.state[p].items()}) for p in params]
    whole = parameters()
    reference = FusedAdam(groups(whole), kernel=kernel)
    for p, (value, state) in zip(whole, before, strict=True):
        p.data.copy_(value)
        reference.state[p] = {k: v.clone() for k, v in state.items()}
    give_gradients(params, generator)
    for p, q in zip(params, whole, strict=True):
        q.grad = p.grad.clone()
    visible = torch.rand(3001, generator=generator) > 0.4
    optimizer.step(visible=visible)
    reference.step()
    for n, (p, q) in enumerate(zip(params, whole, strict=True)):
        for name in ("value", "exp_avg", "exp_avg_sq"):
            now, then, full = (
                (x.detach() if name == "value" else s[name])
                for x, s in ((p, optimizer.state[p]), (before[n][0], before[n][1]), (q, reference.state[q]))
            )
            if n < 4:
                assert torch.equal(now[~visible], then[~visible])
                assert torch.equal(now[visible], full[visible])
            else:
                assert torch.equal(now, full)


@pytest.mark.parametrize("kernel", BODIES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["first", "last", "guard"])
def test_a_step_that_is_not_finite_changes_nothing(kernel, bad, where):
    params = parameters()
    optimizer = FusedAdam(groups(params), kernel=kernel)
    generator = torch.Generator().manual_seed(3)
    give_gradients(params, generator)
    optimizer.step()
    before = [(p.detach().clone(), {k: v.clone() for k, v in optimizer.state[p].items()}) for p in params]
    give_gradients(params, generator)
    guard = torch.tensor(bad if where == "guard" else 1.0)
    if where != "guard":
        params[0 if where == "first" else -1].grad.view(-1)[-1] = bad
    optimizer.step(guard=[guard])
    assert not bool(optimizer.applied)
    for p, (value, state) in zip(params, before, strict=True):
        assert torch.equal(p.detach(), value)
        assert all(torch.equal(optimizer.state[p][k], v) for k, v in state.items())
    give_gradients(params, generator)
    optimizer.step(guard=[torch.tensor(1.0)])
    assert bool(optimizer.applied)
    assert float(optimizer.state[params[0]]["step"]) == 2


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_one_value_that_is_not_finite_is_found_wherever_it_lies(bad):
    tensors = [torch.full((5,), 3e38), torch.full((3001, 3), -3e38), torch.zeros(1, 16, 9, 11)]
    assert all_finite(tensors, threads=2)
    for values in tensors:
        for place in (0, values.numel() // 2, values.numel() - 1):
            kept = float(values.view(-1)[place])
            values.view(-1)[place] = bad
            assert not all_finite(tensors, threads=2)
            values.view(-1)[place] = kept
    assert all_finite([])


@pytest.mark.parametrize("kernel", BODIES)
def test_huge_gradients_whose_sum_overflows_are_finite(kernel):
    p = torch.nn.Parameter(torch.zeros(64))
    p.grad = torch.full((64,), 1e38)
    optimizer = FusedAdam([p], kernel=kernel)
    optimizer.step()
    assert bool(optimizer.applied)


@pytest.mark.parametrize("kernel", BODIES)
def test_range_is_kept(kernel):
    p = torch.nn.Parameter(torch.linspace(-2, 2, 37))
    p.grad = torch.linspace(-1, 1, 37)
    FusedAdam([{"params": [p], "clamp": (-1.0, 1.5)}], lr=0.1, kernel=kernel).step()
    assert float(p.detach().min()) == -1.0
    assert float(p.detach().max()) == 1.5


def test_any_number_of_threads_gives_the_same_bits():
    results = []
    for threads in (1, 2, 3, 8):
        params = parameters()
        optimizer = FusedAdam(groups(params), threads=threads)
        generator = torch.Generator().manual_seed(4)
        for _ in range(3):
            give_gradients(params, generator)
            optimizer.step(visible=torch.rand(3001, generator=generator) > 0.5)
        results.append(torch.cat([p.detach().flatten() for p in params]))
    assert all(torch.equal(results[0], repeated) for repeated in results[1:])


@pytest.mark.parametrize("kernel", BODIES)
def test_parameters_without_gradient_stay_without_state(kernel):
    p, q = torch.nn.Parameter(torch.zeros(4)), torch.nn.Parameter(torch.zeros(4))
    optimizer = FusedAdam([p, q], kernel=kernel)
    p.grad = torch.ones(4)
    optimizer.step()
    assert q not in optimizer.state
    assert float(q.detach().abs().max()) == 0.0
    before = p.detach().clone()
    p.grad, q.grad = None, torch.ones(4)  # not the one of the step before
    optimizer.step()
    assert torch.equal(p.detach(), before) and float(q.detach().abs().min()) > 0.0


@pytest.mark.parametrize("kernel", BODIES)
def test_moments_that_are_put_back_count_from_the_next_step(kernel):
    """As in a repair during a run: the parameter stays the same, but its moments and its memory are replaced."""
    p, q = (torch.nn.Parameter(torch.ones(6)) for _ in range(2))
    ours, theirs = FusedAdam([p], lr=0.1, kernel=kernel), torch.optim.Adam([q], lr=0.1, eps=1e-15)
    for step in range(6):
        p.grad, q.grad = torch.full((6,), 1.0 + step), torch.full((6,), 1.0 + step)
        if step == 2:
            for optimizer, value in ((ours, p), (theirs, q)):
                for name in ("exp_avg", "exp_avg_sq"):
                    optimizer.state[value][name] = torch.full((6,), 0.25)
        if step == 4:
            p.data, q.data = p.data.clone() + 1.0, q.data.clone() + 1.0
        ours.step()
        theirs.step()
    torch.testing.assert_close(p.detach(), q.detach(), rtol=1e-5, atol=1e-6)


def gaussians():
    g = torch.Generator().manual_seed(5)
    shapes = {"means": (9, 3), "quats": (9, 4), "log_scales": (9, 3), "opacity_logits": (9,), "sh0": (9, 1, 3),
              "shN": (9, 8, 3)}  # fmt: skip
    return Gaussians({name: torch.randn(shape, generator=g) for name, shape in shapes.items()}, 4)


@pytest.mark.parametrize("kernel", BODIES)
def test_checkpoints_of_torch_adam_go_on(kernel):
    """State names are torch's: the fused Adam continues a state of torch.optim.Adam, up to rounding."""
    old, new = gaussians(), gaussians()
    generator = torch.Generator().manual_seed(6)
    first = torch.optim.Adam(list(old.params.values()), lr=1e-2, eps=1e-15, fused=True)
    give_gradients(old.params.values(), generator)
    first.step()
    stored = optimizer_state(dict(old.params), first)
    for name, p in new.params.items():
        p.data.copy_(old.params[name].detach())
    second = FusedAdam(list(new.params.values()), lr=1e-2, kernel=kernel)
    restore_optimizer(dict(new.params), second, stored)
    for _ in range(5):
        give_gradients(old.params.values(), generator)
        for name, p in new.params.items():
            p.grad = old.params[name].grad.clone()
        first.step()
        second.step()
    for name, p in new.params.items():
        torch.testing.assert_close(p.detach(), old.params[name].detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kernel", BODIES)
def test_growth_keeps_moments_and_later_groups_join(kernel):
    model = gaussians()
    optimizer = FusedAdam([{"params": [p], "rows": True} for p in model.params.values()], lr=1e-2, kernel=kernel)
    generator = torch.Generator().manual_seed(7)
    give_gradients(model.params.values(), generator)
    optimizer.step()
    moments = optimizer.state[model.params["means"]]["exp_avg"].clone()
    fresh = torch.tensor([False, False, True])
    model.rebuild(torch.tensor([4, 2, 2]), fresh, optimizer)
    kept = optimizer.state[model.params["means"]]["exp_avg"]
    assert torch.equal(kept[:2], moments[[4, 2]])
    assert float(kept[2].abs().max()) == 0.0
    late = torch.nn.Parameter(torch.zeros(5))
    optimizer.add_param_group({"params": [late], "lr": 0.1})
    give_gradients([*model.params.values(), late], generator)
    optimizer.step(visible=torch.tensor([True, False, True]))
    assert float(late.detach().abs().min()) > 0.0


@pytest.mark.parametrize("kernel", BODIES)
def test_what_growth_replaced_is_let_go_of(kernel):
    """On a GPU these are most of a run's memory, and the next forward pass comes before the next optimiser step."""
    model = gaussians()
    optimizer = FusedAdam([{"params": [p], "rows": True} for p in model.params.values()], lr=1e-2, kernel=kernel)
    give_gradients(model.params.values(), torch.Generator().manual_seed(8))
    optimizer.step()
    means = model.params["means"]
    before = [weakref.ref(means), weakref.ref(optimizer.state[means]["exp_avg"])]
    del means
    model.rebuild(torch.tensor([0, 1, 1]), torch.zeros(3, dtype=torch.bool), optimizer)
    assert [reference() for reference in before] == [None, None]


def test_wrong_calls_are_named():
    p = torch.nn.Parameter(torch.zeros(3, dtype=torch.float64))
    p.grad = torch.zeros(3, dtype=torch.float64)
    with pytest.raises(ValueError, match="float32"):
        FusedAdam([p]).step()
    with pytest.raises(ValueError, match="closure"):
        FusedAdam([torch.nn.Parameter(torch.zeros(1))]).step(closure=lambda: 0.0)  # type: ignore[arg-type]


def test_restored_moments_lie_where_their_parameter_does():
    """Checkpoints are loaded to the CPU; torch's `meta` device stands for a GPU here."""
    stored = {f"adam.{name}.a": torch.ones(5, 3) for name in ("exp_avg", "exp_avg_sq")}
    stored["adam.step.a"] = torch.tensor(7.0)
    for device, dtype in (("meta", torch.float32), ("cpu", torch.float64)):
        a = torch.zeros(3, 5, device=device, dtype=dtype).T.requires_grad_()
        optimizer = torch.optim.Adam([a])
        restore_optimizer({"a": a}, optimizer, stored)
        state = optimizer.state[a]
        for name in ("exp_avg", "exp_avg_sq"):
            assert (state[name].device, state[name].dtype, state[name].stride()) == (a.device, dtype, a.stride())
        assert (state["step"].device.type, state["step"].dtype, state["step"].shape) == (device, torch.float32, ())


def test_no_process_that_trains_waits_for_torchs_compiler():
    code = (
        "import sys, torch\n"
        "from torch_backend.train.adam import FusedAdam\n"
        "from torch_backend.torch_types import weighted_gradient\n"
        "x = torch.nn.Parameter(torch.ones(3)); adam = FusedAdam([x], 0.1)\n"
        "x.square().sum().backward(); adam.step(); adam.zero_grad()\n"
        "assert x.grad is None and float(x.detach().max()) < 1.0, x\n"
        "assert weighted_gradient(3.0 * x, x, torch.arange(3.0)).tolist() == [0.0, 3.0, 6.0]\n"
        "sys.exit(', '.join({'torch._dynamo', 'sympy'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
