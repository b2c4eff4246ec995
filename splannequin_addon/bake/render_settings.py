"""The render settings that a bake needs, in one table. Each row is applied for the bake, reported and then restored.

During a bake, the scene itself stores what was changed. A file saved in between, or an undo step, is repaired when it
is loaded. A file that the artist saves during a bake holds the artist's settings.
Settings that are choices about the result stay as the artist has them. These are file format, colour mode, depth,
compression and the linear space of EXR files; size in percent, range and step; the compositor's precision. They include
all settings for rendering the scene's objects (engine, samples, motion blur, Freestyle, simplify, background scene).
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

# Custom property of a scene during a bake: JSON, one [owner, name, value before, value of the bake] per change.
_NOTED = "splannequin_bake_settings"
# Names of displays with sRGB values: Blender's, and those of ACES configurations.
_SRGB = ("sRGB", "sRGB - Display", "sRGB Monitor", "sRGB Display")
_OUT = "render.image_settings"
_COLOURS = "Files are written for an sRGB display without a look, so that the plate keeps its colours."


@dataclass(frozen=True)
class Setting:
    """A row of the table."""

    owner: str
    """Owner of the setting as a path from the scene; empty for the scene itself."""
    name: str
    """Name of the setting. A Blender version without the setting skips the row."""
    values: tuple[Any, ...]
    """Values that the bake accepts. Unless the setting has one of them, the first one this Blender supports is set."""
    why: str
    """Sentence for the artist when the setting was changed; empty if it affects no pixel."""
    when: str = "always"
    """Condition under which the row applies:

    always   in every bake
    strips   the scene's sequencer has strips
    cg       the scene's render is linked to the freeze
    keep     the plate's colours should be preserved
    colours  as keep, and the scene would change the colours
    exact    a frame must be byte-identical on every computer
    """


def _picture(name: str, value: Any, why: str) -> Setting:
    return Setting("render", name, (value,), why)


SETTINGS: tuple[Setting, ...] = (
    Setting(
        "render",
        "use_sequencer",
        (False,),
        "The sequencer was not used, because it would replace the freeze.",
        "strips",
    ),
    _picture("use_compositing", True, "The compositor was switched on."),
    Setting("", "use_nodes", (True,), "The compositor was switched on."),
    _picture("use_border", False, "The render region was not used, because a bake renders whole frames."),
    _picture("use_crop_to_border", False, ""),
    _picture("use_multiview", False, "Stereoscopy was not used, because the freeze has one view."),
    _picture("use_single_layer", False, "All view layers were rendered, not only the active one."),
    _picture("use_stamp", False, "Burned-in metadata was not used."),
    _picture("frame_map_old", 100, "Time remapping was not used, because frame n shows frame n of the take."),
    _picture("frame_map_new", 100, "Time remapping was not used, because frame n shows frame n of the take."),
    _picture("use_overwrite", True, "All frames of the range were rendered, including existing ones."),
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
    # Stamps that depend on time and computer. Also the frame number, because Blender pads it to the digits of the
    # range's last frame.
    *(
        Setting("render", f"use_stamp_{name}", (False,), "", "exact")
        for name in ("date", "time", "render_time", "memory", "hostname", "filename", "frame")
    ),
)
"""Settings that a bake needs, in the order of their application."""


def needed(scene: bpy.types.Scene, is_exact: bool, has_cg: bool) -> list[Setting]:
    """The rows that apply to a bake of a scene.

    Args:
        scene: the scene with the artist's settings.
        is_exact: a frame must be byte-identical on every computer.
        has_cg: the scene's render is linked to the freeze.
    """
    keep = bool(settings_of(scene).keep_colours)
    force = {
        "always": True, "strips": _has_strips(scene), "exact": is_exact, "cg": has_cg, "keep": keep,
        "colours": keep and not _is_linear(scene) and not _keeps_colours(scene),
    }  # fmt: skip
    return [row for row in SETTINGS if force[row.when] and _has(scene, row)]


def apply(scene: bpy.types.Scene, rows: Iterable[Setting]) -> list[str]:
    """Applies rows to the scene and stores the previous values in it. Returns one sentence for each change.

    Raises JobError if a setting is animated or cannot be set; then nothing is changed.
    """
    rows = list(rows)
    moving = _animated(scene)
    for row in rows:
        path = ".".join(filter(None, (row.owner, row.name)))
        if path in moving:
            raise contract.JobError(
                f"The setting {path} of {scene.name} is animated, but a bake needs it to be {row.values[0]}.",
                "Remove its keyframes or its driver.",
                contract.ExitCode.BAKE,
            )
    remarks: list[str] = []
    noted: list[tuple[str, str, Any, Any]] = []
    # Read all values first: setting one can change another. A display, for example, resets a view it does not have.
    were = [(row, getattr(_owner(scene, row.owner), row.name)) for row in rows]
    try:
        for row, before in were:
            owner = _owner(scene, row.owner)
            now = getattr(owner, row.name)
            if now == before and now in row.values:
                continue
            if now not in row.values and not _set(owner, row):
                raise contract.JobError(
                    f"The setting {row.name} of {scene.name} is {before} and cannot be set to {row.values[0]}.",
                    "Set it manually, or turn Keep Plate Colours off.",
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
    """Sets one more setting, which `restore` will reset."""
    holder = _owner(scene, owner)
    noted = json.loads(scene.get(_NOTED, "[]"))
    before = getattr(holder, name)
    setattr(holder, name, value)
    noted.append((owner, name, before, getattr(holder, name)))  # read back, because Blender truncates long paths
    scene[_NOTED] = json.dumps(noted)


def restore(scene: bpy.types.Scene) -> None:
    """Restores the settings that a bake changed. Settings that were changed again since keep their value."""
    noted = json.loads(scene.get(_NOTED, "[]"))
    for owner, name, before, _ in [one for one in noted if getattr(_owner(scene, one[0]), one[1]) == one[3]]:
        with contextlib.suppress(TypeError):  # the enumeration no longer has this value
            setattr(_owner(scene, owner), name, before)
    if _NOTED in scene:
        del scene[_NOTED]


def _set(owner: Any, row: Setting) -> bool:
    """Sets the first of a row's values that this Blender supports. False if it supports none."""
    for value in row.values:
        try:
            setattr(owner, row.name, value)
        except TypeError:  # an enumeration without this value
            continue
        if getattr(owner, row.name) == value:
            return True
    return False


def _owner(scene: bpy.types.Scene, path: str) -> Any:
    untyped: Any = scene
    return untyped.path_resolve(path) if path else untyped


def _has(scene: bpy.types.Scene, row: Setting) -> bool:
    if row.name == "use_nodes" and compat.HAS_COMPOSITING_GROUP:
        return False  # the property exists but has no effect
    try:
        return hasattr(_owner(scene, row.owner), row.name)
    except ValueError:
        return False


def _has_strips(scene: bpy.types.Scene) -> bool:
    """True if the scene's sequencer has strips."""
    editor: Any = scene.sequence_editor
    # Strips outside the frame range also replace the rendered image.
    return editor is not None and bool(len(compat.strips_of(editor)))


def _is_linear(scene: bpy.types.Scene) -> bool:
    """True if the output format stores scene-linear light rather than display values."""
    return bool(scene.render.image_settings.has_linear_colorspace)


def _keeps_colours(scene: bpy.types.Scene) -> bool:
    """True if written files keep the plate's colours."""
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

active_bakes: dict[int, bool] = {}
"""`session_uid` of each scene being baked -> whether its file was saved since the last frame was written."""
# `session_uid` of a scene -> the stored changes of its bake, while the file is being saved.
_paused: dict[int, Any] = {}


def stale_scenes() -> Iterator[bpy.types.Scene]:
    """Scenes with settings of a bake that is no longer running."""
    for scene in bpy.data.scenes:
        if _NOTED in scene and scene.session_uid not in active_bakes and not library_of(scene):
            yield scene


@persistent
def _on_load(*_: object) -> None:
    active_bakes.clear()
    _on_undo()


@persistent
def _on_undo(*_: object) -> None:
    for scene in stale_scenes():
        restore(scene)


@persistent
def _on_save(*_: object) -> None:
    """Handler: restores the artist's settings before the file is saved."""
    _paused.clear()
    for scene in bpy.data.scenes:
        if scene.session_uid in active_bakes and _NOTED in scene:
            active_bakes[scene.session_uid] = True  # the frame being rendered may use the artist's settings
            _paused[scene.session_uid] = scene[_NOTED]
            restore(scene)


@persistent
def on_saved(*_: object) -> None:
    """Handler: applies the bake's settings again after the file was saved."""
    for scene in bpy.data.scenes:
        noted = _paused.pop(scene.session_uid, None)
        if noted is None or scene.session_uid not in active_bakes:
            continue
        for owner, name, _, ours in json.loads(noted):
            setattr(_owner(scene, owner), name, ours)
        scene[_NOTED] = noted
        active_bakes[scene.session_uid] = True  # a frame may have started during the save


_HANDLERS = (
    ("load_post", _on_load), ("undo_post", _on_undo), ("redo_post", _on_undo),
    ("save_pre", _on_save),
)  # fmt: skip


def register() -> None:
    """Registers handlers for load, save and undo. `bake.progress` registers `on_saved`, so that it runs last."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undoes `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
