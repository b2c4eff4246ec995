"""Surface of a take in Blender: placement, shadow catching and holdout in a render, undo, and two shots."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from tests.addon.data.pixels import read

FLOOR = np.array([(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)], float)
PERSON = np.array([(-2, -1.5, 0), (-0.2, -1.5, 0), (-0.2, -1.5, 3), (-2, -1.5, 3)], float)


def write_surface(shot: Path, contract, matrix=None) -> None:
    """Write a surface of the take's current state: a floor, and a person as an upright rectangle."""
    take = contract.TakeFolder(shot / "takes" / "freeze")
    vertices = np.zeros(8, list(contract.VERTEX_FIELDS))
    for n, axis in enumerate("xyz"):
        vertices[axis] = np.concatenate([FLOOR, PERSON])[:, n]
    vertices["red"], vertices["green"], vertices["blue"] = 200, 100, 50
    triangles = np.zeros(4, list(contract.TRIANGLE_FIELDS))
    triangles["corners"], triangles["people"] = 3, (0, 0, 1, 1)
    for corner, of in zip("abc", ((0, 0, 4, 4), (1, 2, 5, 6), (2, 3, 6, 7)), strict=True):
        triangles[corner] = of
    header = contract.SurfaceHeader(contract.file_digest(take.facts), 8, 4)
    take.surface.write_bytes(header.to_bytes() + vertices.tobytes() + triangles.tobytes())


@pytest.fixture
def stood(scene, shot, addon, contract):
    """Root of the shot in the scene, with a surface of its take written for this placement."""
    scene.splannequin.shot_path = str(shot)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    root = addon("shot.scene_objects").part(scene, shot, "root")
    root.matrix_world = Matrix.LocRotScale(Vector((3, -2, 1)), Matrix.Rotation(0.7, 3, "X"), Vector((2.5,) * 3))
    bpy.context.view_layer.update()
    facts = shot / "takes/freeze/take.json"
    placement = addon("shot.placement").placement_in(scene, shot).to_json()
    facts.write_text(json.dumps({**json.loads(facts.read_text()), "placement": placement}))
    write_surface(shot, contract)
    addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)
    return root


def found(addon, scene, shot):
    return addon("freeze.surfaces").find(scene, shot, "freeze")


def corners(item):
    bpy.context.view_layer.update()
    return np.array([item.matrix_world @ v.co for v in item.data.vertices])


def test_surface_keeps_its_place_and_follows_the_root(scene, shot, stood, addon):
    assert bpy.ops.splannequin.add_surface() == {"FINISHED"}
    room, people = found(addon, scene, shot)
    np.testing.assert_allclose(corners(room), FLOOR, atol=1e-5)
    np.testing.assert_allclose(corners(people), PERSON, atol=1e-5)
    assert room.is_shadow_catcher and people.is_shadow_catcher and not room.visible_shadow and people.visible_shadow
    assert [len(item.data.polygons) for item in (room, people)] == [2, 2] and not room.data.validate()
    colour = np.array(room.data.attributes["Col"].data[0].color_srgb)
    np.testing.assert_allclose(colour, [200 / 255, 100 / 255, 50 / 255, 1.0], atol=1e-3)
    stood.location.x += 1.0
    np.testing.assert_allclose(corners(room), FLOOR + np.array([1, 0, 0]), atol=1e-5)


def test_surface_is_replaced_on_reinsert_and_removed_with_the_shot(scene, shot, stood, addon):
    for _ in range(2):
        assert bpy.ops.splannequin.add_surface() == {"FINISHED"}
    assert len(found(addon, scene, shot)) == 2 and len(bpy.data.meshes) <= 4
    addon("process.begin").remove_all(scene, shot)
    assert not [o for o in bpy.data.objects if o.type == "MESH" and o.is_shadow_catcher]


def test_timer_inserts_a_finished_surface(scene, shot, stood, addon):
    timer, job = addon("process.job_timer"), addon("process.jobs").Job(shot / "jobs" / "x", "surface", {})
    job.result = {"take": "freeze"}
    assert addon("process.steps").STEPS["freeze"].arrive(scene, job)
    for _ in range(50):
        if timer.watch_of(shot).work is None:
            break
        timer.tick()
    assert len(found(addon, scene, shot)) == 2
    assert timer.watch_of(shot).notes["freeze"] and not timer.watch_of(shot).failures


@pytest.mark.parametrize("way", ["another file", "undo"])
def test_interrupted_surface_removes_only_its_own_meshes(scene, shot, stood, addon, tmp_path, way):
    timer = addon("process.job_timer")
    for message in ("before", "also before"):
        bpy.ops.ed.undo_push(message=message)
    before = {mesh.session_uid for mesh in bpy.data.meshes}
    timer.work(shot, "freeze", addon("freeze.surfaces").added_in_turns(scene.session_uid, shot, "freeze"))
    while not (fresh := [m for m in bpy.data.meshes if m.session_uid not in before]):
        timer.tick()
    name, fresh[0].use_fake_user = fresh[0].name, True
    del fresh
    if way == "undo":
        bpy.ops.ed.undo()
        timer.tick()
        failures = timer.watch_of(shot).failures
        assert failures["freeze"] == ("The mesh was undone before it was complete.", "Add it again.")
        assert name not in bpy.data.meshes
        return
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "B.blend"), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "B.blend"))
    assert name in bpy.data.meshes and all(watch.work is None for watch in timer.watches())


def test_what_the_artist_deletes_is_let_go(scene, shot, stood, addon):
    bpy.ops.splannequin.add_surface()
    bpy.data.objects.remove(found(addon, scene, shot)[1])
    addon("shot.scene_objects").tidy(scene)
    assert len(addon("shot.scene_objects").of(scene, shot).surfaces) == 1


def test_a_render_has_the_shadow_and_what_is_behind_people_is_hidden(scene, shot, stood, addon, tmp_path):
    bpy.ops.splannequin.add_surface()
    for item in [o for o in scene.objects if o.type in ("MESH", "LIGHT") and o not in found(addon, scene, shot)]:
        bpy.data.objects.remove(item)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.5))
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, -0.6, 0))
    bpy.context.object.data.energy = 3.0
    bpy.ops.object.camera_add(location=(0, -7, 2.5), rotation=(1.3, 0, 0))
    scene.camera = bpy.context.object
    render = scene.render
    render.engine, render.film_transparent, scene.cycles.samples, scene.cycles.device = "CYCLES", True, 16, "CPU"
    scene.cycles.use_denoising = False  # Debian's Blender is built without it
    render.resolution_x, render.resolution_y, render.resolution_percentage = 160, 120, 100
    render.use_compositing = False
    render.image_settings.file_format, render.filepath = "OPEN_EXR", str(tmp_path / "cg.exr")
    bpy.ops.render.render(write_still=True)
    alpha = read(render.filepath)[..., 3]
    assert alpha[50:76, 76:96].mean() > 0.95, "the cube beside the person"
    assert alpha[50:76, 66:71].max() < 0.05, "the cube behind the person"
    assert 0.3 < alpha[66:71, 98:108].mean() <= 1.0, "its shadow on the floor"
    assert alpha[85:, :].mean() < 0.01 and alpha[:, :60].mean() < 0.01, "no shadow of the person, and no floor"


def test_what_cannot_be_added_is_a_sentence(scene, shot, stood, addon, contract):
    surface = shot / "takes/freeze/surface.ply"
    whole = bytearray(surface.read_bytes())
    whole[-5] = 9  # index of a vertex that does not exist
    surface.write_bytes(whole)
    with pytest.raises(ValueError, match="damaged"):
        addon("freeze.surfaces").add(scene, shot, "freeze")
    surface.write_bytes(whole[:-1])
    with pytest.raises(contract.JobError, match="no surface"):
        addon("freeze.surfaces").add(scene, shot, "freeze")
    assert not [m for m in bpy.data.meshes if m.name.endswith(("room", "people"))]
    addon("process.begin").remove_all(scene, shot)
    with pytest.raises(contract.JobError, match="not in this scene"):
        addon("shot.scene_objects").check_root(scene, shot)


def test_button_requests_and_inserts_the_surface(scene, addon, frozen_world):
    shot = frozen_world / "tiny.splannequin"
    scene.splannequin.shot_path, scene.splannequin.take_name = str(shot), "freeze"
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    addon("process.job_timer").refresh(addon("process.job_timer").watch_of(shot))
    assert bpy.ops.splannequin.add_surface() == {"FINISHED"}
    room, people = found(addon, scene, shot)
    root = addon("shot.scene_objects").part(scene, shot, "root")
    back = root.matrix_world.inverted()
    depths = [np.median([(back @ Vector(place)).z for place in corners(item)]) for item in (room, people)]
    assert depths[0] > depths[1] > 0.0, "the wall is behind the patch, in the solve's axes"
    job = addon("process.job_timer").watch_of(shot).jobs["freeze"]
    assert job.kind == "surface" and job.result["made"]
