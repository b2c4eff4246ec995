"""Registers everything the add-on has, in order, and unregisters it in reverse: all of it or nothing, and once.

Rooms below the steps are told of by their modules; each of the five steps hands in one object, with its classes and
whatever else it has Blender know.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import bpy

from . import properties, settings, translations
from .bake import render_settings
from .bake.step import STEP as BAKE
from .command_line import command
from .footage.step import STEP as IMPORT
from .freeze.step import STEP as FREEZE
from .process import backend, job_timer, steps
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


def owner() -> str:
    """Package of the copy of the add-on that Blender knows now; "" for none."""
    for cls in bpy.types.PropertyGroup.__subclasses__():  # `bpy.types` has no groups of properties as attributes
        if cls.__name__ == settings.SPLANNEQUIN_PG_scene.__name__ and getattr(cls, "is_registered", False):
            return cls.__module__.partition(".splannequin_addon.")[0]
    return ""


def registered() -> bool:
    """True between `register` and `unregister` of this copy."""
    return owner() == backend.PACKAGE


def register() -> None:
    """Makes the add-on's classes, properties, timer, handlers and command known to Blender: all, or none if one fails.

    Raises:
        RuntimeError: another copy of the add-on is enabled, and goes on working; or something cannot be registered.
    """
    if registered():
        return
    if owner():
        raise RuntimeError(translations.tr(f"Splannequin is enabled already, as {owner()}: disable that copy first."))
    _take_tooltips_from_docstrings()
    for step in _STEPS:
        steps.add(step)
    holders = _holders_of_properties()
    for cls in holders:
        properties.annotate(cls)
    undo: list[Callable[[], None]] = []
    try:
        for begin, end in _acts():
            undo.append(end)  # also of what fails halfway
            begin()
    except Exception as error:
        _undo(undo)
        raise RuntimeError(translations.tr(f"Splannequin cannot be enabled, and nothing of it is: {error}")) from error
    finally:
        for cls in holders:
            properties.release(cls)


def unregister() -> None:
    """Undoes `register`, in reverse. What fails does not keep the rest from being undone."""
    if registered():
        _undo([end for _, end in _acts()])


def _acts() -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """What registers each thing, and what takes it back, in order."""
    for part in _PARTS:
        yield part.register, part.unregister
    for cls in _CLASSES:
        yield functools.partial(bpy.utils.register_class, cls), functools.partial(bpy.utils.unregister_class, cls)
    for part in _PARTS_AFTER:
        yield part.register, part.unregister


def _undo(acts: Sequence[Callable[[], None]]) -> None:
    """Takes things back in reverse, and then whatever of ours is left: a part that failed may have done half of it."""
    for act in reversed(acts):
        with contextlib.suppress(Exception):
            act()
    for name in dir(bpy.app.handlers):
        hooks: Any = getattr(bpy.app.handlers, name)
        if isinstance(hooks, list):
            hooks[:] = [hook for hook in cast("list[object]", hooks) if not _is_ours(hook)]
    if hasattr(bpy.types.Scene, "splannequin"):
        del bpy.types.Scene.splannequin  # pyright: ignore[reportAttributeAccessIssue]
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu, bpy.types.UIList, bpy.types.AddonPreferences)
    # Groups last, and those that hold others before these: a class is taken back before what it points to.
    left = [cls for kind in (*kinds, bpy.types.PropertyGroup) for cls in reversed(kind.__subclasses__())]
    for cls in left:
        if _is_ours(cls) and getattr(cls, "is_registered", False):
            with contextlib.suppress(Exception):
                bpy.utils.unregister_class(cls)


def _is_ours(thing: object) -> bool:
    return str(getattr(thing, "__module__", "")).startswith(f"{__package__}.")


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
