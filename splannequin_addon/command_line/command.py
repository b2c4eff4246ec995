"""`blender --background [FILE.blend] --command splannequin COMMAND ...`."""

from __future__ import annotations

from typing import Any

import bpy

from . import headless

_handles: list[Any] = []


def _main(arguments: list[str]) -> int:
    return headless.main(arguments)


def register() -> None:
    """Registers the command with Blender."""
    _handles.append(bpy.utils.register_cli_command("splannequin", _main))


def unregister() -> None:
    """Unregisters the command."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
