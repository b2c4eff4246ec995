"""A run on a tiny world with truth: it learns, it opens the gate where things move, it resumes exactly."""

import json
import math

import pytest
import torch

from torch_backend.contract import Cancelled, JobError, TrainParams
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params, load_run, train_shot
from torch_backend.train.checkpoint import load_checkpoint
from torch_backend.train.config import config_from_json, config_to_json
from torch_backend.train.trainer import Trainer, inside_frustum


def test_it_learns_and_reports(trained):
    world, summary = trained
    assert summary["heldout_psnr_db"] > 24.0
    assert summary["heldout_frames"] == 1
    rows = [json.loads(line) for line in (world.shot.run("main") / "metrics.jsonl").read_text().splitlines()]
    assert [r["iteration"] for r in rows] == list(range(90, 901, 90))
    assert rows[-1]["heldout_psnr_db"] > rows[0]["heldout_psnr_db"]
    assert all(r["moving_share"] == 0 for r in rows if r["iteration"] < 300)


def test_the_gate_opens_for_the_patch_that_moves(trained):
    world, summary = trained
    run = load_run(world.shot, "main")
    scene = load_scene(world.shot)
    rows = run.model.open_rows()
    assert 0.005 < summary["moving_share"] < 0.4
    means = run.model.gaussians.params["means"].detach()[rows] / scene.scale + torch.from_numpy(scene.centre).float()
    near = ((means[:, 0] - (-0.3)).abs() < 0.9) & (means[:, 1].abs() < 0.8)
    assert float(near.float().mean()) > 0.8


def short(world, name, **changes):
    return TrainParams(run=name, iterations=60, max_gaussians=1500, **changes)


def test_cancel_and_resume_end_exactly_where_an_unbroken_run_does(world, quiet):
    train_shot(world.shot, short(world, "whole"), quiet())
    with pytest.raises(Cancelled):
        train_shot(world.shot, short(world, "broken"), quiet(cancel_at=("training", 0.5)))
    _, meta = load_checkpoint(world.shot.run("broken") / "checkpoint.safetensors")
    assert 30 <= meta["iteration"] < 60
    train_shot(world.shot, short(world, "broken"), quiet())
    whole, _ = load_checkpoint(world.shot.run("whole") / "checkpoint.safetensors")
    broken, _ = load_checkpoint(world.shot.run("broken") / "checkpoint.safetensors")
    assert whole.keys() == broken.keys()
    for name, value in whole.items():
        torch.testing.assert_close(value, broken[name], rtol=1e-4, atol=1e-5, msg=name)


def test_a_finished_run_is_not_trained_again(world, quiet):
    train_shot(world.shot, short(world, "once"), quiet())
    report = quiet()
    train_shot(world.shot, short(world, "once"), report)
    assert ("progress", "training", 1, 1, "already trained") in report.events


@pytest.mark.parametrize(("method", "supervision"), [("static", "none"), ("hexplane", "paper"), ("auto", "paper")])
def test_every_method_and_preset_of_supervision_runs(world, quiet, method, supervision):
    summary = train_shot(
        world.shot, short(world, f"m-{method}-{supervision}", method=method, supervision=supervision), quiet()
    )
    assert math.isfinite(summary["heldout_psnr_db"])
    assert (summary["moving_share"] > 0) == (method != "static") or method == "auto"


def test_wrong_choices_are_named():
    with pytest.raises(ValueError, match="preset"):
        config_from_params(TrainParams(preset="fast"))
    with pytest.raises(ValueError, match="iterations"):
        config_from_params(TrainParams(iterations=3))


def test_config_round_trip():
    config = config_from_params(TrainParams(preset="final", supervision="paper"))
    assert config_from_json(json.loads(json.dumps(config_to_json(config)))) == config


def test_a_run_of_other_settings_is_not_taken_for_this_one(world, quiet):
    """Finish one, cancel another under the same name, ask for the first again: the checkpoint is no longer its own."""
    train_shot(world.shot, short(world, "mixed"), quiet())
    with pytest.raises(Cancelled):
        train_shot(world.shot, short(world, "mixed", seed=5), quiet(cancel_at=("training", 0.3)))
    report = quiet()
    train_shot(world.shot, short(world, "mixed"), report)
    assert ("progress", "training", 1, 1, "already trained") not in report.events


def test_cancelling_at_once_keeps_the_finished_checkpoint(world, quiet):
    train_shot(world.shot, short(world, "kept"), quiet())
    with pytest.raises(Cancelled):
        train_shot(world.shot, short(world, "kept", seed=5), quiet(cancel_at=("loading frames", 0.5)))
    assert load_run(world.shot, "kept").config.seed == 0


def test_a_run_of_other_cameras_is_refused(tmp_path, quiet):
    import sys

    build_world = sys.modules[quiet.__module__].build_world
    world = build_world(tmp_path)
    train_shot(world.shot, short(world, "main"), quiet())
    path = world.shot.solve / "cameras.json"
    path.write_text(path.read_text().replace("registered", "localised", 1))
    with pytest.raises(JobError, match="other cameras"):
        load_run(world.shot, "main")


def test_damaged_checkpoint_is_an_error_in_words(world, quiet):
    train_shot(world.shot, short(world, "damaged"), quiet())
    path = world.shot.run("damaged") / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(JobError, match="cannot be read"):
        load_run(world.shot, "damaged")


def test_a_bad_frame_is_skipped_not_learnt(world, quiet):
    scene = load_scene(world.shot)
    config = config_from_params(TrainParams(iterations=40))
    images = load_images(scene, scene.solved, 64, 48)
    report = quiet()
    trainer = Trainer(scene, images, scene.solved, config, report)
    trainer.images[5] = math.nan
    for _ in range(16):
        trainer.step()
        trainer.iteration += 1
    assert any(e[0] == "warning" and "not finite" in e[1] for e in report.events)
    assert all(bool(torch.isfinite(p).all()) for p in trainer.model.gaussians.params.values())


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
