"""Registers all parts of the add-on in order and unregisters them in reverse order: all or nothing, and only once.

Lower-level packages are registered through their modules. Each of the five steps provides one object with its classes
and other parts to register.
"""

from __future__ import annotations

import functools
import traceback
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

# The steps in order of execution, which is also the order of their panels.
_STEPS = (IMPORT, SOLVE, TRAIN, FREEZE, BAKE)
_CLASSES = (
    *shots_panel.CLASSES,
    *job_operators.CLASSES,
    *(cls for step in _STEPS for cls in step.classes),
)
# Modules that are registered before the classes.
_PARTS: tuple[steps.Part, ...] = (
    translations,
    settings,
    preferences,
)
_PARTS_AFTER: tuple[steps.Part, ...] = (
    menu,
    render_settings,  # before places: both handle save_pre, and places uses the output path
    places,  # before job_timer: paths must be repaired before shots are looked up again
    *(part for step in _STEPS for part in step.parts),
    job_timer,
    command,
)


def owner() -> str:
    """Package of the copy of the add-on that is registered in Blender; "" if there is none."""
    for cls in bpy.types.PropertyGroup.__subclasses__():  # `bpy.types` has no attributes for property groups
        if cls.__name__ == settings.SPLANNEQUIN_PG_scene.__name__ and getattr(cls, "is_registered", False):
            return cls.__module__.partition(".splannequin_addon.")[0]
    return ""


def registered() -> bool:
    """True between `register` and `unregister` of this copy of the add-on."""
    return owner() == backend.PACKAGE


def register() -> None:
    """Registers the add-on's classes, properties, timer, handlers and command: all, or none if one fails.

    Raises:
        RuntimeError: another copy of the add-on is enabled (it stays enabled), or a part cannot be registered.
    """
    if registered():
        return
    if owner():
        raise RuntimeError(translations.tr(f"Splannequin is already enabled as {owner()}. Disable that copy first."))
    _take_tooltips_from_docstrings()
    for step in _STEPS:
        steps.add(step)
    holders = _holders_of_properties()
    for cls in holders:
        properties.annotate(cls)
    undo: list[Callable[[], None]] = []
    try:
        for begin, end in _registrations():
            undo.append(end)  # before the call, to undo a partial registration
            begin()
    except Exception as error:
        _undo(undo)
        raise RuntimeError(translations.tr(f"Splannequin could not be enabled: {error}")) from error
    finally:
        for cls in holders:
            properties.release(cls)


def unregister() -> None:
    """Undoes `register` in reverse order. An error in one part does not stop the others."""
    if registered():
        _undo([end for _, end in _registrations()])


def _registrations() -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Pairs of (register, unregister) functions, in order."""
    for part in _PARTS:
        yield part.register, part.unregister
    for cls in _CLASSES:
        yield functools.partial(bpy.utils.register_class, cls), functools.partial(bpy.utils.unregister_class, cls)
    for part in _PARTS_AFTER:
        yield part.register, part.unregister


def _undo(calls: Sequence[Callable[[], None]]) -> None:
    """Unregisters parts in reverse order, then everything else that this add-on left registered after partial
    failures."""
    for call in reversed(calls):
        _attempt(call)
    for name in dir(bpy.app.handlers):
        hooks: Any = getattr(bpy.app.handlers, name)
        if isinstance(hooks, list):
            hooks[:] = [hook for hook in cast("list[object]", hooks) if not _is_ours(hook)]
    if hasattr(bpy.types.Scene, "splannequin"):
        del bpy.types.Scene.splannequin  # pyright: ignore[reportAttributeAccessIssue]
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu, bpy.types.UIList, bpy.types.AddonPreferences)
    # Property groups come last. A group is unregistered before the groups that it contains. `__subclasses__` knows only
    # direct subclasses, here and below: no class of ours is derived from another registered one.
    left = [cls for kind in (*kinds, bpy.types.PropertyGroup) for cls in reversed(kind.__subclasses__())]
    for cls in left:
        if _is_ours(cls) and getattr(cls, "is_registered", False):
            _attempt(functools.partial(bpy.utils.unregister_class, cls))


def _attempt(call: Callable[[], None]) -> None:
    """Calls a function and prints its error, so that one part does not keep the others registered."""
    try:
        call()
    except Exception:
        traceback.print_exc()


def _is_ours(thing: object) -> bool:
    return str(getattr(thing, "__module__", "")).startswith(f"{__package__}.")


def _take_tooltips_from_docstrings() -> None:
    """Sets each class's docstring as its tooltip, on one line."""
    for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu):
        for cls in kind.__subclasses__():
            if cls.__module__.startswith(f"{__package__}.") and cls.__doc__ and "bl_description" not in vars(cls):
                # Blender would keep the source's line breaks, and would look up translations with them.
                cls.bl_description = " ".join(cls.__doc__.split())


def _holders_of_properties() -> list[type]:
    """Classes of this add-on that may have properties."""
    kinds = (bpy.types.Operator, bpy.types.PropertyGroup, bpy.types.AddonPreferences)
    return [c for kind in kinds for c in kind.__subclasses__() if c.__module__.startswith(f"{__package__}.")]
