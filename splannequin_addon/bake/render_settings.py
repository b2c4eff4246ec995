"""The render settings that a bake needs, in one table. Each row is set while a bake renders, said, and set back.

While a bake goes on, what it changed is noted in the scene itself: a file that was saved in between, or an undo step,
is put right when it is loaded. A file that the artist saves meanwhile holds the artist's own settings.

Left as the artist has them, because they are choices about the result: file format, colour mode, depth, compression and
the linear space of EXR files; size in percent, range and step; the compositor's precision; everything that only decides
how the scene's own objects are rendered (engine, samples, motion blur, Freestyle, simplify, background scene).
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...torch_backend import contract
from .. import compat, compat_animation
from ..access import library_of, settings_of
from ..scene import scene_setup

_NOTED = "splannequin_bake_settings"
"""Property of a scene that is being baked: JSON, [owner, name, value before, value of the bake] for each change."""
_SRGB = ("sRGB", "sRGB - Display", "sRGB Monitor", "sRGB Display")
"""Names of the display whose values are those of sRGB files: Blender's, and those of ACES configurations."""
_OUT = "render.image_settings"
_COLOURS = "Files are written for an sRGB display without a look, so that the plate keeps its colours."


@dataclass(frozen=True)
class Setting:
    """A row of the table."""

    owner: str
    """What has the setting, as a path from the scene; empty: the scene."""
    name: str
    """Name of the setting. The row is skipped in a Blender that lacks it."""
    values: tuple[Any, ...]
    """Values that the bake can use. The first that this Blender knows is set, unless the setting has one of them."""
    why: str
    """Sentence for the artist when the setting was changed; empty if no pixel depends on it."""
    when: str = "always"
    """When the row is in force:

    always   in every bake
    strips   the scene's sequencer holds something
    cg       the scene's own render is led into the freeze
    keep     the plate's colours are to be kept
    colours  they are to be kept, and the scene would change them
    exact    the same frame has to be the same bytes, whoever renders it
    """


def _picture(name: str, value: Any, why: str) -> Setting:
    return Setting("render", name, (value,), why)


SETTINGS: tuple[Setting, ...] = (
    Setting("render", "use_sequencer", (False,), "The sequencer was left out: it would replace the freeze.", "strips"),
    _picture("use_compositing", True, "The compositor was switched on."),
    Setting("", "use_nodes", (True,), "The compositor was switched on."),
    _picture("use_border", False, "The render region was left out: the bake renders whole frames."),
    _picture("use_crop_to_border", False, ""),
    _picture("use_multiview", False, "Stereoscopy was left out: the freeze has one view."),
    _picture("use_single_layer", False, "All view layers were rendered, not the active one alone."),
    _picture("use_stamp", False, "Burned-in metadata was left out."),
    _picture("frame_map_old", 100, "Time remapping was left out: frame n shows frame n of the take."),
    _picture("frame_map_new", 100, "Time remapping was left out: frame n shows frame n of the take."),
    _picture("use_overwrite", True, "All frames of the range were rendered, also those that were there."),
    _picture("use_placeholder", False, ""),
    _picture("use_file_extension", True, ""),
    Setting("render", "film_transparent", (True,), "Film was set to transparent for the scene's objects.", "cg"),
    Setting("render", "dither_intensity", (0.0,), "Dither was set to 0, so that pixels stay exact.", "keep"),
    Setting(_OUT, "color_management", ("OVERRIDE",), _COLOURS, "colours"),
    Setting(f"{_OUT}.display_settings", "display_device", _SRGB, _COLOURS, "colours"),
    Setting(f"{_OUT}.view_settings", "view_transform", scene_setup.NEUTRAL_VIEWS, _COLOURS, "colours"),
    *(
        Setting(f"{_OUT}.view_settings", name, (value,), _COLOURS, "colours")
        for name, value in scene_setup.NEUTRAL_VIEW.items()
    ),
    # Metadata that tells when and where a picture was made; the frame's number, too, for it is padded to the digits of
    # the range's last.
    *(
        Setting("render", f"use_stamp_{name}", (False,), "", "exact")
        for name in ("date", "time", "render_time", "memory", "hostname", "filename", "frame")
    ),
)
"""Settings that a bake needs, in the order in which they are set."""


def needed(scene: bpy.types.Scene, is_exact: bool, has_cg: bool) -> list[Setting]:
    """The rows that are in force for a bake of a scene.

    Args:
        scene: the scene, as the artist left it.
        is_exact: the same frame has to be the same bytes, whoever renders it.
        has_cg: the scene's own render is led into the freeze.
    """
    keep = bool(settings_of(scene).keep_colours)
    force = {
        "always": True, "strips": _has_strips(scene), "exact": is_exact, "cg": has_cg, "keep": keep,
        "colours": keep and not _is_linear(scene) and not _keeps_colours(scene),
    }  # fmt: skip
    return [row for row in SETTINGS if force[row.when] and _has(scene, row)]


def apply(scene: bpy.types.Scene, rows: Iterable[Setting]) -> list[str]:
    """Gives the scene what a bake needs, and notes in it what was there; returns what was changed, one sentence each.

    JobError if a setting is animated, or cannot be set; nothing is changed then.
    """
    rows = list(rows)
    moving = _animated(scene)
    for row in rows:
        path = ".".join(filter(None, (row.owner, row.name)))
        if path in moving:
            raise contract.JobError(
                f"The setting {path} of {scene.name} is animated, and a bake needs it as {row.values[0]}.",
                "Remove its keyframes or its driver.",
                contract.ExitCode.BAKE,
            )
    remarks: list[str] = []
    noted: list[tuple[str, str, Any, Any]] = []
    # All of them first: one setting may change another, as a display does whose views have other names.
    were = [(row, getattr(_owner(scene, row.owner), row.name)) for row in rows]
    try:
        for row, before in were:
            owner = _owner(scene, row.owner)
            now = getattr(owner, row.name)
            if now == before and now in row.values:
                continue
            if now not in row.values and not _set(owner, row):
                raise contract.JobError(
                    f"The setting {row.name} of {scene.name} is {before}, and cannot be set to {row.values[0]}.",
                    "Set it by hand, or switch Keep Plate Colours off.",
                    contract.ExitCode.BAKE,
                )
            noted.append((row.owner, row.name, before, getattr(owner, row.name)))
            scene[_NOTED] = json.dumps(noted)
            if row.why and row.why not in remarks:
                remarks.append(row.why)
    except BaseException:
        restore(scene)
        raise
    return remarks


def set_noted(scene: bpy.types.Scene, owner: str, name: str, value: Any) -> None:
    """Gives one more setting a value, which `restore` takes back."""
    holder = _owner(scene, owner)
    noted = json.loads(scene.get(_NOTED, "[]"))
    before = getattr(holder, name)
    setattr(holder, name, value)
    noted.append((owner, name, before, getattr(holder, name)))  # a path that is too long was cut off
    scene[_NOTED] = json.dumps(noted)


def restore(scene: bpy.types.Scene) -> None:
    """Restores the settings that a bake changed, except those that were changed again since."""
    noted = json.loads(scene.get(_NOTED, "[]"))
    for owner, name, before, _ in [one for one in noted if getattr(_owner(scene, one[0]), one[1]) == one[3]]:
        with contextlib.suppress(TypeError):  # an enumeration that has another value since
            setattr(_owner(scene, owner), name, before)
    if _NOTED in scene:
        del scene[_NOTED]


def _set(owner: Any, row: Setting) -> bool:
    """Sets the first of a row's values that this Blender knows. False if it knows none."""
    for value in row.values:
        try:
            setattr(owner, row.name, value)
        except TypeError:  # an enumeration without this value
            continue
        if getattr(owner, row.name) == value:
            return True
    return False


def _owner(scene: bpy.types.Scene, path: str) -> Any:
    held: Any = scene
    return held.path_resolve(path) if path else held


def _has(scene: bpy.types.Scene, row: Setting) -> bool:
    if row.name == "use_nodes" and compat.HAS_COMPOSITING_GROUP:
        return False  # it is there, and says nothing any more
    try:
        return hasattr(_owner(scene, row.owner), row.name)
    except ValueError:
        return False


def _has_strips(scene: bpy.types.Scene) -> bool:
    """True if the scene's sequencer holds anything, wherever it lies: it replaces the picture out of its range, too."""
    editor: Any = scene.sequence_editor
    return editor is not None and bool(len(editor.strips if hasattr(editor, "strips") else editor.sequences))


def _is_linear(scene: bpy.types.Scene) -> bool:
    """True if the files hold light, not what a display is to show."""
    return bool(scene.render.image_settings.has_linear_colorspace)


def _keeps_colours(scene: bpy.types.Scene) -> bool:
    """True if files leave with the colours that the plate came in with."""
    out: Any = scene.render.image_settings
    display: Any = scene.display_settings
    moving = any(path.startswith(("view_settings.", "display_settings.")) for path in _animated(scene))
    follows = out.color_management == "FOLLOW_SCENE"
    return follows and not moving and display.display_device in _SRGB and scene_setup.keeps_plate_colours(scene)


def _animated(scene: bpy.types.Scene) -> set[str]:
    """Paths of the scene's properties that keyframes, drivers or NLA strips set."""
    data = scene.animation_data
    if data is None:
        return set()
    found = {curve.data_path for curve in compat_animation.fcurves(scene)} | {
        driver.data_path for driver in data.drivers
    }
    for strip in (strip for track in data.nla_tracks for strip in track.strips):
        found |= {curve.data_path for curve in compat_animation.curves_of_strip(strip)}
    return found


# ------------------------------------------------------------------------------------------- saving, loading, undo

going_on: dict[int, bool] = {}
"""`session_uid` of each scene that is being baked -> whether its file was saved since the last frame was written."""
_paused: dict[int, Any] = {}
"""`session_uid` of a scene -> what the bake had noted, while its file is saved."""


def left_behind() -> Iterator[bpy.types.Scene]:
    """Scenes whose settings are those of a bake that does not go on."""
    for scene in bpy.data.scenes:
        if _NOTED in scene and scene.session_uid not in going_on and not library_of(scene):
            yield scene


@persistent
def _on_load(*_: object) -> None:
    going_on.clear()
    _on_undo()


@persistent
def _on_undo(*_: object) -> None:
    for scene in left_behind():
        restore(scene)


@persistent
def _on_save(*_: object) -> None:
    """The file is to hold the artist's settings. The frame that is being rendered may get some of them."""
    _paused.clear()
    for scene in bpy.data.scenes:
        if scene.session_uid in going_on and _NOTED in scene:
            going_on[scene.session_uid] = True
            _paused[scene.session_uid] = scene[_NOTED]
            restore(scene)


@persistent
def on_saved(*_: object) -> None:
    """Handler: the bake goes on with its own settings."""
    for scene in bpy.data.scenes:
        noted = _paused.pop(scene.session_uid, None)
        if noted is None or scene.session_uid not in going_on:
            continue
        for owner, name, _, ours in json.loads(noted):
            setattr(_owner(scene, owner), name, ours)
        scene[_NOTED] = noted
        going_on[scene.session_uid] = True  # a frame may have begun meanwhile


_HANDLERS = (
    ("load_post", _on_load), ("undo_post", _on_undo), ("redo_post", _on_undo),
    ("save_pre", _on_save),
)  # fmt: skip


def register() -> None:
    """Listens to files that are loaded and saved, and to undo; `on_saved` is registered where it comes last."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undoes `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
