"""The view of a shot.blend that was baked without a window (also checked by eye in Blender 4.3 and 5.2)."""

import json
import os

import bpy
import pytest


@pytest.fixture
def bake(addon, shot, tmp_path, previews):
    """bake(t_star, ...): bakes the shot's take at that instant, opens the file and returns its scene."""

    previews(shot)

    def run(t_star=6, blend=None, **facts):
        path = shot / "takes" / "freeze" / "take.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "t_star_frame": t_star, **facts}))
        words = ["bake", "--shot", str(shot), "--output", str(tmp_path / "out")]
        assert addon("command_line.headless").main([*words, *(["--blend", str(blend)] if blend else [])]) == 0
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / "shot.blend"))
        return bpy.context.scene

    return run


def views():
    return [
        area.spaces.active.region_3d.view_perspective
        for screen in bpy.data.screens
        for area in screen.areas
        if area.type == "VIEW_3D" and area.spaces.active.region_3d is not None
    ]


def shown(camera):
    return [b for b in camera.data.background_images if b.show_background_image]


@pytest.mark.parametrize(("t_star", "frame"), [(6, 6), (7, 7), (90, 7)])
def test_it_opens_through_the_camera_on_the_freeze_at_its_instant_with_a_light(bake, shot, t_star, frame):
    scene = bake(t_star)
    assert set(views()) == {"CAMERA"} and scene.frame_current == frame
    (freeze,) = shown(scene.camera)
    assert scene.camera.data.show_background_images and freeze.display_depth == "BACK"
    preview = shot / "takes" / "freeze" / "preview" / "000005.png"
    assert os.path.normpath(bpy.path.abspath(freeze.image.filepath)) == str(preview)
    assert (freeze.image_user.frame_start, freeze.image_user.frame_offset) == (5, 4)
    assert freeze.image.filepath.startswith("//"), "the folder can be moved"
    assert len(scene.camera.data.background_images) == 2, "the plate can be switched on"
    (light,) = [item for item in scene.objects if item.type == "LIGHT"]
    assert light.data.energy > 0 and not light.hide_render
    (points,) = [item for item in scene.objects if item.type == "MESH"]
    assert points.hide_get(), "they would cover the picture; the eye in the outliner shows them"


def test_a_take_of_another_camera_is_not_shown_through_the_clips(bake):
    scene = bake(6, camera_path="own.json")
    (plate,) = shown(scene.camera)
    assert plate.image.filepath.endswith(".png")


def test_existing_artist_file_is_not_changed(bake, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    before = views()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.frame_current = 5, 6, 5
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "artist.blend"))
    scene = bake(6, tmp_path / "artist.blend")
    assert views() == before and scene.frame_current in (5, 6)
    assert not [item for item in scene.objects if item.type == "LIGHT"]
    (plate,) = shown(scene.camera)
    assert plate.image.filepath.endswith(".png")


def test_a_scene_without_the_solved_camera_is_left_as_it_is(addon, scene, shot):
    before, names = views(), {item.name for item in scene.objects}
    addon("command_line.first_view").set_up(scene, shot, "freeze")
    assert views() == before and {item.name for item in scene.objects} == names
