"""Cameras from elsewhere and for elsewhere, on Blender's side.

In: a file is handed on to the backend as it is; what Blender's own tracker solved is read here and written as a
nerfstudio transforms.json, whose camera axes are Blender's. Out: the backend writes.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import present, settings_of, size_of
from ..process import backend, children

LEAST_TRACKED = 8
"""Frames that a tracked camera has to be solved for."""


def params(scene: bpy.types.Scene, shot: Path | None) -> contract.SolveParams:
    """What the solve is asked for, from what the artist set; writes Blender's tracking into the shot if it is chosen.

    JobError names what is missing. OSError if the shot cannot be written.
    """
    props = settings_of(scene)
    asked = contract.SolveParams(camera_model=props.camera_model, retry=props.retry)
    asked.focal_mm = _said(props.focal_mm)
    if asked.focal_mm:
        asked.sensor_mm, asked.refine_focal = _said(props.sensor_mm), props.refine_focal
    if props.st_map and props.cameras_from == "SOLVE":  # others bring their own lens
        asked.st_map = os.path.abspath(bpy.path.abspath(props.st_map))
        asked.st_map_way, asked.st_map_layer = props.st_map_way, props.st_map_layer.strip()
    if props.cameras_from == "FILE":
        if not props.cameras_path:
            raise contract.JobError(
                "No file with cameras is chosen.",
                "Choose a COLMAP folder, a transforms.json or a camera path, or set Cameras From to Solve.",
                contract.ExitCode.USAGE,
            )
        asked.cameras = os.path.abspath(bpy.path.abspath(props.cameras_path))
    elif props.cameras_from == "TRACKING":
        data = transforms(props.tracking_clip)
        if shot is None or not contract.ShotFolder(shot).info_path.is_file():
            raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE)
        backend.python()  # before anything is written: without a backend nothing would read it
        file = contract.ShotFolder(shot).tracking
        contract.ShotFolder(shot).own(file.parent)
        contract.write_json(file, data, parents=False)
        asked.cameras = str(file)
    return asked


def _said(value: float) -> float:
    """A number as it was typed: Blender's has 32 bits, and 23.976 becomes 23.9759998."""
    return float(f"{value:.7g}")


def transforms(clip: bpy.types.MovieClip | None) -> dict[str, Any]:
    """The solved camera of a movie clip as the content of a transforms.json.

    Frames are named by the number that Splannequin counts by: the file's own in a sequence, 1 for a video's first.

    Raises:
        contract.JobError: no clip, no solved camera, or a lens that cannot be told in that format.
    """
    if clip is None:
        raise contract.JobError(
            "No tracked clip is chosen.", "Choose the movie clip whose camera is solved.", contract.ExitCode.USAGE
        )
    tracked = next((o for o in present(clip.tracking).objects if o.is_camera), None)
    solved = present(tracked.reconstruction) if tracked else None
    cameras = list(solved.cameras) if solved and solved.is_valid else []
    if len(cameras) < LEAST_TRACKED:
        raise contract.JobError(
            f"The camera of {clip.name} is solved for {len(cameras)} frames only."
            if cameras
            else f"The camera of {clip.name} is not solved.",
            "Press Solve Camera Motion in the Movie Clip editor first.",
            contract.ExitCode.USAGE,
        )
    first = first_number(clip)
    return {
        **lens(clip),
        "frames": [
            {
                "file_path": f"{first + camera.frame - 1}.png",
                "transform_matrix": [list(row[:]) for row in camera.matrix],
            }
            for camera in cameras
            if first + camera.frame > 0  # an offset may begin before the footage does
        ],
    }


def first_number(clip: bpy.types.MovieClip) -> int:
    """Our number of what a clip calls its frame 1."""
    number = _file_number(Path(bpy.path.abspath(clip.filepath))) if clip.source == "SEQUENCE" else 1
    return number + clip.frame_offset


def _file_number(path: Path) -> int:
    """Frame number of a picture among its neighbours, as the import reads it; 1 if its name has none."""
    try:
        names = os.listdir(path.parent)
    except OSError:
        names = []
    found = contract.numbered_files({path.name, *names})
    return next((n for s in found for n, name in s.files.items() if name == path.name), 1)


def lens(clip: bpy.types.MovieClip) -> dict[str, Any]:
    """A clip's lens in nerfstudio's words. JobError for a distortion model that has none there.

    Blender's polynomial model is the radial part of OpenCV's; its pixels count from below.
    """
    camera, (width, height) = present(present(clip.tracking).camera), size_of(clip)
    model = camera.distortion_model
    bend = {
        "POLYNOMIAL": ("k1", "k2", "k3"),
        "DIVISION": ("division_k1", "division_k2"),
        "NUKE": ("nuke_k1", "nuke_k2", "nuke_p1", "nuke_p2"),
        "BROWN": ("brown_k1", "brown_k2", "brown_k3", "brown_k4", "brown_p1", "brown_p2"),
    }.get(model, ())
    values = {name: float(getattr(camera, name, 0.0)) for name in bend}
    if model != "POLYNOMIAL" and (not bend or any(values.values())):
        raise contract.JobError(
            f"The lens of {clip.name} has the distortion model {model.title()}, which cannot be handed on.",
            "Set it to Polynomial in the Movie Clip editor and solve its camera again.",
            contract.ExitCode.USAGE,
        )
    centre: Any = camera.principal_point_pixels
    focal, (x, y) = float(camera.focal_length_pixels), centre
    told = {"w": int(width), "h": int(height), "fl_x": focal, "fl_y": focal * float(camera.pixel_aspect)}
    told |= {"cx": float(x), "cy": float(height - y), "camera_model": "OPENCV"}
    return {**told, **(values if model == "POLYNOMIAL" else {})}


# ------------------------------------------------------------------------------------------------- out


def begin_export(words: contract.ExportWords) -> children.Question:
    """Has the backend write a shot's cameras or splats for other programs, without waiting.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
    """
    return backend.ask("export", *contract.said_of(words))


def exported(asked: children.Question, folder: Path) -> str:
    """What an export has done, in words. JobError with the backend's own sentence if it failed."""
    asked.answer("{}")
    return f"Written to {folder}"
