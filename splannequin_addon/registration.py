"""Registers everything the add-on has, in order, and unregisters it in reverse. Registering twice registers once."""

from __future__ import annotations

import bpy

from . import cli, ops_clip, ops_jobs, ops_solves, ops_steps, panel, pictures, points, preferences, props, supervisor

_CLASSES = (*ops_steps.CLASSES, *ops_jobs.CLASSES, *ops_clip.CLASSES, *ops_solves.CLASSES, *panel.CLASSES)


def registered() -> bool:
    """True between `register` and `unregister`."""
    return hasattr(bpy.types.Scene, "splannequin")


def register() -> None:
    """Makes the add-on's classes, properties, timer, handlers and command known to Blender."""
    if registered():
        return
    props.register()
    preferences.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    pictures.register()
    points.register()
    supervisor.register()
    cli.register()


def unregister() -> None:
    """Undoes `register`, in reverse."""
    if not registered():
        return
    cli.unregister()
    supervisor.unregister()
    points.unregister()
    pictures.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    preferences.unregister()
    props.unregister()
