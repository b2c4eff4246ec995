"""Registration adds every class and handler once; unregistration removes all of them."""

import os
import subprocess
import sys

import bpy
import pytest


def ours() -> set[str]:
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.PropertyGroup, bpy.types.AddonPreferences)
    return {c.__name__ for kind in kinds for c in kind.__subclasses__() if _ours(c) and c.is_registered}


def _ours(cls) -> bool:
    return cls.__module__.startswith("bl_ext.user_default.splannequin")


def handlers() -> int:
    lists = (bpy.app.handlers.load_post, bpy.app.handlers.render_write, bpy.app.handlers.render_complete)
    lists += (bpy.app.handlers.save_pre, bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail)
    return sum(_ours(h) for hooks in (*lists, bpy.app.handlers.render_cancel) for h in hooks)


def test_unregister_leaves_nothing_and_register_twice_registers_once(package):
    before, hooks = ours(), handlers()
    assert {"SPLANNEQUIN_OT_import_clip", "SPLANNEQUIN_PT_shots", "SPLANNEQUIN_PG_scene"} <= before and hooks >= 11
    try:
        package.unregister()
        assert ours() == set() and handlers() == 0
        assert not hasattr(bpy.types.Scene, "splannequin") and not hasattr(bpy.types, "SPLANNEQUIN_OT_train")
        package.unregister()
    finally:
        package.register()
    package.register()
    assert ours() == before and handlers() == hooks


def everything() -> tuple:
    """The add-on's registered parts: classes, handlers, number of menu entries, and the property of scenes."""
    menus = (bpy.types.TOPBAR_MT_render, bpy.types.CLIP_MT_clip)
    drawn = [getattr(getattr(menu.draw, "__func__", menu.draw), "_draw_funcs", []) for menu in menus]
    entries = sum(_ours(draw) for functions in drawn for draw in functions)
    return ours(), handlers(), entries, hasattr(bpy.types.Scene, "splannequin")


class BrokenOperator(bpy.types.Operator):
    """Operator that Blender refuses, because its identifier has no dot."""

    bl_idname = "broken"
    bl_label = "Broken"


@pytest.mark.parametrize("where", ["a part", "half a part", "a class", "the last part"])
def test_what_fails_while_it_is_enabled_leaves_nothing_behind(package, addon, monkeypatch, where):
    registration, preferences = addon("registration"), addon("ui.preferences")
    before = everything()
    package.unregister()
    assert everything()[:2] == (set(), 0)

    def breaks() -> None:
        raise AttributeError("it is broken")

    failing = {
        "a part": (addon("translations"), "register", breaks),
        "half a part": (preferences, "_CLASSES", (*preferences._CLASSES[:2], BrokenOperator)),
        "a class": (registration, "_CLASSES", (*registration._CLASSES[:7], BrokenOperator, *registration._CLASSES[7:])),
        "the last part": (addon("command_line.command"), "register", breaks),
    }[where]
    try:
        with monkeypatch.context() as patch:
            patch.setattr(*failing)
            with pytest.raises(RuntimeError, match="could not be enabled"):
                package.register()
            assert everything()[:2] == (set(), 0) and not hasattr(bpy.types.Scene, "splannequin")
    finally:
        package.register()
    assert everything() == before, "and it can be enabled again"


def test_a_part_that_cannot_be_taken_back_keeps_nothing_else(package, addon, monkeypatch, capfd):
    before = everything()

    def breaks() -> None:
        raise AttributeError("it is broken")

    with monkeypatch.context() as patch:
        patch.setattr(addon("shot.places"), "unregister", breaks)
        package.unregister()
    assert everything()[:2] == (set(), 0) and "AttributeError: it is broken" in capfd.readouterr().err
    package.register()
    assert everything() == before


COPIES = """
import os
import sys
from pathlib import Path
import bpy
import addon_utils
root, name = Path(os.environ["COPY_OF"]), os.environ["COPY_FIRST"]
places = {"splannequin_copy": bpy.utils.user_resource("SCRIPTS", path="addons", create=True),
          "bl_ext.user_default.splannequin": bpy.utils.user_resource("EXTENSIONS", path="user_default", create=True)}
for package, place in places.items():
    (Path(place) / package.rpartition(".")[2]).symlink_to(root, target_is_directory=True)
sys.path.append(places["splannequin_copy"])  # as Blender does at its start, if the folder is there then
addon_utils.modules_refresh()
first, second = name, next(other for other in places if other != name)
def known():
    groups = bpy.types.PropertyGroup.__subclasses__()
    return next((c for c in groups if c.__name__ == "SPLANNEQUIN_PG_scene" and c.is_registered), None)
assert addon_utils.enable(first) is not None
mine = known()
errors = []
assert addon_utils.enable(second, handle_error=errors.append) is None
assert known() is mine and hasattr(bpy.types.Scene, "splannequin"), "the first goes on working"
assert f"is already enabled as {first}" in str(errors[0]), errors
addon_utils.disable(second)
assert known() is mine and hasattr(bpy.types.Scene, "splannequin")
bpy.ops.splannequin.set_up.poll()
addon_utils.disable(first)
assert known() is None
assert addon_utils.enable(second) is not None and known().__module__.startswith(second + ".")
addon_utils.disable(second)
assert known() is None and not hasattr(bpy.types.Scene, "splannequin")
addon_utils.enable(first)
bpy.ops.script.reload()
hooks = [h for hooks in (bpy.app.handlers.load_post, bpy.app.handlers.save_pre) for h in hooks]
hooks = [h for h in hooks if "splannequin" in h.__module__]
assert len(hooks) == len({(h.__module__, h.__name__) for h in hooks}), hooks
addon_utils.disable(first)
print("held", flush=True)
os._exit(0)  # a bpy module that was reloaded does not always come to its end
"""


@pytest.mark.parametrize("first", ["splannequin_copy", "bl_ext.user_default.splannequin"])
def test_of_two_installed_copies_the_second_is_refused(root, tmp_path, first):
    blender = [bpy.app.binary_path, "--background", "--factory-startup", "--python-expr"]
    environ = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path), "COPY_OF": str(root), "COPY_FIRST": first}
    command = [*(blender if bpy.app.binary_path else (sys.executable, "-c")), COPIES]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=300)
    assert "held\n" in done.stdout, done.stdout[-2000:] + done.stderr[-2000:]


def test_panels_are_in_order_in_one_tab(addon):
    steps = addon("process.steps").STEPS.values()
    assert [step.panel.title for step in steps] == ["1  Import", "2  Solve", "3  Train", "4  Freeze", "5  Bake"]
    tab = bpy.types.SPLANNEQUIN_PT_shots
    assert (tab.bl_category, tab.bl_space_type, tab.bl_region_type) == ("Splannequin", "VIEW_3D", "UI")
    for step in steps:
        assert step.panel.operator.partition(".")[2] in dir(bpy.ops.splannequin)


def test_handlers_and_timer_survive_another_file(addon):
    before = handlers()
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert handlers() == before >= 11
