"""Stopping policy: criteria, probe frames, and equal decisions after a resume."""

import copy
import io
import json
import math
from dataclasses import dataclass

import pytest
import torch

from tests.backend import conftest
from tests.backend.trainings import take_steps
from torch_backend.cli import Console
from torch_backend.contract import Event, TrainParams
from torch_backend.freeze.frozen import freeze_at, render_frozen
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params
from torch_backend.train.checkpoint import load_checkpoint
from torch_backend.train.loop import train_to_end
from torch_backend.train.model import restore_model
from torch_backend.train.modelled import modelled
from torch_backend.train.optimizer import limit_harmonics
from torch_backend.train.residual import correlation_frames
from torch_backend.train.resume import restore_run, save_run
from torch_backend.train.stopping import (
    FieldOpened,
    LimitHarmonics,
    RunFacts,
    RunSchedule,
    StoppingConfig,
    StoppingPolicy,
    growth_gain,
    lasting,
    newest_gain,
    probe_frames,
)
from torch_backend.train.trainer import Trainer


@pytest.fixture(scope="module")
def long_world(tmp_path_factory):
    """(scene, images) of the tiny shot, extended so that it has probe frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conftest, "FRAMES", 30)
        world = conftest.build_world(tmp_path_factory.mktemp("long"))
    scene = load_scene(world.shot)
    return scene, load_images(scene, scene.solved, 64, 48)


def trainer_of(long_world, quiet, iterations=100, method="auto", **changes):
    scene, images = long_world
    config = config_from_params(TrainParams(iterations=iterations, max_gaussians=1200, method=method))
    config.densify.every = 10
    config.needs.least = 24
    for path, value in changes.items():
        part = config
        *parents, name = path.split("__")
        for parent in parents:
            part = getattr(part, parent)
        setattr(part, name, value)
    return Trainer(scene, images.clone(), scene.solved, config, quiet())


def finish(trainer, folder):
    train_to_end(trainer, folder / "checkpoint.safetensors", lambda _: None)
    return trainer


def test_probes_are_spread_and_never_an_end():
    assert probe_frames(23, 12) == []
    assert probe_frames(200, 0) == []
    for frames in (24, 31, 48, 240, 2000):
        probes = probe_frames(frames, 12)
        assert 3 <= len(probes) <= 12
        assert len(set(probes)) == len(probes)
        assert min(probes) > 0
        assert max(probes) < frames - 1
        gaps = torch.tensor(probes).diff()
        assert int(gaps.max() - gaps.min()) <= 1


def test_growth_is_judged_per_tenth_if_any_happened():
    measured = [(100 * n, round(1000 * 1.1**n), 20.0 + 0.2 * n) for n in range(6)]
    assert growth_gain(measured) == pytest.approx(0.2, rel=0.01)
    flat = [*measured, *((100 * n, round(1000 * 1.1**n), 21.0 - 0.01 * (n % 2)) for n in range(6, 11))]
    assert growth_gain(flat) < 0.03  # earlier gains no longer count
    assert growth_gain([(n, 1000 + n, 20.0 + n) for n in range(20)]) is None
    assert growth_gain(measured[:2]) is None
    assert growth_gain(measured, measured[-1][0] - measured[0][0] + 1) is None  # too short to decide
    assert growth_gain(measured, measured[-1][0] - measured[0][0]) == growth_gain(measured)


def test_newest_gain_is_over_the_best_before():
    measured = [(0, 1, 20.0), (10, 1, 21.0), (20, 1, 20.5), (30, 1, 21.2), (40, 1, 21.1)]
    assert newest_gain(measured, 20) == pytest.approx(0.2)
    assert newest_gain(measured, 40) is None
    assert newest_gain(measured, -1) is None


def test_correlation_follows_the_period_and_knows_noise():
    frames, g = torch.arange(60.0), torch.Generator().manual_seed(0)
    phase = 2 * math.pi * torch.rand(40, generator=g)
    noise = 0.2 * torch.randn(60, 40, generator=g)
    for period in (12.0, 24.0):
        swing = torch.sin(2 * math.pi * frames[:, None] / period + phase)
        assert correlation_frames(swing + noise, torch.ones(60, 40)) == pytest.approx(period / 6, rel=0.3)
    assert correlation_frames(noise, torch.ones(60, 40)) is None
    hidden = torch.ones(60, 40)
    hidden[20:40] = 0
    swing = torch.sin(2 * math.pi * frames[:, None] / 24 + phase)
    swing[20:40] = 100.0  # frames in which it is not visible
    assert correlation_frames(swing, hidden) == pytest.approx(4.0, rel=0.3)


def test_dropped_harmonics_change_nothing_below(long_world, quiet):
    trainer = trainer_of(long_world, quiet)
    trainer.model.sh_degree = 2
    for _ in range(3):
        trainer.step()
    trainer.model.sh_degree = 1
    before = trainer.render_frame(4)
    moments = trainer.optimizer.state[trainer.model.gaussians.params["shN"]]["exp_avg"][:, :3].clone()
    limit_harmonics(trainer.model.gaussians, trainer.optimizer, 1)
    shN = trainer.model.gaussians.params["shN"]
    assert shN.shape[1:] == (3, 3)
    assert torch.equal(trainer.render_frame(4), before)
    assert torch.equal(trainer.optimizer.state[shN]["exp_avg"], moments)
    kept = shN.detach().clone()
    trainer.step()
    assert not torch.equal(trainer.model.gaussians.params["shN"], kept)


def test_probe_frames_are_not_trained_on_until_they_join(long_world, quiet):
    never = {"needs__sh_gain": -1e9, "needs__growth_gain": -1e9}
    runs = [trainer_of(long_world, quiet, **never) for _ in range(2)]
    probes = runs[0].policy.probes
    assert len(probes) == 3
    runs[1].images[probes] = 1.0  # destroys these pictures
    for trainer in runs:
        take_steps(trainer, 60)
    assert bool(runs[0].model.gaussians.open.any())
    for name, value in runs[0].model.gaussians.params.items():
        assert torch.equal(value, runs[1].model.gaussians.params[name]), name
    assert not runs[0].model.gaussians.support[:, [runs[0]._bins[n] for n in probes]].any()
    for trainer in runs:
        take_steps(trainer, 39)
    assert runs[0].model.gaussians.support[:, [runs[0]._bins[n] for n in probes]].any()
    assert not torch.equal(runs[0].model.gaussians.params["sh0"], runs[1].model.gaussians.params["sh0"])


@pytest.mark.parametrize("rates_end", [0.1, 0.2, 1.0])
def test_what_harmonics_gained_is_scaled_by_what_they_may_still_learn(rates_end):
    steps = rates_end ** (torch.arange(1000, dtype=torch.float64) / 1000)
    for since, now in ((0.15, 0.3), (0.3, 0.45), (0.45, 0.6)):
        first, last = round(1000 * since), round(1000 * now)
        share = float(steps[first:].sum() / steps[first:last].sum())
        assert lasting(since, now, rates_end) == pytest.approx(share, rel=0.01)


@pytest.fixture(scope="module")
def free(long_world, quiet, tmp_path_factory):
    """A run that gains enough of everything."""
    changes = {f"needs__{name}_gain": -1e9 for name in ("sh", "growth", "stop")}
    return finish(
        trainer_of(long_world, quiet, init__seeds=0, densify__every=5, **changes), tmp_path_factory.mktemp("free")
    )


@pytest.fixture(scope="module")
def bound(long_world, quiet, tmp_path_factory):
    """(run that gains too little of everything, its folder)."""
    changes, folder = (
        {f"needs__{name}_gain": 1e9 for name in ("sh", "growth", "stop")},
        tmp_path_factory.mktemp("bound"),
    )
    return finish(trainer_of(long_world, quiet, init__seeds=0, densify__every=5, **changes), folder), folder


def test_a_degree_that_gains_too_little_is_dropped_for_good(long_world, free, bound):
    """Dropped coefficients are absent from the checkpoint too, and the rest can be frozen."""
    trainer, folder = bound
    assert trainer.model.sh_degree == 0
    assert trainer.policy.degrees.keys() == {1}
    rows = {row["what"]: row for row in modelled(trainer)}
    assert rows["SH degree 1"]["detail"] == "dropped"
    assert rows["SH degree 1"]["gain_db"] == pytest.approx(trainer.policy.degrees[1], abs=1e-3)
    model = restore_model(*load_checkpoint(folder / "checkpoint.safetensors"), trainer.config)
    assert model.gaussians.params["shN"].shape[1] == 0
    scene = long_world[0]
    image = render_frozen(freeze_at(model, 0.5, 2.0), scene.viewmats[9], scene.camera_at(64, 48)[9], 64, 48)
    assert float(image.alpha.mean()) > 0.9
    assert free.model.sh_degree == 2


def test_growth_ends_when_it_gains_too_little(free, bound):
    assert free.policy.growth_ended is None
    assert len(free.model.gaussians) > 1000
    policy = bound[0].policy
    assert 0 < policy.growth_ended < 0.6 * 100
    at_end = dict((i, n) for i, n, _ in policy.measured)[policy.growth_ended]
    assert len(bound[0].model.gaussians) <= at_end < 1000


def test_growth_is_not_judged_while_a_field_is_on_trial(long_world, quiet):
    """Losses on the probe frames while a field opens are not caused by the number of Gaussians."""
    trainer = trainer_of(long_world, quiet, needs__growth_gain=1e9)
    ended = []
    opened = FieldOpened(30, 1.0)
    for facts in (RunFacts(), RunFacts(opened=opened), RunFacts(opened=opened, hardened=60)):
        trainer.policy.facts, trainer.policy.growth_ended = facts, None
        trainer.policy.measured = [
            (trainer.config.iterations * (n - 6) // 30, round(trainer.gaussian_count * 1.2 ** (n - 6)), 20.0 + 0.1 * n)
            for n in range(6)
        ]
        trainer.policy._measure(trainer)
        ended.append(trainer.policy.growth_ended is not None)
    assert ended == [True, False, True]


@dataclass
class Numbers:
    """Stand-in for a run, as the policy sees it: PSNR by SH degree, and gains of exposure and field."""

    iteration: int
    sh_degree: int = 1
    gaussian_count: int = 1000
    by_degree: tuple[float, ...] = (20.0, 20.01, 20.5)
    steps: int = 100

    @property
    def progress(self):
        return self.iteration / self.steps

    def probe_psnr(self, frames, *, sh_degree=None, exposure=True, field=True, viewmats=None):
        degree = self.sh_degree if sh_degree is None else sh_degree
        without = 0.3 * (not exposure) + 0.2 * (not field)
        return self.by_degree[degree] - without + (0.1 if viewmats is not None else 0.0)

    def correlation_frames(self):
        return 4.0


def policy_of(**changes):
    return StoppingPolicy(StoppingConfig(**changes), 60, RunSchedule(100, 10, 0.6, 0.7, 0.15, 0.2))


def test_the_policy_yields_a_decision_and_changes_nothing_of_the_run():
    policy, run = policy_of(sh_gain=0.1), Numbers(35)
    before = vars(run).copy()
    decisions = policy.decide(run)
    assert next(decisions) == LimitHarmonics(0)
    assert vars(run) == before
    assert policy.sh_degree(2) == 0
    assert list(decisions) == []
    assert list(policy.decide(run)) == []  # each decision is made once
    assert not list(policy_of(sh_gain=0.001).decide(run))


def test_what_a_degree_was_dropped_from_is_what_joins():
    """If both happen at one step, the last measurement of the probes uses the model without the harmonics."""
    policy, run = policy_of(sh_gain=0.1), Numbers(60)
    for decision in policy.decide(run):
        run.sh_degree = decision.degree
    assert policy.excluded == set()
    facts = policy.facts
    assert facts.probe_psnr_db == 20.0
    assert (facts.exposure_gain_db, facts.field_gain_db) == (pytest.approx(0.3), pytest.approx(0.2))


def test_refined_cameras_are_judged_once_with_held_out_probes():
    policy = policy_of()
    policy.judge_cameras(Numbers(30), torch.eye(4)[None])
    assert policy.facts.poses_gain_db == pytest.approx(0.1)
    policy = policy_of()
    policy.joined = True
    policy.judge_cameras(Numbers(30), torch.eye(4)[None])
    assert policy.facts.poses_gain_db is None


def test_stopping_facts_load_from_older_versions():
    facts = RunFacts(growth_gain_db=0.1, opened=FieldOpened(100, 2.5), hardened=225)
    assert facts.to_json() == {"growth_gain_db": 0.1, "opened": {"iteration": 100, "seconds": 2.5}, "hardened": 225}
    assert RunFacts.from_json(facts.to_json()) == facts
    assert RunFacts.from_json({**facts.to_json(), "poses_gain_db": None, "of_another_version": 1}) == facts


def test_a_run_that_gains_nothing_anneals_and_ends(long_world, quiet, free, bound):
    trainer, folder = bound
    assert trainer.policy.stopped == 80  # first measurement after the gate has stopped waiting for motion
    assert trainer.iteration == 90
    group = trainer.optimizer.param_groups[0]
    trainer._schedule_rates()
    assert group["lr"] == pytest.approx(group["lr_end"])
    assert trainer.report.events[-1][2:4] == (90, 90)
    end = modelled(trainer)[-1]
    assert end["detail"] == "stopped at step 90 of 100: nothing more was gained"
    again = trainer_of(long_world, quiet, densify__every=5)
    restore_run(again, folder / "checkpoint.safetensors")
    assert again.end == 90
    assert free.policy.stopped is None
    assert free.iteration == 100


@pytest.mark.parametrize(("softened", "stopped"), [(0.0, 30), (0.5, 70)])
def test_no_end_is_looked_for_while_pictures_are_soft_nor_across_their_end(softened, stopped):
    """Sharp probe frames do not improve with softened pictures, so gains are only measured over whole pictures."""
    policy = StoppingPolicy(StoppingConfig(join=1.0), 60, RunSchedule(100, 10, 0.6, 0.7, 0.15, 0.2, softened))
    policy.growth_ended, policy.facts.hardened = 10, 20
    for step in range(1, 101):
        list(policy.decide(Numbers(step)))
    assert policy.stopped == stopped


def test_a_resumed_run_decides_the_same(long_world, quiet, tmp_path):
    changes = {"init__seeds": 0, "needs__growth_gain": 0.5, "needs__stop_gain": 0.5}
    whole = finish(trainer_of(long_world, quiet, **changes), tmp_path)
    broken = trainer_of(long_world, quiet, **changes)
    for steps in (45, 27):
        take_steps(broken, steps)
        save_run(broken, tmp_path / "broken.safetensors")
        resumed = trainer_of(long_world, quiet, **changes)
        restore_run(resumed, tmp_path / "broken.safetensors")
        finish(resumed, tmp_path)
        expected, got = (copy.deepcopy(json.loads(json.dumps(t.policy.state()))) for t in (whole, resumed))
        for state in (expected, got):
            (state["facts"].get("opened") or {}).pop("seconds", None)
        assert got == expected
        assert resumed.iteration == whole.iteration
        for name, value in whole.model.gaussians.params.items():
            torch.testing.assert_close(resumed.model.gaussians.params[name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_published_hosts_are_not_stopped_early(long_world, quiet):
    scene, images = long_world
    for params in (TrainParams(method="hexplane"), TrainParams(host_config="reference")):
        trainer = Trainer(scene, images, scene.solved, config_from_params(params), quiet())
        assert trainer.policy.probes == []
        assert trainer.policy.excluded == set()
    for method in ("auto", "static"):  # the methods are compared with each other, so both use the policy
        assert trainer_of(long_world, quiet, method=method).policy.excluded == set(probe_frames(len(scene.solved), 12))


def test_time_nodes_follow_the_motion(long_world, quiet):
    """One sway over a clip of 30 frames; half of the number of frames would be 15 nodes."""
    trainer = trainer_of(long_world, quiet, iterations=300, needs__sh_gain=1e9)
    take_steps(trainer, 61)  # the field joins at a fifth of the run
    assert trainer.model.field is not None
    nodes = trainer.policy.facts.time_nodes
    assert 4 <= nodes <= 12
    assert trainer.model.field.config.time_nodes == nodes


def test_the_console_shows_the_table(trained):
    summary = trained.summary
    rows = {row["what"]: row for row in summary["modelled"]}
    moving = rows["moving Gaussians"]
    assert moving["seconds"] + rows["static world"]["seconds"] == pytest.approx(summary["train_seconds"], abs=0.1)
    assert moving["gain_db"] is None  # 14 frames have no probe frames, so nothing was measured
    stream = io.StringIO()
    Console(stream)(Event("metric", 0, 0.0, {"stage": "train", "values": summary}))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1 + len(summary["modelled"])
    assert "moving Gaussians" in stream.getvalue()
    assert lines[1].split()[-1] == "-"
