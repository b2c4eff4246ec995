"""Non-finite or extreme values are dropped or repaired and reported; the run continues."""

import dataclasses
import math
import sys

import pytest
import torch

from benchmarks.stability import METHODS, configuration, table, train_once
from torch_backend.contract import JobError, TrainParams
from torch_backend.deformation.hexplane import HexPlane
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params
from torch_backend.train.adam import FusedAdam
from torch_backend.train.events import harden_gate, open_gate, schedule_events
from torch_backend.train.optimizer import add_field, schedule_rates
from torch_backend.train.repair import drop_displaced, repair
from torch_backend.train.resume import restore_run, save_run
from torch_backend.train.trainer import Trainer

NAN = math.nan
RATES = ("lr", "lr_start", "lr_end")


@pytest.fixture(scope="module")
def begin(world, quiet, tmp_path_factory):
    """begin(method, steps): trainer on the tiny world after that many steps; the field is added after 20 of 60.

    The steps are only taken once.
    """
    scene, folder = load_scene(world.shot), tmp_path_factory.mktemp("begun")
    pictures = load_images(scene, scene.solved, 64, 48)

    def make(method="hexplane", steps=25, **changes) -> Trainer:
        config = configuration(method, 0, iterations=60, **changes)
        if config.host == "hexplane":
            config.field.resolution = 16  # a step takes a third of the time
        trainer, begun = Trainer(scene, pictures.clone(), scene.solved, config, quiet()), folder / f"{method}-{steps}"
        if begun.is_file():
            restore_run(trainer, begun)
        elif steps:
            go_on(trainer, steps)
            assert not warnings(trainer)
            save_run(trainer, begun)
        return trainer

    return make


def go_on(trainer: Trainer, steps: int) -> list[float]:
    """Run the loop of `Trainer.run` without checkpoints; return the losses of the applied steps."""
    losses = []
    for _ in range(steps):
        schedule_events(trainer)
        loss = float(trainer.step())
        losses += [loss] if bool(trainer.optimizer.applied) else []
        trainer.iteration += 1
        if trainer.iteration % 10 == 0:
            trainer.inspect_nonfinite()
    return losses


def warnings(trainer: Trainer) -> list[str]:
    return trainer.report.warnings


def finite(trainer: Trainer) -> bool:
    params = [p for group in trainer.optimizer.param_groups for p in group["params"]]
    moments = [m for p in params for m in trainer.optimizer.state[p].values()]
    return all(bool(torch.isfinite(t).all()) for t in [*params, *moments])


def aligned(trainer: Trainer) -> bool:
    g, d = trainer.model.gaussians, trainer.densifier
    sizes = {len(t) for t in (*g.params.values(), g.open, g.support, g.hidden, d.gradient, d.seen)}
    optimised = {id(p) for group in trainer.optimizer.param_groups for p in group["params"]}
    return len(sizes) == 1 and all(id(p) in optimised for p in g.params.values())


def gaussian(name, value, row=7):
    def poison(trainer):
        trainer.model.gaussians.params[name].data[row] = value

    return poison


def of_everything(trainer):
    """The quaternion also loses its momentum, which would rotate it."""
    for name, value, row in (
        ("means", torch.tensor([NAN, 0.0, 1.0]), 7), ("log_scales", torch.tensor([math.inf, -3.0, -3.0]), 8),
        ("opacity_logits", NAN, 9), ("sh0", NAN, 10), ("shN", NAN, slice(11, 13)), ("quats", 0.0, 14),
    ):  # fmt: skip
        gaussian(name, value, row)(trainer)
    trainer.optimizer.state[trainer.model.gaussians.params["quats"]]["exp_avg"][14] = 0.0
    trainer.model.exposure.values.data[4, 0, 1] = math.inf


def of_the_field(trainer):
    dict(trainer.model.field.named_parameters())["trunk.weight"].data[3, 2] = NAN


def of_a_moment(trainer):
    """The number is noticed before the next step, which would turn it into NaN and drop the Gaussian."""
    p = trainer.model.gaussians.params["means"]
    trainer.optimizer.state[p]["exp_avg_sq"][7, 0] = math.inf
    trainer.inspect_nonfinite()


@pytest.mark.parametrize(
    ("poison", "words"),
    [
        (
            of_everything,
            "dropped 6 Gaussians (means, log_scales, opacity_logits, sh0, shN not finite), "
            "repaired 1 Gaussian (quats without length), repaired 1 number of exposure",
        ),
        (of_the_field, "repaired 1 number of trunk.weight"),
        (of_a_moment, "cleared 1 moment of Adam"),
    ],
)
def test_bad_numbers_are_named_and_the_run_goes_on(begin, poison, words):
    trainer = begin("hexplane" if poison is of_the_field else "static")
    before = float(torch.tensor(go_on(trainer, 5)).mean())
    count = len(trainer.model.gaussians)
    poison(trainer)
    after = go_on(trainer, 9)  # densification, which drops some of these, is due at 40
    trainer.inspect_nonfinite()
    said = warnings(trainer)
    assert len(said) == 1
    assert words in said[0]
    assert "Step 3" in said[0]
    assert len(after) >= 8
    assert sum(after) / len(after) < 1.3 * before
    assert len(trainer.model.gaussians) == count - (int(words.split()[1]) if words.startswith("dropped") else 0)
    assert finite(trainer)
    go_on(trainer, 15)
    assert len(warnings(trainer)) == 1
    assert aligned(trainer)


def test_what_was_in_order_stays_as_it_was_row_by_row(begin):
    trainer = begin("control_points", 30)
    model, densifier = trainer.model, trainer.densifier
    bad = [3, 10, 11]
    gaussian("means", NAN, 3)(trainer)
    gaussian("sh0", math.inf, slice(10, 12))(trainer)
    gaussian("hyper", NAN, 5)(trainer)
    gaussian("quats", 1e-8, 6)(trainer)
    keep = [n for n in range(len(model.gaussians)) if n not in bad]
    params = {name: p.detach()[keep].clone() for name, p in model.gaussians.params.items()}
    moments = {name: trainer.optimizer.state[p]["exp_avg"][keep].clone() for name, p in model.gaussians.params.items()}
    memory = [t[keep].clone() for t in (model.gaussians.open, model.gaussians.support, densifier.gradient)]
    said = repair(model, trainer.optimizer, densifier, trainer.soundness.memory, 30)
    assert "dropped 3 Gaussians (means, sh0 not finite)" in said
    assert "repaired 1 Gaussian (hyper not finite)" in said
    params["hyper"][4] = model.field.owned["hyper"].value
    params["quats"][5] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    moments["hyper"][4] = moments["quats"][5] = 0.0
    for name, p in model.gaussians.params.items():
        assert torch.equal(p, params[name]), name
        assert torch.equal(trainer.optimizer.state[p]["exp_avg"], moments[name]), name
    for kept, now in zip(memory, (model.gaussians.open, model.gaussians.support, densifier.gradient), strict=True):
        assert torch.equal(kept, now)
    assert repair(model, trainer.optimizer, densifier, trainer.soundness.memory, 30) == ""


def test_non_finite_gradient_removes_only_its_gaussian(begin):
    trainer = begin("static")
    count = len(trainer.model.gaussians)
    trainer.model.gaussians.params["means"].register_hook(lambda g: g.index_fill(0, torch.tensor([4]), NAN))
    assert len(go_on(trainer, 10)) == 9
    (said,) = warnings(trainer)
    assert "was skipped" in said
    assert "dropped 1 Gaussian (gradient of means not finite)" in said
    assert len(trainer.model.gaussians) == count - 1
    assert finite(trainer)
    assert aligned(trainer)


@pytest.mark.parametrize("supervision", ["support", "paper"])
def test_a_frame_with_bad_pixels_is_left_out_from_then_on(begin, supervision):
    trainer = begin(steps=0, supervision=supervision)
    trainer.images[5, 10:12, 20] = NAN
    count = len(trainer.model.gaussians)
    go_on(trainer, 19)
    (said,) = warnings(trainer)
    assert f"excluded frame {trainer.scene.frames[trainer.train_ids[5]]} from the training" in said
    assert len(go_on(trainer, 25)) == 25  # with `paper`, some of these steps use a second frame
    assert len(warnings(trainer)) == 1
    assert finite(trainer)
    assert len(trainer.model.gaussians) >= 0.9 * count


def test_a_bad_frame_does_not_keep_the_gate_shut(begin):
    trainer = begin("auto", steps=0)
    trainer.images[5] = NAN
    go_on(trainer, 19)
    open_gate(trainer)
    go_on(trainer, 5)
    assert 5 in trainer.soundness.unusable
    trainer.config.gate.pixels = 1e-6  # any change counts as motion
    harden_gate(trainer)
    assert bool(trainer.model.gaussians.open.any())
    assert finite(trainer)


@pytest.mark.parametrize("host", ["hexplane", "control_points"])
def test_a_field_that_throws_gaussians_out_of_their_place_is_put_back(begin, host):
    """One step at 100,000 times the learning rates: Gaussians outside the picture have no gradient to return by."""
    trainer = begin(host, 30)
    before = {name: p.detach().clone() for name, p in trainer.model.field.named_parameters()}
    # the field returns to the state of the second last inspection
    loss = float(torch.tensor(go_on(trainer, 19)).mean())
    normal = trainer._schedule_rates
    fields = {id(p) for p in trainer.model.field.parameters()}
    rates = [group["lr_start"] for group in trainer.optimizer.param_groups]

    def hasty():
        normal()
        for group in trainer.optimizer.param_groups:
            if any(id(p) in fields for p in group["params"]):
                group["lr"] *= 1e5

    trainer._schedule_rates = hasty
    trainer.step()
    trainer._schedule_rates = normal
    assert float(trainer.step()) > 1.3 * loss
    trainer.inspect_nonfinite()
    (said,) = warnings(trainer)
    assert "restored the field" in said
    for name, p in trainer.model.field.named_parameters():
        assert torch.equal(p, before[name])
    halved = [now["lr_start"] / was for now, was in zip(trainer.optimizer.param_groups, rates, strict=True)]
    assert sorted(set(halved)) == [0.5, 1.0]
    after = go_on(trainer, 20)
    assert len(after) == 20
    assert sum(after[-10:]) / 10 < 1.2 * loss
    assert len(warnings(trainer)) == 1
    assert finite(trainer)


@pytest.mark.parametrize(("share", "times", "said"), [(0.2, 7.0, 1), (0.2, 5.0, 0), (0.05, 7.0, 0)])
def test_diverged_field_is_restored_between_two_checks(begin, share, times, said):
    """The bound is relative to the extent of moving Gaussians; the extent of the whole scene is many times larger."""
    trainer = begin("hexplane", 30)
    means = trainer.model.gaussians.params["means"].detach()[trainer.model.open_rows()]
    shift = torch.zeros_like(means)
    shift[: round(share * len(means)), 0] = times * (means - means.median(0).values).norm(dim=1).median()
    trainer.soundness.memory.observe(shift)
    trainer.soundness.memory.observe(torch.zeros_like(means))
    trainer.inspect_nonfinite()
    assert len(warnings(trainer)) == said


def farthest(trainer: Trainer) -> torch.Tensor:
    """[N]: largest displacement of each Gaussian along one axis in scene units, 0 if it is static."""
    rows = trainer.model.open_rows()
    far = torch.zeros(len(trainer.model.gaussians))
    with torch.no_grad():
        for time in trainer.model.centres:
            deltas = trainer.model.deltas(rows, time[None])
            far[rows] = torch.maximum(far[rows], deltas.means.abs().amax(1))
    return far


def bound_between(trainer: Trainer, count: int) -> torch.Tensor:
    """Set the bound so that the `count` farthest Gaussians are out of place; return them as bool [N]."""
    far = farthest(trainer)
    first, second = far.sort(descending=True).values[count - 1 : count + 1]
    assert first > second
    trainer.soundness.memory._limit.fill_(float(first + second) / 2)
    return far >= first


def test_only_displaced_outliers_are_dropped(begin):
    trainer = begin("hexplane", 30)
    model, memory = trainer.model, trainer.soundness.memory
    assert drop_displaced(model, trainer.optimizer, trainer.densifier, memory) == 0
    outliers = bound_between(trainer, 7)
    expected = {name: p.detach()[~outliers].clone() for name, p in model.gaussians.params.items()}
    gradient = trainer.densifier.gradient[~outliers].clone()
    assert drop_displaced(model, trainer.optimizer, trainer.densifier, memory) == 7
    for name, p in model.gaussians.params.items():
        assert torch.equal(p, expected[name]), name
    assert torch.equal(trainer.densifier.gradient, gradient)
    assert drop_displaced(model, trainer.optimizer, trainer.densifier, memory) == 0
    assert len(go_on(trainer, 20)) == 20
    assert not warnings(trainer)


@pytest.mark.parametrize("method", ["auto", "hexplane"])
def test_growth_drops_outliers_only_with_a_gate(begin, method):
    """Published hosts without a gate stay as published."""
    trainer = begin(method, 30)
    if method == "auto":
        trainer.policy.gate_hardened(trainer.iteration)  # so early, no Gaussian would stay open
    trainer.config.densify.every = trainer.iteration
    # no other Gaussians are added or dropped
    trainer.densifier.config.budget = trainer.densifier.config.prune_opacity = 0
    count = len(trainer.model.gaussians)
    outliers = bound_between(trainer, 3)
    kept = trainer.model.gaussians.params["means"].detach()[~outliers].clone()
    schedule_events(trainer)
    assert len(trainer.model.gaussians) == count - 3 * (method == "auto")
    if method == "auto":
        assert torch.equal(trainer.model.gaussians.params["means"], kept)


def test_small_gaussian_may_move_by_many_times_its_size(begin):
    trainer = begin("hexplane", 30)
    means = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)) * 0.02
    trainer.soundness.memory.keep(trainer.model.field, means)
    trainer.soundness.memory.observe(torch.full_like(means, 0.9))
    trainer.inspect_nonfinite()
    assert not warnings(trainer)


def test_a_field_that_was_put_back_keeps_its_rates_when_the_run_is_resumed(begin, tmp_path):
    trainer = begin("hexplane", 30)
    trainer.soundness.memory.observe(torch.full((len(trainer.model.open_rows()), 3), 1e6))
    trainer.inspect_nonfinite()
    save_run(trainer, tmp_path / "checkpoint.safetensors")
    resumed = begin("hexplane", 0)
    restore_run(resumed, tmp_path / "checkpoint.safetensors")
    rates = [[group[key] for key in ("lr_start", "lr_end")] for group in trainer.optimizer.param_groups]
    assert [[group[key] for key in ("lr_start", "lr_end")] for group in resumed.optimizer.param_groups] == rates
    lr = trainer.config.field.lr_grid
    assert [0.5 * lr, 0.5 * lr * trainer.config.field.lr_end] in rates


def test_resumed_run_drops_the_same_outliers(begin, tmp_path):
    """Without a stored bound it would drop nothing until its next inspection, and a round of growth may come first."""
    trainer = begin("hexplane", 30)
    trainer.soundness.memory.observe(torch.full((len(trainer.model.open_rows()), 3), 1e6))
    worst = float(trainer.soundness.memory._worst)
    outliers = bound_between(trainer, 5)
    save_run(trainer, tmp_path / "checkpoint.safetensors")
    resumed = begin("hexplane", 0)
    restore_run(resumed, tmp_path / "checkpoint.safetensors")
    memory = resumed.soundness.memory
    assert drop_displaced(resumed.model, resumed.optimizer, resumed.densifier, memory) == 5 == int(outliers.sum())
    assert worst > 0 and "restored the field" in memory.restore_stable(resumed.model.field, resumed.optimizer)
    assert trainer.soundness.memory.restore_stable(trainer.model.field, trainer.optimizer)
    for (name, p), (_, q) in zip(trainer.model.field.named_parameters(), resumed.model.field.named_parameters()):
        assert torch.equal(p, q), name


def test_a_field_that_joins_sooner_starts_at_the_rates_of_a_third_of_the_run():
    rates = {}
    for preset in ("standard", "final"):
        config = config_from_params(TrainParams(preset=preset))
        settings = dataclasses.replace(config.field, time_nodes=8)
        box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        field = HexPlane(settings, box, torch.Generator().manual_seed(0))
        optimizer = FusedAdam(
            [{"params": [torch.nn.Parameter(torch.zeros(1))], **dict.fromkeys(RATES, 1.0)}], eps=1e-15
        )
        add_field(optimizer, field, None, config, 1.0)
        rates[preset] = []
        for progress in (config.gate.start, 1.0):
            schedule_rates(optimizer, progress)
            rates[preset] += [group["lr"] for group in optimizer.param_groups[1:]]
    assert rates["final"] == pytest.approx(rates["standard"])
    third = 0.1 ** (1 / 3)
    assert rates["final"] == pytest.approx([3e-2 * third, 1e-3 * third, 3e-3, 1e-4])


@pytest.mark.parametrize("name", ["means", "log_scales", "opacity_logits"])
def test_large_step_of_one_attribute_recovers(begin, name):
    trainer = begin("static", 20)
    loss = float(torch.tensor(go_on(trainer, 10)).mean())
    normal = trainer._schedule_rates

    def hasty():
        normal()
        next(group for group in trainer.optimizer.param_groups if group.get("name") == name)["lr"] *= 1e2

    trainer._schedule_rates = hasty
    trainer.step()
    trainer._schedule_rates = normal
    after = go_on(trainer, 50)
    assert len(after) == 50
    assert sum(after[-5:]) / 5 < 2.0 * loss
    assert finite(trainer)


def test_control_points_on_one_spot_stay_finite(begin):
    trainer = begin("control_points", 25)
    field = trainer.model.field
    field.places[:] = field.places[0].clone()
    field.log_radii.data[:] = -20.0
    assert len(go_on(trainer, 20)) == 20
    assert finite(trainer)
    assert not warnings(trainer)


def test_a_gaussian_too_large_for_its_place_is_dropped(begin):
    trainer = begin("static", 5)
    g, d = trainer.model.gaussians, trainer.densifier
    at = g.params["means"].detach()[7].clone()
    g.params["log_scales"].data[7, 1] = math.log(1.1 * d.config.max_scale * max(1.0, float(at.norm())))
    d.step(g, trainer.optimizer, len(g), 0.8)
    assert not bool((g.params["means"] == at).all(1).any())
    assert aligned(trainer)


def test_a_step_that_memory_did_not_suffice_for_opens_the_gate_once(begin):
    """Once there is memory, `_step_that_fits` schedules the events of the same step again."""
    trainer = begin("auto", steps=0)
    while trainer.model.field is None:
        go_on(trainer, 1)
    trainer.iteration -= 1
    field, groups = trainer.model.field, [group.get("name") for group in trainer.optimizer.param_groups]
    schedule_events(trainer)
    assert trainer.model.field is field
    assert [group.get("name") for group in trainer.optimizer.param_groups] == groups


def test_field_is_rebuilt_after_out_of_memory(begin, monkeypatch):
    module, restarts = sys.modules[schedule_events.__module__], []

    def short(*arguments):
        restarts.append(arguments)
        if len(restarts) == 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return add_field(*arguments)

    add_field = module.add_field
    monkeypatch.setattr(module, "add_field", short)
    trainer = begin("control_points", steps=0)
    while not restarts:
        try:
            go_on(trainer, 1)
        except torch.OutOfMemoryError:
            assert trainer.model.field is None
    go_on(trainer, 2)
    names = [group.get("name") for group in trainer.optimizer.param_groups]
    assert trainer.model.field is not None and len(names) == len(set(names)) and len(restarts) == 2


def test_too_much_to_repair_ends_in_words(begin):
    trainer = begin("static", 5)
    trainer.model.gaussians.params["means"].data[::2] = NAN
    trainer.model.gaussians.params["means"].data[1] = NAN
    with pytest.raises(JobError, match="unstable at step 5"):
        trainer.inspect_nonfinite()


def test_whole_runs_stay_finite_and_alike(world):
    methods = METHODS[2:]
    scene = load_scene(world.shot)
    outcomes = []
    for method in methods:
        for seed in range(2):
            config = configuration(method, seed, iterations=60)
            if method == "auto":
                config.field.resolution = 16
            outcomes.append(train_once(scene, config))
    for outcome in outcomes:
        assert outcome.psnr_db is not None
        assert (outcome.finite, outcome.skipped_steps, outcome.warnings) == (True, 0, [])
    for method in methods:
        values = [outcome.psnr_db for outcome in outcomes if outcome.method == method]
        assert min(values) > 18.0
        assert max(values) - min(values) < 3.0
    assert all(row.split("|")[7].strip() == "0" for row in table(outcomes)[2:])
