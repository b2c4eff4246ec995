"""Cameras from elsewhere and for elsewhere, on Blender's side.

In: a file that the backend reads is handed on as it is; what Blender's own tracker solved, a camera of the scene, and
the camera of a file that Blender reads are written as a nerfstudio transforms.json, whose camera axes are Blender's.
Out: the backend writes.
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
"""Least number of solved frames of a tracked camera."""
_READING_SECONDS = 0.02
"""Seconds of each turn of the timer that are spent on sampling a camera of the scene."""


def params(scene: bpy.types.Scene, shot: Path | None, is_read: bool = False) -> contract.SolveParams:
    """Parameters of the solve from the artist's settings; writes cameras that Blender reads into the shot.

    Args:
        scene: the scene.
        shot: shot folder, None without one.
        is_read: the cameras that `reads_in_turns` is about are written already, or will be.

    JobError names what is missing. OSError if the shot cannot be written.
    """
    props = settings_of(scene)
    params = contract.SolveParams(camera_model=props.camera_model, retry=props.retry)
    params.focal_mm = _said(props.focal_mm)
    if params.focal_mm:
        params.sensor_mm, params.refine_focal = _said(props.sensor_mm), props.refine_focal
    if props.st_map and props.cameras_from == "SOLVE":  # others bring their own lens
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
    """The shot folder, with a backend to read what will be written into it. JobError without either."""
    if shot is None or not contract.ShotFolder(shot).info_path.is_file():
        raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE)
    backend.python()
    return shot


def _scene_camera(scene: bpy.types.Scene) -> str:
    """Name of the chosen camera of the scene. JobError without one that can be the clip's."""
    camera = settings_of(scene).scene_camera
    if camera is None or scene_objects.is_plate(camera):
        raise contract.JobError(
            "No camera of the scene is chosen.",
            "Choose an animated camera, or set Cameras From to Solve.",
            contract.ExitCode.USAGE,
        )
    return str(camera.name)


def has_file_for_blender(asked: contract.SolveParams) -> bool:
    """True if a solve is asked to take the cameras of a file that Blender reads."""
    return camera_file.is_one(asked.cameras)


def with_file_read(scene: bpy.types.Scene, asked: contract.SolveParams, shot: Path) -> contract.SolveParams:
    """Solve parameters of a command line. Cameras of a file that Blender reads are written into the shot first.

    JobError if they cannot be.
    """
    if not has_file_for_blender(asked):
        return asked
    read = camera_file.read_now(scene, Path(os.path.abspath(asked.cameras)), _imported(shot))
    return dataclasses.replace(asked, cameras=str(read))


def reads_in_turns(scene: bpy.types.Scene) -> bool:
    """True if cameras are chosen that Blender reads for longer than a turn of the timer."""
    props = settings_of(scene)
    return props.cameras_from == "SCENE" or (props.cameras_from == "FILE" and camera_file.is_one(props.cameras_path))


def read_in_turns(scene: bpy.types.Scene, shot: Path) -> Iterator[job_timer.Progress]:
    """Writes such cameras into the shot, a part of a turn of the timer each. Nothing of bpy is kept between two.

    JobError and OSError as `params`.
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
        if not question.ended:  # given up
            question.process.kill()
    camera_file.written(question, file, folder)


def _sampled(turns: Iterator[tuple[int, int]]) -> Iterator[job_timer.Progress]:
    """The frames of a camera read, as many a turn as there is time for."""
    with contextlib.closing(turns):  # pyright: ignore[reportArgumentType]  -- a generator, which may be given up
        for done, total in turns:
            until = time.monotonic() + _READING_SECONDS
            while time.monotonic() < until:
                done, total = next(turns, (total, total))
            yield job_timer.Progress(f"Reading the camera, frame {done} of {total}", done, total)


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
    first = same_footage.first_number(clip)
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
    lens = {"w": int(width), "h": int(height), "fl_x": focal, "fl_y": focal * float(camera.pixel_aspect)}
    lens |= {"cx": float(x), "cy": float(height - y), "camera_model": "OPENCV"}
    return {**lens, **(values if model == "POLYNOMIAL" else {})}


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
