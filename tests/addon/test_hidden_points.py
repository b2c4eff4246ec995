"""Scrubbing temporarily hides the shot's points; files, undo and crashes must not leave them hidden."""

import bpy
import pytest


@pytest.fixture
def scrubbed(addon, with_shot, shot):
    """The scene while its shot is scrubbed, reduced to hiding the points."""
    addon("solve.arrival").load_camera(with_shot, shot)
    addon("freeze.hidden_points").begin(with_shot, shot)
    yield with_shot
    addon("freeze.hidden_points").end()


def points(addon, shot):
    scene = bpy.context.scene
    return addon("shot.scene_objects").part(scene, shot, "points")


def test_a_file_saved_while_scrubbing_shows_the_points_when_it_is_opened(addon, scrubbed, shot, tmp_path):
    assert points(addon, shot).hide_get()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert points(addon, shot).hide_get(), "scrubbing goes on"
    addon("freeze.hidden_points").end()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not points(addon, shot).hide_get()


def test_a_copy_that_no_handler_saw_shows_the_points_when_it_is_opened(addon, scrubbed, shot, tmp_path):
    """An autosave runs no handlers."""
    module = addon("freeze.hidden_points")
    bpy.app.handlers.save_pre.remove(module._restore)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "auto.blend"), copy=True)
    finally:
        bpy.app.handlers.save_pre.append(module._restore)
    module.end()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "auto.blend"))
    assert not points(addon, shot).hide_get()


def test_points_that_the_artist_hid_stay_hidden(addon, with_shot, shot):
    addon("solve.arrival").load_camera(with_shot, shot)
    points(addon, shot).hide_set(True)
    addon("freeze.hidden_points").begin(with_shot, shot)
    addon("freeze.hidden_points").end()
    assert points(addon, shot).hide_get()
