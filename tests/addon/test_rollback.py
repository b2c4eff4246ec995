"""A failing change leaves the scene unchanged."""

import bpy
import pytest


def test_failed_change_is_rolled_back(addon, scene):
    scene.render.resolution_x, scene.frame_end = 640, 40
    camera, objects = scene.camera, set(bpy.data.objects)
    with pytest.raises(OSError, match="gone"), addon("scene.rollback").scene_of(scene):
        scene.render.resolution_x, scene.frame_end = 1280, 80
        scene["splannequin_note"] = 1
        created = bpy.data.objects.new("made", bpy.data.cameras.new("made"))
        scene.collection.objects.link(created)
        scene.camera = created
        raise OSError("the disk is gone")
    assert (scene.render.resolution_x, scene.frame_end) == (640, 40)
    assert scene.camera == camera and set(bpy.data.objects) == objects
    assert "made" not in bpy.data.cameras and "splannequin_note" not in scene


def test_a_change_that_succeeds_stays(addon, scene):
    with addon("scene.rollback").scene_of(scene):
        scene.frame_end = 77
        bpy.data.objects.new("made", None)
    assert scene.frame_end == 77 and "made" in bpy.data.objects
