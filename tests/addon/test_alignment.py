"""Floor, origin and scale: the maths against float64 truth, and the buttons on a scene."""

import json

import bpy
import numpy as np
import pytest


def turned(seed: int) -> np.ndarray:
    """A random rotation [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


@pytest.fixture
def maths(addon):
    return addon("solve.alignment")


@pytest.mark.parametrize("seed", range(5))
def test_three_points_lie_in_the_floor_with_the_cameras_above(maths, seed):
    rng = np.random.default_rng(seed)
    rotation, shift = turned(seed), rng.normal(size=3) * 5
    flat = np.concatenate([rng.uniform(-2, 2, (3, 2)), np.zeros((3, 1))], axis=1)
    centres = np.array([0, 0, 1.5]) + rng.normal(size=(9, 3)) * 0.2
    places, above = flat @ rotation.T + shift, centres @ rotation.T + shift
    change = maths.level(places, above, np.zeros((9, 3)))
    np.testing.assert_allclose(change[:3, :3] @ change[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(change[:3, :3]) == pytest.approx(1.0)
    laid = places @ change[:3, :3].T + change[:3, 3]
    np.testing.assert_allclose(laid[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(laid.mean(axis=0)[:2], places.mean(axis=0)[:2], atol=1e-12)
    assert ((above @ change[:3, :3].T + change[:3, 3])[:, 2] > 0.5).all()
    swapped = maths.level(places[[1, 0, 2]], above, np.zeros((9, 3)))
    np.testing.assert_allclose(swapped, change, atol=1e-12, err_msg="the order of the clicks says nothing")


def test_a_camera_level_with_the_points_is_turned_by_its_up(maths):
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    centres, ups = np.array([[0.5, 0.5, 0.0]]), np.array([[0.1, 0.0, -1.0]])
    np.testing.assert_allclose(maths.level(places, centres, ups)[:3, :3] @ [0, 0, -1], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("one", "other"),
    [((0, 0, 1), (0, 0, 1)), ((0, 0, -2), (0, 0, 1)), ((1, 2, 3), (-1, -2, -3)), ((1, 2, 3), (3, -1, 0))],
)
def test_the_shortest_turn(maths, one, other):
    rotation = maths.turn(np.array(one, float), np.array(other, float))
    np.testing.assert_allclose(rotation @ maths.unit(one), maths.unit(other), atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    cosine = maths.unit(one) @ maths.unit(other)
    assert np.trace(rotation) == pytest.approx(1 + 2 * cosine), "no turn beyond what is needed"


def test_what_cannot_be_aligned_is_said(maths, contract):
    line, centre = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.01]]), np.zeros((1, 3))
    with pytest.raises(contract.JobError, match="on one line"):
        maths.level(line, centre, centre)
    with pytest.raises(contract.JobError, match="on one line"):
        maths.level(np.zeros((3, 3)), centre, centre)
    with pytest.raises(contract.JobError, match="the same"):
        maths.scaled(np.ones((2, 3)), 1.0)
    for distance in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(contract.JobError, match="above 0"):
            maths.scaled(np.eye(3)[:2], distance)


def test_the_first_guess_stands_on_the_floor(addon, contract):
    cameras = addon("solve.cameras")
    tilt = np.radians(25.0)  # looking down on a table: the camera's up leans forward
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


def test_a_solve_stands_on_the_floor_that_it_found(addon, scene, shot):
    file = shot / "solve" / "solve.json"
    normal = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])
    file.write_text(json.dumps({**json.loads(file.read_text()), "floor": {"normal": normal.tolist(), "height": 0.7}}))
    cameras = addon("solve.cameras")
    cameras.build(scene, shot)
    root = np.array(cameras.find(scene, shot, "EMPTY").matrix_world)
    np.testing.assert_allclose(root[:3, :3] @ normal, [0, 0, 1], atol=1e-6)
    assert (root @ [*(0.7 * normal), 1.0])[2] == pytest.approx(0.0, abs=1e-6)


def test_the_nearest_point_under_the_mouse(maths):
    places = np.array([[0, 0, -5], [1, 0, -5], [0, 0, 5.0]])  # the last is behind
    matrix = np.array([[1.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]])
    at, before = maths.seen(places, matrix, (200, 100))
    np.testing.assert_allclose(at[:2], [[100, 50], [120, 50]])
    assert before.tolist() == [True, True, False]
    assert maths.nearest((103, 54), places, matrix, (200, 100), 15) == 0
    assert maths.nearest((115, 50), places, matrix, (200, 100), 15) == 1
    assert maths.nearest((150, 50), places, matrix, (200, 100), 15) == -1
    assert maths.nearest((100, 50), np.zeros((0, 3)), matrix, (200, 100), 15) == -1


@pytest.fixture
def built(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    bpy.context.view_layer.update()
    return scene


def world(addon, scene, shot) -> np.ndarray:
    """The solve's points where they stand, [P, 3], from the file and the root."""
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
    addon("solve.cameras").find(built, shot, "EMPTY").select_set(True)  # ours does not count
    root = addon("solve.cameras").find(built, shot, "EMPTY")
    bpy.context.view_layer.update()
    relative = [root.matrix_world.inverted() @ e.matrix_world.translation for e in empties]
    assert bpy.ops.splannequin.align_floor(selected=True) == {"FINISHED"}
    np.testing.assert_allclose([(root.matrix_world @ at).z for at in relative], 0.0, atol=1e-5)
    with pytest.raises(RuntimeError, match="3 objects are selected, 2 are needed"):
        bpy.ops.splannequin.align_scale(selected=True)


def test_alignment_is_one_undo_step(addon, built, shot):
    place = world(addon, built, shot)[3]
    stood = np.array(addon("solve.cameras").find(built, shot, "EMPTY").matrix_world)
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.splannequin.align_origin("EXEC_DEFAULT", True, places=place) == {"FINISHED"}
    bpy.ops.ed.undo()
    root = addon("solve.cameras").find(bpy.context.scene, shot, "EMPTY")
    np.testing.assert_allclose(root.matrix_world, stood, atol=1e-6)


def test_points_on_a_line_leave_the_root_alone(addon, built, shot):
    stood = np.array(addon("solve.cameras").find(built, shot, "EMPTY").matrix_world)
    with pytest.raises(RuntimeError, match="one line"):
        bpy.ops.splannequin.align_floor(places=[0, 0, 0, 1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(addon("solve.cameras").find(built, shot, "EMPTY").matrix_world, stood)


def test_no_solve_no_alignment(scene):
    assert not bpy.ops.splannequin.align_floor.poll()


def test_depth_in_the_compositor_and_the_view_follow_the_scale(addon, contract, built, shot):
    cameras = addon("solve.cameras")
    state = addon("shot.contents").read(shot)
    addon("bake.insertion").insert_freeze(built, shot, "freeze")
    assert addon("bake.freeze_group").shown(built) == (shot / "takes" / "freeze", pytest.approx(1.0))
    places = world(addon, built, shot)[[0, 1]]
    apart = float(np.linalg.norm(places[1] - places[0]))
    bpy.ops.splannequin.align_scale(places=places.ravel(), distance=3 * apart)
    assert addon("bake.freeze_group").shown(built)[1] == pytest.approx(3.0, rel=1e-4) and not addon(
        "bake.shown_take"
    ).stale_scale(built, shot)
    assert "compositor follows" in addon("process.supervisor").watch_of(shot).notes["solve"][0]
    root = cameras.find(built, shot, "EMPTY")
    root.scale = (5.0, 5.0, 5.0)  # by hand
    bpy.context.view_layer.update()
    assert addon("bake.shown_take").stale_scale(built, shot)
    assert any("stale" in line for line in addon("process.steps").STEPS["bake"].view(built, state).state)
    addon("bake.insertion").insert_freeze(built, shot, "freeze")
    assert addon("bake.freeze_group").shown(built)[1] == pytest.approx(5.0) and not addon(
        "bake.shown_take"
    ).stale_scale(built, shot)
    assert addon("process.steps").STEPS["bake"].view(built, state).state[0] == "The freeze is in your compositor."
    built.frame_set(6)
    graph = bpy.context.evaluated_depsgraph_get()
    camera = built.camera.evaluated_get(graph)
    window = camera.calc_matrix_camera(graph, x=16, y=12)
    viewmat, _ = addon("freeze.own_camera").in_solve(
        built, shot, camera.matrix_world.normalized().inverted(), window, 16, 12
    )
    want = contract.CameraPath.load(shot / "solve" / "cameras.json").frames[1].viewmat
    np.testing.assert_allclose(viewmat, want, atol=1e-4)
