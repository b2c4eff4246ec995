"""Scenes and masks are found by session number after renaming and undo, and never confused with another one."""

import bpy


def test_a_scene_keeps_its_number_when_it_is_renamed_and_undone(addon, scene):
    session, uid = addon("scene.session"), scene.session_uid
    bpy.ops.ed.undo_push(message="before")
    scene.name = "renamed"
    bpy.data.scenes.new("Scene")
    bpy.ops.ed.undo_push(message="renamed")
    assert session.scene_of(uid) == scene
    bpy.ops.ed.undo()
    assert session.scene_of(uid) == bpy.context.scene and bpy.context.scene.name == "Scene"
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert session.scene_of(uid) is None, "another file's scene of the same name is another scene"


def test_a_mask_that_is_gone_is_not_found(addon):
    session, mask = addon("scene.session"), bpy.data.masks.new("people")
    uid = mask.session_uid
    assert session.of(bpy.data.masks, uid) == mask and session.scene_of(uid) is None
    bpy.data.masks.remove(mask)
    bpy.data.masks.new("people")
    assert session.of(bpy.data.masks, uid) is None
