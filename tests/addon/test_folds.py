"""Open steps of the panel: the current step, and steps that the artist opened or closed."""

import json
import shutil

import pytest

STEPS = ("import", "solve", "train", "freeze", "bake")


@pytest.fixture
def watch(addon, with_shot, shot):
    return addon("process.job_timer").watch_of(shot)


def opened(scene):
    return [step for step in STEPS if getattr(scene.splannequin, f"is_{step}_open")]


def look_again(addon, watch):
    watch.state = addon("shot.inventory").read(watch.shot)


def test_new_scene_shows_only_the_import_panel_open(scene):
    assert opened(scene) == ["import"]


def test_each_step_opens_when_those_before_it_are_done(addon, with_shot, watch, shot):
    assert opened(with_shot) == ["solve"], "the camera is yet to be loaded into the scene"
    addon("solve.arrival").load_camera(with_shot, shot)
    assert opened(with_shot) == ["bake"]
    for part, step in (("takes/freeze", "freeze"), ("runs/main", "train"), ("solve", "solve"), ("frames", "import")):
        shutil.rmtree(shot / part)
        look_again(addon, watch)
        assert opened(with_shot) == [step]


def test_finished_step_stays_open_until_another_begins(addon, contract, with_shot, watch, shot):
    timer = addon("process.job_timer")
    addon("solve.arrival").load_camera(with_shot, shot)
    job = addon("process.jobs").new_job(shot, "freeze", contract.FreezeParams())
    timer.follow("freeze", job)
    assert opened(with_shot) == ["freeze"], "it runs"
    done = contract.Event("done", 1, 1.0, {"result": {"t_star_frame": 6, "take": "freeze", "first": 5, "last": 7}})
    (job.folder / contract.EVENTS_FILE).write_text(json.dumps(done.__dict__) + "\n")
    status = contract.Status("freeze", "done", 1, 1.0, 2.0, 2.0, fraction=1.0)
    contract.write_json(job.folder / contract.STATUS_FILE, status.__dict__)
    for _ in range(5):
        timer.tick()
    assert opened(with_shot) == ["freeze", "bake"], "its verdict is to be read"
    timer.follow("bake", addon("process.jobs").new_job(shot, "freeze", contract.FreezeParams()))
    assert opened(with_shot) == ["bake"]


def test_a_step_that_failed_is_open(addon, with_shot, watch, shot):
    addon("solve.arrival").load_camera(with_shot, shot)
    watch.fail("train", ValueError("no"))
    assert opened(with_shot) == ["train"]


def test_the_artist_opens_and_closes_as_they_like(addon, scene, with_shot, watch, shot):
    props = with_shot.splannequin
    addon("solve.arrival").load_camera(with_shot, shot)
    props.is_train_open, props.is_bake_open = True, False
    assert opened(with_shot) == ["train"]
    shutil.rmtree(shot / "takes" / "freeze")
    look_again(addon, watch)
    assert opened(with_shot) == ["train", "freeze"], "what is at hand opens beside what the artist opened"


def test_step_opened_early_closes_when_done(addon, with_shot, watch, shot, tmp_path):
    addon("solve.arrival").load_camera(with_shot, shot)
    shutil.move(shot / "takes" / "freeze", tmp_path / "kept")
    shutil.move(shot / "runs" / "main", tmp_path / "run")
    look_again(addon, watch)
    with_shot.splannequin.is_freeze_open = True
    assert opened(with_shot) == ["train", "freeze"]
    shutil.move(tmp_path / "run", shot / "runs" / "main")
    look_again(addon, watch)
    assert opened(with_shot) == ["freeze"]
    shutil.move(tmp_path / "kept", shot / "takes" / "freeze")
    look_again(addon, watch)
    assert opened(with_shot) == ["bake"]


def test_a_missing_shot_opens_the_import(addon, with_shot, watch, shot):
    addon("solve.arrival").load_camera(with_shot, shot)
    shot.rename(shot.with_name("elsewhere"))
    look_again(addon, watch)
    assert opened(with_shot) == ["import"]


def test_folded_panels_are_stored_per_shot(addon, with_shot, watch, shot, tmp_path):
    addon("solve.arrival").load_camera(with_shot, shot)
    with_shot.splannequin.is_train_open = True
    addon("shot.selection").add(with_shot)
    assert opened(with_shot) == ["import"]
    with_shot.splannequin.active_shot = 0
    assert opened(with_shot) == ["train", "bake"]
