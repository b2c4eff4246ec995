"""All steps from an imported clip to frozen frames by one button, on real jobs."""

import shutil

import bpy
import pytest


@pytest.fixture
def chain(addon):
    return addon("process.all_steps")


@pytest.fixture
def solved(scene, frozen_world):
    """The tiny shot without takes. Its training was stopped after the last checkpoint, before the end."""
    shot = frozen_world / "tiny.splannequin"
    shutil.rmtree(shot / "takes", ignore_errors=True)
    (shot / "runs" / "main" / "summary.json").unlink(missing_ok=True)
    scene.splannequin.shot_path = str(shot)
    return shot


@pytest.fixture
def watch(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    return addon("process.job_timer").watch_of(shot)


def ended_job(addon, contract, watch, step, state="done"):
    """Make the newest job of a step an ended one."""
    job = addon("process.jobs").new_job(watch.shot, step, contract.STEP_PARAMS[step]())
    job.status = contract.Status(step, state, 0, 0.0, 1.0, 0.0)
    watch.jobs[step] = job


def begun(chain, watch, remaining, step="solve"):
    """Register a chain of steps with `step` running and `remaining` still to run."""
    found = chain.Chain(list(remaining), chain.contract.TotalProgress({}), step)
    chain._chains[watch.shot] = found
    return found


def test_no_step_is_missing_before_the_import(scene, chain):
    assert chain.missing(scene) == [] and not bpy.ops.splannequin.all_steps.poll()


def test_one_press_trains_and_freezes_what_is_solved(addon, scene, chain, solved, contract):
    assert chain.missing(scene) == ["train", "freeze"]
    scene.splannequin.choose_t_star, scene.splannequin.t_star = True, 104
    scene.splannequin.detail = scene.splannequin.develop = False
    assert bpy.ops.splannequin.all_steps() == {"FINISHED"}
    assert chain.missing(scene) == [] and not bpy.ops.splannequin.all_steps.poll()
    state = addon("shot.inventory").read(solved)
    assert state.takes["freeze"]["t_star_frame"] == 104 and state.takes["freeze"]["frame_count"] > 0
    assert chain.progress(solved) is None
    shutil.rmtree(solved / "takes")
    addon("process.job_timer").refresh(addon("process.job_timer").watch_of(solved))
    assert chain.missing(scene) == ["freeze"], "what is done is not done again"


def test_a_step_that_fails_is_the_last_one(addon, scene, chain, solved, monkeypatch, tmp_path):
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "gone"))
    with pytest.raises(RuntimeError, match="SPLANNEQUIN_BACKEND_PYTHON does not exist"):
        bpy.ops.splannequin.all_steps()
    failures = addon("process.job_timer").watch_of(solved).failures
    assert list(failures) == ["train"] and chain.progress(solved) is None


@pytest.mark.parametrize("state", ["failed", "cancelled"])
def test_after_a_job_that_did_not_end_well_nothing_is_begun(addon, contract, chain, watch, monkeypatch, state):
    pressed = []
    monkeypatch.setattr(chain, "_begin_next", lambda found, scene: pressed.append(found.remaining.pop(0)))
    found = begun(chain, watch, ["train", "freeze"])
    ended_job(addon, contract, watch, "solve", state)
    assert chain._turn(watch.shot, found) is False and pressed == [] and chain.progress(watch.shot) is None


def test_the_next_step_begins_when_the_one_before_is_done_and_its_shot_is_chosen(
    addon, contract, scene, chain, watch, monkeypatch
):
    pressed = []
    monkeypatch.setattr(chain, "_begin_next", lambda found, scene: pressed.append(found.remaining.pop(0)))
    found = begun(chain, watch, ["train"])
    ended_job(addon, contract, watch, "solve", "running")
    assert chain._turn(watch.shot, found) is True and pressed == []
    ended_job(addon, contract, watch, "solve")
    addon("shot.selection").add(scene)  # chooses another shot of the scene
    assert chain._turn(watch.shot, found) is True and pressed == []
    addon("shot.selection").choose(scene, 0)
    assert chain._turn(watch.shot, found) is True and pressed == ["train"]


def test_a_file_without_the_shot_ends_it(addon, contract, scene, chain, watch):
    found = begun(chain, watch, ["train"])
    ended_job(addon, contract, watch, "solve")
    scene.splannequin.shot_path = ""
    assert chain._turn(watch.shot, found) is False and chain.progress(watch.shot) is None


def test_cancel_between_two_steps_ends_it(addon, contract, chain, watch):
    found = begun(chain, watch, ["train"])
    ended_job(addon, contract, watch, "solve")
    assert bpy.ops.splannequin.cancel() == {"FINISHED"}
    assert chain._turn(watch.shot, found) is False


def test_the_bar_goes_by_what_the_running_job_says_of_itself(addon, contract, chain, watch):
    found = begun(chain, watch, ["train"])
    found.way = contract.TotalProgress({"solve": 50.0, "train": 100.0})
    ended_job(addon, contract, watch, "solve", "running")
    job = watch.jobs["solve"]
    job.status.stage, job.status.eta_seconds = "solve", 50.0
    share, left = chain.progress(watch.shot)
    assert left == pytest.approx(150.0, abs=1.0) and share < 0.05
    job.status.eta_seconds = 100.0  # a busy machine: the estimate doubles
    assert chain.progress(watch.shot)[1] == pytest.approx(300.0, abs=2.0)
