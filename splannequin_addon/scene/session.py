"""What is kept of the artist's data-blocks between two turns of the timer: their number in this session of Blender.

It survives renaming and undo, and no other file that is loaded has it; a name may be another's by then.
"""

from __future__ import annotations

from typing import TypeVar

import bpy

_Block = TypeVar("_Block", bound=bpy.types.ID)


def scene_of(uid: int) -> bpy.types.Scene | None:
    """The scene of this number, whatever it is called now; None if it is gone."""
    return of(bpy.data.scenes, uid)


def of(blocks: bpy.types.bpy_prop_collection[_Block], uid: int) -> _Block | None:
    """The one of some data-blocks that has this number; None if it is gone."""
    return next((block for block in blocks if block.session_uid == uid), None)
