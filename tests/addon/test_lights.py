"""Light of a take in Blender: Cycles' render in each direction, restoring the artist's world, and undo."""

import json
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Quaternion, Vector

KEY = "0123abcd"
COLORS = {
    (1, 0, 0): (4.0, 0.1, 0.2),
    (-1, 0, 0): (0.1, 0.8, 0.3),
    (0, 1, 0): (0.2, 0.3, 0.9),
    (0, -1, 0): (0.7, 0.7, 0.1),
    (0, 0, 1): (0.6, 0.2, 0.8),
    (0, 0, -1): (0.3, 0.9, 0.9),
}
"""Map from direction to linear light, in the scene axes that the panorama was written for."""


def write_light(shot: Path, contract, placement: dict, key: str = KEY) -> Path:
    """Write a panorama of the take in the backend's format: each direction has the colour of the nearest axis."""
    height, width = 128, 256
    # v counts from below, like Blender's rows
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    longitude, latitude = 2 * np.pi * (0.5 - u), np.pi * (v - 0.5)
    x = np.cos(latitude)[:, None] * np.cos(longitude)
    y = np.cos(latitude)[:, None] * np.sin(longitude)
    along = np.stack([x, y, np.broadcast_to(np.sin(latitude)[:, None], x.shape)], -1)
    axes, colors = (np.array(list(part), float) for part in (COLORS, COLORS.values()))
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = colors[(along @ axes.T).argmax(-1)]
    folder = contract.TakeFolder(shot / "takes" / "freeze")
    path = folder.light(key)
    path.parent.mkdir(exist_ok=True)
    image = bpy.data.images.new("made", width, height, float_buffer=True)
    image.colorspace_settings.is_data = True  # otherwise Blender saves it as sRGB
    image.pixels[:] = pixels.ravel()
    image.filepath_raw, image.file_format = str(path), "OPEN_EXR"
    image.save()
    bpy.data.images.remove(image)
    facts = contract.LightFacts(contract.file_digest(path), [0.0, 0.0, 1.0], 0.4, placement)
    folder.light_facts(key).write_text(json.dumps(facts.to_json()))
    return path


@pytest.fixture
def lit(scene, shot, addon, contract):
    """Root of the shot, rotated and scaled in the scene, with a panorama written for this placement."""
    scene.splannequin.shot_path = str(shot)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    root = addon("shot.scene_objects").part(scene, shot, "root")
    root.matrix_world = Matrix.LocRotScale(Vector((3, -2, 1)), Matrix.Rotation(0.7, 3, "X"), Vector((2.5,) * 3))
    bpy.context.view_layer.update()
    write_light(shot, contract, addon("shot.placement").placement_in(scene, shot).to_json())
    addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)
    return root


def add(addon, scene, shot, key=KEY):
    return addon("freeze.lights").add(scene, shot, "freeze", key)


def shown(scene, folder: Path, side: int) -> dict[tuple[int, int, int], np.ndarray]:
    """Linear light that Cycles renders of the world around three axes, all positive (side 1) or all negative (side
    -1)."""
    for item in [o for o in scene.objects if o.type in ("MESH", "LIGHT")]:
        bpy.data.objects.remove(item)
    camera = bpy.data.objects.new("looking", bpy.data.cameras.new("looking"))
    scene.collection.objects.link(camera)
    camera.data.angle, camera.rotation_mode, size = 2.2, "QUATERNION", 48
    scene.camera, render = camera, scene.render
    render.engine, render.film_transparent, scene.cycles.samples, scene.cycles.device = "CYCLES", False, 1, "CPU"
    scene.cycles.use_denoising = False  # Debian's Blender is built without it
    scene.world.cycles.sampling_method = "NONE"  # makes no map for samples towards the light
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage, render.use_compositing = 100, False
    render.image_settings.file_format = "OPEN_EXR"
    camera.rotation_quaternion = Vector((side, side, side)).to_track_quat("-Z", "Y")
    render.filepath = str(folder / f"{side}.exr")
    bpy.ops.render.render(write_still=True)
    pixels = np.array(bpy.data.images.load(render.filepath).pixels[:]).reshape(size, size, 4)
    found = {}
    for axis in (a for a in COLORS if sum(a) == side):
        seen = camera.rotation_quaternion.inverted() @ Vector(axis)
        x, y = (int(size / 2 * (1 + part / -seen.z / np.tan(2.2 / 2))) for part in (seen.x, seen.y))
        found[axis] = pixels[y - 1 : y + 2, x - 1 : x + 2, :3].reshape(-1, 3).mean(0)
    assert len(found) == 3
    return found


def test_cycles_shows_every_direction_in_its_colour_and_follows_the_root(scene, shot, lit, addon, tmp_path):
    light_facts = add(addon, scene, shot)
    assert "40 %" in light_facts[0]
    for axis, light in shown(scene, tmp_path, 1).items():
        np.testing.assert_allclose(light, COLORS[axis], atol=0.01, err_msg=str(axis))
    turn = Quaternion((1, 1, 1), 2 * np.pi / 3)  # +X becomes +Y, +Y becomes +Z, +Z becomes +X
    lit.matrix_world = Matrix.Translation((1, 2, 3)) @ turn.to_matrix().to_4x4() @ lit.matrix_world
    bpy.context.view_layer.update()
    for axis, light in shown(scene, tmp_path, -1).items():
        x, y, z = axis
        np.testing.assert_allclose(light, COLORS[y, z, x], atol=0.01, err_msg=f"turned, {axis}")


def test_the_artists_world_comes_back(scene, shot, lit, addon):
    mine, lights = scene.world, addon("freeze.lights")
    mine.name = "mine"
    add(addon, scene, shot)
    ours = lights.find(scene, shot)
    assert scene.world == ours != mine and scene.splannequin.world_before == mine
    add(addon, scene, shot)
    assert len(bpy.data.worlds) == 2 and scene.splannequin.world_before == mine, "made again, it is replaced"
    assert bpy.ops.splannequin.remove_light() == {"FINISHED"}
    assert scene.world == mine and [w.name for w in bpy.data.worlds] == ["mine"]
    assert not [i for i in bpy.data.images if i.filepath.endswith(f"{KEY}.exr")]
    assert not bpy.ops.splannequin.remove_light.poll()


def test_a_scene_without_a_world_has_none_again(scene, shot, lit, addon):
    scene.world = None
    add(addon, scene, shot)
    addon("process.begin").remove_all(scene, shot)
    assert scene.world is None and scene.splannequin.world_before is None
    assert not [w for w in bpy.data.worlds if w.name.endswith("light")]


def test_a_world_that_was_chosen_since_stays(scene, shot, lit, addon):
    add(addon, scene, shot)
    scene.world = bpy.data.worlds.new("newer")
    addon("process.begin").remove_all(scene, shot)
    assert scene.world.name == "newer" and not [w for w in bpy.data.worlds if w.name.endswith("light")]


def test_two_shots_take_turns(scene, shot, lit, addon, contract, tmp_path):
    mine, lights = scene.world, addon("freeze.lights")
    add(addon, scene, shot)
    second_shot = tmp_path / "other.splannequin"
    shutil.copytree(shot, second_shot)
    scene.splannequin.shot_path = str(second_shot)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    add(addon, scene, second_shot)
    assert scene.world == lights.find(scene, second_shot) != lights.find(scene, shot)
    lights.remove(scene, second_shot)
    assert scene.world == lights.find(scene, shot)
    lights.remove(scene, shot)
    assert scene.world == mine


def test_undo_removes_it_and_redo_restores_it(scene, shot, lit, addon):
    lights, mine = addon("freeze.lights"), scene.world.name
    bpy.ops.ed.undo_push(message="before")
    add(addon, scene, shot)
    bpy.ops.ed.undo_push(message="added")
    bpy.ops.ed.undo()
    assert bpy.context.scene.world.name == mine and lights.find(bpy.context.scene, shot) is None
    bpy.ops.ed.redo()
    scene = bpy.context.scene
    assert scene.world == lights.find(scene, shot) is not None
    assert bpy.ops.splannequin.remove_light("EXEC_DEFAULT", True) == {"FINISHED"}
    assert bpy.context.scene.world.name == mine


def test_it_is_saved_with_the_file(scene, shot, lit, addon, tmp_path):
    add(addon, scene, shot)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    scene, lights = bpy.context.scene, addon("freeze.lights")
    assert scene.world == lights.find(scene, shot) is not None
    drivers = scene.world.node_tree.animation_data.drivers
    assert len(drivers) == 3 and all(d.driver.is_simple_expression or d.driver.type == "SUM" for d in drivers)
    lights.remove(scene, shot)
    assert scene.world is not None and not scene.world.name.endswith("light")


def test_timer_inserts_a_job_result_only_into_its_scene(scene, shot, lit, addon):
    job = addon("process.jobs").Job(shot / "jobs" / "x", "light", {})
    job.result = {"take": "freeze", "key": KEY}
    step = addon("process.steps").STEPS["freeze"]
    job.scene_uid = scene.session_uid + 1
    assert step.finish(scene, job) == [] and addon("freeze.lights").find(scene, shot) is None
    job.scene_uid = scene.session_uid
    assert not step.arrive(scene, job)
    assert step.finish(scene, job) and addon("freeze.lights").find(scene, shot) is not None


def test_what_cannot_be_added_is_a_sentence(scene, shot, lit, addon, contract):
    light = contract.TakeFolder(shot / "takes" / "freeze").light(KEY)
    light.write_bytes(light.read_bytes()[:-1])
    world = scene.world
    with pytest.raises(contract.JobError, match="does not have this light"):
        add(addon, scene, shot)
    with pytest.raises(contract.JobError, match="does not have this light"):
        add(addon, scene, shot, "../x")
    addon("process.begin").remove_all(scene, shot)
    with pytest.raises(contract.JobError, match="not in this scene"):
        add(addon, scene, shot)
    assert scene.world == world and len(bpy.data.worlds) == 1


def test_button_requests_the_light_at_the_cursor(scene, addon, contract, frozen_world):
    shot = frozen_world / "tiny.splannequin"
    scene.splannequin.shot_path, scene.splannequin.take_name = str(shot), "freeze"
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    timer = addon("process.job_timer")
    timer.refresh(timer.watch_of(shot))
    root = addon("shot.scene_objects").part(scene, shot, "root")
    scene.cursor.location = root.matrix_world @ Vector((0.0, 0.0, 1.5))
    assert bpy.ops.splannequin.add_light() == {"FINISHED"}
    job = timer.watch_of(shot).jobs["freeze"]
    assert job.kind == "light" and job.result["made"] and job.result["position"] == list(scene.cursor.location)
    assert 0.5 < job.result["filled"] < 0.95, "the wall is before the point alone"
    world = addon("freeze.lights").find(scene, shot)
    assert scene.world == world
    folder = contract.TakeFolder(shot / "takes" / "freeze")
    image = bpy.data.images.load(str(folder.light(job.result["key"])))
    assert tuple(image.size) == (1024, 512) and image.is_float
    wall = (root.matrix_world.to_3x3() @ Vector((0, 0, 1))).normalized()  # the solve's camera looks along z
    column = int(1024 * (0.5 - np.arctan2(wall.y, wall.x) / (2 * np.pi)))
    row = int(512 * (0.5 + np.arcsin(wall.z) / np.pi))
    red = np.array(image.pixels[:]).reshape(512, 1024, 4)[row, column, :3]
    assert red[0] > 3 * red[1:].max(), "the patch, straight ahead, is red"
