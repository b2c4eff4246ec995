"""Registers everything the add-on has, in order, and unregisters it in reverse. Registering twice registers once.

Rooms below the steps are told of by their modules; each of the five steps hands in one object, with its classes and
whatever else it has Blender know.
"""

from __future__ import annotations

import bpy

from . import properties, settings, translations
from .bake import render_settings
from .bake.step import STEP as BAKE
from .command_line import command
from .footage.step import STEP as IMPORT
from .freeze.step import STEP as FREEZE
from .process import job_timer, steps
from .shot import places
from .solve.step import STEP as SOLVE
from .train.step import STEP as TRAIN
from .ui import job_operators, menu, preferences, shots_panel

_STEPS = (IMPORT, SOLVE, TRAIN, FREEZE, BAKE)
"""In the order of the work, and of their panels."""
_CLASSES = (
    *shots_panel.CLASSES,
    *job_operators.CLASSES,
    *(cls for step in _STEPS for cls in step.classes),
)
_PARTS: tuple[steps.Part, ...] = (
    translations,
    settings,
    preferences,
)
"""Before the classes."""
_PARTS_AFTER: tuple[steps.Part, ...] = (
    menu,
    render_settings,  # before what looks at the output path of a file that is saved
    places,
    *(part for step in _STEPS for part in step.parts),
    job_timer,
    command,
)


def registered() -> bool:
    """True between `register` and `unregister`."""
    return hasattr(bpy.types.Scene, "splannequin")


def register() -> None:
    """Makes the add-on's classes, properties, timer, handlers and command known to Blender."""
    if registered():
        return
    _take_tooltips_from_docstrings()
    for step in _STEPS:
        steps.add(step)
    holders = _holders_of_properties()
    for cls in holders:
        properties.annotate(cls)
    try:
        for part in _PARTS:
            part.register()
        for cls in _CLASSES:
            bpy.utils.register_class(cls)
        for part in _PARTS_AFTER:
            part.register()
    finally:
        for cls in holders:
            properties.release(cls)


def unregister() -> None:
    """Undoes `register`, in reverse."""
    if not registered():
        return
    for part in reversed(_PARTS_AFTER):
        part.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    for part in reversed(_PARTS):
        part.unregister()


def _take_tooltips_from_docstrings() -> None:
    """Gives each of our classes its docstring as tooltip, on one line: Blender would keep the source's line breaks, and
    translations would be looked up with them."""
    for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu):
        for cls in kind.__subclasses__():
            if cls.__module__.startswith(f"{__package__}.") and cls.__doc__ and "bl_description" not in vars(cls):
                cls.bl_description = " ".join(cls.__doc__.split())


def _holders_of_properties() -> list[type]:
    """Those of our classes that may have properties."""
    kinds = (bpy.types.Operator, bpy.types.PropertyGroup, bpy.types.AddonPreferences)
    return [c for kind in kinds for c in kind.__subclasses__() if c.__module__.startswith(f"{__package__}.")]
