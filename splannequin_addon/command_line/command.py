"""`blender --background [FILE.blend] --command splannequin COMMAND ...`."""

from __future__ import annotations

from typing import Any

import bpy

from . import headless

_handles: list[Any] = []


def register() -> None:
    """Registers the command with Blender."""
    _handles.append(bpy.utils.register_cli_command("splannequin", headless.main))


def unregister() -> None:
    """Unregisters the command."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
