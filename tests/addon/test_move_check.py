"""Check of a camera move before the freeze: a real backend reports the areas that its pictures will lack."""

import re

import bpy
import numpy as np
import pytest
from mathutils import Matrix


@pytest.fixture(scope="module")
def world(frozen_world):
    """The backend's tiny world, trained."""
    return frozen_world / "tiny.splannequin"


@pytest.fixture
def move(addon, scene, world):
    """The world's shot with its camera in the scene, and a smoothed copy of the camera as freeze path."""
    scene.splannequin.shot_path = str(world)
    scene.splannequin.set_up_scene = True
    scene.splannequin.t_star, scene.splannequin.choose_t_star = 105, True
    addon("solve.arrival").load_camera(scene, world)
    assert bpy.ops.splannequin.move_smooth() == {"FINISHED"}
    return scene.splannequin.path_camera


@pytest.fixture(scope="module")
def _session(addon, world):
    backend = addon("process.backend")
    one = addon("freeze.live").open_session(world, "main", backend.python(), backend.package_root())
    yield one
    one.close()


@pytest.fixture
def scrubbed(addon, _session, monkeypatch):
    """A real session of the run, which the view shows and the check shares."""
    monkeypatch.setattr(addon("freeze.viewport"), "_session", _session)


def test_the_operator_says_a_small_share_near_the_path_and_leaves_the_scene_as_it_is(
    addon, scene, world, move, scrubbed
):
    scene.frame_set(110)
    assert bpy.ops.splannequin.check_move() == {"FINISHED"}
    watch = addon("process.job_timer").watch_of(world)
    (said,) = watch.notes["freeze"]
    assert move.name in said and int(re.search(r"about (\d+) %", said)[1]) < 30
    assert scene.frame_current == 110 and not watch.running()
    scene.splannequin.path_camera = None
    assert not bpy.ops.splannequin.check_move.poll()


def test_share_is_full_when_turned_away_and_a_long_move_is_checked_at_sampled_frames(
    addon, scene, world, move, scrubbed, monkeypatch
):
    turned_camera = bpy.data.objects.new("away", move.data)
    scene.collection.objects.link(turned_camera)
    scene.frame_set(105)
    turned_camera.matrix_world = move.matrix_world @ Matrix.Rotation(np.pi, 4, "Y")
    bpy.context.view_layer.update()
    scene.frame_start, scene.frame_end = 101, 301
    check = addon("freeze.move_check")
    monkeypatch.setattr(check, "MOST_FRAMES", 6)
    shares = check.waited(check.checking(scene, world, "away")).shares
    assert min(shares.values()) > 0.95
    assert len(shares) <= check.MOST_FRAMES + 1 and min(shares) == 101 and max(shares) == 301


def test_in_a_window_it_takes_turns_and_can_be_stopped(addon, scene, world, move, stand_in):
    stand_in("exec cat > /dev/null")
    timer, check = addon("process.job_timer"), addon("freeze.move_check")
    timer.work(world, "freeze", check._in_turns(scene.session_uid, world, move.name))
    watch = timer.watch_of(world)
    for _ in range(20):
        timer.tick()
    assert watch.running() == "freeze" and watch.work.progress is not None
    assert timer.stop_work(watch) and watch.running() is None and "freeze" not in watch.failures


def test_a_session_that_ends_ends_the_check(addon, contract, scene, world, move, stand_in):
    stand_in("exit 3")
    check = addon("freeze.move_check")
    with pytest.raises(contract.JobError):
        check.waited(check.checking(scene, world, move.name))
