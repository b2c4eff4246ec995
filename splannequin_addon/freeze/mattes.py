"""Mattes of objects in a take: lassos from a mask drawn in Blender, and the results of matte jobs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

import bpy

from ...torch_backend import contract
from ..access import settings_of
from ..process import backend
from ..scene import paths, sequences
from ..shot import inventory, scene_objects, selection

CURVE_STEPS = 12
"""Polygon corners per curve segment between two points of a mask."""

Corner = tuple[float, float]


def params_of(scene: bpy.types.Scene, shot: Path) -> contract.MatteParams:
    """Parameters of a matte job from the selected mask at the scene's current frame. Writes the lassos into the take.

    Lassos of the same name at other frames stay. Raises JobError without a take or mask, or if the mask is empty.
    """
    props = settings_of(scene)
    mask, folder = props.matte_mask, take_of(shot, props.take_name)
    if mask is None:
        raise contract.JobError(
            "No mask is chosen.", "Draw one over the frozen frame, and choose it.", contract.ExitCode.USAGE
        )
    name, frame = contract.checked_name(mask.name, "matte"), scene.frame_current
    facts = inventory.read(shot).takes[props.take_name]
    drawn = polygons(mask, int(facts["width"]), int(facts["height"]))
    if not drawn:
        raise contract.JobError(
            f"Nothing is drawn in the mask {name}.", "Draw a closed spline around the object.", contract.ExitCode.USAGE
        )
    if inventory.missing_frames(shot, props.take_name, [frame]):
        raise contract.JobError(
            f"The take has no frame {frame}.", "Go to a frame of the take.", contract.ExitCode.USAGE
        )
    rows = [row for row in inventory.lassos(folder) if row["name"] == name and row["frame"] != frame]
    rows += [{"name": name, "frame": frame, "polygon": polygon} for polygon in drawn]
    path = folder.drawn_lassos
    try:
        contract.ShotFolder(shot).own(path.parent).mkdir(exist_ok=True)
        contract.write_json(path, {"mattes": rows}, parents=False)
    except OSError as error:
        raise inventory.unwritable(
            path, error, "Free disk space, or make sure that the shot folder is writable."
        ) from error
    return contract.MatteParams(take=props.take_name, polygons=str(path), device=backend.device())


def sources_of(scene: bpy.types.Scene, matte: str) -> list[str]:
    """Sources for an object: the clip itself, and all takes with its matte except the selected take."""
    folder = selection.shot_folder(scene)
    takes = inventory.read(folder).takes if folder is not None else {}
    chosen = settings_of(scene).take_name
    return [contract.LIVE_SOURCE, *(name for name, take in takes.items() if name != chosen and matte in take["mattes"])]


def combination(scene: bpy.types.Scene, shot: Path, matte: str, source: str, result: str) -> contract.CombineParams:
    """Parameters that make the take `result`, with an object from `source` and the objects it already has."""
    base = settings_of(scene).take_name
    takes = inventory.read(shot).takes
    before: dict[str, Any] = takes[result]["combined"] if result in takes else {}
    if base == result and before:  # the combined take itself is selected
        base = str(before.get("base"))
    kept = before.get("things") if before.get("base") == base else None
    pairs = cast("dict[Any, Any]", kept) if isinstance(kept, dict) else {}
    things = {str(name): str(take) for name, take in pairs.items()}
    things[matte] = source.strip()
    return contract.CombineParams(
        take=result, base=base, things=",".join(f"{name}={take}" for name, take in things.items())
    )


def take_of(shot: Path, name: str) -> contract.TakeFolder:
    """The folder of an existing take. Raises JobError if it does not exist."""
    if name not in inventory.read(shot).takes:
        raise contract.JobError("There is no take yet.", "Freeze first.", contract.ExitCode.USAGE)
    return contract.TakeFolder(contract.ShotFolder(shot).take(name))


def polygons(mask: bpy.types.Mask, width: int, height: int) -> list[list[Corner]]:
    """Closed splines of a mask's visible layers as polygons, in pixels from the top left corner of an image.

    Mask coordinates go from 0 to 1 along the longer side of the image, and are centred along the other side.
    """
    longest = max(width, height)
    found: list[list[Corner]] = []
    for layer in mask.layers:
        for spline in () if layer.hide else layer.splines:
            corners = _corners(spline)
            if len(corners) >= 3:
                found.append(
                    [((x - 0.5) * longest + 0.5 * width, 0.5 * height - (y - 0.5) * longest) for x, y in corners]
                )
    return found


def _corners(spline: bpy.types.MaskSpline) -> list[Corner]:
    """A spline of a mask as a polygon in mask coordinates, from its cubic segments."""
    points: list[Any] = list(spline.points)
    found: list[Corner] = []
    for n, point in enumerate(points):
        after = points[(n + 1) % len(points)]
        piece = [tuple(at) for at in (point.co, point.handle_right, after.handle_left, after.co)]
        if point.handle_type == "VECTOR" and after.handle_type == "VECTOR":
            found.append((float(piece[0][0]), float(piece[0][1])))
            continue
        for step in range(CURVE_STEPS):
            t = step / CURVE_STEPS
            shares = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
            x, y = (sum(share * at[axis] for share, at in zip(shares, piece, strict=True)) for axis in (0, 1))
            found.append((float(x), float(y)))
    return found


def frozen_sequence(shot: Path, name: str) -> tuple[bpy.types.Image, int, int]:
    """(image sequence of a take's frozen frames without overscan, first frame, last frame), to draw on."""
    folder, facts = take_of(shot, name), inventory.read(shot).takes[name]
    path = folder.preview(facts["first"])
    if not path.is_file():
        raise contract.JobError(f"{path} does not exist.", "Freeze again.", contract.ExitCode.USAGE)
    image = sequences.load_sequence(path, f"Frozen {name} of {scene_objects.name_of(shot)}", "srgb")
    return image, facts["first"], facts["last"]


def arrived(shot: Path, result: dict[str, Any]) -> list[str]:
    """Reloads images that show a take's mattes. Returns a sentence about the take's mattes."""
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(str(result["take"])))
    inside = os.path.abspath(folder.mattes)
    for image in bpy.data.images:
        file = paths.absolute(image.filepath) if image.filepath and not image.library else ""
        if file and os.path.abspath(file).startswith(inside + os.sep):
            image.reload()
    names = list(inventory.mattes(folder))
    return (
        [f"{len(names)} mattes in take {result['take']}: {', '.join(names)}."] if names else ["The take has no mattes."]
    )
