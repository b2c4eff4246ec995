"""Registers everything the add-on has, in order, and unregisters it in reverse. Registering twice registers once."""

from __future__ import annotations

import bpy

from . import settings, translations
from .command_line import command
from .footage import operators as footage_operators
from .process import supervisor
from .shot import places
from .solve import align_operators, mattes, points, stmaps
from .solve import operators as solve_operators
from .train import pictures
from .ui import job_operators, menu, pick_operators, preferences, shots_panel, step_operator, step_panel

_CLASSES = (
    *step_operator.CLASSES,
    *job_operators.CLASSES,
    *footage_operators.CLASSES,
    *pick_operators.CLASSES,
    *align_operators.CLASSES,
    *shots_panel.CLASSES,
    *solve_operators.CLASSES,
    *stmaps.CLASSES,
    *mattes.CLASSES,
    *step_panel.CLASSES,
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
    settings.register()
    preferences.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    menu.register()
    pictures.register()
    points.register()
    places.register()
    supervisor.register()
    command.register()


def unregister() -> None:
    """Undoes `register`, in reverse."""
    if not registered():
        return
    align_operators.stop()
    command.unregister()
    stmaps.unregister()
    supervisor.unregister()
    places.unregister()
    points.unregister()
    pictures.unregister()
    menu.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    preferences.unregister()
    settings.unregister()
    translations.unregister()


def _take_tooltips_from_docstrings() -> None:
    """Gives each of our classes its docstring as tooltip, on one line: Blender would keep the source's line breaks, and
    translations would be looked up with them."""
    for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu):
        for cls in kind.__subclasses__():
            if cls.__module__.startswith(f"{__package__}.") and cls.__doc__ and "bl_description" not in vars(cls):
                cls.bl_description = " ".join(cls.__doc__.split())
