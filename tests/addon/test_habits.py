"""Conventions of add-ons: plain names that the search finds, tooltips, undo, no keymap, existing icons."""

import ast

import bpy

CHANGES_NO_SCENE = {
    # start jobs that push an undo step when they end
    "import_clip", "solve_camera", "train", "freeze", "bake", "all_steps",
    "add_splats", "add_surface", "add_light",  # as above: the timer reads the file
    "render", "cancel", "live", "open_log", "set_up", "cancel_setup", "check_backend", "remove_backend",
    # write or remove files on disk
    "write_stmaps", "export_cameras", "export_for_farm", "remove_run", "remove_take", "clear_motion",
    "matte_from_mask", "remove_matte", "combine_takes",  # start a job that writes files
    "check_move",  # only reports
}  # fmt: skip


def operators() -> dict[str, type]:
    names = dir(bpy.ops.splannequin)
    assert len(names) > 15
    return {name: getattr(bpy.types, f"SPLANNEQUIN_OT_{name}") for name in names}


def test_no_two_operators_have_the_same_name():
    said = [c.bl_label for c in operators().values() if "INTERNAL" not in c.bl_options]
    assert len(set(said)) == len(said)


def test_operators_are_registered_and_undone():
    for name, cls in operators().items():
        assert "INTERNAL" in cls.bl_options or "REGISTER" in cls.bl_options, name
        assert ("UNDO" in cls.bl_options) == (name not in CHANGES_NO_SCENE), name


def test_all_operators_are_in_our_name(package):
    for cls in bpy.types.Operator.__subclasses__():
        if cls.__module__.startswith(f"{package.__name__}."):
            assert cls.bl_idname.startswith("splannequin."), cls.bl_idname


def test_no_keymap_is_touched(package, root):
    """No key is bound in the source; headless Blender has no key configuration to check."""
    for config in bpy.context.window_manager.keyconfigs if bpy.context.window_manager else ():
        for keymap in config.keymaps:
            assert not [i for i in keymap.keymap_items if i.idname.startswith("splannequin.")]
    for path in (root / "splannequin_addon").rglob("*.py"):
        assert "keymap" not in path.read_text(encoding="utf-8"), path


def test_the_search_finds_every_operator(addon):
    """Blender's search lists the operators of menus."""
    menu = addon("ui.menu")
    listed = [name for group in menu.entries() for name in group]
    assert len(set(listed)) == len(listed)
    assert {*listed, "use_movie_clip"} == menu.searchable()
    assert menu.searchable() == {n for n, c in operators().items() if "INTERNAL" not in c.bl_options}
    assert menu._in_render in bpy.types.TOPBAR_MT_render.draw._draw_funcs
    assert menu._in_clip in bpy.types.CLIP_MT_clip.draw._draw_funcs


def test_an_operator_that_is_in_no_group_of_the_menu_comes_last(addon, monkeypatch):
    menu = addon("ui.menu")
    monkeypatch.setattr(menu, "_GROUPS", (("bake",),))
    first, rest = menu.entries()
    assert first == ["bake"] and "train" in rest and rest == sorted(rest)


def icons_in(tree: ast.AST) -> set[str]:
    """Texts passed as `icon=`, assigned to `icon`, or passed as fourth argument of `wrap`."""
    values = [k.value for n in ast.walk(tree) if isinstance(n, ast.Call) for k in n.keywords if k.arg == "icon"]
    values += [n.value for n in ast.walk(tree) if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "icon"]
    values += [
        n.args[3]
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and ast.unparse(n.func) == "wrap" and len(n.args) > 3
    ]
    found = [part.value for v in values if not isinstance(v, ast.Call) for part in ast.walk(v)
             if isinstance(part, ast.Constant) and isinstance(part.value, str)]  # fmt: skip
    return {text for text in found if text and "." not in text}


def test_icons_exist_in_this_blender(addon, root):
    known = set(bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items.keys())
    used = set(addon("ui.icons").OF.values())
    for path in (root / "splannequin_addon").rglob("*.py"):
        used |= icons_in(ast.parse(path.read_text(encoding="utf-8")))
    assert {"CHECKMARK", "INFO", "FREEZE"} <= used
    used.discard("WARNING")  # icon of a dialog, which accepts other names
    assert used <= known, sorted(used - known)


def test_every_operator_has_an_icon(addon):
    assert set(addon("ui.icons").OF) == {f"splannequin.{name}" for name in operators()}


def test_a_video_from_the_menu_is_chosen_in_the_file_browser_and_a_dropped_one_at_once(scene, tmp_path):
    assert bpy.ops.splannequin.use_clip("INVOKE_DEFAULT", filepath=str(tmp_path / "a clip.mp4")) == {"FINISHED"}
    assert scene.splannequin.clip.endswith("a clip.mp4")
