"""All differences in animation between Blender 4.2 and 5.2 that the add-on handles: actions have layers since 4.4."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

if TYPE_CHECKING:
    _Animated = bpy.types.Scene | bpy.types.Object | bpy.types.Camera
    """Data-blocks that this module animates."""


def _enumerated(name: str) -> Mapping[str, int]:
    """Values of an enumeration property of keyframes, by identifier."""
    prop: Any = bpy.types.Keyframe.bl_rna.properties[name]
    return {item.identifier: item.value for item in prop.enum_items}


def fcurves(datablock: _Animated) -> Iterator[bpy.types.FCurve]:
    """The F-curves of a data-block's action, with or without layers (4.4 on)."""
    data = datablock.animation_data
    if data is None or data.action is None:
        return
    for curves in _curves(data):
        yield from curves


def curves_of_strip(strip: bpy.types.NlaStrip) -> list[bpy.types.FCurve]:
    """The F-curves of the action that an NLA strip plays."""
    return [curve for curves in _curves(strip) for curve in curves] if strip.action is not None else []


def _curves(animation: bpy.types.AnimData | bpy.types.NlaStrip) -> list[Any]:
    """Collections of F-curves of an action: one per strip (4.4 on), or the action's only one."""
    action: Any = animation.action  # the stubs know strips of one version and curves of another
    if hasattr(action, "layers") and action.layers:
        if animation.action_slot is None:  # the action animates other data-blocks only
            return []
        bags = [strip.channelbag(animation.action_slot) for layer in action.layers for strip in layer.strips]
        return [bag.fcurves for bag in bags if bag is not None]
    return [action.fcurves] if hasattr(action, "fcurves") else []


def remove_fcurves(datablock: _Animated, data_path: str) -> None:
    """Removes the F-curves and drivers of a data path from a data-block."""
    data = datablock.animation_data
    if data is None:
        return
    for driver in [d for d in data.drivers if d.data_path == data_path]:
        data.drivers.remove(driver)
    if data.action is None:
        return
    for curves in _curves(data):
        for curve in [c for c in curves if c.data_path == data_path]:
            curves.remove(curve)


def set_keys(
    datablock: _Animated, frames: Sequence[int], channels: Mapping[str, np.ndarray], types: Sequence[str] = ()
) -> None:
    """Sets keyframes of several channels at once, with linear interpolation. Other channels keep their keyframes.

    Args:
        datablock: data-block to animate.
        frames: [F] ascending frame numbers.
        channels: data path -> values [F, C], one column per array index. Existing keys of these channels are replaced.
        types: [F] type of each key, which sets its colour: KEYFRAME, JITTER, EXTREME. Empty: all KEYFRAME.
    """
    known = _enumerated("type")
    animation: Any = datablock.animation_data_create()
    action: Any = animation.action
    if action is None or action.library is not None:  # a linked action is read-only
        action = animation.action = bpy.data.actions.new(f"{datablock.name}Action")
    if hasattr(action, "slots"):
        slot = animation.action_slot
        if slot is None:
            slot = animation.action_slot = action.slots.new(datablock.id_type, datablock.name)
        layer = action.layers[0] if action.layers else action.layers.new("Layer")
        strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
        curves = strip.channelbag(slot, ensure=True).fcurves
    else:
        curves = action.fcurves
    straight = _enumerated("interpolation")["LINEAR"]
    for name, values in channels.items():
        for index in range(values.shape[1]):
            curve = curves.find(name, index=index) or curves.new(name, index=index)
            keys = curve.keyframe_points
            keys.clear()
            keys.add(len(frames))
            keys.foreach_set("co", np.stack([np.asarray(frames, float), values[:, index]], axis=1).ravel())
            keys.foreach_set("interpolation", np.full(len(frames), straight, dtype=np.int32))
            if any(kind != "KEYFRAME" for kind in types):
                keys.foreach_set("type", np.array([known[kind] for kind in types], dtype=np.int32))
            curve.update()  # `foreach_set` leaves handles and order as they were


def remove_keys(datablock: _Animated, data_paths: Sequence[str]) -> None:
    """Removes the F-curves of these data paths from a data-block. Also removes the action if it is then empty."""
    data = datablock.animation_data
    if data is None or data.action is None:
        return
    for curves in _curves(data):
        for curve in [c for c in curves if c.data_path in data_paths]:
            curves.remove(curve)
    action: Any = data.action
    if not any(len(curves) for curves in _curves(data)) and action.users == 1 + int(action.use_fake_user):
        data.action = None
        bpy.data.actions.remove(action)
