"""The marker "t*" on the timeline. The marker and the instant t* follow each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..access import named, settings_of

if TYPE_CHECKING:
    import bpy

NAME = "t*"
# `session_uid` of a scene -> (frame of the marker, t*) when the two last agreed.
_known: dict[int, tuple[int, int]] = {}


def toggle(scene: bpy.types.Scene) -> bool:
    """Adds the marker to the timeline, or removes it. True if it was added."""
    if remove(scene):
        return False
    scene.timeline_markers.new(NAME, frame=settings_of(scene).t_star)
    _known[scene.session_uid] = (settings_of(scene).t_star, settings_of(scene).t_star)
    return True


def remove(scene: bpy.types.Scene) -> bool:
    """Removes the marker. True if there was one."""
    _known.pop(scene.session_uid, None)
    marker = named(scene.timeline_markers, NAME)
    if marker is None:
        return False
    scene.timeline_markers.remove(marker)
    return True


def follow(scene: bpy.types.Scene) -> bool:
    """Synchronises marker and t*: the one that changed last sets the other. True if something was changed."""
    marker, props = named(scene.timeline_markers, NAME), settings_of(scene)
    if marker is None or marker.frame == props.t_star:
        if marker is not None:
            _known[scene.session_uid] = (marker.frame, props.t_star)
        return False
    before = _known.get(scene.session_uid)
    if before is not None and before[0] != marker.frame and before[1] == props.t_star:
        props.t_star, props.choose_t_star = marker.frame, True
    else:
        marker.frame = props.t_star
    _known[scene.session_uid] = (marker.frame, props.t_star)
    return True


def forget() -> None:
    """Clears the stored markers of all scenes. Call it when another file is loaded."""
    _known.clear()
