"""Ownership of objects in a scene: copies, renamed objects, children of the root, and other files."""

import shutil
import sys

import bpy
import numpy as np
import pytest


def duplicate(*items):
    """Duplicate objects (Shift-D); return the copies by the original's name."""
    for item in items:
        item.hide_select = False
    bpy.ops.object.select_all(action="DESELECT")
    before = set(bpy.context.scene.objects)
    for item in items:
        item.select_set(True)
    bpy.ops.object.duplicate()
    return {o.name.partition(".")[0]: o for o in bpy.context.scene.objects if o not in before}


@pytest.fixture
def built(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    return scene


def test_copies_of_ours_are_the_artists(addon, built, shot):
    cameras = addon("solve.cameras")
    ours = {kind: cameras.find(built, shot, kind) for kind in ("EMPTY", "CAMERA", "MESH")}
    ours["CAMERA"].name, ours["EMPTY"].name = "zz renamed", "aa renamed"  # one name sorts before, one after the copies
    copies = duplicate(*ours.values())
    assert len(copies) == 3
    assert {kind: cameras.find(built, shot, kind) for kind in ours} == ours
    copies["aa renamed"].scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()
    assert addon("shot.scene_objects").depth_scale(built, shot) == pytest.approx(1.0)
    names = sorted(c.name for c in copies.values())
    cameras.build(built, shot)
    assert sorted(c.name for c in copies.values()) == names, "a second build spares them"
    assert cameras.find(built, shot, "CAMERA") not in copies.values()
    assert addon("solve.cameras").remove(built, shot)
    assert sorted(c.name for c in copies.values()) == names, "and so does removal"
    for copy in copies.values():
        assert copy.name in built.objects and not copy.keys()
    assert len(copies["zz renamed"].data.background_images) == 1 and not len(built.splannequin.made)
    assert not [c for c in bpy.data.collections if c.name.startswith("Splannequin")]


def test_what_hangs_on_the_root_stays_where_it_is(addon, built, shot):
    cameras = addon("solve.cameras")
    root = cameras.find(built, shot, "EMPTY")
    root.location, root.scale = (1.0, 2.0, 3.0), (2.0, 2.0, 2.0)
    cube = built.objects["Cube"]
    cube.parent, cube.location = root, (0.5, 0.0, 0.0)
    bpy.context.view_layer.update()
    stood = np.array(cube.matrix_world)
    cameras.build(built, shot)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(cube.matrix_world, stood, atol=1e-6)
    assert cube.parent == cameras.find(built, shot, "EMPTY"), "a new solve comes in under the same root"
    cameras.remove(built, shot)
    bpy.context.view_layer.update()
    assert cube.parent is None
    np.testing.assert_allclose(cube.matrix_world, stood, atol=1e-6)


def test_what_the_artist_deleted_is_let_go(addon, built, shot):
    cameras, supervisor = addon("solve.cameras"), addon("process.job_timer")
    bpy.ops.object.select_all(action="DESELECT")
    cameras.find(built, shot, "CAMERA").select_set(True)
    bpy.ops.object.delete()
    assert cameras.find(built, shot, "CAMERA") is None
    supervisor.watch_of(shot)
    supervisor.tick()
    assert built.splannequin.made[0].camera is None
    assert bpy.data.objects.get("my shot é camera") is None or not bpy.data.objects["my shot é camera"].users
    cameras.build(built, shot)
    assert cameras.find(built, shot, "CAMERA")


def test_a_turn_of_the_timer_lists_no_scenes_objects(addon, built, shot):
    """A scene may have tens of thousands of objects, and the timer blocks Blender."""
    scene_objects, called = addon("shot.scene_objects"), []
    assert built.splannequin.camera_before is not None and built.splannequin.made[0].camera is not None
    sys.setprofile(lambda frame, event, _: called.append(frame.f_code.co_name) if event == "call" else None)
    try:
        scene_objects.tidy(built)
    finally:
        sys.setprofile(None)
    assert "tidy" in called and "users_scene" not in called
    assert built.splannequin.camera_before is not None and built.splannequin.made[0].camera is not None


def test_what_another_scene_has_is_not_let_go(addon, built, shot):
    scene_objects, camera = addon("shot.scene_objects"), built.splannequin.made[0].camera
    camera_before = built.splannequin.camera_before
    second_scene = bpy.data.scenes.new("elsewhere")
    for item in (camera, camera_before):
        for collection in item.users_collection:
            collection.objects.unlink(item)
        second_scene.collection.objects.link(item)
    scene_objects.tidy(built)
    assert built.splannequin.made[0].camera == camera and built.splannequin.camera_before == camera_before
    bpy.data.scenes.remove(second_scene)
    scene_objects.tidy(built)
    assert built.splannequin.made[0].camera is None and built.splannequin.camera_before is None


def test_ours_are_found_after_saving_and_in_a_full_copy_of_the_scene(addon, built, shot, tmp_path):
    cameras = addon("solve.cameras")
    duplicate(cameras.find(built, shot, "CAMERA"))
    name = cameras.find(built, shot, "CAMERA").name
    bpy.ops.scene.new(type="FULL_COPY")
    copy = bpy.context.scene
    assert cameras.find(copy, shot, "CAMERA").name in copy.objects
    assert cameras.remove(copy, shot)
    assert cameras.find(built, shot, "CAMERA").name == name, "removal in the copy leaves the first scene alone"
    bpy.context.window.scene = built
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert cameras.find(bpy.context.scene, shot, "CAMERA").name == name


def test_two_shots_of_one_name_are_two(addon, built, shot, tmp_path):
    cameras, scene_objects = addon("solve.cameras"), addon("shot.scene_objects")
    second_shot = tmp_path / "elsewhere" / shot.name
    shutil.copytree(shot, second_shot)
    assert cameras.find(built, second_shot, "CAMERA") is None
    cameras.build(built, second_shot)
    cameras.remove(built, second_shot)
    assert cameras.find(built, shot, "CAMERA")
    moved = tmp_path / "moved" / shot.name
    shutil.move(shot, moved)
    assert cameras.find(built, moved, "CAMERA"), "a folder that was moved is the same shot"
    scene_objects.new(built, moved)
    assert cameras.find(built, shot, "CAMERA") is None and len(built.splannequin.made) == 1


def test_previous_scene_camera_is_restored(addon, built, shot):
    cameras, first_camera = addon("solve.cameras"), bpy.data.objects["Camera"]
    assert built.camera == cameras.find(built, shot, "CAMERA")
    first_camera.name = "renamed since"
    cameras.build(built, shot)
    cameras.remove(built, shot)
    assert built.camera == first_camera and built.splannequin.camera_before is None
    cameras.build(built, shot)
    second_camera = built.camera = duplicate(first_camera)["renamed since"]
    cameras.remove(built, shot)
    assert built.camera == second_camera, "the artist chose another since"
    cameras.build(built, shot)
    bpy.data.objects.remove(second_camera)
    cameras.remove(built, shot)
    assert built.camera is None, "what was deleted does not come back"
    built.camera = first_camera
    cameras.build(built, shot)
    bpy.ops.object.select_all(action="DESELECT")
    first_camera.select_set(True)
    bpy.ops.object.delete()
    addon("shot.scene_objects").tidy(built)
    cameras.remove(built, shot)
    assert built.camera is None and not first_camera.users, "the file does not keep it"


def test_another_shots_camera_takes_the_place_of_a_removed_one(addon, built, shot, tmp_path):
    cameras, first_camera, second_shot = (
        addon("solve.cameras"),
        bpy.data.objects["Camera"],
        tmp_path / "second.splannequin",
    )
    shutil.copytree(shot, second_shot)
    cameras.build(built, second_shot)
    cameras.remove(built, shot)
    assert built.camera == cameras.find(built, second_shot, "CAMERA")
    cameras.build(built, shot)
    cameras.remove(built, shot)
    assert built.camera == cameras.find(built, second_shot, "CAMERA")
    cameras.remove(built, second_shot)
    assert built.camera == first_camera


def test_objects_linked_under_our_names_do_not_hide_ours(addon, built, shot, tmp_path):
    """Shots made alike are named alike, so that objects linked from another shot's file have the names of ours."""
    scene_objects, collection = addon("shot.scene_objects"), built.splannequin.made[0].collection.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    scene = bpy.context.scene
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (_, here):
        here.collections = [collection]
    scene.collection.children.link(bpy.data.collections[collection])
    scene.splannequin.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    entry = scene.splannequin.made[0]
    assert entry.camera.library is None and entry.camera == scene.camera
    assert {name: scene_objects.part(scene, shot, name) for name in scene_objects.PARTS} == {
        name: getattr(entry, name) for name in scene_objects.PARTS
    }
    camera, root = entry.camera, entry.root
    addon("solve.cameras").build(scene, shot)
    assert (entry.camera, entry.root) == (camera, root)
