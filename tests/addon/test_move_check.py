"""Check of a camera move before the freeze: a real backend reports the areas that its pictures will lack."""

import shutil

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


def found(addon, scene, world, name):
    check = addon("freeze.move_check")
    return check.waited(check.checking(scene, world, name)).shares


def test_guessed_share_is_small_near_the_path_and_full_when_turned_away(addon, scene, world, move):
    scene.frame_set(103)
    shares = found(addon, scene, world, move.name)
    assert list(shares) == list(range(101, 117)) and scene.frame_current == 103
    assert np.mean(list(shares.values())) < 0.3
    turned_camera = bpy.data.objects.new("away", move.data)
    scene.collection.objects.link(turned_camera)
    scene.frame_set(105)
    turned_camera.matrix_world = move.matrix_world @ Matrix.Rotation(np.pi, 4, "Y")
    bpy.context.view_layer.update()
    assert min(found(addon, scene, world, "away").values()) > 0.95


def test_the_operator_says_it_and_leaves_the_scene_as_it_is(addon, scene, world, move):
    scene.frame_set(110)
    assert bpy.ops.splannequin.check_move() == {"FINISHED"}
    watch = addon("process.job_timer").watch_of(world)
    assert len(watch.notes["freeze"]) == 1 and move.name in watch.notes["freeze"][0]
    assert scene.frame_current == 110 and not watch.running()
    scene.splannequin.path_camera = None
    assert not bpy.ops.splannequin.check_move.poll()


def test_long_move_is_checked_at_sampled_frames(addon, scene, world, move):
    scene.frame_start, scene.frame_end = 101, 301
    shares = found(addon, scene, world, move.name)
    assert len(shares) <= addon("freeze.move_check").MOST_FRAMES + 1
    assert min(shares) == 101 and max(shares) == 301


def test_in_a_window_it_takes_turns_and_can_be_stopped(addon, scene, world, move):
    timer, check = addon("process.job_timer"), addon("freeze.move_check")
    timer.work(world, "freeze", check._in_turns(scene.session_uid, world, move.name))
    watch = timer.watch_of(world)
    for _ in range(20):
        timer.tick()
    assert watch.running() == "freeze" and watch.work.progress is not None
    assert timer.stop_work(watch) and watch.running() is None and "freeze" not in watch.failures


def test_a_run_that_cannot_be_loaded_is_named(addon, contract, scene, world, move, tmp_path):
    broken = tmp_path / "broken.splannequin"
    shutil.copytree(world, broken)
    (broken / "runs" / scene.splannequin.run_name / "checkpoint.safetensors").write_bytes(b"nothing")
    with pytest.raises(contract.JobError):
        found(addon, scene, broken, move.name)
