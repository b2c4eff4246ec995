"""A run on a tiny world with ground truth: it learns, opens the gate where objects move, and resumes exactly."""

import hashlib
import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torch_backend.scene
from tests.backend.train.devices import NamedDevices
from tests.backend.trainings import assert_same_run, short
from torch_backend.contract import Cancelled, ExitCode, FreezeParams, JobError, TrainParams
from torch_backend.freeze import freeze_shot
from torch_backend.gaussians import PARAM_NAMES
from torch_backend.scene import load_images, load_scene
from torch_backend.shot import Shot, write_json
from torch_backend.train import PRESETS, config_from_params, load_run, train_shot
from torch_backend.train.checkpoint import CHECKPOINT_FILE, MISFITS, load_checkpoint, misfit, read_meta, save_checkpoint
from torch_backend.train.config import config_from_json, config_to_json
from torch_backend.train.paper import inside_frustum
from torch_backend.train.trainer import Trainer


def test_it_learns_and_reports(trained):
    summary = trained.summary
    assert summary["heldout_psnr_db"] > 24.0
    assert summary["heldout_frames"] == 1
    rows = [json.loads(line) for line in (trained.shot.run("main") / "metrics.jsonl").read_text().splitlines()]
    assert [r["iteration"] for r in rows] == list(range(90, 901, 90))
    assert rows[-1]["heldout_psnr_db"] > rows[0]["heldout_psnr_db"]
    assert all(r["moving_share"] == 0 for r in rows if r["iteration"] < 180)


def test_the_gate_opens_for_the_patch_that_moves(trained):
    summary = trained.summary
    run = load_run(trained.shot, "main")
    scene = load_scene(trained.shot)
    rows = run.model.open_rows()
    assert 0.005 < summary["moving_share"] < 0.4
    means = run.model.gaussians.params["means"].detach()[rows] / scene.scale + torch.from_numpy(scene.centre).float()
    near = ((means[:, 0] - (-0.3)).abs() < 0.9) & (means[:, 1].abs() < 0.8)
    assert float(near.float().mean()) > 0.8


def test_frames_beyond_memory_train_identically_from_a_hidden_file(world, quiet, monkeypatch, master):
    monkeypatch.setattr(torch_backend.scene, "IMAGE_MEMORY_BYTES", 0)
    scene, folder = load_scene(world.shot), world.shot.run("mapped")
    train_shot(world.shot, short("mapped"), quiet())
    from_file, _ = load_checkpoint(master / "checkpoint.safetensors")
    mapped, _ = load_checkpoint(folder / "checkpoint.safetensors")
    assert all(torch.equal(value, mapped[name]) for name, value in from_file.items())
    images = load_images(scene, scene.solved, 64, 48, folder=folder)
    assert torch.equal(images, load_images(scene, scene.solved, 64, 48))
    assert {path.name for path in folder.iterdir()} == {path.name for path in master.iterdir()}
    maps = Path("/proc/self/maps")
    if maps.is_file():
        assert any(str(folder) in line for line in maps.read_text().splitlines()), "else they are held in memory"


def test_frames_that_no_disk_holds_are_refused_in_a_sentence(world, monkeypatch):
    monkeypatch.setattr(torch_backend.scene, "IMAGE_MEMORY_BYTES", 0)
    scene = load_scene(world.shot)
    with pytest.raises(JobError, match=r"No space left in .*training frames.* needs about \d+ MB"):
        load_images(scene, scene.solved, 1_000_000, 1_000_000, folder=world.shot.root)


@pytest.mark.parametrize(
    ("method", "supervision", "more"),
    [
        ("static", "none", {}),
        ("auto", "paper", {"host": "mlp"}),
        ("hexplane", "paper", {"detector": "weight"}),
        ("hexplane", "support", {"host_config": "reference"}),
        ("mlp", "paper", {"detector": "grad_signed"}),
        ("mlp", "support", {"host_config": "reference"}),
        ("control_points", "support", {}),
        ("control_points", "paper", {"host_config": "reference"}),
    ],
)
def test_every_method_and_preset_of_supervision_runs(world, quiet, tmp_path, method, supervision, more):
    """Every tensor is created on a named device."""
    name = "-".join(["m", method, supervision, *more.values()])
    report, options = quiet(), {"method": method, "supervision": supervision, **more}
    with NamedDevices() as mode:
        summary = train_shot(world.shot, TrainParams(run=name, iterations=30, max_gaussians=400, **options), report)
        if method == "auto":
            shot = Shot(shutil.copytree(world.shot.root, tmp_path / "s.splannequin"))  # a freeze adds mattes
            freeze_shot(shot, FreezeParams(run=name, first=101, last=101, develop="on"), quiet())
    assert mode.found == set()
    assert math.isfinite(summary["heldout_psnr_db"])
    assert not [e for e in report.events if e[0] == "warning" and "skipped" in e[1]]
    assert summary["host_config"] == more.get("host_config", "default")
    if method != "auto":
        assert summary["moving_share"] == (method != "static")
    again = load_run(world.shot, name).model
    assert again.gaussians.params.keys() - PARAM_NAMES == ({"hyper"} if method == "control_points" else set())
    with torch.no_grad():
        assert all(bool(torch.isfinite(v).all()) for v in again.state_at(0.4).values())


@pytest.mark.parametrize("host", ["hexplane", "control_points"])
def test_state_can_be_evaluated_without_canonical_gradients(world, quiet, host):
    params = TrainParams(run=f"pull-{host}", iterations=12, max_gaussians=300, method=host)
    train_shot(world.shot, params, quiet())
    model = load_run(world.shot, f"pull-{host}").model
    with torch.no_grad():
        for p in model.field.parameters():
            p += 0.01 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0))
    params = [model.gaussians.params[name].requires_grad_() for name in sorted(PARAM_NAMES)]
    reached = {}
    for canonical in (True, False):
        state = model.state_at(0.4, canonical=canonical)
        total = sum(value.sum() for value in state.values())
        pulls = torch.autograd.grad(total, [*params, *model.field.parameters()], allow_unused=True)
        reached[canonical] = state, [pull is not None and bool((pull != 0).any()) for pull in pulls]
    for name in PARAM_NAMES:
        torch.testing.assert_close(reached[True][0][name], reached[False][0][name], rtol=0, atol=0)
    assert all(reached[True][1][: len(params)])
    assert not any(reached[False][1][: len(params)])
    assert sum(reached[False][1]) >= 4


def test_another_host_works_behind_the_gate_and_resumes(world, quiet, monkeypatch):
    """Gaussians are split and pruned while the field exists: a host's own parameters must follow."""

    def easily_moved():
        config = preview()
        config.gate.pixels = 1e-3  # 110 steps are too few to detect motion
        return config

    preview = PRESETS["preview"]
    monkeypatch.setitem(PRESETS, "preview", easily_moved)

    def params(run):
        return TrainParams(run=f"{run}-points", iterations=110, max_gaussians=1500, host="control_points")

    report = quiet()
    summary = train_shot(world.shot, params("whole"), report)
    assert 0 < summary["moving_share"] < 0.8
    assert summary["host"] == "control_points"
    with pytest.raises(Cancelled):
        train_shot(world.shot, params("broken"), quiet(cancel_at=("training", 0.7)))
    train_shot(world.shot, params("broken"), quiet())
    assert_same_run(world.shot.run("whole-points"), world.shot.run("broken-points"), rtol=1e-3, atol=1e-4)


def test_wrong_choices_are_named():
    with pytest.raises(ValueError, match="preset"):
        config_from_params(TrainParams(preset="fast"))
    with pytest.raises(ValueError, match="detector"):
        config_from_params(TrainParams(detector="loud"))
    with pytest.raises(ValueError, match="control_points"):
        config_from_params(TrainParams(host="nerf"))
    with pytest.raises(ValueError, match="reference"):
        config_from_params(TrainParams(host_config="published"))
    with pytest.raises(ValueError, match="iterations"):
        config_from_params(TrainParams(iterations=3))


def test_the_gate_opens_after_a_fifth_of_the_run_at_most_600_steps_and_what_hangs_on_it_with_it():
    """Ghosts of moving objects from a longer static stage are never removed (docs/decisions.md)."""
    preview, standard, final = (config_from_params(TrainParams(preset=preset)) for preset in PRESETS)
    opened, degrees = [400, 600, 600], [300, 1350, 1350]
    for c, steps, degree in zip((preview, standard, final), opened, degrees, strict=True):
        assert [round(at * c.iterations) for at in (c.gate.start, c.supervision.start)] == [steps, steps]
        assert round(c.sh_every * c.iterations) == degree, "a raise needs its steps, and no more"
        assert c.gate.harden - c.gate.start == pytest.approx(0.45 - 1 / 3), "a trial is as long as it was"
    for published in ({"method": "hexplane", "supervision": "paper"}, {"host_config": "reference"}):
        config = config_from_params(TrainParams(preset="final", **published))
        assert round(config.supervision.start * config.iterations) == 10_000, "published numbers are what they were"


def test_config_round_trip():
    for host in ("hexplane", "mlp", "control_points"):
        for host_config in ("default", "reference"):
            params = TrainParams(preset="final", supervision="paper", method=host, host_config=host_config)
            config = config_from_params(params)
            assert config.host == host
            assert config_from_json(json.loads(json.dumps(config_to_json(config)))) == config


def test_near_and_far_means_move_equally_in_pixels(world, quiet):
    scene = load_scene(world.shot)
    images = load_images(scene, scene.solved, 64, 48)
    for reach, exponent in ((5.0, 1.0), (0.0, 0.0)):
        config = config_from_params(TrainParams())
        config.lr_means_reach = reach
        trainer = Trainer(scene, images, scene.solved, config, quiet())
        means = trainer.model.gaussians.params["means"]
        with torch.no_grad():  # the scene is a few units away: some points become near, some far
            means *= torch.logspace(-1, 1, len(means))[:, None]
        before = means.detach().clone()
        trainer.step()
        pulled = means.grad.abs() > 1e-9  # Adam's first step has the length of its rate, independent of the gradient
        length = before.norm(dim=1, keepdim=True).clamp_min(1.0).expand_as(means)
        expected = config.lr_means * (length / (reach or 1.0)) ** exponent
        assert int(pulled.sum()) > 100
        assert length[pulled].max() > 3.0 * length[pulled].min()
        assert torch.allclose((means.detach() - before).abs()[pulled], expected[pulled], rtol=0.02, atol=1e-6)


def iteration_of(folder):
    return read_meta(folder / "checkpoint.safetensors")["iteration"]


def files_of(run):
    """Map from name to hash of every file of a run, without the folder of its replacement."""
    files = [p for p in run.rglob("*") if p.is_file() and "next" not in p.parts]
    return {str(p.relative_to(run)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def begun_in(run):
    """Folders of trainings that will replace the run."""
    return sorted(p.parent for p in run.glob("next/*/checkpoint.safetensors"))


def test_finished_run_is_kept_until_its_replacement_is_done(world, quiet, finished):
    run = finished("mixed")
    before = files_of(run)
    report = quiet(cancel_at=("training", 0.5))
    with pytest.raises(Cancelled):
        train_shot(world.shot, short("mixed", seed=5), report)
    assert files_of(run) == before
    assert any(e[0] == "warning" and "training starts again" in e[1] and "is kept" in e[2] for e in report.events)
    assert load_run(world.shot, "mixed").config.seed == 0
    (work,) = begun_in(run)
    stopped = iteration_of(work)
    assert 30 <= stopped < 60
    report = quiet()
    assert train_shot(world.shot, short("mixed"), report)["iterations"] == 60
    assert ("progress", "training", 1, 1, "already trained") in report.events
    report = quiet()
    train_shot(world.shot, short("mixed", seed=5), report)
    assert ("progress", "training", stopped, 60, f"resumed at step {stopped}") in report.events
    assert load_run(world.shot, "mixed").config.seed == 5
    assert not (run / "next").exists()
    assert files_of(run).keys() == before.keys()
    rows = [json.loads(line)["iteration"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert rows == list(range(6, 61, 6))


def test_cancelled_evaluation_runs_on_resume(world, quiet, monkeypatch, master):
    """Two cancels in an evaluation, and two in the last one: the curve has no gap."""
    measured, goes_on = Trainer.frame_psnrs, []

    def pressed(self, *args, **options):
        if self.iteration in (30, 60) and goes_on.count(self.iteration) < 2:
            goes_on.append(self.iteration)
            self.report.cancelled = True
        return measured(self, *args, **options)

    monkeypatch.setattr(Trainer, "frame_psnrs", pressed)
    for _ in range(4):
        with pytest.raises(Cancelled):
            train_shot(world.shot, short("holed"), quiet())
        assert iteration_of(world.shot.run("holed")) == goes_on[-1]
    report = quiet()
    train_shot(world.shot, short("holed"), report)
    assert goes_on == [30, 30, 60, 60]
    run, curves = world.shot.run("holed"), []
    for folder in (master, run):
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        curves.append([{**json.loads(line), "seconds": None} for line in lines])
    assert curves[0] == curves[1]
    assert [row["iteration"] for row in curves[0]] == list(range(6, 61, 6))
    whole, holed = files_of(master), files_of(run)
    pictures = [name for name in whole if name.startswith("previews")]
    assert len(pictures) == 10
    assert {name: whole[name] for name in pictures} == {n: digest for n, digest in holed.items() if n in pictures}
    from_file, resumed = (load_checkpoint(folder / CHECKPOINT_FILE)[0] for folder in (master, run))
    assert all(torch.equal(value, resumed[name]) for name, value in from_file.items())


def test_resumed_run_ends_as_an_unbroken_one_and_measures_no_step_twice(world, quiet, master):
    class Stops(quiet):
        def image(self, label, path):
            super().image(label, path)
            self.cancelled = path.stem == "000030"

    with pytest.raises(Cancelled):
        train_shot(world.shot, short("told"), Stops())
    assert iteration_of(world.shot.run("told")) == 30
    report = quiet()
    train_shot(world.shot, short("told"), report)
    rows = [
        json.loads(line)["iteration"]
        for line in (world.shot.run("told") / "metrics.jsonl").read_text().split("\n")[:-1]
    ]
    assert rows == list(range(6, 61, 6))
    assert [Path(e[2]).stem for e in report.events if e[0] == "image"] == [f"{n:06d}" for n in range(36, 61, 6)]
    assert_same_run(master, world.shot.run("told"))


def test_a_finished_run_that_begins_anew_stays_too(world, quiet, finished):
    run = finished("restarted")
    before = files_of(run)
    with pytest.raises(Cancelled):
        train_shot(world.shot, short("restarted", resume=False), quiet(cancel_at=("training", 0.1)))
    assert files_of(run) == before
    train_shot(world.shot, short("restarted"), quiet())
    assert not begun_in(run), "the finished run is what it could only come to"


def test_a_training_that_was_begun_behind_a_link_is_not_gone_on_with(world, quiet, tmp_path, finished):
    """A shot folder may come from anywhere, and a link in it may lead to another user's run."""
    run = finished("linked")
    with pytest.raises(Cancelled):
        train_shot(world.shot, short("linked", seed=5), quiet(cancel_at=("training", 0.1)))
    (work,) = begun_in(run)
    theirs = work.rename(tmp_path / "theirs")
    before = files_of(theirs)
    work.symlink_to(theirs)
    with pytest.raises(JobError, match="is a link to"):
        train_shot(world.shot, short("linked", seed=5), quiet())
    assert files_of(theirs) == before


def test_paused_runs_of_one_name_wait_side_by_side(world, quiet):
    """A short training with other settings must not delete hours of a paused run."""
    for seed in (1, 2, 3):
        with pytest.raises(Cancelled):
            train_shot(world.shot, short("paused", seed=seed), quiet(cancel_at=("training", 0.1)))
    run = world.shot.run("paused")
    assert load_run(world.shot, "paused").config.seed == 1
    assert len(begun_in(run)) == 2
    report = quiet()
    train_shot(world.shot, short("paused", seed=2), report)
    assert any(e[0] == "progress" and "resumed" in e[4] for e in report.events)
    assert load_run(world.shot, "paused").config.seed == 2
    assert not (run / "next").exists()


def test_kill_during_run_replacement_is_repaired(world, quiet, tmp_path):
    """Files are replaced one after the other; the state after each replacement is built by hand."""
    shot = Shot(shutil.copytree(world.shot.root, tmp_path / "s.splannequin", ignore=shutil.ignore_patterns("runs")))
    run, old, new = shot.run("main"), tmp_path / "old", tmp_path / "new"
    params = TrainParams(iterations=12, max_gaussians=300, method="static", seed=5)
    for folder, seed in ((old, 0), (new, 5)):
        train_shot(shot, replace(params, seed=seed), quiet())
        run.rename(folder)
    key, expected = json.loads((new / "summary.json").read_text())["key"], files_of(new)
    for moved in range(5):
        shutil.copytree(old, run)
        shutil.copytree(new, run / "next" / key)
        for name in ("checkpoint.safetensors", "config.json", "metrics.jsonl", "previews")[:moved]:
            if name == "previews":
                shutil.rmtree(run / name)
            (run / "next" / key / name).replace(run / name)
        assert load_run(shot, "main").config.seed == (5 if moved else 0), "it can be frozen from meanwhile"
        report = quiet()
        train_shot(shot, params, report)
        assert ("progress", "training", 1, 1, "already trained") in report.events
        assert files_of(run) == expected
        assert not (run / "next").exists()
        shutil.rmtree(run)


def test_cancelling_at_once_keeps_the_finished_checkpoint(world, quiet, finished):
    finished("kept")
    with pytest.raises(Cancelled):
        train_shot(world.shot, short("kept", seed=5), quiet(cancel_at=("loading frames", 0.5)))
    assert load_run(world.shot, "kept").config.seed == 0


def test_run_of_different_pictures_is_refused_and_retrained(world, tmp_path, quiet):
    """Another grade of the same footage with imported cameras, whose files are identical byte by byte."""
    shot = Shot(shutil.copytree(world.shot.root, tmp_path / "s.splannequin", ignore=shutil.ignore_patterns("runs")))
    record, params = json.loads(shot.listing.read_text()), TrainParams(iterations=12, max_gaussians=300)

    def imported(key):
        write_json(shot.listing, {**record, "key": key})

    def trained():
        report = quiet()
        train_shot(shot, params, report)
        return ("progress", "training", 1, 1, "already trained") not in report.events

    imported("as filmed")
    assert trained() and not trained()
    before = load_run(shot, "main")
    imported("graded")
    with pytest.raises(JobError, match="other pictures"):
        load_run(shot, "main")
    with pytest.raises(JobError, match="other pictures"):
        train_shot(shot, replace(params, extend=5), quiet())
    assert trained() and not trained() and load_run(shot, "main").stamp != before.stamp


def test_a_run_is_known_by_its_content_whatever_the_time_of_its_file(world, tmp_path, finished):
    """A disk may round modification times, and `cp -r` changes them."""
    checkpoint = finished("timed") / CHECKPOINT_FILE
    run = load_run(world.shot, "timed")
    for time in (checkpoint.stat().st_mtime_ns // 100 * 100, 1):
        os.utime(checkpoint, ns=(time, time))
        assert not run.stale and load_run(world.shot, "timed").stamp == run.stamp
    copy = shutil.copyfile(checkpoint, tmp_path / CHECKPOINT_FILE)
    os.replace(copy, checkpoint)
    assert not run.stale and load_run(world.shot, "timed").stamp == run.stamp
    tensors, meta = load_checkpoint(checkpoint)
    save_checkpoint(checkpoint, tensors, {**meta, "trained_seconds": meta["trained_seconds"] + 1.0})
    assert run.stale


@pytest.mark.skipif(os.name == "nt", reason="a link needs a privilege there")
def test_figures_are_not_appended_through_a_link(world, quiet, tmp_path):
    theirs, folder = tmp_path / "notes.txt", world.shot.run("figures")
    theirs.touch()
    folder.mkdir(parents=True)
    (folder / "metrics.jsonl").symlink_to(theirs)
    train_shot(world.shot, TrainParams(run="figures", iterations=12, max_gaussians=300), quiet())
    assert not theirs.read_text() and not (folder / "metrics.jsonl").is_symlink()


def test_damaged_checkpoint_is_an_error_in_words(world, finished):
    path = finished("damaged") / CHECKPOINT_FILE
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(JobError, match="cannot be read"):
        load_run(world.shot, "damaged")


def test_a_run_that_keeps_failing_ends_in_words(world, quiet):
    scene = load_scene(world.shot)
    images = load_images(scene, scene.solved, 64, 48)
    trainer = Trainer(scene, images * math.nan, scene.solved, config_from_params(TrainParams()), quiet())
    with pytest.raises(JobError, match="unstable"):
        for _ in range(40):
            trainer.step()


def test_inside_frustum():
    K = torch.tensor([[10.0, 0, 16.0], [0, 10.0, 8.0], [0, 0, 1]])
    means = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1.59, 0, 1], [1.61, 0, 1], [0, -0.81, 1]])
    assert inside_frustum(means, torch.eye(4), K, 32, 16).tolist() == [True, False, True, False, False]


def test_a_checkpoint_that_does_not_fit_is_a_sentence(world, quiet):
    """The file is complete and of the right version, but a tensor is missing or has another shape."""
    params = TrainParams(run="misfit", iterations=12, max_gaussians=300, method="hexplane")
    train_shot(world.shot, params, quiet())
    path = world.shot.run("misfit") / CHECKPOINT_FILE
    (path.parent / "summary.json").unlink()
    tensors, meta = load_checkpoint(path)
    field = next(name for name in tensors if name.startswith("field."))
    shorter = {**tensors, "exposure": tensors["exposure"][:-1].clone()}
    for wrong in (shorter, {name: value for name, value in tensors.items() if name != field}):
        save_checkpoint(path, wrong, meta)
        with pytest.raises(JobError, match="does not fit this version"):
            load_run(world.shot, "misfit")
        with pytest.raises(JobError, match="does not fit this version"):
            train_shot(world.shot, params, quiet())


def test_a_card_that_fails_says_nothing_of_the_checkpoint():
    """The message must not ask for a new training if the checkpoint is sound."""
    for error in (torch.OutOfMemoryError("CUDA out of memory."), torch.AcceleratorError("an illegal memory access")):
        assert isinstance(error, MISFITS) and misfit(Path("checkpoint"), error, ExitCode.TRAIN) is error
    message = misfit(Path("checkpoint"), RuntimeError("size mismatch\nfor a"), ExitCode.TRAIN)
    assert isinstance(message, JobError) and "(RuntimeError: size mismatch)" in str(message)
