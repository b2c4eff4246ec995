"""Restores the scene if a change to it fails."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from typing import Any

import bpy

from .. import compat
from ..access import settings_of

# Kinds of data-blocks that this add-on creates. Users precede the data that they use.
_KINDS = ("objects", "cameras", "meshes", "collections", "node_groups", "actions", "images", "textures")
# Owner -> settings that a step may change.
_SETTINGS = {
    "render": (
        "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "fps", "fps_base",
        "dither_intensity", "film_transparent", "filepath",
    ),
    "view_settings": ("view_transform", "look", "exposure", "gamma", "use_curve_mapping", "use_white_balance"),
    "scene": ("frame_start", "frame_end", "frame_current"),
    "layer": ("use_pass_z",),
}  # fmt: skip


@contextlib.contextmanager
def scene_of(scene: bpy.types.Scene) -> Generator[None, None, None]:
    """Context manager that makes a change all or nothing: an exception removes new data and restores settings.

    Removed data does not come back. Remove data last, when nothing else can fail.
    """
    existing = {kind: {block.session_uid for block in getattr(bpy.data, kind)} for kind in _KINDS}
    names = [(owner, name) for owner, names in _SETTINGS.items() for name in names]
    values = {(o, name): getattr(_owner(scene, o), name) for o, name in names if hasattr(_owner(scene, o), name)}
    camera = scene.camera.session_uid if scene.camera is not None else None
    switches = compat.compositor_switches(scene)
    custom_properties = {key: scene[key] for key in scene.keys() if key.startswith("splannequin_")}  # noqa: SIM118
    entry_count = len(settings_of(scene).made)
    try:
        yield
    except BaseException:
        for kind in _KINDS:
            bpy.data.batch_remove([b for b in getattr(bpy.data, kind) if b.session_uid not in existing[kind]])
        for (owner, name), value in values.items():
            if getattr(_owner(scene, owner), name) != value:
                setattr(_owner(scene, owner), name, value)
        scene.camera = next((o for o in scene.objects if o.session_uid == camera), None)
        compat.restore_compositor_switches(scene, switches)
        for key in [k for k in scene.keys() if k.startswith("splannequin_")]:  # noqa: SIM118
            del scene[key]
        for key, value in custom_properties.items():
            scene[key] = value
        while len(settings_of(scene).made) > entry_count:
            settings_of(scene).made.remove(entry_count)
        raise


def _owner(scene: bpy.types.Scene, name: str) -> Any:
    return {
        "scene": scene, "render": scene.render, "view_settings": scene.view_settings, "layer": scene.view_layers[0],
    }[name]  # fmt: skip
