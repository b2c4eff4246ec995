"""Timecode of the footage in Blender: in the panel at the current frame, and in the metadata of rendered files."""

import json

import bpy
import pytest

from tests.addon.data.pixels import set_format

NOTE = "Timecode 01:00:00:10 at frame 5, 24 fps."


@pytest.fixture
def dated(scene, shot):
    """dated(code): the scene with a shot whose first frame has this timecode."""

    def tell(code):
        for path, more in ((shot / "frames" / "frames.json", {"timecode": code}), (shot / "shot.json", {"fps": 24.0})):
            path.write_text(json.dumps({**json.loads(path.read_text()), **more}))
        return scene, shot

    return tell


def lines(addon, scene, shot):
    return addon("process.steps").STEPS["import"].view(scene, addon("shot.inventory").read(shot)).state


def test_the_panel_says_the_timecode_of_the_current_frame(addon, dated):
    scene, shot = dated("01:00:00:10")
    scene.frame_set(5)
    assert lines(addon, scene, shot)[-1] == "Timecode 01:00:00:10 at frame 5."
    scene.frame_set(20)
    assert lines(addon, scene, shot)[-1] == "Timecode 01:00:01:01 at frame 20."
    for without in ("", "an hour"):
        dated(without)
        assert not any("Timecode" in line for line in lines(addon, scene, shot))


def test_what_is_rendered_tells_it_and_removal_takes_it_back(addon, dated, tmp_path):
    scene, shot = dated("01:00:00:10")
    assert f"Note in the metadata of rendered images: {NOTE}" in addon("bake.insertion").insert_freeze(
        scene, shot, "freeze"
    )
    set_format(scene, "OPEN_EXR")
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.filepath = str(tmp_path / "out.exr")
    bpy.ops.render.render(write_still=True)
    assert NOTE.encode() in (tmp_path / "out.exr").read_bytes()
    assert not scene.render.use_stamp, "nothing is burnt into the picture"
    again = addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    assert not any("Note" in line for line in again), "it is said once"
    assert addon("scene.scene_setup").restore(scene)
    assert (scene.render.use_stamp_note, scene.render.stamp_note_text) == (False, "")


def test_artist_note_is_kept(addon, dated):
    scene, shot = dated("01:00:00:10")
    scene.render.stamp_note_text = "graded by Kim"
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    assert (scene.render.use_stamp_note, scene.render.stamp_note_text) == (False, "graded by Kim")


def test_footage_without_timecode_removes_the_old_note(addon, dated):
    scene, shot = dated("01:00:00:10")
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    dated("")
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    assert (scene.render.use_stamp_note, scene.render.stamp_note_text) == (False, "")
