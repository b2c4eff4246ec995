"""Buttons for floor, origin and scale, on a scene (tests/addon_free tests the maths)."""

import json

import bpy
import numpy as np
import pytest


@pytest.fixture
def maths(addon):
    return addon("solve.alignment")


def test_first_placement_puts_the_solve_on_the_floor(addon, contract):
    cameras = addon("solve.cameras")
    tilt = np.radians(25.0)  # the camera looks down at a table: its up vector leans forward
    right, down = np.array([1.0, 0, 0]), -np.array([0, np.sin(tilt), np.cos(tilt)])
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, down, np.cross(right, down)]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [0, -3, 1.6]
    path = contract.CameraPath(640, 480, [contract.CameraFrame(1, viewmat.ravel().tolist(), [500, 500, 320, 240])])
    points = np.random.default_rng(0).uniform((-1, -1, 0.2), (1, 1, 2), (100, 3))
    placed = cameras.scene_from_solve(path, points, ([0.0, 0.0, 1.0], 0.2))
    np.testing.assert_allclose(placed[:3, :3] @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose((placed @ [0.3, 0.7, 0.2, 1])[2], 0.0, atol=1e-12)
    leaning = cameras.scene_from_solve(path, points)
    np.testing.assert_allclose(leaning[:3, :3] @ -down, [0, 0, 1], atol=1e-12)


def test_solve_is_placed_on_its_detected_floor(addon, scene, shot):
    file = shot / "solve" / "solve.json"
    normal = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])
    file.write_text(json.dumps({**json.loads(file.read_text()), "floor": {"normal": normal.tolist(), "height": 0.7}}))
    cameras = addon("solve.cameras")
    cameras.build(scene, shot)
    root = np.array(cameras.find(scene, shot, "EMPTY").matrix_world)
    np.testing.assert_allclose(root[:3, :3] @ normal, [0, 0, 1], atol=1e-6)
    assert (root @ [*(0.7 * normal), 1.0])[2] == pytest.approx(0.0, abs=1e-6)


@pytest.fixture
def built(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    bpy.context.view_layer.update()
    return scene


def world(addon, scene, shot) -> np.ndarray:
    """Solved points [P, 3] in world space: points.npz transformed by the root."""
    bpy.context.view_layer.update()
    matrix = np.array(addon("solve.cameras").find(scene, shot, "EMPTY").matrix_world, dtype=np.float64)
    return np.load(shot / "solve" / "points.npz")["xyz"] @ matrix[:3, :3].T + matrix[:3, 3]


def test_the_buttons_turn_move_and_scale_the_root(addon, built, shot):
    cameras, ops = addon("solve.cameras"), bpy.ops.splannequin
    root = cameras.find(built, shot, "EMPTY")
    root.rotation_euler = (0.4, -0.7, 0.2)
    before = world(addon, built, shot)
    assert ops.align_floor(places=before[[0, 4, 9]].ravel()) == {"FINISHED"}
    np.testing.assert_allclose(world(addon, built, shot)[[0, 4, 9], 2], 0.0, atol=1e-5)
    for frame in (5, 6, 7):
        built.frame_set(frame)
        assert built.camera.matrix_world.translation.z > 0
    assert ops.align_origin(places=world(addon, built, shot)[4]) == {"FINISHED"}
    np.testing.assert_allclose(world(addon, built, shot)[4], 0.0, atol=1e-5)
    clip = built.camera.data.clip_end
    assert ops.align_scale(places=world(addon, built, shot)[[0, 9]].ravel(), distance=2.5) == {"FINISHED"}
    now = world(addon, built, shot)
    assert np.linalg.norm(now[0] - now[9]) == pytest.approx(2.5, abs=1e-4)
    np.testing.assert_allclose(now[[0, 4, 9], 2], 0.0, atol=1e-5, err_msg="the floor stays the floor")
    np.testing.assert_allclose(now[4], 0.0, atol=1e-5, err_msg="and the origin the origin")
    grown = np.linalg.norm(now[1:] - now[0], axis=1) / np.linalg.norm(before[1:] - before[0], axis=1)
    np.testing.assert_allclose(grown, grown[0], rtol=1e-4, err_msg="one factor for all axes")
    assert len(set(root.scale)) == 1 and root.scale[0] == pytest.approx(grown[0], rel=1e-4)
    assert built.camera.data.clip_end == pytest.approx(clip * grown[0], rel=1e-3)
    cameras.build(built, shot)
    np.testing.assert_allclose(world(addon, built, shot), now, atol=1e-6, err_msg="a new solve stands there, too")
    assert built.camera.data.clip_end == pytest.approx(clip * grown[0], rel=1e-3)


def test_selected_objects_serve_as_points(addon, built, shot):
    empties = []
    for place in ((0, 0, 1.0), (1, 0, 1.5), (0, 1, 1.0)):
        empties.append(bpy.data.objects.new("at", None))
        built.collection.objects.link(empties[-1])
        empties[-1].location = place
    bpy.ops.object.select_all(action="DESELECT")
    with pytest.raises(RuntimeError, match="0 objects are selected, 3 are needed"):
        bpy.ops.splannequin.align_floor(selected=True)
    for empty in empties:
        empty.select_set(True)
    addon("solve.cameras").find(built, shot, "EMPTY").select_set(True)  # the shot's root is not counted
    root = addon("solve.cameras").find(built, shot, "EMPTY")
    bpy.context.view_layer.update()
    relative = [root.matrix_world.inverted() @ e.matrix_world.translation for e in empties]
    assert bpy.ops.splannequin.align_floor(selected=True) == {"FINISHED"}
    np.testing.assert_allclose([(root.matrix_world @ at).z for at in relative], 0.0, atol=1e-5)
    with pytest.raises(RuntimeError, match="3 objects are selected, 2 are needed"):
        bpy.ops.splannequin.align_scale(selected=True)


def test_collinear_points_do_not_change_the_root(addon, built, shot):
    stood = np.array(addon("solve.cameras").find(built, shot, "EMPTY").matrix_world)
    with pytest.raises(RuntimeError, match="one line"):
        bpy.ops.splannequin.align_floor(places=[0, 0, 0, 1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(addon("solve.cameras").find(built, shot, "EMPTY").matrix_world, stood)


def test_no_solve_no_alignment(scene):
    assert not bpy.ops.splannequin.align_floor.poll()


def test_depth_in_the_compositor_and_the_view_follow_the_scale(addon, contract, built, shot):
    cameras = addon("solve.cameras")
    state = addon("shot.inventory").read(shot)
    addon("bake.insertion").insert_freeze(built, shot, "freeze")
    assert addon("bake.freeze_group").shown(built) == (shot / "takes" / "freeze", pytest.approx(1.0))
    places = world(addon, built, shot)[[0, 1]]
    distance = float(np.linalg.norm(places[1] - places[0]))
    bpy.ops.splannequin.align_scale(places=places.ravel(), distance=3 * distance)
    assert addon("bake.freeze_group").shown(built)[1] == pytest.approx(3.0, rel=1e-4) and not addon(
        "bake.shown_take"
    ).stale_scale(built, shot)
    assert "compositor follows" in addon("process.job_timer").watch_of(shot).notes["solve"][0]
    root = cameras.find(built, shot, "EMPTY")
    root.scale = (5.0, 5.0, 5.0)  # by hand
    bpy.context.view_layer.update()
    assert addon("bake.shown_take").stale_scale(built, shot)
    assert any("outdated" in line for line in addon("process.steps").STEPS["bake"].view(built, state).state)
    addon("bake.insertion").insert_freeze(built, shot, "freeze")
    assert addon("bake.freeze_group").shown(built)[1] == pytest.approx(5.0) and not addon(
        "bake.shown_take"
    ).stale_scale(built, shot)
    assert addon("process.steps").STEPS["bake"].view(built, state).state[0] == "The freeze is in your compositor."
    built.frame_set(6)
    graph = bpy.context.evaluated_depsgraph_get()
    camera = built.camera.evaluated_get(graph)
    window = camera.calc_matrix_camera(graph, x=16, y=12)
    viewmat, _ = addon("shot.seen_camera").in_solve(
        built, shot, camera.matrix_world.normalized().inverted(), window, 16, 12
    )
    want = contract.CameraPath.load(shot / "solve" / "cameras.json").frames[1].viewmat
    np.testing.assert_allclose(viewmat, want, atol=1e-4)
