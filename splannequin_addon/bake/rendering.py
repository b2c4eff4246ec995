"""The render of a baked shot: which frames, where to, and as pictures on disk."""

from __future__ import annotations

import contextlib
import shutil
import uuid
from collections.abc import Callable, Generator
from pathlib import Path

import bpy

from ...torch_backend import contract
from .. import compat
from ..scene import paths
from ..scene.ownership import BAKES, DIGITS

COMPOSITED = "composited"
"""Folder of the pictures, in the output folder of a bake."""
_BESIDE = ".part-"
"""Begins the name of a folder in which a part of a bake is made."""
_DEFAULT_OUTPUTS = ("/tmp/", "/tmp\\", "//", "")  # noqa: S108  (what Blender gives a new file)


def frames_of(scene: bpy.types.Scene) -> range:
    """Frames that a bake is about: the scene's range and step, as Blender renders them."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def default_output(shot: Path, take: str) -> Path:
    """Where a bake goes if the scene names no folder of its own."""
    return shot / BAKES / take


def choose_output(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Gives the scene an output path if it still has Blender's default; returns what was changed, in words."""
    if scene.render.filepath not in _DEFAULT_OUTPUTS:
        return []
    folder = default_output(shot, take)
    scene.render.filepath = paths.blend_path(folder / DIGITS)
    return [f"Output path set to {folder}."]


def render_beside(
    scene: bpy.types.Scene,
    folder: Path,
    png: bool,
    on_frame: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> list[int]:
    """`render`, but a picture comes to its place whole: the same frames may be rendered twice at once, or killed.

    JobError also if the scene writes a movie, of which there are no parts.
    """
    if not png and scene.render.is_movie_format:
        raise contract.JobError(
            "The .blend writes a movie, which cannot be made in parts.",
            "Choose pictures as its output format.",
            contract.ExitCode.BAKE,
        )
    beside = folder / f"{_BESIDE}{uuid.uuid4().hex}"
    try:
        with _without_stamps(scene):
            numbers = render(scene, beside, png, on_frame, check_cancelled)
        for made in sorted(beside.iterdir()):
            contract.replace_file(made, folder / made.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return numbers


def gathered(scene: bpy.types.Scene, folder: Path, png: bool) -> list[int]:
    """The scene's range, if all of its pictures are in `folder`; what killed parts left there is removed.

    JobError names the first that lacks.
    """
    scene.render.filepath = str(folder / DIGITS)
    scene.render.use_file_extension = True
    if png:
        compat.set_png(scene.render.image_settings)
    wanted = list(frames_of(scene))
    lost = [n for n in wanted if not Path(scene.render.frame_path(frame=n)).is_file()]
    if lost:
        raise contract.JobError(
            f"{folder} lacks {len(lost)} of {len(wanted)} frames, the first is {lost[0]}.",
            "Bake the part that it belongs to again.",
            contract.ExitCode.BAKE,
        )
    for left in folder.glob(f"{_BESIDE}*"):
        shutil.rmtree(left, ignore_errors=True)
    return wanted


_STAMPS = ("date", "time", "render_time", "memory", "hostname", "filename", "frame")
"""Of what Blender writes into a picture's metadata: what tells when and where it was made; the frame's number, too, for
that is padded to the digits of the range's last."""


@contextlib.contextmanager
def _without_stamps(scene: bpy.types.Scene) -> Generator[None]:
    """Meanwhile the same frame is the same bytes, whoever renders it, and in whatever range."""
    names = [f"use_stamp_{name}" for name in _STAMPS]
    before = {name: bool(getattr(scene.render, name)) for name in names}
    try:
        for name in names:
            setattr(scene.render, name, False)
        yield
    finally:
        for name, value in before.items():
            setattr(scene.render, name, value)


def render(
    scene: bpy.types.Scene,
    folder: Path,
    png: bool = True,
    on_frame: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> list[int]:
    """Renders the scene's range through the compositor to folder/NNNNNN.*, blocking; returns the frames written.

    Args:
        scene: a scene with the freeze inserted.
        folder: where the pictures go.
        png: write 8-bit RGB PNG, without Blender's stamps; else what the scene's output format says.
        on_frame: called with (frames done, frames in all).
        check_cancelled: called between frames; what it raises ends the bake. Frames written so far stay, a movie file
            is closed and holds them.

    Raises:
        contract.JobError: Blender refused, or a frame is not on disk afterwards.
    """
    wanted = list(frames_of(scene))
    folder.mkdir(parents=True, exist_ok=True)
    scene.render.filepath = str(folder / DIGITS)
    scene.render.use_file_extension = True
    scene.render.use_overwrite = True
    if png:
        compat.set_png(scene.render.image_settings)
    done: list[int] = []
    stopped: list[BaseException] = []

    def count(rendered: bpy.types.Scene, *_: object) -> None:
        try:
            done.append(rendered.frame_current)
            if on_frame:
                on_frame(len(done), len(wanted))
            if check_cancelled:
                check_cancelled()
        except BaseException as error:  # Blender prints what a handler raises, and renders on
            stopped.append(error)
        if stopped:
            # The render's loop counts on from here: at the last frame it ends, and closes what it writes to.
            rendered.frame_current = rendered.frame_end

    now = scene.frame_current
    bpy.app.handlers.render_write.append(count)
    try:
        with _without_stamps(scene) if png else contextlib.nullcontext():
            bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        raise contract.JobError(
            f"Blender could not render the scene: {str(error).strip()}",
            "Open shot.blend and render it there to see why.",
            contract.ExitCode.BAKE,
        ) from error
    finally:
        bpy.app.handlers.render_write.remove(count)
    scene.frame_set(now)
    if not stopped and check_cancelled:
        check_cancelled()  # asked for while Blender was at work, in a handler of someone else's
    if stopped:
        raise stopped[0]
    lost = [n for n in wanted if not Path(scene.render.frame_path(frame=n)).is_file()]
    if lost:
        raise contract.JobError(
            f"Blender wrote no picture for frame {lost[0]} in {folder}.",
            "Is the disk full, or the folder not yours to write?",
            contract.ExitCode.BAKE,
        )
    return wanted
