"""Frozen frames through the scene's compositor to the artist's output."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..scene import scene_setup
from ..shot import contents
from ..solve import cameras
from . import compositor

DIGITS = "######"
_DEFAULT_OUTPUTS = ("/tmp/", "/tmp\\", "//", "")  # noqa: S108  (what Blender gives a new file)


def insert(scene: Any, shot: Path, take: str, warp: bool | None = None) -> list[str]:
    """Puts a take into the scene's compositor, or updates it; returns what was changed, in words.

    Args:
        scene: the scene.
        shot: shot folder.
        take: name of the take.
        warp: True freezes the plate that is led into the group, False shows the take's own frames, None: as it does.

    Raises:
        contract.JobError: the take has no frames, or is to be used as a warp and cannot be.
    """
    frozen, plate = _sources(scene, shot, take)
    if warp:
        _need_warp(shot, frozen)
    footage = _footage(scene, shot, plate)
    changes = compositor.insert(scene, frozen, plate, footage, scene.splannequin.insert_at, warp)
    lacking = missing_frames(shot, take, frames_of(scene))
    if lacking:
        changes.append(f"{len(lacking)} frames of the scene's range are not in the take, the first is {lacking[0]}.")
    return changes


def read_ahead(scene: Any, shot: Path, take: str) -> Iterator[None]:
    """Has Blender read what `insert` will need, a picture a turn. JobError as `insert`."""
    frozen, plate = _sources(scene, shot, take)
    shown = plate if compositor.shows_plate(scene) else None
    return compositor.read_ahead(frozen, shown, compositor.wants_warp(scene))


def _need_warp(shot: Path, take: compositor.Take) -> None:
    """JobError if a take cannot freeze a plate that shows frame n at frame n."""
    name = take.folder.name
    if not any(take.plate_size):
        raise contract.JobError(
            f"The take {name!r} has no warp: it was frozen without detail.",
            "Freeze it again with detail.",
            contract.ExitCode.BAKE,
        )
    if contents.read(shot).takes.get(name, {}).get("camera_path"):
        raise contract.JobError(
            f"The take {name!r} is seen from a camera of your own: its warp looks into other frames of the plate.",
            "Use its frozen frames, or freeze a take on the clip's own camera.",
            contract.ExitCode.BAKE,
        )


def _sources(scene: Any, shot: Path, take: str) -> tuple[compositor.Take, Path | None]:
    """A take, and the first picture of its plate if there is one. JobError if the take has no frames."""
    try:
        frozen = compositor.take_of(contract.ShotFolder(shot).takes / take, cameras.depth_scale(scene, shot))
    except FileNotFoundError as error:
        raise contract.JobError(
            f"The take {take!r} of {shot.name} holds no frozen frames.", "Freeze first.", contract.ExitCode.BAKE
        ) from error
    plate = contract.ShotFolder(shot).plate(frozen.first)
    return frozen, plate if plate.is_file() else None


def _footage(scene: Any, shot: Path, plate: Path | None) -> list[Path]:
    """Files by which a node that shows the plate is known: the undistorted plate, the clip."""
    told = str(contents.read(shot).info.get("source", ""))
    chosen = scene.splannequin.clip
    files = [plate, Path(told) if told else None, Path(bpy.path.abspath(chosen)) if chosen else None]
    return [file for file in files if file is not None]


def shown(scene: Any, shot: Path) -> str:
    """Name of the take of this shot that the scene's compositor shows; empty if there is none, or another shot's."""
    there = compositor.shown(scene)
    return there[0].name if there is not None and there[0].parent == contract.ShotFolder(shot).takes else ""


def stale_scale(scene: Any, shot: Path) -> bool:
    """True if the shot was scaled since its take was put into the compositor: its depth does not fit the scene's."""
    there = compositor.shown(scene)
    if there is None or not shown(scene, shot):
        return False
    scale = cameras.depth_scale(scene, shot)
    return abs(there[1] - scale) > 1e-4 * scale


def follow_scale(scene: Any, shot: Path) -> list[str]:
    """Brings the depth of a take in the compositor to the shot's scale; returns what was changed, in words."""
    if not stale_scale(scene, shot):
        return []
    compositor.set_depth_scale(scene, cameras.depth_scale(scene, shot))
    return ["Depth in the compositor follows the new scale."]


def remove(scene: Any) -> bool:
    """Takes the freeze out of the scene's compositor. True if it was there."""
    return compositor.remove(scene)


def frames_of(scene: Any) -> range:
    """Frames that a bake is about: the scene's range and step, as Blender renders them."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def missing_frames(shot: Path, take: str, frames: Iterable[int]) -> list[int]:
    """Those of some frames that a take lacks."""
    there = set(compositor.frame_numbers(contract.ShotFolder(shot).takes / take))
    return [n for n in frames if n not in there]


def default_output(shot: Path, take: str) -> Path:
    """Where a bake goes if the scene names no folder of its own."""
    return shot / "bake" / take


def choose_output(scene: Any, shot: Path, take: str) -> list[str]:
    """Gives the scene an output path if it still has Blender's default; returns what was changed, in words."""
    if scene.render.filepath not in _DEFAULT_OUTPUTS:
        return []
    folder = default_output(shot, take)
    scene.render.filepath = compositor.blend_path(folder / DIGITS)
    return [f"Output path set to {folder}."]


def fit_take(scene: Any, shot: Path, take: str, new: bool = False) -> list[str]:
    """Gives the scene the rate and range of a take, and a size that loses no pixel of it; says what changed.

    Args:
        scene: the scene. What the artist has set in it stays, and it never becomes smaller.
        shot: shot folder.
        take: name of the take.
        new: the scene is a new one, which takes the plate's size.
    """
    frozen, state, render = (
        compositor.take_of(contract.ShotFolder(shot).takes / take),
        contents.read(shot),
        scene.render,
    )
    width, height = size = _plate_size(state) if new else (render.resolution_x, render.resolution_y)
    alike = abs(width * frozen.size[1] - height * frozen.size[0]) <= 0.02 * width * frozen.size[1]
    if frozen.size[0] > width or (new and not alike):  # of a camera of the artist's own
        size = frozen.size
    elif not new:
        size = None
    fps = float(state.info.get("fps", 0.0))
    return scene_setup.fit_clip(scene, size, fps, (frozen.first, frozen.last), over=new)


def _plate_size(state: contents.ShotState) -> tuple[int, int]:
    """Width and height of the undistorted plate in pixels, (0, 0) before the import."""
    solved = contract.ShotFolder(state.folder).cameras
    if not solved.is_file():
        return state.size
    path = contract.CameraPath.load(solved)
    return path.width, path.height


def render(
    scene: Any,
    folder: Path,
    png: bool = True,
    on_frame: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> list[int]:
    """Renders the scene's range through the compositor to folder/NNNNNN.*, blocking; returns the frames written.

    Args:
        scene: a scene with the freeze inserted.
        folder: where the pictures go.
        png: write 8-bit RGB PNG; else what the scene's output format says.
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

    def count(rendered: Any, *_: Any) -> None:
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
