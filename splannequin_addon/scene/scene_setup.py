"""Settings of the scene that a shot needs, changed only with consent, said in words, and taken back on removal."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from ...torch_backend import contract
from ..access import present
from . import axes

if TYPE_CHECKING:
    import bpy

_BEFORE = "splannequin_settings_before"
_OURS = "splannequin_settings_ours"
_TOGETHER = (
    {"resolution_x", "resolution_y", "resolution_percentage"},
    {"pixel_aspect_x", "pixel_aspect_y"},
    {"fps", "fps_base"},
    {"frame_start", "frame_end"},
    {"use_stamp_note", "stamp_note_text"},
)
_SHOTS = {
    "render": ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "fps",
               "fps_base"),
    "scene": ("frame_start", "frame_end"),
}  # fmt: skip
"""Settings that each shot of a scene has its own of, by owner; first before last."""
NEUTRAL_VIEWS = ("Standard", "Un-tone-mapped")
"""Views that show colours as they are: Blender's own, that of the ACES configurations."""
NEUTRAL_VIEW = {"look": "None", "exposure": 0.0, "gamma": 1.0, "use_curve_mapping": False, "use_white_balance": False}
"""The other settings of a view that shows colours as they are. Blender before 4.3 has no white balance."""


def untouched(scene: bpy.types.Scene) -> bool:
    """True if size, rate and range of the scene are those of a new file: nothing of the artist's would be lost."""
    render = scene.render
    size = (render.resolution_x, render.resolution_y) == (1920, 1080)
    return size and render.fps == 24 and (scene.frame_start, scene.frame_end) == (1, 250)


def fitted(scene: bpy.types.Scene) -> bool:
    """True if `fit_clip` has changed the scene before: it is ours to fit again."""
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
    """Gives the scene the clip's size, rate and range; returns what was changed, in words.

    Args:
        scene: the scene.
        size: width and height in pixels; None leaves them.
        fps: frames per second; 0 leaves the scene's.
        frames: first and last frame, inclusive.
        k: fx, fy, cx, cy, for the pixel aspect; None leaves it.
        over: also what the artist has changed since it was set here.
    """
    render = scene.render
    changes: list[str] = []
    spared = set[str]() if over else {name for names in _touched(scene).values() for name in names}
    aspect = axes.pixel_aspect(k) if k else (render.pixel_aspect_x, render.pixel_aspect_y)
    now = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    if size is not None and now != (*size, 100) and "resolution_x" not in spared:
        _set(scene, "render", {"resolution_x": size[0], "resolution_y": size[1], "resolution_percentage": 100})
        changes.append(f"Resolution set to {size[0]} x {size[1]}.")
    if (render.pixel_aspect_x, render.pixel_aspect_y) != aspect and "pixel_aspect_x" not in spared:
        _set(scene, "render", {"pixel_aspect_x": aspect[0], "pixel_aspect_y": aspect[1]})
        changes.append("Pixel aspect set to the lens's.")
    if fps > 0 and abs(render.fps / render.fps_base - fps) > 1e-4 and "fps" not in spared:
        whole = max(round(fps), 1)
        _set(scene, "render", {"fps": whole, "fps_base": whole / fps})
        changes.append(f"Frame rate set to {fps:g}.")
    if (scene.frame_start, scene.frame_end) != frames and "frame_start" not in spared:
        _set(scene, "scene", {"frame_start": frames[0], "frame_end": frames[1]})
        changes.append(f"Frame range set to {frames[0]} to {frames[1]}.")
    if not frames[0] <= scene.frame_current <= frames[1]:
        scene.frame_set(frames[0])
    return changes


def kept(scene: bpy.types.Scene) -> str:
    """Size, rate and range as they stand, and what of them was set here, as JSON: for `put_back`."""
    ours = json.loads(scene.get(_OURS, "{}"))
    now = {owner: {name: getattr(_owner(scene, owner), name) for name in names} for owner, names in _SHOTS.items()}
    set_here = {o: {n: v for n, v in ours.get(o, {}).items() if n in names} for o, names in _SHOTS.items()}
    return json.dumps({"now": now, "ours": set_here})


def put_back(scene: bpy.types.Scene, was: str) -> None:
    """Sets size, rate and range as `kept` told them; nothing in a scene where none of them was ever set here."""
    if not was or not fitted(scene):
        return
    stored = json.loads(was)
    for owner, values in stored["now"].items():
        different = {n: v for n, v in values.items() if not _same(getattr(_owner(scene, owner), n), v)}
        _set(scene, owner, different)
    ours = json.loads(scene[_OURS])
    for owner, names in _SHOTS.items():
        others = {n: v for n, v in ours.get(owner, {}).items() if n not in names}
        ours[owner] = others | stored["ours"].get(owner, {})
    scene[_OURS] = json.dumps(ours)
    if not scene.frame_start <= scene.frame_current <= scene.frame_end:
        scene.frame_set(scene.frame_start)


def keep_plate_colours(scene: bpy.types.Scene) -> list[str]:
    """Sets the view transform so that pictures leave as they came in; returns what was changed, in words.

    Blender's default view (AgX) is made for renders and would change every plate. Dithering is noise on the last bit.
    JobError if the colour configuration has no such view.
    """
    changes: list[str] = []
    if not keeps_plate_colours(scene):
        view = present(scene.view_settings)
        was, neutral = view.view_transform, _neutral(view)
        values = {name: value for name, value in NEUTRAL_VIEW.items() if hasattr(view, name)}
        _set(scene, "view", {"view_transform": neutral, **values})
        changes.append(f"View transform set from {was} to {neutral}, so that the plate keeps its colours.")
    if scene.render.dither_intensity:
        _set(scene, "render", {"dither_intensity": 0.0})
        changes.append("Dither set to 0, so that pixels stay exact.")
    return changes


def note(scene: bpy.types.Scene, text: str) -> list[str]:
    """Has rendered files say a text in their metadata, as Blender's Note; returns what was changed, in words.

    A note of the artist's own stays. Without a text one that was made here goes.
    """
    render = scene.render
    ours = json.loads(scene.get(_OURS, "{}")).get("render", {}).get("stamp_note_text")
    now = render.stamp_note_text
    if (render.use_stamp_note or now) and now != ours:
        return []
    if text == now and render.use_stamp_note == bool(text):
        return []
    _set(scene, "render", {"use_stamp_note": bool(text), "stamp_note_text": text})
    return [f"What is rendered says in its metadata (Note): {text}"] if text else []


def _neutral(view: Any) -> str:
    """Name of the view that shows colours as they are. JobError if there is none for the display that is chosen."""
    was = view.view_transform
    for name in (was, *NEUTRAL_VIEWS):
        try:
            view.view_transform = name
        except TypeError:  # what an enumeration says to a value it lacks; which ones it has, it does not tell
            continue
        view.view_transform = was
        if name in NEUTRAL_VIEWS:
            return name
    raise contract.JobError(
        f"This Blender's colour configuration has no view that leaves colours alone ({', '.join(NEUTRAL_VIEWS)}).",
        "Use Blender's own configuration, or switch Keep Plate Colours off.",
        contract.ExitCode.BAKE,
    )


def render_cg(scene: bpy.types.Scene) -> list[str]:
    """Has the scene rendered on a transparent film with a depth pass; returns what was changed, in words."""
    changes: list[str] = []
    if not scene.render.film_transparent:
        _set(scene, "render", {"film_transparent": True})
        changes.append("Film set to transparent.")
    if not scene.view_layers[0].use_pass_z:
        _set(scene, "layer", {"use_pass_z": True})
        changes.append("The depth pass was switched on.")
    return changes


def keeps_plate_colours(scene: bpy.types.Scene) -> bool:
    """True if pictures leave the scene with the colours they came in with."""
    view: Any = present(scene.view_settings)
    return view.view_transform in NEUTRAL_VIEWS and all(
        getattr(view, name, value) == value for name, value in NEUTRAL_VIEW.items()
    )


def restore(scene: bpy.types.Scene) -> bool:
    """Takes back the settings that were changed here, but what the artist has changed since. True if there was one.

    Settings that belong together (a size, a rate, a range) are taken back together or not at all.
    """
    stored = scene.get(_BEFORE)
    if not stored:
        return False
    touched = _touched(scene)
    for owner, values in json.loads(stored).items():
        target = _owner(scene, owner)
        for name, value in values.items():
            if name not in touched.get(owner, ()):
                setattr(target, name, value)
    for key in (_BEFORE, _OURS):
        if key in scene:
            del scene[key]
    return True


def _touched(scene: bpy.types.Scene) -> dict[str, set[str]]:
    """What was set here and is different now, with what belongs together with it, by owner: the artist's."""
    found: dict[str, set[str]] = {}
    for owner, set_here in json.loads(scene.get(_OURS, "{}")).items():
        touched = {n for n, v in set_here.items() if not _same(getattr(_owner(scene, owner), n), v)}
        for group in _TOGETHER:
            touched |= group if touched & group else set()
        found[owner] = touched
    return found


def _same(one: Any, other: Any) -> bool:
    return abs(one - other) < 1e-5 if isinstance(other, float) else bool(one == other)


def _owner(scene: bpy.types.Scene, name: str) -> Any:
    return {
        "scene": scene, "render": scene.render, "view": scene.view_settings, "layer": scene.view_layers[0],
    }[name]  # fmt: skip


def _set(scene: bpy.types.Scene, owner: str, values: dict[str, Any]) -> None:
    """Changes settings; keeps in the scene what they were (unless that is kept already) and what they became."""
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
    """Pixels that a render of the scene has."""
    render = scene.render
    share = render.resolution_percentage
    return render.resolution_x * share // 100, render.resolution_y * share // 100
