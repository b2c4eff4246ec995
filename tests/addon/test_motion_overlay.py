"""Tinted overlay of moving areas over the plate of the solved camera: built from the mattes, removed with the shot."""

import os

import bpy
import numpy as np
import pytest

from tests.addon.data.make_shot import png
from tests.addon.data.pixels import read
from tests.addon.test_mattes import HEIGHT, labels, matted  # noqa: F401 - a fixture


@pytest.fixture
def loaded(addon, scene, matted):  # noqa: F811
    addon("solve.arrival").load_camera(scene, matted)
    addon("process.job_timer").refresh(addon("process.job_timer").watch_of(matted))
    return matted


def toggle():
    assert bpy.ops.splannequin.motion_over_plate() == {"FINISHED"}


def frames(addon, shot):
    """Map from frame to its tinted picture [H, W, 4] on the disk, top row first, as Blender reads it."""
    found = {}
    for path in sorted(addon("solve.mattes").overlay_folder(shot).iterdir()):
        found[int(path.stem)] = np.rint(read(path) * 255).astype(int)
    return found


def test_overlay_tints_moving_pixels_only(addon, scene, loaded):
    toggle()
    camera = addon("solve.cameras").find(scene, loaded, "CAMERA").data
    plate, overlay = camera.background_images
    assert overlay.display_depth == "FRONT" and plate.display_depth == "BACK" and plate.show_background_image
    assert (overlay.image_user.frame_start, overlay.image_user.frame_offset) == (5, 4)
    written = frames(addon, loaded)
    assert sorted(written) == [5, 6, 7]
    for number, picture in written.items():
        alpha = picture[..., 3]
        moves, unknown = labels(number) == 255, labels(number) == 128
        assert (alpha[labels(number) == 0] == 0).all() and (alpha[moves] > alpha[unknown].max()).all()
        assert (picture[moves][:, 0] > picture[moves][:, 2]).all(), "orange"
        assert (picture[unknown][:, 2] > picture[unknown][:, 0]).all(), "blue"
    toggle()
    assert addon("solve.motion_overlay").find(scene, loaded) is None
    assert list(camera.background_images) == [plate] and not [i for i in bpy.data.images if "Motion over" in i.name]


def test_the_plate_is_seen_below_it_and_the_freeze_again_afterwards(addon, scene, loaded, previews):
    """In a shot.blend, the freeze covers the plate."""
    previews(loaded)
    addon("command_line.first_view").set_up(scene, loaded, "freeze")
    camera = addon("solve.cameras").find(scene, loaded, "CAMERA").data
    toggle()
    plate, freeze, overlay = camera.background_images
    assert [b.show_background_image for b in (plate, freeze, overlay)] == [True, False, True]
    toggle()
    assert [b.show_background_image for b in camera.background_images] == [False, True]


def test_what_was_painted_since_is_tinted_anew(addon, loaded):
    toggle()
    toggle()
    folder = addon("solve.mattes").overlay_folder(loaded)
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    painted = loaded / "motion_paint" / "000006.png"
    painted.parent.mkdir()
    painted.write_bytes(png(np.full((HEIGHT, 16), 255, np.uint8)))
    later = max(before.values()) + 10**9
    os.utime(painted, ns=(later, later))
    toggle()
    changed = {p.name for p in folder.iterdir() if p.stat().st_mtime_ns != before[p.name]}
    assert changed == {"000006.png"} and (frames(addon, loaded)[6][..., 3] > 100).all()


def test_new_solve_or_shot_removal_removes_the_overlay(addon, scene, loaded):
    overlay = addon("solve.motion_overlay")
    toggle()
    addon("solve.arrival").load_camera(scene, loaded)
    assert overlay.find(scene, loaded) is None, "the mattes are those of another solve"
    toggle()
    addon("process.steps").STEPS["solve"].remove(scene, loaded, [])
    assert not [i for i in bpy.data.images if "Motion over" in i.name]


def test_missing_mattes_or_camera_are_reported(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    with pytest.raises(RuntimeError, match="no motion matte"):
        bpy.ops.splannequin.motion_over_plate()


def test_nothing_is_written_through_a_link(addon, scene, loaded, tmp_path):
    motion, target = loaded / "solve" / "motion", tmp_path / "elsewhere"
    motion.rename(target)
    motion.symlink_to(target, target_is_directory=True)
    with pytest.raises(RuntimeError, match="Cannot write"):
        bpy.ops.splannequin.motion_over_plate()
    assert not (target / "overlay").exists()
