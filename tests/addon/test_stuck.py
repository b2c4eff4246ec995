"""Panels in states where artists found a disabled button or an empty panel: which buttons and text they show."""

import json
import shutil
from pathlib import Path

import bpy
import pytest


@pytest.fixture
def with_raw(shot) -> Path:
    """Shot with the import's pictures, as before the solve."""
    raw = shot / "frames" / "raw"
    raw.mkdir()
    for n in (5, 6, 7):
        shutil.copy(shot / "frames" / f"{n:06d}.png", raw)
    return shot


@pytest.fixture
def session(addon, shot, monkeypatch, stand_in):
    """Session whose backend only listens, held by the view."""
    viewport = addon("freeze.viewport")
    python = stand_in("exec cat > /dev/null")
    one = addon("freeze.live").open_session(shot, "nothing", python, addon("process.backend").package_root())
    monkeypatch.setattr(viewport, "_session", one)
    yield one
    viewport.end()
    one.close()


def test_scrubbing_can_be_stopped_while_a_job_runs_and_when_the_shot_is_gone(addon, with_shot, shot, session):
    viewport = addon("freeze.viewport")
    session.failure = None
    assert session.open and not bpy.ops.splannequin.suggested_instant.poll()
    nothing = addon("process.steps").View(False, False, [], "")
    assert addon("freeze.panel").can_scrub(nothing, "train")
    shot.rename(shot.with_name("gone"))
    addon("process.job_timer").forget()
    assert bpy.ops.splannequin.live.poll()
    assert bpy.ops.splannequin.live() == {"FINISHED"} and viewport.session() is None
    assert not addon("freeze.panel").can_scrub(nothing, "train") and not addon("freeze.panel").can_scrub(nothing, None)


def test_the_solve_can_be_loaded_while_the_shot_trains(addon):
    can = addon("solve.panel").can_load_camera
    assert can(None) and can("train") and can("freeze") and can("bake")
    assert not can("import") and not can("solve")


def test_an_instant_that_nobody_chose_is_the_one_that_is_drawn(addon, with_shot, session):
    viewport, props = addon("freeze.viewport"), with_shot.splannequin
    session.facts = {"suggestions": [{"frame": 6, "seen": 0.9, "sharpness": 0.8}]}
    viewport._suggest(with_shot)
    assert (props.t_star, props.choose_t_star) == (6, False) and viewport.instant(with_shot) == 6
    props.choose_t_star, props.t_star = True, 5
    viewport._suggest(with_shot)
    assert props.t_star == 5 == viewport.instant(with_shot)


def test_the_log_that_is_offered_has_something_in_it(addon, contract, shot, with_shot):
    steps = addon("process.steps").STEPS
    job = addon("process.jobs").new_job(shot, "solve", contract.SolveParams())
    (job.folder / "log.txt").touch()
    assert steps["solve"].log(job) is None, "an empty file helps nobody"
    (shot / "solve" / "colmap.log").write_text("what COLMAP said")
    assert steps["solve"].log(job) == shot / "solve" / "colmap.log"
    (job.folder / "log.txt").write_text("what the backend said")
    assert steps["solve"].log(job) == job.folder / "log.txt"
    train_job = addon("process.jobs").new_job(shot, "train", contract.TrainParams())
    assert steps["train"].log(train_job) is None


def test_which_frames_are_solved_is_a_setting(addon, scene, tmp_path):
    scene.splannequin.clip = str(tmp_path / "a.mp4")
    params = addon("process.steps").STEPS["import"].params(scene)
    assert (params.step, params.fps) == (0, 0.0)
    scene.splannequin.solve_step, scene.splannequin.fps = 3, 25.0
    params = addon("process.steps").STEPS["import"].params(scene)
    assert (params.step, params.fps) == (3, 25.0)


def test_the_rate_of_a_sequence_is_the_one_that_was_set(addon, scene, tmp_path, pictures):
    import numpy as np

    noise = np.random.default_rng(0)
    wide = noise.integers(0, 255, (12, 24, 3), dtype=np.uint8).repeat(10, axis=0).repeat(10, axis=1)
    for n in range(1, 10):
        pictures.write(tmp_path / f"f.{n:04d}.png", np.ascontiguousarray(wide[:, 8 * n : 8 * n + 160]))
    scene.splannequin.clip, scene.splannequin.fps = str(tmp_path / "f.0001.png"), 30.0
    assert bpy.ops.splannequin.import_clip() == {"FINISHED"}
    assert addon("shot.inventory").read(addon("shot.selection").shot_folder(scene)).info["fps"] == 30.0


def test_named_colour_space_reaches_the_request(addon, scene, tmp_path):
    scene.splannequin.clip, scene.splannequin.colour_space = str(tmp_path / "a.mp4"), " ARRI LogC3 (EI800) "
    params = addon("process.steps").STEPS["import"].params(scene)
    assert params.colour_space == "ARRI LogC3 (EI800)"


def test_manual_footage_settings_reach_the_request(addon, scene, tmp_path):
    props = scene.splannequin
    props.clip = str(tmp_path / "a.mp4")
    plain = addon("process.steps").STEPS["import"].params(scene)
    assert (plain.layer, plain.pixel_aspect, plain.matrix, plain.levels) == ("", 0.0, "auto", "auto")
    props.layer, props.pixel_aspect, props.matrix, props.levels = " left ", 1.333, "bt601", "full"
    params = addon("process.steps").STEPS["import"].params(scene)
    assert (params.layer, params.pixel_aspect, params.matrix, params.levels) == ("left", 1.333, "bt601", "full")


def test_the_panel_says_how_the_footage_was_read(addon, with_shot):
    shot = addon("shot.selection").shot_folder(with_shot)
    listing = shot / "frames" / "frames.json"
    frames_record = json.loads(listing.read_text())
    frames_record["read_as"] = [
        "Read as 64 x 48, 24 fps.",
        7,
        "Assumed, because the footage does not state it: matrix.",
    ]
    listing.write_text(json.dumps(frames_record))
    view = addon("process.steps").STEPS["import"].view(with_shot, addon("shot.inventory").read(shot))
    assert view.state[-2:] == [frames_record["read_as"][0], frames_record["read_as"][2]]


def test_after_the_import_the_clip_is_seen_and_nothing_else_is_touched(addon, with_shot, with_raw):
    scene, plate = with_shot, addon("footage.plate")
    mine, objects = scene.camera, set(scene.objects)
    said = addon("footage.arrival").imported(scene, with_raw)
    camera = plate.find(scene, with_raw)
    assert f"{camera.name} shows the clip until the camera is solved." in said
    assert scene.camera == mine and set(scene.objects) - objects == {camera}
    background = camera.data.background_images[0]
    assert Path(background.image.filepath) == with_raw / "frames" / "raw" / "000005.png"
    assert (background.image_user.frame_start, background.image_user.frame_duration) == (5, 3)
    assert camera.data.show_background_images
    addon("footage.arrival").imported(scene, with_raw)
    assert set(scene.objects) - objects == {plate.find(scene, with_raw)}, "again: in place of the first"


def test_the_solved_camera_takes_the_clips_place(addon, with_shot, with_raw):
    scene, plate = with_shot, addon("footage.plate")
    before = set(bpy.data.images), set(bpy.data.cameras)
    addon("footage.arrival").imported(scene, with_raw)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    assert plate.find(scene, with_raw) is None and scene.camera == addon("solve.cameras").find(
        scene, with_raw, "CAMERA"
    )
    assert not [c for c in bpy.data.cameras if "plate" in c.name]
    addon("process.begin").remove_all(scene, with_raw)
    assert (set(bpy.data.images), set(bpy.data.cameras)) == before


def test_removing_the_shot_before_the_solve_takes_the_clips_camera_along(addon, with_shot, with_raw):
    before = set(bpy.data.objects), set(bpy.data.images), set(bpy.data.cameras)
    addon("footage.arrival").imported(with_shot, with_raw)
    addon("process.begin").remove_all(with_shot, with_raw)
    assert (set(bpy.data.objects), set(bpy.data.images), set(bpy.data.cameras)) == before


def test_a_listing_that_is_broken_shows_no_plate(addon, with_shot, with_raw):
    listing = with_raw / "frames" / "frames.json"
    for text in ('{"frames": []}', '{"frames": [{"frame": 1, "file": 3}]}', "[", '{"frames": 3}'):
        listing.write_text(text)
        assert addon("footage.plate").show(with_shot, with_raw) is None
    listing.write_text(json.dumps({"frames": [{"frame": 1, "file": "../../../etc/hostname"}]}))
    assert addon("footage.plate").show(with_shot, with_raw) is None, "no picture of another place"


def test_a_missing_backend_says_why(addon, monkeypatch, tmp_path):
    backend = addon("process.backend")
    monkeypatch.setattr(backend, "_state", None)
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "gone"))
    assert "does not exist" in backend.state()[1].message
    monkeypatch.delenv("SPLANNEQUIN_BACKEND_PYTHON")
    backend.clear_state()
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SPLANNEQUIN_HOME", str(tmp_path))
    trouble = backend.state()[1]
    assert trouble is None or "is not set up" in trouble.message


def test_interrupted_environment_is_not_accepted(addon, contract, monkeypatch, tmp_path):
    """Set-up was cancelled, or Blender was closed during it: the interpreter exists, the packages do not."""
    backend = addon("process.backend")
    monkeypatch.delenv("SPLANNEQUIN_BACKEND_PYTHON", raising=False)
    monkeypatch.setenv("SPLANNEQUIN_HOME", str(tmp_path))
    python = backend.venv_python(tmp_path / ".venv")
    python.parent.mkdir(parents=True)
    python.touch()
    assert backend.python() == str(python), "somebody's own environment has no notes of ours, and is believed"
    notes = tmp_path / ".venv" / ".splannequin"
    notes.mkdir()
    refused = "The backend's set-up did not finish"
    # named explicitly, so that no other environment is used instead
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(python))

    def said() -> str:
        trouble = backend.trouble()
        if trouble is None:
            return ""
        assert trouble.exit_code == contract.ExitCode.ENVIRONMENT and "Press Repair" in trouble.hint
        return trouble.message

    assert said() == f"{refused}. The environment in {tmp_path / '.venv'} is incomplete."
    (notes / "installing").touch()
    assert refused in said()
    (notes / "installed.json").write_text("{}")
    assert refused in said(), "a repair was begun and has not finished"
    monkeypatch.delenv("SPLANNEQUIN_BACKEND_PYTHON")
    found = backend.trouble()
    assert (found is not None and refused in found.message) or backend.python() != str(python), "the next one is taken"
    (notes / "installing").unlink()
    assert backend.python() == str(python)
