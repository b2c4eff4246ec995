"""Everything the add-on registers is there once, and gone after it is unregistered."""

import bpy


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
    assert {"SPLANNEQUIN_OT_import_clip", "SPLANNEQUIN_PT_bake", "SPLANNEQUIN_PG_scene"} <= before and hooks >= 11
    try:
        package.unregister()
        assert ours() == set() and handlers() == 0
        assert not hasattr(bpy.types.Scene, "splannequin") and not hasattr(bpy.types, "SPLANNEQUIN_OT_train")
        package.unregister()
    finally:
        package.register()
    package.register()
    assert ours() == before and handlers() == hooks


def test_the_panels_stand_in_order_in_one_tab(addon):
    steps = addon("process.steps").STEPS.values()
    panels = [c for step in steps for c in step.classes if hasattr(c, "step") and issubclass(c, bpy.types.Panel)]
    assert [p.bl_label for p in panels] == ["1  Import", "2  Solve", "3  Train", "4  Freeze", "5  Bake"]
    assert {(p.bl_category, p.bl_space_type, p.bl_region_type) for p in panels} == {("Splannequin", "VIEW_3D", "UI")}
    for panel in panels:
        assert panel.operator.partition(".")[2] in dir(bpy.ops.splannequin)


def test_handlers_and_timer_survive_another_file(addon):
    before = handlers()
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert handlers() == before >= 11
