"""Scene settings that a shot needs. They are changed only with consent, reported, and restored on removal."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING, Any

from ...torch_backend import contract
from ..access import present
from . import axes

if TYPE_CHECKING:
    import bpy

_BEFORE = "splannequin_settings_before"
_OURS = "splannequin_settings_ours"
# Settings that belong together are restored together or not at all.
_COUPLED = (
    {"resolution_x", "resolution_y", "resolution_percentage"},
    {"pixel_aspect_x", "pixel_aspect_y"},
    {"fps", "fps_base"},
    {"frame_start", "frame_end"},
    {"use_stamp_note", "stamp_note_text"},
)
# Owner -> settings of which each shot of a scene has its own values; the first frame precedes the last.
_SHOTS = {
    "render": ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "fps",
               "fps_base"),
    "scene": ("frame_start", "frame_end"),
}  # fmt: skip
NEUTRAL_VIEWS = ("Standard", "Un-tone-mapped")
"""View transforms that leave colours unchanged: Blender's, and that of ACES configurations."""
NEUTRAL_VIEW = {"look": "None", "exposure": 0.0, "gamma": 1.0, "use_curve_mapping": False, "use_white_balance": False}
"""Other settings of a view that leaves colours unchanged. Blender before 4.3 has no white balance."""


def untouched(scene: bpy.types.Scene) -> bool:
    """True if the scene has a new file's size, rate and range, so that changing them loses no work."""
    render = scene.render
    size = (render.resolution_x, render.resolution_y) == (1920, 1080)
    return size and render.fps == 24 and (scene.frame_start, scene.frame_end) == (1, 250)


def fitted(scene: bpy.types.Scene) -> bool:
    """True if `fit_clip` has changed the scene before, and may therefore change it again."""
    before = json.loads(scene.get(_BEFORE, "{}"))
    return "resolution_x" in before.get("render", {}) or "frame_start" in before.get("scene", {})


def fit_clip(
    scene: bpy.types.Scene,
    size: tuple[int, int] | None,
    fps: float,
    frames: tuple[int, int],
    k: tuple[float, float, float, float] | None = None,
    over: bool = True,
) -> list[str]:
    """Sets the scene's size, rate and range to the clip's. Returns the changes as sentences.

    Args:
        size: width and height in pixels; None keeps the scene's.
        fps: frames per second; 0 keeps the scene's.
        frames: first and last frame, inclusive.
        k: fx, fy, cx, cy, for the pixel aspect; None keeps the scene's.
        over: also overwrite settings that the artist has changed since they were set here.
    """
    render = scene.render
    changes: list[str] = []
    excluded = set[str]() if over else {name for names in _touched(scene).values() for name in names}
    aspect = axes.pixel_aspect(k) if k else (render.pixel_aspect_x, render.pixel_aspect_y)
    now = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    if size is not None and now != (*size, 100) and "resolution_x" not in excluded:
        _set(scene, "render", {"resolution_x": size[0], "resolution_y": size[1], "resolution_percentage": 100})
        changes.append(f"Resolution set to {size[0]} x {size[1]}.")
    if (render.pixel_aspect_x, render.pixel_aspect_y) != aspect and "pixel_aspect_x" not in excluded:
        _set(scene, "render", {"pixel_aspect_x": aspect[0], "pixel_aspect_y": aspect[1]})
        changes.append("Pixel aspect set to match the lens.")
    if fps > 0 and abs(render.fps / render.fps_base - fps) > 1e-4 and "fps" not in excluded:
        # Blender's rate is a whole number over `fps_base`: 23.976 is about 24 / 1.001.
        whole = max(round(fps), 1)
        _set(scene, "render", {"fps": whole, "fps_base": whole / fps})
        changes.append(f"Frame rate set to {fps:g}.")
    if (scene.frame_start, scene.frame_end) != frames and "frame_start" not in excluded:
        _set(scene, "scene", {"frame_start": frames[0], "frame_end": frames[1]})
        changes.append(f"Frame range set to {frames[0]} to {frames[1]}.")
    if not frames[0] <= scene.frame_current <= frames[1]:
        scene.frame_set(frames[0])
    return changes


def kept(scene: bpy.types.Scene) -> str:
    """JSON with the scene's size, rate and range, and the values of them set by this module. Input of `put_back`."""
    ours = json.loads(scene.get(_OURS, "{}"))
    now = {owner: {name: getattr(_owner(scene, owner), name) for name in names} for owner, names in _SHOTS.items()}
    set_values = {o: {n: v for n, v in ours.get(o, {}).items() if n in names} for o, names in _SHOTS.items()}
    return json.dumps({"now": now, "ours": set_values})


def put_back(scene: bpy.types.Scene, was: str) -> None:
    """Restores size, rate and range from `kept`. Does nothing if this module never set them in the scene."""
    if not was or not fitted(scene):
        return
    stored = json.loads(was)
    for owner, values in stored["now"].items():
        different = {n: v for n, v in values.items() if not _same(getattr(_owner(scene, owner), n), v)}
        _set(scene, owner, different)
    ours = json.loads(scene[_OURS])
    for owner, names in _SHOTS.items():
        unrelated = {n: v for n, v in ours.get(owner, {}).items() if n not in names}
        ours[owner] = unrelated | stored["ours"].get(owner, {})
    scene[_OURS] = json.dumps(ours)
    if not scene.frame_start <= scene.frame_current <= scene.frame_end:
        scene.frame_set(scene.frame_start)


def keep_plate_colours(scene: bpy.types.Scene) -> list[str]:
    """Sets the view transform so that rendered images keep the plate's colours. Returns the changes as sentences.

    Raises JobError if the colour configuration has no such view.
    """
    changes: list[str] = []
    # Blender's default view (AgX) is designed for renders and would change every plate.
    if not keeps_plate_colours(scene):
        view = present(scene.view_settings)
        was, neutral = view.view_transform, _neutral(view)
        values = {name: value for name, value in NEUTRAL_VIEW.items() if hasattr(view, name)}
        _set(scene, "view", {"view_transform": neutral, **values})
        changes.append(f"View transform set from {was} to {neutral}, so that the plate keeps its colours.")
    if scene.render.dither_intensity:  # noise in the last bit
        _set(scene, "render", {"dither_intensity": 0.0})
        changes.append("Dither set to 0, so that pixels stay exact.")
    return changes


def note(scene: bpy.types.Scene, text: str) -> list[str]:
    """Writes a text into the metadata of rendered files, as Blender's Note. Returns the changes as sentences.

    A note written by the artist is not changed. An empty text removes a note that was set here.
    """
    render = scene.render
    ours = json.loads(scene.get(_OURS, "{}")).get("render", {}).get("stamp_note_text")
    now = render.stamp_note_text
    if (render.use_stamp_note or now) and now != ours:
        return []
    if text == now and render.use_stamp_note == bool(text):
        return []
    _set(scene, "render", {"use_stamp_note": bool(text), "stamp_note_text": text})
    return [f"Note in the metadata of rendered images: {text}"] if text else []


def _neutral(view: Any) -> str:
    """Name of the view that leaves colours unchanged. Raises JobError if the selected display has none."""
    was, look = view.view_transform, view.look
    for name in (was, *NEUTRAL_VIEWS):
        try:
            view.view_transform = name
        except TypeError:  # the enumeration lacks the value; Blender offers no list of its values
            continue
        view.view_transform = was
        view.look = look  # Blender resets a look that a view lacks
        if name in NEUTRAL_VIEWS:
            return name
    raise contract.JobError(
        f"Blender's colour configuration has no view that keeps colours unchanged ({', '.join(NEUTRAL_VIEWS)}).",
        "Use Blender's default configuration, or turn Keep Plate Colours off.",
        contract.ExitCode.BAKE,
    )


def render_cg(scene: bpy.types.Scene) -> list[str]:
    """Sets up the scene to render with a transparent film and a depth pass. Returns the changes as sentences."""
    changes: list[str] = []
    if not scene.render.film_transparent:
        _set(scene, "render", {"film_transparent": True})
        changes.append("Film set to transparent.")
    if not scene.view_layers[0].use_pass_z:
        _set(scene, "layer", {"use_pass_z": True})
        changes.append("The depth pass was switched on.")
    return changes


def keeps_plate_colours(scene: bpy.types.Scene) -> bool:
    """True if rendered images keep the plate's colours."""
    view: Any = present(scene.view_settings)
    return view.view_transform in NEUTRAL_VIEWS and all(
        getattr(view, name, value) == value for name, value in NEUTRAL_VIEW.items()
    )


def restore(scene: bpy.types.Scene) -> bool:
    """Restores the settings that were changed here, except those that the artist has changed since. True if there were
    any.

    Settings that belong together stay together, see `_COUPLED`.
    """
    stored = scene.get(_BEFORE)
    if not stored:
        return False
    touched = _touched(scene)
    for owner, values in json.loads(stored).items():
        target = _owner(scene, owner)
        for name, value in values.items():
            if name not in touched.get(owner, ()):
                # An enumeration may lack the value now: a look of another view, or a view of another configuration.
                with contextlib.suppress(TypeError):
                    setattr(target, name, value)
    for key in (_BEFORE, _OURS):
        if key in scene:
            del scene[key]
    return True


def _touched(scene: bpy.types.Scene) -> dict[str, set[str]]:
    """Owner -> settings that were set here and changed by the artist since, with the settings that belong to them."""
    found: dict[str, set[str]] = {}
    for owner, set_values in json.loads(scene.get(_OURS, "{}")).items():
        touched = {n for n, v in set_values.items() if not _same(getattr(_owner(scene, owner), n), v)}
        for group in _COUPLED:
            touched |= group if touched & group else set()
        found[owner] = touched
    return found


def _same(first: Any, second: Any) -> bool:
    return abs(first - second) < 1e-5 if isinstance(second, float) else bool(first == second)


def _owner(scene: bpy.types.Scene, name: str) -> Any:
    return {
        "scene": scene, "render": scene.render, "view": scene.view_settings, "layer": scene.view_layers[0],
    }[name]  # fmt: skip


def _set(scene: bpy.types.Scene, owner: str, values: dict[str, Any]) -> None:
    """Changes settings. Stores in the scene their first values from before (only once) and their new values."""
    target = _owner(scene, owner)
    before, ours = (json.loads(scene.get(key, "{}")) for key in (_BEFORE, _OURS))
    was = {name: getattr(target, name) for name in values}
    for name, value in values.items():
        setattr(target, name, value)
    for name in values:
        before.setdefault(owner, {}).setdefault(name, was[name])
        ours.setdefault(owner, {})[name] = getattr(target, name)
    scene[_BEFORE], scene[_OURS] = json.dumps(before), json.dumps(ours)


def render_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height of the scene's render in pixels."""
    render = scene.render
    share = render.resolution_percentage
    return render.resolution_x * share // 100, render.resolution_y * share // 100
