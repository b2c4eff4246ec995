"""Every operator that supports undo restores all properties of the file on undo, and its result on redo."""

import importlib.util
import shutil
from pathlib import Path

import bpy
import pytest

from tests.addon.data import make_detail
from tests.addon.data.file_state import difference, file_state

_spec = importlib.util.spec_from_file_location("test_whole_file", Path(__file__).with_name("test_whole_file.py"))
whole_file = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(whole_file)
full = whole_file.full
# Reading the file's state touches deprecated properties.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

PLACES = [0.0, 0.0, 0.0, 1.0, 0.2, 0.1, 0.3, 1.0, 0.4]
"""Three non-collinear points."""
CALLS = {
    "align_floor": {"places": PLACES},
    "align_origin": {"places": PLACES[3:6]},
    "align_scale": {"places": PLACES[:6], "distance": 3.0},
    "insert_matte": {"name": "him"},
    "pick_run": {"name": "other"},
    "pick_take": {"name": "later"},
}
"""Arguments of the operators that need some."""
BEFORE = {
    "combine_cg": ("insert_freeze",),
    "freeze_as_warp": ("insert_freeze",),
    "insert_matte": ("insert_freeze",),
    "remove_shot": ("insert_freeze", "add_splats", "add_surface"),
    "shot_remove": ("insert_freeze", "shot_add"),
    "save_motion": ("paint_motion",),
}
"""Operators that must run before another."""
TESTED_IN = {
    "suggested_instant": "needs a live session; it sets what t_star_here sets",
    "use_movie_clip": "needs an editor of clips; it calls use_clip",
}


def undoable(addon):
    names = addon("ui.menu").searchable() | set(dir(bpy.ops.splannequin))
    return {n for n in names if "UNDO" in getattr(bpy.types, f"SPLANNEQUIN_OT_{n}").bl_options}


NAMES = (
    "align_floor", "align_origin", "align_scale", "combine_cg", "draw_matte", "freeze_as_warp", "insert_freeze",
    "insert_matte", "load_camera", "locate_shot", "motion_over_plate", "move_hold", "move_orbit", "move_retime",
    "move_smooth", "paint_motion", "pick_run", "pick_take", "remove_light", "remove_shot", "save_motion", "shot_add",
    "shot_remove", "show_motion", "t_star_here", "t_star_marker", "use_clip",
)  # fmt: skip


def test_no_operator_is_left_out(addon):
    assert undoable(addon) == {*NAMES, *TESTED_IN}


@pytest.fixture
def ready(full, scene, addon, contract, new_take):
    """Shot with data for all operators: mattes, a second take and run, and a lasso."""
    for folder in (full / "solve" / "motion", full / "takes" / "freeze" / "preview"):
        folder.mkdir()
        for frame in (5, 6, 7):
            shutil.copy(full / "frames" / f"{frame:06d}.png", folder)
    whole_file.add_matte(full, contract, "him")
    new_take(full, "later")
    shutil.copytree(full / "runs" / "main", full / "runs" / "other")
    addon("process.job_timer").watch_of(full).state = addon("shot.inventory").read(full)
    scene.frame_set(6)
    return full


@pytest.mark.parametrize("name", NAMES)
def test_it_is_undone_and_done_again_without_a_trace(ready, addon, name, tmp_path):
    def call(operator, **arguments):
        assert getattr(bpy.ops.splannequin, operator)("EXEC_DEFAULT", True, **arguments) == {"FINISHED"}

    arguments = dict(CALLS.get(name, {}))
    if name == "locate_shot":
        arguments["directory"] = str(shutil.copytree(ready, tmp_path / "moved.splannequin"))
    elif name == "use_clip":
        (tmp_path / "other.mp4").touch()
        arguments["filepath"] = str(tmp_path / "other.mp4")
    elif name == "freeze_as_warp":
        make_detail.add_take(ready)
        bpy.context.scene.splannequin.take_name = "detail"
    elif name == "load_camera":
        addon("process.begin").remove_all(bpy.context.scene, ready)
    elif name == "remove_light":
        whole_file.test_lights.add(addon, bpy.context.scene, ready)
    for operator in BEFORE.get(name, ()):
        call(operator)
    bpy.ops.ed.undo_push(message="before")
    before = file_state()
    call(name, **arguments)
    after = file_state()
    assert difference(before, after) or name == "save_motion", "it changes the file, and that one the shot"
    bpy.ops.ed.undo()
    assert difference(before, file_state()) == []
    bpy.ops.ed.redo()
    assert difference(after, file_state()) == []
