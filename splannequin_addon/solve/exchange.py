"""Import and export of cameras on Blender's side.

Import: a file that the backend reads is passed on unchanged. Other cameras are written as a nerfstudio transforms.json,
whose camera axes are Blender's. They come from Blender's tracker, from the scene, or from a file that Blender reads.
Export: the backend writes the files.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import present, settings_of, size_of
from ..process import backend, children, job_timer
from ..scene import same_footage
from ..shot import scene_objects
from . import camera_file, camera_samples, scene_camera

LEAST_TRACKED = 8
"""Minimum number of solved frames of a tracked camera."""
# Time per timer step for sampling a camera of the scene.
_READING_SECONDS = 0.02


def params(scene: bpy.types.Scene, shot: Path | None, is_read: bool = False) -> contract.SolveParams:
    """Solve parameters from the artist's settings. Writes cameras that Blender reads into the shot.

    Args:
        shot: shot folder, or None.
        is_read: the caller writes cameras for which `reads_in_turns` is True.

    Raises JobError, which names what is missing, and OSError if the shot cannot be written.
    """
    props = settings_of(scene)
    params = contract.SolveParams(camera_model=props.camera_model, retry=props.retry)
    params.focal_mm = _said(props.focal_mm)
    if params.focal_mm:
        params.sensor_mm, params.refine_focal = _said(props.sensor_mm), props.refine_focal
    if props.st_map and props.cameras_from == "SOLVE":  # imported cameras have their own lens
        params.st_map = os.path.abspath(bpy.path.abspath(props.st_map))
        params.st_map_way, params.st_map_layer = props.st_map_way, props.st_map_layer.strip()
    if props.cameras_from == "FILE":
        if not props.cameras_path:
            raise contract.JobError(
                "No file with cameras is chosen.",
                "Choose a COLMAP folder, a transforms.json or a camera path, or set Cameras From to Solve.",
                contract.ExitCode.USAGE,
            )
        params.cameras = os.path.abspath(bpy.path.abspath(props.cameras_path))
        if camera_file.is_one(params.cameras):
            file, folder = Path(params.cameras), _imported(shot)
            params.cameras = str(contract.ShotFolder(folder).tracking)
            if not is_read:
                camera_file.read_now(scene, file, folder)
    elif props.cameras_from == "SCENE":
        name, folder = _scene_camera(scene), _imported(shot)
        params.cameras = str(contract.ShotFolder(folder).tracking)
        if not is_read:
            for _ in scene_camera.write_in_turns(scene, name, folder):
                pass
    elif props.cameras_from == "TRACKING":
        data = transforms(props.tracking_clip)
        params.cameras = str(camera_samples.write(_imported(shot), data))
    return params


def _imported(shot: Path | None) -> Path:
    """The shot folder, after a check that the shot and a backend exist. Raises JobError otherwise."""
    if shot is None or not contract.ShotFolder(shot).info_path.is_file():
        raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE)
    backend.python()
    return shot


def _scene_camera(scene: bpy.types.Scene) -> str:
    """`name_full` of the selected camera of the scene. Raises JobError if it is missing or shows only the plate."""
    camera = settings_of(scene).scene_camera
    if camera is None or scene_objects.is_plate(camera):
        raise contract.JobError(
            "No camera of the scene is chosen.",
            "Choose an animated camera, or set Cameras From to Solve.",
            contract.ExitCode.USAGE,
        )
    return str(camera.name_full)


def has_file_for_blender(requested: contract.SolveParams) -> bool:
    """True if the solve parameters name a file whose cameras Blender reads."""
    return camera_file.is_one(requested.cameras)


def with_file_read(scene: bpy.types.Scene, requested: contract.SolveParams, shot: Path) -> contract.SolveParams:
    """Solve parameters of a command line. First writes cameras of a file that Blender reads into the shot.

    Raises JobError if this fails.
    """
    if not has_file_for_blender(requested):
        return requested
    read = camera_file.read_now(scene, Path(os.path.abspath(requested.cameras)), _imported(shot))
    return dataclasses.replace(requested, cameras=str(read))


def reads_in_turns(scene: bpy.types.Scene) -> bool:
    """True if the selected cameras take Blender more than one timer step to read."""
    props = settings_of(scene)
    return props.cameras_from == "SCENE" or (props.cameras_from == "FILE" and camera_file.is_one(props.cameras_path))


def read_in_turns(scene: bpy.types.Scene, shot: Path) -> Iterator[job_timer.Progress]:
    """Writes the cameras of `reads_in_turns` into the shot in steps. Keeps no bpy data between steps.

    Raises JobError and OSError as `params` does.
    """
    if settings_of(scene).cameras_from == "SCENE":
        turns = scene_camera.write_in_turns(scene, _scene_camera(scene), _imported(shot))
        del scene
        yield from _sampled(turns)
        return
    file, folder = Path(os.path.abspath(bpy.path.abspath(settings_of(scene).cameras_path))), _imported(shot)
    question, began = camera_file.begin(scene, file, folder), time.monotonic()
    del scene
    try:
        while not question.ended and time.monotonic() - began < camera_file.LONGEST_SECONDS:
            yield job_timer.Progress(f"Reading the cameras of {file.name}", 0, 1)
    finally:
        if not question.ended:  # cancelled or timed out
            question.process.kill()
    camera_file.written(question, file, folder)


def _sampled(turns: Iterator[tuple[int, int]]) -> Iterator[job_timer.Progress]:
    """Reads as many frames of a camera per step as the time limit allows."""
    with contextlib.closing(turns):  # pyright: ignore[reportArgumentType]  -- a generator, which may be given up
        for done, total in turns:
            until = time.monotonic() + _READING_SECONDS
            while time.monotonic() < until:
                done, total = next(turns, (total, total))
            yield job_timer.Progress(f"Reading the camera, frame {done} of {total}", done, total)


def _said(value: float) -> float:
    """A number as typed."""
    return float(f"{value:.7g}")  # Blender's float has 32 bits: 23.976 becomes 23.9759998


def transforms(clip: bpy.types.MovieClip | None) -> dict[str, Any]:
    """The solved camera of a movie clip as the content of a transforms.json.

    Frames have Splannequin's numbers: the file's number in a sequence, or counted from 1 in a video.

    Raises:
        contract.JobError: there is no clip or no solved camera, or the format does not support the lens.
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
    first = same_footage.first_number(clip)
    return {
        **lens(clip),
        "frames": [
            {
                "file_path": f"{first + camera.frame - 1}.png",
                "transform_matrix": [list(row[:]) for row in camera.matrix],
            }
            for camera in cameras
            if first + camera.frame > 0  # an offset may start before the footage
        ],
    }


def lens(clip: bpy.types.MovieClip) -> dict[str, Any]:
    """A clip's lens as fields of a nerfstudio transforms.json. Raises JobError for an unsupported distortion model."""
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
            f"The lens of {clip.name} uses the distortion model {model.title()}, which is not supported.",
            "Set it to Polynomial in the Movie Clip editor and solve its camera again.",
            contract.ExitCode.USAGE,
        )
    centre: Any = camera.principal_point_pixels
    focal, (x, y) = float(camera.focal_length_pixels), centre
    lens = {"w": int(width), "h": int(height), "fl_x": focal, "fl_y": focal * float(camera.pixel_aspect)}
    lens |= {"cx": float(x), "cy": float(height - y), "camera_model": "OPENCV"}  # Blender counts rows from the bottom
    return {**lens, **(values if model == "POLYNOMIAL" else {})}  # the radial part of OpenCV's


# ------------------------------------------------------------------------------------------------- out


def begin_export(words: contract.ExportWords) -> children.Question:
    """Makes the backend export a shot's cameras or splats for other programs, without waiting.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
    """
    return backend.ask("export", *contract.arguments_of(words))


def exported(question: children.Question, folder: Path) -> str:
    """Sentence about a finished export. Raises JobError with the backend's message if it failed."""
    question.answer("{}")
    return f"Written to {folder}"
