"""All data of the open file as a flat dictionary, for comparison before and after an operator, undo and redo."""

from __future__ import annotations

from typing import Any

import bpy

_SPARED = {"all_ids", "window_managers", "workspaces", "screens", "libraries", "brushes", "palettes"}
"""Collections that undo does not restore, or that Blender fills itself when an editor is opened."""
_UNREAD = {
    "bl_rna", "rna_type", "id_data", "session_uid", "original", "users", "tag", "pixels", "bindcode", "size",
    "channels", "depth", "resolution", "frame_duration", "animation_data", "fcurves", "file_format", "particle_edit",
    "uv_sculpt",  # Blender 4.2 ends by SIGSEGV when it is read
}  # fmt: skip
"""Properties that are not part of the file's data, or that Blender computes when something is drawn."""
_DEPTH = 5
_MOST = 40
"""Longest collection whose items are read one by one; of a longer one (vertices, keys, points) only the length is
kept."""


def file_state() -> dict[str, Any]:
    """Map from the path of every property of every data-block to its value."""
    found: dict[str, Any] = {}
    for name in sorted(dir(bpy.data)):
        blocks = getattr(bpy.data, name)
        if isinstance(blocks, bpy.types.bpy_prop_collection) and name not in _SPARED:
            for block in blocks:
                path = f"{name}[{block.name}]"
                _read(block, path, found, _DEPTH)
                found |= {f"{path}[{key}]": str(_plain(value)) for key, value in block.items()}
    for action in bpy.data.actions:
        found[f"actions[{action.name}] keys"] = _keys(action)
    return found


def difference(one: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """List of the differences between two states, one "path: value -> value" each."""
    return [f"{k}: {one.get(k)} -> {second.get(k)}" for k in sorted({*one, *second}) if one.get(k) != second.get(k)]


def _read(struct: Any, path: str, found: dict[str, Any], depth: int) -> None:
    """Read a struct and its nested structs into `found`; other data-blocks are stored by name only."""
    found[path] = type(struct).__name__
    for rna in struct.bl_rna.properties if depth else ():
        name = rna.identifier
        if name in _UNREAD or name.startswith(("is_", "has_")):
            continue
        if name == "frame_current" and isinstance(struct, bpy.types.ImageUser):  # frame that was drawn last
            continue
        child_path, value = f"{path}.{name}", getattr(struct, name, None)
        if rna.type == "COLLECTION":
            found[child_path] = len(value)
            for n, item in enumerate(value if len(value) <= _MOST else ()):
                _follow(item, f"{child_path}[{n}]", found, depth)
        elif rna.type == "POINTER":
            _follow(value, child_path, found, depth)
        elif getattr(rna, "is_array", False):
            found[child_path] = [round(v, 5) if isinstance(v, float) else v for v in _flat(value)]
        else:
            found[child_path] = round(value, 5) if isinstance(value, float) else value


def _follow(value: Any, path: str, found: dict[str, Any], depth: int) -> None:
    is_embedded = isinstance(value, bpy.types.NodeTree | bpy.types.Collection) and value.is_embedded_data
    if value is None or (isinstance(value, bpy.types.ID) and not is_embedded):
        found[path] = value and value.name
    else:
        _read(value, path, found, depth - 1)


def _plain(value: Any) -> Any:
    """Custom property as plain Python data, without its address. Before 5.0, custom properties include the add-ons'
    own."""
    return value.to_dict() if hasattr(value, "to_dict") else value.to_list() if hasattr(value, "to_list") else value


def _flat(value: Any) -> list[Any]:
    return [one for row in value for one in (_flat(row) if hasattr(row, "__len__") else [row])]


def _keys(action: Any) -> list[tuple[str, int, list[float]]]:
    """(data path, index, frames and values) of every F-curve."""
    curves = getattr(action, "fcurves", None)
    if curves is None:  # Blender 5 stores F-curves in layers
        strips = [strip for layer in action.layers for strip in layer.strips]
        curves = [curve for strip in strips for bag in strip.channelbags for curve in bag.fcurves]
    found = []
    for curve in curves:
        values = [0.0] * (2 * len(curve.keyframe_points))
        curve.keyframe_points.foreach_get("co", values)
        found.append((curve.data_path, curve.array_index, [round(v, 5) for v in values]))
    return found
