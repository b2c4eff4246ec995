"""A camera of the artist's scene used for the clip: compared with Blender's projection; placement of the solve."""

import json

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

FIRST, LAST = 5, 7  # of the test shot, whose frames are 16 x 12
POINTS = np.random.default_rng(3).uniform([-4, -3, -9], [4, 3, -4], (20, 3))


def moving_camera(scene, frames=(FIRST, LAST), name="match é"):
    """Camera that moves and zooms on a scaled parent, with shift and vertical sensor fit."""
    parent = bpy.data.objects.new("dolly", None)
    parent.location, parent.rotation_euler, parent.scale = (1.0, -2.0, 0.5), (0.1, -0.2, 0.3), (1.5, 1.5, 1.5)
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width, data.sensor_height = "VERTICAL", 30.0, 20.0
    data.shift_x, data.shift_y = 0.12, -0.07
    camera = bpy.data.objects.new(name, data)
    camera.parent = parent
    for item in (parent, camera):
        scene.collection.objects.link(item)
    for frame, share in zip(frames, (0.0, 1.0), strict=True):
        camera.location, camera.rotation_euler = (share, 0.3 * share, -0.2 * share), (0.1 * share, 0.2 * share, 0.3)
        data.lens = 28.0 + 4.0 * share
        for block, path in ((camera, "location"), (camera, "rotation_euler"), (data, "lens")):
            block.keyframe_insert(path, frame=frame)
    return camera


@pytest.fixture
def chosen(scene, shot):
    """Scene of the shot's aspect ratio, with a moving camera chosen as its source."""
    scene.render.resolution_x, scene.render.resolution_y = 1600, 1200
    props = scene.splannequin
    props.shot_path, props.cameras_from, props.scene_camera = str(shot), "SCENE", moving_camera(scene)
    return scene


def seen_by_blender(scene, camera, size):
    """Blender's projection [F, P, 2] of POINTS placed in front of the camera, and these points in world space [F, P,
    3]."""
    pixels, world = [], []
    for frame in range(FIRST, LAST + 1):
        scene.frame_set(frame)
        seen = camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
        at = [seen.matrix_world.normalized() @ Vector(p) for p in POINTS]
        views = [world_to_camera_view(scene, seen, p) for p in at]
        pixels.append([(v.x * size[0], (1.0 - v.y) * size[1]) for v in views])
        world.append([p[:] for p in at])
    return np.array(pixels), np.array(world)


def projected(transforms, world):
    """[F, P, 2] pixels of the points `world` [F, P, 3], projected by a transforms.json."""
    pixels = []
    for frame, points in zip(transforms["frames"], world, strict=True):
        lens = {**transforms, **frame}
        view = np.linalg.inv(np.array(frame["transform_matrix"]))
        x, y, z = view[:3, :3] @ points.T + view[:3, 3:]
        pixels.append(np.stack([lens["cx"] - lens["fl_x"] * x / z, lens["cy"] + lens["fl_y"] * y / z], axis=1))
    return np.array(pixels)


@pytest.mark.parametrize("aspect", [(1.0, 1.0), (1.0, 1.6), (2.0, 1.0)])
@pytest.mark.parametrize("fit", ["VERTICAL", "HORIZONTAL", "AUTO"])
def test_what_is_written_projects_as_blender_does(addon, chosen, shot, aspect, fit):
    """Covers lens, sensor, fit, shift, pixel aspect and zoom, at the clip's size instead of the render size."""
    chosen.render.pixel_aspect_x, chosen.render.pixel_aspect_y = aspect
    camera = chosen.splannequin.scene_camera
    camera.data.sensor_fit = fit
    chosen.frame_set(40, subframe=0.25)
    params = addon("process.steps").STEPS["solve"].params(chosen)
    assert (chosen.frame_current, chosen.frame_subframe) == (40, 0.25)
    assert params.cameras == str(shot / "tracking" / "transforms.json")
    transforms = json.loads((shot / "tracking" / "transforms.json").read_text(encoding="utf-8"))
    assert [f["file_path"] for f in transforms["frames"]] == ["5.png", "6.png", "7.png"]
    assert (transforms["w"], transforms["h"]) == (16, 12)
    want, world = seen_by_blender(chosen, camera, (16, 12))
    assert np.ptp(want) > 4.0
    np.testing.assert_allclose(projected(transforms, world), want, atol=1e-3 * 16 / 1920)
    turns = np.array([f["transform_matrix"] for f in transforms["frames"]])[:, :3, :3]
    np.testing.assert_allclose(turns.swapaxes(1, 2) @ turns, np.broadcast_to(np.eye(3), turns.shape), atol=1e-6)


def test_nothing_of_the_artists_changes(addon, chosen):
    kinds = ("scenes", "objects", "cameras", "actions", "collections", "images", "worlds")
    before = {kind: [b.name for b in getattr(bpy.data, kind)] for kind in kinds}
    picked = [o.name for o in chosen.objects if o.select_get()]
    addon("process.steps").STEPS["solve"].params(chosen)
    assert {kind: [b.name for b in getattr(bpy.data, kind)] for kind in kinds} == before
    assert [o.name for o in chosen.objects if o.select_get()] == picked and bpy.context.scene == chosen


def test_the_timer_reads_it_in_turns_and_the_solve_begins(addon, chosen, shot):
    timer, step = addon("process.job_timer"), addon("process.steps").STEPS["solve"]
    chosen.frame_set(3)
    timer.work(shot, "solve", step.in_turns(chosen, shot))
    watch = timer.watch_of(shot)
    for _ in range(50):
        if watch.work is None:
            break
        timer.tick()
    assert not watch.failures and chosen.frame_current == 3
    assert watch.jobs["solve"].folder.is_dir() and (shot / "tracking" / "transforms.json").is_file()
    request = json.loads((watch.jobs["solve"].folder / "request.json").read_text(encoding="utf-8"))
    assert request["params"]["cameras"] == str(shot / "tracking" / "transforms.json")
    watch.jobs["solve"].process.kill()
    watch.jobs["solve"].process.wait()


def test_cancelled_camera_restores_frame_and_shot(addon, chosen, shot):
    turns = addon("solve.scene_camera").write_in_turns(chosen, "match é", shot)
    chosen.frame_set(3)
    assert next(turns) == (1, 3) and chosen.frame_current == 5
    turns.close()
    assert chosen.frame_current == 3 and not (shot / "tracking").exists()


@pytest.mark.parametrize("kind", ["ORTHO", "PANO"])
def test_a_camera_without_perspective_is_refused(addon, contract, chosen, kind):
    chosen.splannequin.scene_camera.data.type = kind
    with pytest.raises(contract.JobError, match="match é is not a perspective camera of this scene"):
        addon("process.steps").STEPS["solve"].params(chosen)


def test_cameras_that_cannot_be_the_clips_are_refused(addon, contract, chosen, shot):
    solve, props = addon("process.steps").STEPS["solve"], chosen.splannequin
    camera = props.scene_camera
    props.scene_camera = chosen.objects["Camera"]
    with pytest.raises(contract.JobError, match="Camera stands still from frame 5 to 7"):
        solve.params(chosen)
    props.scene_camera = None
    with pytest.raises(contract.JobError, match="No camera of the scene is chosen"):
        solve.params(chosen)
    props.scene_camera, chosen.render.resolution_x = camera, 1920
    with pytest.raises(
        contract.JobError, match="renders 1920 x 1200 pixels, but the clip has a different aspect ratio, 16 x 12"
    ):
        solve.params(chosen)
    assert not (shot / "tracking").exists()


def test_frames_that_nobody_tracked_are_left_out(addon, scene):
    """Frames outside the camera's keys are not tracked. A pause between two keys counts as tracked."""
    module, evaluated = addon("solve.camera_samples"), addon("shot.seen_camera").evaluated

    def left(camera, frames, span):
        samples = [module.sample_of(n, *evaluated(scene, camera.name, n, (16, 12))[:2], (16, 12)) for n in frames]
        return [s.number for s in module.without_ends(samples, span)]

    camera = moving_camera(scene, (5, 7))
    assert module.keyed(camera) == (5.0, 7.0)
    assert left(camera, range(1, 12), module.keyed(camera)) == [5, 6, 7]
    assert left(camera, range(1, 12), None) == [5, 6, 7], "what moves it has no keys that are known"
    for block in (camera, camera.data):
        for path in ("location", "rotation_euler") if block is camera else ("lens",):
            block.keyframe_insert(path, frame=10)  # same values as at frame 7
    assert left(camera, range(1, 12), module.keyed(camera))[-1] == 10


@pytest.fixture
def in_scene_world(shot):
    """Shot whose solve comes from a camera of the scene."""
    record = json.loads((shot / "solve" / "solve.json").read_text())
    (shot / "solve" / "solve.json").write_text(json.dumps({**record, "world": "scene"}))
    return shot


def test_solve_is_placed_at_the_scene_camera(addon, contract, scene, in_scene_world):
    shot = in_scene_world
    scene.splannequin.shot_path = str(shot)
    said = addon("solve.arrival").load_camera(scene, shot)
    root = addon("solve.cameras").find(scene, shot, "EMPTY")
    np.testing.assert_array_equal(np.array(root.matrix_world), np.eye(4))
    assert addon("solve.scale").scaled(scene, shot) and not any("guess" in line for line in said)
    path = contract.CameraPath.load(shot / "solve" / "cameras.json")
    for frame in path.frames:
        scene.frame_set(frame.frame)
        view = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.array(scene.camera.matrix_world.inverted())
        np.testing.assert_allclose(view, np.reshape(frame.viewmat, (4, 4)), atol=1e-5)


def test_a_shot_changes_worlds_and_keeps_what_the_artist_did_in_one(addon, scene, shot):
    load, scale = addon("solve.arrival").load_camera, addon("solve.scale")
    scene.splannequin.shot_path = str(shot)
    load(scene, shot)
    root = addon("solve.cameras").find(scene, shot, "EMPTY")
    guess = np.array(root.matrix_world)
    assert np.abs(guess - np.eye(4)).max() > 0.1
    root.scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()
    solve_record = (shot / "solve" / "solve.json").read_text()
    (shot / "solve" / "solve.json").write_text(json.dumps({**json.loads(solve_record), "world": "scene"}))
    load(scene, shot)
    np.testing.assert_allclose(np.array(root.matrix_world), np.eye(4), atol=1e-6)
    assert scale.scaled(scene, shot)
    root.location = (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    load(scene, shot)
    assert root.location[:] == (1.0, 2.0, 3.0), "who moves it in the scene's world means it"
    (shot / "solve" / "solve.json").write_text(solve_record)
    load(scene, shot)
    np.testing.assert_allclose(np.array(root.matrix_world), guess, atol=1e-5)
    assert not scale.scaled(scene, shot)
