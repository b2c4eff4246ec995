"""Axes, lens and keys of the solved camera, compared with hand-computed values and with a render."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from tests.addon.data.pixels import glow


def project(viewmat: np.ndarray, k: list[float], points: np.ndarray) -> np.ndarray:
    """Pixels [P, 2] of world points [P, 3], OpenCV pinhole, pixel centres at +0.5."""
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return np.stack([k[0] * seen[:, 0] / seen[:, 2] + k[2], k[1] * seen[:, 1] / seen[:, 2] + k[3]], axis=1)


def poses_of(shot: Path) -> tuple[list[dict], int, int]:
    path = json.loads((shot / "solve" / "cameras.json").read_text())
    return path["frames"], path["width"], path["height"]


@pytest.mark.parametrize("fy", [20.0, 16.0, 25.0])
def test_points_fall_where_the_solve_says(addon, scene, shot, fy):
    poses, width, height = poses_of(shot)
    for pose in poses:
        pose["K"][1] = fy
    path = {"version": 1, "width": width, "height": height, "frames": poses}
    (shot / "solve" / "cameras.json").write_text(json.dumps(path))
    addon("solve.arrival").load_camera(scene, shot)
    root = addon("solve.cameras").find(scene, shot, "EMPTY")
    points = np.load(shot / "solve" / "points.npz")["xyz"].astype(np.float64)
    for pose in poses:
        scene.frame_set(pose["frame"])
        expected = project(np.reshape(pose["viewmat"], (4, 4)), pose["K"], points)
        for point, (u, v) in zip(points, expected, strict=True):
            projected = root.matrix_world @ Vector(point)
            x, y, _ = world_to_camera_view(scene, scene.camera, projected)
            assert (x * width, (1 - y) * height) == pytest.approx((u, v), abs=2e-3)


def test_keys_lie_on_the_clips_frames_and_are_straight(addon, scene, shot):
    camera = addon("solve.cameras").build(scene, shot)
    curves = list(addon("compat_animation").fcurves(camera))
    assert len(curves) == 7
    for curve in curves:
        assert [key.co[0] for key in curve.keyframe_points] == [5, 6, 7]
        assert {key.interpolation for key in curve.keyframe_points} == {"LINEAR"}
    assert not list(addon("compat_animation").fcurves(camera.data)), "a lens that does not change needs no keys"


def test_lens_is_keyed_where_it_changes(addon, scene, shot):
    poses, width, height = poses_of(shot)
    poses[2]["K"] = [30.0, 30.0, 9.0, 5.0]
    path = {"version": 1, "width": width, "height": height, "frames": poses}
    (shot / "solve" / "cameras.json").write_text(json.dumps(path))
    camera = addon("solve.cameras").build(scene, shot)
    scene.frame_set(5)
    assert camera.data.lens == pytest.approx(20 * 36 / 16)
    scene.frame_set(7)
    assert camera.data.lens == pytest.approx(30 * 36 / 16)


def test_quaternions_take_the_short_way(addon, scene, shot):
    poses, width, height = poses_of(shot)
    frames = []
    for n in range(40):  # a full turn, during which the decomposition flips its sign
        angle = 2 * np.pi * n / 39
        viewmat = np.eye(4)
        viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        frames.append({"frame": n, "viewmat": viewmat.ravel().tolist(), "K": poses[0]["K"]})
    path = {"version": 1, "width": width, "height": height, "frames": frames}
    (shot / "solve" / "cameras.json").write_text(json.dumps(path))
    camera = addon("solve.cameras").build(scene, shot)
    keys = np.array(
        [
            [k.co[1] for k in c.keyframe_points]
            for c in addon("compat_animation").fcurves(camera)
            if "quat" in c.data_path
        ]
    )
    assert keys.shape == (4, 40)
    assert (np.sum(keys[:, 1:] * keys[:, :-1], axis=0) > 0.9).all()


def test_plate_fits_the_sensor_and_follows_the_frame_numbers(addon, scene, shot):
    camera = addon("solve.cameras").build(scene, shot)
    background = camera.data.background_images[0]
    user = background.image_user
    assert camera.data.show_background_images and background.frame_method == "FIT"
    assert background.image.source == "SEQUENCE" and background.image.colorspace_settings.name == "sRGB"
    assert bpy.path.abspath(background.image.filepath) == str(shot / "frames" / "000005.png")
    assert (user.frame_start, user.frame_offset, user.frame_duration) == (5, 4, 3)


def test_point_cloud_has_stored_colours_and_positions(addon, scene, shot):
    addon("solve.cameras").build(scene, shot)
    cloud = addon("solve.cameras").find(scene, shot, "MESH")
    stored = np.load(shot / "solve" / "points.npz")
    colour = cloud.data.color_attributes["Col"]
    assert colour.domain == "POINT" and cloud.hide_render
    rgba = np.empty(len(stored["rgb"]) * 4, np.float32)
    colour.data.foreach_get("color_srgb", rgba)
    np.testing.assert_allclose(rgba.reshape(-1, 4)[:, :3] * 255, stored["rgb"], atol=0.51)
    co = np.empty(len(stored["xyz"]) * 3, np.float32)
    cloud.data.vertices.foreach_get("co", co)
    np.testing.assert_array_equal(co.reshape(-1, 3), stored["xyz"])


def test_second_build_replaces_and_keeps_the_roots_place(addon, scene, shot):
    cameras = addon("solve.cameras")
    cameras.build(scene, shot)
    root = cameras.find(scene, shot, "EMPTY")
    root.scale = (2.0, 2.0, 2.0)
    root.location = (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    counts = [len(x) for x in (bpy.data.objects, bpy.data.cameras, bpy.data.meshes, bpy.data.images, bpy.data.actions)]
    cameras.build(scene, shot)
    assert counts == [
        len(x) for x in (bpy.data.objects, bpy.data.cameras, bpy.data.meshes, bpy.data.images, bpy.data.actions)
    ]
    assert tuple(cameras.find(scene, shot, "EMPTY").location) == (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    assert addon("shot.scene_objects").depth_scale(scene, shot) == pytest.approx(2.0)


def rewrite(shot: Path, **lens) -> list[dict]:
    """Write another solve of the same clip: all poses moved, with optional changes to the last frame's lens."""
    poses, width, height = poses_of(shot)
    for pose in poses:
        pose["viewmat"][3] += 0.5
    poses[-1].update(lens)
    path = {"version": 1, "width": width, "height": height, "frames": poses}
    (shot / "solve" / "cameras.json").write_text(json.dumps(path))
    return poses


def test_what_refers_to_the_camera_goes_on_with_the_next_solve(addon, scene, shot):
    cameras = addon("solve.cameras")
    camera = cameras.build(scene, shot)
    root, cloud, cube = cameras.find(scene, shot, "EMPTY"), cameras.find(scene, shot, "MESH"), scene.objects["Cube"]
    cube.parent, cube.location = camera, (0.0, 0.0, -1.0)
    tracks = scene.objects["Light"].constraints.new("TRACK_TO")
    tracks.target = camera
    variable = cube.driver_add("hide_render").driver.variables.new()
    variable.targets[0].id = camera
    cut = scene.timeline_markers.new("cut", frame=6)
    cut.camera = camera
    material = bpy.data.materials.new("dots")
    cloud.data.materials.append(material)
    cloud.modifiers.new("nodes", "NODES")
    poses = rewrite(shot)
    assert cameras.build(scene, shot) == camera == cube.parent == tracks.target == variable.targets[0].id == cut.camera
    assert cameras.find(scene, shot, "MESH") == cloud and len(cloud.modifiers) == 1
    assert list(cloud.data.materials) == [material] and camera.parent == cloud.parent == root
    assert scene.camera == camera and cube.location.z == -1.0
    for pose in poses:
        scene.frame_set(pose["frame"])
        expected = np.linalg.inv(np.reshape(pose["viewmat"], (4, 4)))[:3, 3]
        np.testing.assert_allclose(camera.location, expected, atol=1e-5)


def test_what_the_artist_set_in_the_camera_stays_over_the_next_solve(addon, scene, shot):
    cameras, animation = addon("solve.cameras"), addon("compat_animation")
    camera = cameras.build(scene, shot)
    data = camera.data
    data.dof.use_dof, data.dof.aperture_fstop, data.passepartout_alpha, data.clip_end = True, 1.4, 1.0, 1e5
    data.dof.keyframe_insert("focus_distance", frame=5)
    camera.keyframe_insert("hide_render", frame=5)
    camera.name = "hero"
    artists_image = data.background_images.new()
    artists_image.image = bpy.data.images.new("storyboard", 8, 8)
    data.background_images[0].alpha = 0.25
    rewrite(shot, K=[30.0, 30.0, 9.0, 5.0])
    cameras.build(scene, shot)
    assert camera.name == "hero" and camera.data == data
    assert data.dof.use_dof and data.dof.aperture_fstop == pytest.approx(1.4) and data.passepartout_alpha == 1.0
    assert data.clip_end == 1e5 and [b.alpha for b in data.background_images] == [0.25, 0.5]
    assert data.background_images[1].image.name == "storyboard"
    assert {c.data_path for c in animation.fcurves(camera)} == {"location", "rotation_quaternion", "hide_render"}
    assert {c.data_path for c in animation.fcurves(data)} == {"dof.focus_distance", "lens", "shift_x", "shift_y"}
    assert [k.co[0] for k in next(iter(animation.fcurves(camera))).keyframe_points] == [5, 6, 7]
    rewrite(shot, K=poses_of(shot)[0][0]["K"])
    cameras.build(scene, shot)
    assert {c.data_path for c in animation.fcurves(data)} == {"dof.focus_distance"}, "the lens no longer changes"
    cameras.remove(scene, shot)
    assert "storyboard" in bpy.data.images


def test_a_lens_that_no_longer_changes_leaves_no_action(addon, scene, shot):
    cameras = addon("solve.cameras")
    k = poses_of(shot)[0][0]["K"]
    rewrite(shot, K=[30.0, 30.0, 9.0, 5.0])
    camera = cameras.build(scene, shot)
    assert len(bpy.data.actions) == 2
    rewrite(shot, K=k)
    cameras.build(scene, shot)
    assert len(bpy.data.actions) == 1 and camera.data.lens == pytest.approx(20 * 36 / 16)


def test_scene_is_upright(addon, scene, shot):
    cameras = addon("solve.cameras")
    camera = cameras.build(scene, shot)
    ups = []
    for frame in (5, 6, 7):
        scene.frame_set(frame)
        ups.append(np.array(camera.matrix_world)[:3, 1])
    mean = np.mean(ups, axis=0)
    np.testing.assert_allclose(mean / np.linalg.norm(mean), (0, 0, 1), atol=1e-5)


def test_a_rendered_ball_lands_on_the_projected_pixel(addon, scene, shot, tmp_path, pictures):
    for item in list(scene.objects):
        bpy.data.objects.remove(item)
    addon("solve.arrival").load_camera(scene, shot)
    poses, width, height = poses_of(shot)
    scale = 6  # a picture of 96 x 72, where the tolerance of a centroid is a tenth of a pixel
    scene.render.resolution_x, scene.render.resolution_y = width * scale, height * scale
    root = addon("solve.cameras").find(scene, shot, "EMPTY")
    point = np.array([[-0.5, 0.2, 0.3]])
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.05, location=root.matrix_world @ Vector(point[0]))
    bpy.context.object.data.materials.append(glow())
    scene.world = None
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 8, False
    addon("compat").set_png(scene.render.image_settings)
    scene.frame_set(6)
    scene.render.filepath = str(tmp_path / "ball.png")
    bpy.ops.render.render(write_still=True)
    weight = pictures.read(tmp_path / "ball.png").mean(axis=2)
    weight = np.where(weight > 0.2, weight, 0.0)  # removes dithering of dark pixels
    assert weight.max() > 0.5, "the ball is in the picture"
    rows, columns = np.mgrid[0 : height * scale, 0 : width * scale] + 0.5
    found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum() / scale
    pose = next(p for p in poses if p["frame"] == 6)
    expected = project(np.reshape(pose["viewmat"], (4, 4)), pose["K"], point)[0]
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_an_artists_camera_is_read_in_solve_units(addon, contract, scene, shot):
    """A camera that copies the solved camera, with its lens, reproduces the solve; its lens and size are kept."""
    cameras = addon("solve.cameras")
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    root = cameras.find(scene, shot, "EMPTY")
    root.scale = (2.0, 2.0, 2.0)
    artists_camera = bpy.data.objects.new("mine", scene.camera.data.copy())
    scene.collection.objects.link(artists_camera)
    for kind in ("COPY_LOCATION", "COPY_ROTATION"):
        artists_camera.constraints.new(kind).target = scene.camera
    scene.splannequin.path_camera = artists_camera
    assert addon("freeze.own_camera").name_of(scene) == "mine"
    scene.frame_start, scene.frame_end, scene.frame_step = 5, 7, 1
    scene.frame_set(6)
    path = run_out(addon("freeze.own_camera").sample_path(scene, "mine", shot, 0))
    want = contract.CameraPath.load(shot / "solve" / "cameras.json")
    assert scene.frame_current == 6
    assert (path.width, path.height) == (want.width, want.height)
    for found, solved in zip(path.frames, want.frames, strict=True):
        assert (found.frame, found.source) == (solved.frame, "blender")
        np.testing.assert_allclose(found.viewmat, solved.viewmat, atol=5e-5)
        np.testing.assert_allclose(found.K, solved.K, rtol=1e-4)
    artists_camera.data.lens *= 2.0
    wide = run_out(addon("freeze.own_camera").sample_path(scene, "mine", shot, 64))
    assert (wide.width, wide.height) == (64, 48)
    np.testing.assert_allclose(wide.frames[0].K[0], 8 * want.frames[0].K[0], rtol=1e-4)
    params = addon("freeze.takes").freeze_from(scene, wide)
    assert contract.CameraPath.load(params.camera_path) == wide
    assert params.width == 64
    artists_camera.data.type = "ORTHO"
    with pytest.raises(contract.JobError, match="mine is not a perspective camera"):
        run_out(addon("freeze.own_camera").sample_path(scene, "mine", shot, 0))
    scene.splannequin.path_camera = scene.camera
    assert addon("freeze.own_camera").name_of(scene) == "", "the clip's own camera is the clip's own move"


def test_motion_blur_takes_the_scenes_shutter_and_only_on_a_camera_of_the_artists(addon, contract, scene, shot):
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    artists_camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    scene.collection.objects.link(artists_camera)
    takes, props = addon("freeze.takes"), scene.splannequin
    props.path_camera, scene.render.motion_blur_shutter = artists_camera, 0.25
    assert takes.params_of(scene).shutter == 0.0, "unless it is asked for"
    props.motion_blur = True
    scene.frame_start, scene.frame_end = 5, 7
    path = run_out(addon("freeze.own_camera").sample_path(scene, "mine", shot, 0))
    params = takes.freeze_from(scene, path)
    assert params.shutter == pytest.approx(90.0)
    contract.check_params(params)
    scene.render.motion_blur_shutter = 3.0
    contract.check_params(takes.params_of(scene))
    assert takes.params_of(scene).shutter == 360.0
    file = shot / "takes" / "freeze" / "take.json"
    facts = json.loads(file.read_text()) | {"camera_path": params.camera_path, "shutter": 360.0}
    file.write_text(json.dumps(facts))
    assert takes.take_params(shot, "freeze").shutter == 360.0
    take = addon("shot.inventory").read(shot).takes["freeze"]
    props.run_name = take["run"]
    assert "motion blur" not in takes.outdated(scene, take)
    scene.render.motion_blur_shutter = 0.5
    assert takes.outdated(scene, take) == "The take's motion blur differs from the current setting."
    props.path_camera = scene.camera
    assert takes.params_of(scene).shutter == 0.0, "the clip's own path has its plates' blur"


@pytest.fixture
def moving(scene, shot):
    """Scene with a camera that moves over frames 1 to 5."""
    scene.splannequin.shot_path = str(shot)
    scene.frame_end = 5
    camera = scene.objects["Camera"]
    for frame, x in ((1, 0.0), (5, 10.0)):
        camera.location = (x, 0.0, 0.0)
        camera.keyframe_insert("location", frame=frame)
    return scene


def path_of(addon, scene, shot) -> list[float]:
    """Sideways camera position by frame."""
    path = run_out(addon("freeze.own_camera").sample_path(scene, "Camera", shot, 64))
    return [round(frame.viewmat[3], 4) for frame in path.frames]


def test_a_camera_moves_in_a_scene_that_is_not_shown(addon, moving, shot):
    """A camera that is shared with the window's scene is read from its own scene's evaluation."""
    wanted = path_of(addon, moving, shot)
    assert len(set(wanted)) == 5
    second_scene = bpy.data.scenes.new("B")
    second_scene.collection.objects.link(moving.objects["Camera"])
    second_scene.splannequin.shot_path, second_scene.frame_end = str(shot), 5
    assert bpy.context.scene == moving and path_of(addon, second_scene, shot) == wanted
    root = bpy.data.objects.new("root", None)
    second_scene.collection.objects.link(root)
    root.scale = (2.0, 2.0, 2.0)
    addon("shot.scene_objects").new(second_scene, shot).root = root
    assert path_of(addon, second_scene, shot) == pytest.approx([value / 2 for value in wanted], abs=1e-3)


@pytest.mark.parametrize("how", ["disabled", "excluded"])
def test_a_camera_that_blender_does_not_evaluate_is_refused(addon, contract, moving, shot, how):
    """Without evaluation the camera would seem to stand still."""
    wanted = path_of(addon, moving, shot)
    moving.camera = None
    if how == "disabled":
        moving.objects["Camera"].hide_viewport = True
    else:
        bpy.context.view_layer.layer_collection.children[0].exclude = True
    with pytest.raises(contract.JobError, match="Camera does not move, because it is disabled"):
        path_of(addon, moving, shot)
    moving.camera = moving.objects["Camera"]
    assert path_of(addon, moving, shot) == wanted, "the scene's camera is always evaluated"


@pytest.fixture
def read_on(addon, moving, shot):
    """Watch of a shot whose camera the timer is reading; the first turns have run."""
    timer, takes = addon("process.job_timer"), addon("freeze.takes")
    moving.frame_end = 100000  # more frames than one turn reads
    moving.frame_set(77)
    turns = addon("freeze.own_camera").sample_path(moving, "Camera", shot, 64)
    timer.work(shot, "freeze", takes.reading(moving.session_uid, shot, "freeze", turns, 100000))
    timer.tick()
    assert timer.watch_of(shot).work.progress.done and moving.frame_current != 77
    return timer.watch_of(shot)


def test_reading_a_camera_can_be_cancelled(read_on, moving, shot):
    assert bpy.ops.splannequin.cancel(step="train") == {"CANCELLED"} and read_on.work is not None
    assert bpy.ops.splannequin.cancel(step="freeze") == {"FINISHED"}
    assert read_on.running() is None and moving.frame_current == 77
    assert not read_on.failures and not (shot / "jobs").exists()


def test_reading_a_camera_stops_when_the_file_closes(read_on):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert read_on.work is None and bpy.context.scene.name == "Scene"
    assert bpy.context.scene.frame_current == 1


def test_a_scene_that_is_renamed_while_its_camera_is_read_is_read_on(addon, moving, shot):
    moving.frame_set(3)
    turns = addon("freeze.own_camera").sample_path(moving, "Camera", shot, 64)
    next(turns)
    moving.name = "renamed"
    assert len(run_out(turns).frames) == 5 and moving.frame_current == 3


def test_a_take_begins_though_its_scene_is_renamed_while_the_camera_is_read(addon, moving, shot):
    timer, turns = addon("process.job_timer"), addon("freeze.own_camera").sample_path(moving, "Camera", shot, 64)
    moving.splannequin.shot_path = str(shot)
    timer.work(shot, "freeze", addon("freeze.takes").reading(moving.session_uid, shot, "freeze", turns, 5))
    moving.name = "renamed"
    bpy.data.scenes.new("Scene")
    watch = timer.watch_of(shot)
    while watch.work is not None:
        timer.tick()
    assert not watch.failures and watch.jobs["freeze"].scene_uid == moving.session_uid
    watch.jobs["freeze"].process.kill()
    watch.jobs["freeze"].process.wait()


def run_out(turns):
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return end.value


def test_a_keyed_instant_is_followed_frame_by_frame(addon, scene, shot):
    steps = addon("process.steps")
    props = scene.splannequin
    props.shot_path, props.choose_t_star = str(shot), True
    scene.frame_start, scene.frame_end = 5, 9
    assert steps.STEPS["freeze"].params(scene).t_star_per_frame == {}
    for frame, value in ((5, 5), (7, 7)):
        props.t_star = value
        assert scene.keyframe_insert("splannequin.t_star", frame=frame)
    for curve in addon("compat_animation").fcurves(scene):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    ramp = steps.STEPS["freeze"].params(scene).t_star_per_frame
    assert ramp == {"5": 5.0, "6": 6.0, "7": 7.0, "8": 7.0, "9": 7.0}
    props.choose_t_star = False
    assert steps.STEPS["freeze"].params(scene).t_star_per_frame == {}


def test_points_are_drawn_with_their_colours(addon, scene, shot):
    """Points are drawn over the view with colours. Blender draws loose points black, so the object shows only its
    bounds."""
    cameras = addon("solve.cameras")
    cameras.build(scene, shot)
    cloud = cameras.find(scene, shot, "MESH")
    with np.load(shot / "solve" / "points.npz") as stored:
        xyz, rgb = stored["xyz"], stored["rgb"]
    places, colours = addon("solve.points").coloured(cloud.data)
    np.testing.assert_allclose(places, xyz, atol=1e-6)
    np.testing.assert_allclose(colours[:, :3], rgb / 255.0, atol=1.1 / 255)
    assert cloud.display_type == "BOUNDS"
    cloud.name = "renamed"
    assert cameras.find(scene, shot, "MESH") == cloud


def test_a_camera_linked_under_the_same_name_is_not_read_instead(addon, moving, shot, tmp_path):
    """Nearly every file has an object `Camera`, and Blender lists a linked one first if its collection is first."""
    collection = bpy.data.collections.new("Theirs")
    moving.collection.children.link(collection)
    theirs = bpy.data.objects.new("Filmed", bpy.data.cameras.new("Filmed"))
    collection.objects.link(theirs)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"), copy=True)
    bpy.data.batch_remove([theirs, collection])
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (_, here):
        here.collections = ["Theirs"]
    moving.collection.children.link(bpy.data.collections["Theirs"])
    mine, own = moving.objects["Camera"], bpy.data.collections.new("Mine")
    moving.collection.children.link(own)
    for each in list(mine.users_collection):
        each.objects.unlink(mine)
    own.objects.link(mine)
    mine.name = "Filmed"
    assert mine.name == "Filmed" and moving.objects["Filmed"] != mine, "this Blender lists the linked one first"
    moving.splannequin.shot_path, moving.splannequin.path_camera = str(shot), mine
    name = addon("freeze.own_camera").name_of(moving)
    path = run_out(addon("freeze.own_camera").sample_path(moving, name, shot, 64))
    assert len({tuple(frame.viewmat) for frame in path.frames}) == 5, "the artist's camera moves"
    theirs = next(item for item in moving.objects if item.name == "Filmed" and item != mine)
    moving.splannequin.path_camera = theirs
    name = addon("freeze.own_camera").name_of(moving)
    path = run_out(addon("freeze.own_camera").sample_path(moving, name, shot, 64))
    assert len({tuple(frame.viewmat) for frame in path.frames}) == 1, "the linked one does not"


def test_muted_keyframes_of_t_star_are_not_followed(addon, scene, shot):
    props = scene.splannequin
    props.shot_path, props.choose_t_star, props.t_star = str(shot), True, 5
    props.keyframe_insert("t_star", frame=5)
    (curve,) = addon("compat_animation").fcurves(scene)
    assert addon("freeze.takes").keyed_instants(scene)
    curve.mute = True
    assert addon("freeze.takes").keyed_instants(scene) == {}


def test_an_action_without_a_slot_for_the_scene_has_no_curves(addon, scene):
    action = bpy.data.actions.new("of others")
    if not hasattr(action, "slots"):
        pytest.skip("since 4.4")
    scene.animation_data_create().action = action
    other = action.slots.new("OBJECT", "other")
    strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
    strip.channelbag(other, ensure=True).fcurves.new("location", index=0)
    assert scene.animation_data.action_slot is None
    assert list(addon("compat_animation").fcurves(scene)) == []
    addon("compat_animation").remove_fcurves(scene, "splannequin.t_star")
