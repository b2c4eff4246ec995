"""The menu Render > Splannequin, which contains all operators."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import bpy

from ..access import layout_of
from . import icons

# Names of operators in order of use. Operators that are missing here come last.
_GROUPS = (
    ("use_clip", "import_clip", "solve_camera", "load_camera", "train", "cancel"),
    ("t_star_here", "t_star_marker", "suggested_instant", "live", "freeze"),
    ("move_smooth", "move_retime", "move_hold", "move_orbit", "check_move"),
    ("draw_matte", "matte_from_mask", "add_splats", "add_surface", "add_light", "remove_light"),
    ("bake", "insert_freeze", "freeze_as_warp", "combine_cg", "render", "export_for_farm"),
    ("set_up", "check_backend", "remove_backend"),
    ("locate_shot", "remove_shot"),
)
# Operators that are only in the menu of the editor they need.
_EXCLUDED = {"use_movie_clip"}


def searchable() -> set[str]:
    """Names of the operators that need no arguments: all except internal ones."""
    ops: Any = bpy.ops  # our operators are not in the stubs
    names = dir(ops.splannequin)
    return {n for n in names if "INTERNAL" not in getattr(bpy.types, f"SPLANNEQUIN_OT_{n}").bl_options}


def entries() -> Iterator[list[str]]:
    """Names of the operators in the menu, one list per group."""
    left = searchable() - _EXCLUDED
    for group in _GROUPS:
        yield [name for name in group if name in left]
        left -= set(group)
    # Operators without a group also belong in a menu, because Blender's search (F3) only finds menu entries.
    yield sorted(left)


class SPLANNEQUIN_MT_shot(bpy.types.Menu):
    """Freeze time in a handheld clip of people holding still"""

    bl_idname = "SPLANNEQUIN_MT_shot"
    bl_label = "Splannequin"

    def draw(self, context: bpy.types.Context) -> None:
        """Draws every operator in order of use."""
        first = True
        for group in entries():
            if group and not first:
                layout_of(self).separator()
            for name in group:
                layout_of(self).operator(f"splannequin.{name}", icon=icons.of(f"splannequin.{name}"))
                first = False


def _in_render(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    layout_of(self).separator()
    layout_of(self).menu(SPLANNEQUIN_MT_shot.bl_idname, icon="FREEZE")


def _in_clip(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    layout_of(self).separator()
    layout_of(self).operator("splannequin.use_movie_clip", icon=icons.of("splannequin.use_movie_clip"))


def _menu_entries() -> list[tuple[Any, Callable[[bpy.types.Menu, bpy.types.Context], None]]]:
    """Pairs of (Blender menu, function that draws our entries in it)."""
    return [(bpy.types.TOPBAR_MT_render, _in_render), (bpy.types.CLIP_MT_clip, _in_clip)]


def register() -> None:
    """Registers the menu and adds it to Blender's menus."""
    bpy.utils.register_class(SPLANNEQUIN_MT_shot)
    for menu, draw in _menu_entries():
        menu.append(draw)


def unregister() -> None:
    """Undoes `register`."""
    for menu, draw in _menu_entries():
        menu.remove(draw)
    bpy.utils.unregister_class(SPLANNEQUIN_MT_shot)
