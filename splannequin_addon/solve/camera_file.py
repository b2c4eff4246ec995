"""Cameras of Alembic, FBX and USD files, read by Blender's importers in a separate Blender process.

The process starts with factory settings, and scripts in files do not run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import camera_of
from ..process import backend, children
from ..shot import inventory, seen_camera
from . import camera_samples

KINDS = {".abc": "Alembic", ".fbx": "FBX", ".usd": "USD", ".usda": "USD", ".usdc": "USD", ".usdz": "USD"}
"""File suffix -> format."""
MOST_FRAMES = 100_000
"""Maximum number of frames read from a file."""
LONGEST_SECONDS = 1800.0
"""Time limit for reading a file."""
# Relative difference between the aspects of film back and frames above which a note is written.
_FILM_SLACK = 0.02
# Kinds of data that the USD importer skips.
_NO_GEOMETRY = (
    "curves", "lights", "materials", "meshes", "volumes", "shapes", "skeletons", "blendshapes", "points",
)  # fmt: skip


def is_one(path: str) -> bool:
    """True if the file has a format whose cameras Blender reads."""
    return Path(path).suffix.lower() in KINDS


def begin(scene: bpy.types.Scene, file: Path, shot: Path) -> children.Question:
    """Starts a second Blender that writes the camera of a file into a shot, without waiting.

    Args:
        scene: the scene, for its pixel aspect.
        file: the file.
        shot: shot folder. The rate of its clip converts the file's time to frames.

    Raises:
        contract.JobError: the file or the shot does not exist, or Blender cannot be started.
    """
    if not file.is_file():
        raise contract.JobError(f"{file} does not exist.", "Choose another file.", contract.ExitCode.SOLVE)
    _, size = camera_samples.frames_of(shot)
    render = scene.render
    fps = float(inventory.read(shot).info.get("fps", 0.0)) or render.fps / render.fps_base
    wanted = {
        "file": str(file.absolute()),
        "shot": str(shot.absolute()),
        "size": size,
        "fps": fps,
        "aspect": (render.pixel_aspect_x, render.pixel_aspect_y),
    }
    # In a process of its own: a file may be gigabytes large, an importer may crash on a damaged file, and its data
    # would be left over.
    script = str(Path(__file__).with_name("read_camera_file.py"))
    words = ["--", json.dumps(wanted)]
    if bpy.app.binary_path:
        quiet = ("--background", "--factory-startup", "--disable-autoexec", "-noaudio")
        fails = ("--python-exit-code", str(int(contract.ExitCode.INTERNAL)))  # otherwise a failed script exits with 0
        words = [bpy.app.binary_path, *quiet, *fails, "--python", script, *words]
    else:  # Blender as a module
        words = [sys.executable, "-P", script, *words]
    piped: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    piped |= {"encoding": "utf-8", "errors": "replace"}
    placed = {"args": words, "cwd": os.path.dirname(words[0]) or None}
    try:
        return children.Question(children.start(placed, backend.package_root(), outlives=False, **piped))
    except OSError as error:
        raise contract.JobError(
            f"A second Blender could not be started to read {file.name}: {error}.",
            "Import the file, and choose Scene Camera.",
            contract.ExitCode.ENVIRONMENT,
        ) from error


def written(question: children.Question, file: Path, shot: Path) -> Path:
    """The transforms.json from the second Blender. Raises JobError with that Blender's message if it failed."""
    question.answer(f"Blender could not read {file.name}: {{}}", "Import the file, and choose Scene Camera.")
    return contract.ShotFolder(shot).tracking


def read_now(scene: bpy.types.Scene, file: Path, shot: Path) -> Path:
    """`begin` and `written`, with waiting."""
    question = begin(scene, file, shot)
    question.wait(LONGEST_SECONDS)
    return written(question, file, shot)


# ------------------------------------------------------------------------------------------------- in the child


def main(words: str) -> int:
    """Runs in the second Blender: reads the camera that `begin` requests. Returns an exit code."""
    wanted = json.loads(words)
    try:
        scene = _new_file(wanted["size"], wanted["fps"], wanted["aspect"])
        data = read(scene, Path(wanted["file"]), tuple(wanted["size"]))
        camera_samples.write(Path(wanted["shot"]), data)
    except contract.JobError as error:
        print(f"Error: {error.message} {error.hint}".rstrip(), file=sys.stderr)
        return error.exit_code
    except OSError as error:
        known = inventory.unwritable(Path(wanted["shot"]), error, "Make sure that the disk is not full.")
        print(f"Error: {known.message} {known.hint}".rstrip(), file=sys.stderr)
        return known.exit_code
    return contract.ExitCode.OK


def _new_file(size: tuple[int, int], fps: float, aspect: tuple[float, float]) -> bpy.types.Scene:
    """The scene of an empty file with the clip's rate and size."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.data.scenes[0]
    # Importers convert time by the rate, and the lens in pixels depends on the size.
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
    return scene


def read(scene: bpy.types.Scene, file: Path, size: tuple[int, int]) -> dict[str, Any]:
    """The first moving camera of a file, as the content of a transforms.json.

    Args:
        scene: an empty scene, into which the whole file is imported.
        file: the file.
        size: width and height in pixels of the clip's frames.

    Raises:
        contract.JobError: the file cannot be read, or has no moving perspective camera.
    """
    _import(file)
    cameras = sorted((o for o in scene.objects if o.type == "CAMERA"), key=lambda o: o.name)
    if not cameras:
        raise contract.JobError(f"{file.name} contains no camera.", "Choose another file.", contract.ExitCode.SOLVE)
    for camera in [c for c in cameras if camera_of(c).type == "PERSP"]:
        data = camera_of(camera)
        if data.sensor_fit == "AUTO":  # files store the film back, whose width is the images' width
            data.sensor_fit = "HORIZONTAL"
        frames = _frames_of(scene, camera)
        if len(frames) > MOST_FRAMES:
            raise contract.JobError(
                f"{camera.name} of {file.name} has {len(frames)} frames, more than {MOST_FRAMES}.",
                "Export the frames of the clip alone.",
                contract.ExitCode.SOLVE,
            )
        samples = [_sample(scene, camera.name, number, size) for number in frames]
        if len(samples) > 1 and camera_samples.moves(samples):
            notes = [*_choice(file, camera, len(cameras)), *_film_back(scene, file, camera, size)]
            return camera_samples.transforms(samples, size, notes=notes)
    if not any(camera_of(camera).type == "PERSP" for camera in cameras):
        kinds = "The camera" if len(cameras) == 1 else f"Each of the {len(cameras)} cameras"
        message = f"{kinds} of {file.name} is orthographic or a panorama."
    else:
        message = f"No camera of {file.name} moves."
    raise contract.JobError(message, camera_samples.MOVING_CAMERA_HINT, contract.ExitCode.SOLVE)


def _sample(scene: bpy.types.Scene, name: str, number: int, size: tuple[int, int]) -> camera_samples.Sample:
    """A camera of the file at a frame."""
    matrix, window, _ = seen_camera.evaluated(scene, name, number, size, camera_samples.MOVING_CAMERA_HINT)
    return camera_samples.sample_of(number, matrix, window, size)


def _frames_of(scene: bpy.types.Scene, camera: bpy.types.Object) -> range:
    """Frames of a camera: the range of its keyframes, or of the whole file if a constraint reads the motion from it."""
    span, owner = camera_samples.keyed(camera), camera
    spans = [span] if span is not None else []
    while owner is not None:
        if any(c.type == "TRANSFORM_CACHE" for c in owner.constraints):
            spans.append((scene.frame_start, scene.frame_end))
        owner = owner.parent
    if not spans:
        return range(0)
    return camera_samples.whole_frames((min(first for first, _ in spans), max(last for _, last in spans)))


def _choice(file: Path, camera: bpy.types.Object, count: int) -> list[tuple[str, str]]:
    """Note, as (sentence, hint), about which of several cameras was used; empty for a single camera."""
    if count == 1:
        return []
    return [
        (
            f"{file.name} contains {count} cameras. {camera.name} was used, the first that moves.",
            "For another one import the file, and choose Scene Camera.",
        )
    ]


def _film_back(
    scene: bpy.types.Scene, file: Path, camera: bpy.types.Object, size: tuple[int, int]
) -> list[tuple[str, str]]:
    """Note, as (sentence, hint), about a film back whose aspect ratio differs from the frames; empty if it does not."""
    data, render = camera_of(camera), scene.render
    shape = size[0] * render.pixel_aspect_x / (size[1] * render.pixel_aspect_y)
    if abs(data.sensor_width / data.sensor_height / shape - 1.0) <= _FILM_SLACK:
        return []
    film = f"{data.sensor_width:.4g} x {data.sensor_height:.4g} mm"
    return [
        (
            f"The film back of {camera.name} in {file.name} is {film}, which is a different aspect ratio than the "
            "clip's frames.",
            "The width of the film back was used.",
        )
    ]


def _import(file: Path) -> None:
    """Imports a file into the scene with Blender's importer. Raises JobError without an importer, or if it fails."""
    kind = KINDS[file.suffix.lower()]
    reader = {"Alembic": _alembic, "FBX": _fbx, "USD": _usd}[kind]()
    if reader is None:
        raise contract.JobError(
            f"This Blender {bpy.app.version_string} has no importer for {kind}.",
            "Export the camera in another format.",
            contract.ExitCode.SOLVE,
        )
    try:
        done = reader(str(file))
    except Exception as error:  # the Python FBX importer raises arbitrary exceptions for damaged files
        raise _refused(file, str(error)) from error
    if "FINISHED" not in done:
        raise _refused(file, "")


def _refused(file: Path, message: str) -> contract.JobError:
    """The error for a file that an importer refused, with the importer's message unless it is a traceback."""
    first = (
        next((line for line in message.splitlines() if line.strip()), "").removeprefix("Error: ").strip().rstrip(".")
    )
    why = (
        contract.printable(first, 200)
        if first and "Traceback" not in first
        else "it is damaged or has an unsupported format"
    )
    return contract.JobError(
        f"Blender could not read {file.name}: {why}.",
        "Export the camera again.",
        contract.ExitCode.SOLVE,
    )


def _alembic() -> Callable[[str], Any] | None:
    if not bpy.app.alembic.supported:
        return None
    operator: Any = bpy.ops.wm.alembic_import
    return lambda path: operator(filepath=path, as_background_job=False)


def _usd() -> Callable[[str], Any] | None:
    if not bpy.app.usd.supported:
        return None
    operator: Any = bpy.ops.wm.usd_import
    known = operator.get_rna_type().properties.keys()
    left_out = {f"import_{name}": False for name in _NO_GEOMETRY if f"import_{name}" in known}
    return lambda path: operator(filepath=path, **left_out)


def _fbx() -> Callable[[str], Any] | None:
    """Blender's FBX importer: the C++ one (4.5 and later) or the Python one. Both map the file's time 0 to frame 0."""
    wm: Any = bpy.ops.wm
    if "fbx_import" in dir(wm):
        return lambda path: wm.fbx_import(filepath=path, anim_offset=0.0)
    scene: Any = bpy.ops.import_scene
    if "fbx" not in dir(scene):
        return None

    def read(path: str) -> Any:
        done = scene.fbx(filepath=path, anim_offset=0.0)
        _correct_rate()
        return done

    return read


def _correct_rate() -> None:
    """Rescales all keyframes to the file's rate."""
    base = bpy.data.scenes[0].render.fps_base
    actions: Any = bpy.data.actions
    # The Python importer treats a rate of 23.976 as 24.
    for curve in [curve for action in actions for curve in action.fcurves]:
        for key in curve.keyframe_points:
            for point in (key.co, key.handle_left, key.handle_right):
                point.x /= base
        curve.update()
