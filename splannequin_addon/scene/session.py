"""Identifies the artist's data-blocks between two timer steps by their number in this Blender session.

The number survives renaming and undo, and is not reused when another file is loaded. A name may belong to another
data-block by then.
"""

from __future__ import annotations

from typing import TypeVar

import bpy

_Block = TypeVar("_Block", bound=bpy.types.ID)


def scene_of(uid: int) -> bpy.types.Scene | None:
    """The scene with this number; None if it no longer exists."""
    return of(bpy.data.scenes, uid)


def of(blocks: bpy.types.bpy_prop_collection[_Block], uid: int) -> _Block | None:
    """The data-block with this number; None if it no longer exists."""
    return next((block for block in blocks if block.session_uid == uid), None)
