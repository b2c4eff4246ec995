"""Registers everything the add-on has, in order, and unregisters it in reverse. Registering twice registers once."""

from __future__ import annotations

import bpy

from . import (
    cli,
    mattes,
    menu,
    ops_align,
    ops_clip,
    ops_jobs,
    ops_runs,
    ops_shots,
    ops_solves,
    ops_steps,
    panel,
    pictures,
    places,
    points,
    preferences,
    props,
    stmaps,
    supervisor,
    translations,
)

_CLASSES = (
    *ops_steps.CLASSES,
    *ops_jobs.CLASSES,
    *ops_clip.CLASSES,
    *ops_runs.CLASSES,
    *ops_align.CLASSES,
    *ops_shots.CLASSES,
    *ops_solves.CLASSES,
    *stmaps.CLASSES,
    *mattes.CLASSES,
    *panel.CLASSES,
)


def registered() -> bool:
    """True between `register` and `unregister`."""
    return hasattr(bpy.types.Scene, "splannequin")


def register() -> None:
    """Makes the add-on's classes, properties, timer, handlers and command known to Blender."""
    if registered():
        return
    _take_tooltips_from_docstrings()
    translations.register()
    props.register()
    preferences.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    menu.register()
    pictures.register()
    points.register()
    places.register()
    supervisor.register()
    cli.register()


def unregister() -> None:
    """Undoes `register`, in reverse."""
    if not registered():
        return
    ops_align.stop()
    cli.unregister()
    stmaps.unregister()
    supervisor.unregister()
    places.unregister()
    points.unregister()
    pictures.unregister()
    menu.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    preferences.unregister()
    props.unregister()
    translations.unregister()


def _take_tooltips_from_docstrings() -> None:
    """Gives each of our classes its docstring as tooltip, on one line: Blender would keep the source's line breaks, and
    translations would be looked up with them."""
    for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu):
        for cls in kind.__subclasses__():
            if cls.__module__.startswith(f"{__package__}.") and cls.__doc__ and "bl_description" not in vars(cls):
                cls.bl_description = " ".join(cls.__doc__.split())
