"""The add-on's preferences: where the backend's Python is."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import StringProperty

from ..torch_backend import contract
from . import backend


class SPLANNEQUIN_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > Splannequin."""

    bl_idname = backend.PACKAGE

    backend_python: StringProperty(
        name="Backend Python",
        description="Python interpreter of the backend's environment; empty: found by itself",
        subtype="FILE_PATH",
    )

    def draw(self, context: Any) -> None:
        """The path, and what is used if it is empty."""
        layout = self.layout
        layout.prop(self, "backend_python")
        try:
            layout.label(text=f"In use: {backend.python()}", icon="CHECKMARK")
        except contract.JobError as error:
            column = layout.column(align=True)
            column.alert = True
            column.label(text=error.message, icon="ERROR")
            column.label(text=error.hint)


def register() -> None:
    """Registers the preferences."""
    bpy.utils.register_class(SPLANNEQUIN_preferences)


def unregister() -> None:
    """Undoes `register`."""
    bpy.utils.unregister_class(SPLANNEQUIN_preferences)
