"""Operators for camera moves: keys, the path that Freeze reads, undo, and two shots in one file."""

import json
import shutil

import bpy
import numpy as np
import pytest
from mathutils import Matrix

FIRST, LAST = 5, 44


@pytest.fixture
def shaky(addon, scene, shot):
    """Shot with 40 frames of a shaky walk past its points; its camera is in the scene, its root is moved and scaled."""
    return with_walk(addon, scene, shot)


def with_walk(addon, scene, shot, seed=0):
    cameras = json.loads((shot / "solve" / "cameras.json").read_text())
    rng, frames = np.random.default_rng(seed), []
    for n in range(FIRST, LAST + 1):
        viewmat = np.eye(4)
        viewmat[:3, 3] = np.array([-0.05 * (n - 25), 0.1, 4.0]) + 0.02 * rng.normal(size=3)
        frames.append({"frame": n, "viewmat": viewmat.ravel().tolist(), "K": [*[20.0 + 0.1 * n] * 2, 9.0, 5.0]})
    (shot / "solve" / "cameras.json").write_text(json.dumps({**cameras, "frames": frames}))
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    root = addon("solve.cameras").find(scene, shot, "EMPTY")
    root.matrix_world = (
        Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.7, 4, "Z") @ Matrix.Scale(2.0, 4) @ root.matrix_world
    )
    bpy.context.view_layer.update()
    return shot


def path_read(addon, scene, shot):
    """Camera path that Freeze would send to the backend."""
    turns = addon("freeze.own_camera").sample_path(scene, addon("freeze.own_camera").name_of(scene), shot, 0)
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return end.value


def test_zero_smoothing_keeps_the_clip_path(addon, contract, scene, shaky):
    assert bpy.ops.splannequin.move_smooth(position=0.0, rotation=0.0) == {"FINISHED"}
    camera = scene.splannequin.path_camera
    assert camera.name.endswith(" smooth") and camera.parent == addon("solve.cameras").find(scene, shaky, "EMPTY")
    found, want = path_read(addon, scene, shaky), contract.CameraPath.load(shaky / "solve" / "cameras.json")
    assert [f.frame for f in found.frames] == list(range(FIRST, LAST + 1))
    for one, expected in zip(found.frames, want.frames, strict=True):
        np.testing.assert_allclose(one.viewmat, expected.viewmat, atol=1e-4)
        np.testing.assert_allclose(one.K, expected.K, rtol=1e-4)


def test_smooth_at_1_leaves_a_tenth_of_the_second_difference(addon, contract, scene, shaky):
    bpy.ops.splannequin.move_smooth(position=1.0, rotation=1.0)
    moves, axes = addon("freeze.moves"), addon("scene.axes")
    want = axes.poses(contract.CameraPath.load(shaky / "solve" / "cameras.json"))
    found = axes.poses(path_read(addon, scene, shaky))
    assert moves.unsteadiness(want)[0] > 10 * moves.unsteadiness(found)[0]
    np.testing.assert_allclose(found[[0, -1]], want[[0, -1]], atol=1e-4)


def test_a_camera_is_an_ordinary_one_that_can_be_edited(addon, scene, shaky):
    bpy.ops.splannequin.move_smooth()
    camera = scene.splannequin.path_camera
    assert scene.camera == camera and not camera.constraints and camera.users_collection
    curves = list(addon("compat_animation").fcurves(camera))
    assert {c.data_path for c in curves} == {"location", "rotation_quaternion"}
    before = np.array(path_read(addon, scene, shaky).frames[3].viewmat)
    for point in curves[0].keyframe_points:
        point.co.y += 0.5
    assert np.abs(np.array(path_read(addon, scene, shaky).frames[3].viewmat) - before).max() > 0.1
    solved = addon("solve.cameras").find(scene, shaky, "CAMERA")
    assert solved != camera and solved.data != camera.data, "the solved camera is left as it is"
    bpy.ops.splannequin.move_smooth()
    assert scene.splannequin.path_camera != camera, "a second move takes nothing from the first"


def test_retime_stops_at_the_current_frame_and_the_range_follows(addon, scene, shaky):
    scene.frame_set(25)
    bpy.ops.splannequin.move_retime(ease_in=8, hold=10, ease_out=4)
    path = path_read(addon, scene, shaky)
    assert (scene.frame_start, scene.frame_end) == (FIRST, LAST + 4 + 10 + 2)
    still = [f for f in path.frames if np.allclose(f.viewmat, path.frames[30].viewmat, atol=1e-5)]
    assert [f.frame for f in still] == list(range(25 + 4, 25 + 4 + 11))
    assert path.frames[0].K[0] == pytest.approx(20.5, rel=1e-4) and path.frames[-1].K[0] == pytest.approx(
        24.4, rel=1e-4
    )
    assert still[0].K[0] == pytest.approx(22.5, rel=1e-4), "its lens is that of the frame it stands at"
    scene.frame_start, scene.frame_end = 1, 3
    bpy.ops.splannequin.move_retime(fit_range=False)
    assert (scene.frame_start, scene.frame_end) == (1, 3)


def test_hold_lasts_seconds_of_the_scene(addon, scene, shaky):
    scene.render.fps, scene.render.fps_base = 30, 1.0
    bpy.ops.splannequin.move_hold(frame=25, seconds=0.5, ease=0)
    path = path_read(addon, scene, shaky)
    assert len(path.frames) == LAST - FIRST + 1 + 15
    for frame in path.frames[20:36]:
        np.testing.assert_allclose(frame.viewmat, path.frames[20].viewmat, atol=1e-5)


@pytest.mark.parametrize(("angle", "rise"), [(0.4, 0.0), (0.0, 0.3), (-0.4, -0.3)])
def test_orbit_leaves_the_path_around_the_middle_and_comes_back(addon, scene, shaky, angle, rise):
    scene.render.fps, scene.render.fps_base = 24, 1.0
    scene.frame_set(25)
    standing = addon("solve.cameras").find(scene, shaky, "CAMERA").matrix_world.copy()
    bpy.ops.splannequin.move_orbit(frame=25, seconds=1.0, ease=0, angle=angle, rise=rise, distance=6.0)
    camera, places = scene.splannequin.path_camera, []
    for frame in (25, 25 + 12, 25 + 24):
        scene.frame_set(frame)
        places.append(np.array(camera.matrix_world))
    np.testing.assert_allclose(places[0], standing, atol=1e-4)
    np.testing.assert_allclose(places[2], places[0], atol=1e-4)
    # The principal point is not the picture's centre: fx 22.5, cx 9, cy 5, 16 x 12 pixels.
    ray = np.array(standing)[:3, :3] / 2.0 @ [(8 - 9) / 22.5, -(6 - 5) / 22.5, -1.0]
    pivot = np.array(standing)[:3, 3] + 6.0 * ray
    for place in places:
        local = np.linalg.inv(place) @ [*pivot, 1.0]
        np.testing.assert_allclose(local, np.linalg.inv(places[0]) @ [*pivot, 1.0], atol=1e-4)
    moved = places[1][:3, 3] - places[0][:3, 3]
    right = np.array(standing)[:3, 0] / 2.0
    if angle:
        assert np.sign(moved @ right) == np.sign(angle)
    if rise:
        assert np.sign(moved[2]) == np.sign(rise)
    else:
        assert moved[2] == pytest.approx(0.0, abs=1e-4), "it swings around the scene's upward axis"


def test_middle_depth_comes_from_the_take_before_the_points(addon, scene, shaky):
    operators = addon("freeze.move_operators")
    path = operators.clip_path(shaky)
    z = addon("freeze.middle_depth").of_frame(shaky / "takes" / "freeze" / "000006.exr")
    assert operators.found_depth(scene, path, 6, path.poses[1]) == z > 0
    xyz = addon("solve.cameras").points_of(shaky)[0]
    by_points = operators.found_depth(scene, path, 25, path.poses[20])  # the take does not have frame 25
    assert 4.0 + xyz[:, 2].min() - 0.2 < by_points < 4.0 + xyz[:, 2].max() + 0.2
    facts = shaky / "takes" / "freeze" / "take.json"
    facts.write_text(json.dumps({**json.loads(facts.read_text()), "camera_path": "/somewhere/else.json"}))
    assert operators.found_depth(scene, path, 6, path.poses[1]) != z, "a take of another camera shows something else"
    (shaky / "solve" / "points.npz").unlink()
    with pytest.raises(RuntimeError, match="frame 25"):
        bpy.ops.splannequin.move_orbit(frame=25)
    assert bpy.ops.splannequin.move_orbit(frame=25, distance=3.0) == {"FINISHED"}


def test_two_shots_each_keep_their_move(addon, scene, shaky, tmp_path):
    bpy.ops.splannequin.move_smooth()
    one = scene.splannequin.path_camera
    selection = addon("shot.selection")
    selection.add(scene)
    copy = tmp_path / "second.splannequin"
    shutil.copytree(shaky, copy)
    with_walk(addon, scene, copy, seed=1)
    assert scene.splannequin.path_camera is None
    bpy.ops.splannequin.move_hold(frame=20)
    second = scene.splannequin.path_camera
    assert second.name == "second hold" and second.parent == addon("solve.cameras").find(scene, copy, "EMPTY")
    selection.choose(scene, 0)
    assert scene.splannequin.path_camera == one and one.parent == addon("solve.cameras").find(scene, shaky, "EMPTY")
    selection.choose(scene, 1)
    assert scene.splannequin.path_camera == second


def test_move_needs_the_solve_in_the_scene(scene, shot):
    scene.splannequin.shot_path = str(shot)
    assert not bpy.ops.splannequin.move_smooth.poll()
