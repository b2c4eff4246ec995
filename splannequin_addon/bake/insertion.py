"""Inserts frozen frames into the scene's compositor and renders to the artist's output."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import present, settings_of
from ..process import job_timer
from ..scene import paths, rollback, scene_setup, session
from ..shot import inventory, places, scene_objects
from ..shot.shot_state import ShotState
from . import cg_camera, compositor, freeze_group, rendering, take_files
from .take_files import Take


def insert(scene: bpy.types.Scene, shot: Path, take: str, warp: bool | None = None) -> list[str]:
    """Puts a take into the scene's compositor, or updates it. Returns the changes as sentences.

    Args:
        shot: shot folder.
        take: name of the take.
        warp: True: freeze the plate linked to the group. False: show the take's frames. None: unchanged.

    Raises:
        contract.JobError: the take has no frames, or its warp is requested but cannot be used.
    """
    frozen, plate = _sources(scene, shot, take)
    if warp:
        _need_warp(shot, frozen)
    footage = _footage(scene, shot, plate)
    changes = compositor.insert(scene, frozen, plate, footage, settings_of(scene).insert_at, warp)
    missing = inventory.missing_frames(shot, take, rendering.frames_of(scene))
    if cg_camera.is_cg_linked(scene):
        numbers = rendering.frames_of(scene)
        wrong = cg_camera.difference(scene, frozen.folder, [numbers[0], numbers[-1]]) if numbers else ""
        changes += [wrong] if wrong else []
    if missing:
        changes.append(
            f"The take lacks {len(missing)} frames of the scene's range. The first missing frame is {missing[0]}."
        )
    return changes


def prefetch(scene: bpy.types.Scene, shot: Path, take: str) -> Iterator[None]:
    """Loads the images that `insert` will need, one per iteration. Raises JobError as `insert` does."""
    frozen, plate = _sources(scene, shot, take)
    shown = plate if freeze_group.shows_plate(scene) else None
    return compositor.prefetch(frozen, shown, freeze_group.wants_warp(scene))


def _need_warp(shot: Path, take: Take) -> None:
    """Raises JobError if the take's warp cannot freeze a plate that shows frame n at scene frame n."""
    name = take.folder.name
    if inventory.read(shot).takes.get(name, {}).get("camera_path"):
        raise contract.JobError(
            f"The take {name!r} was frozen from your own camera, so its warp needs other frames of the plate.",
            "Use the take's frozen frames, or freeze a take from the clip's camera.",
            contract.ExitCode.BAKE,
        )
    if not any(take.plate_size):
        raise contract.JobError(
            f"The take {name!r} has no warp, because it was frozen without detail.",
            "Freeze it again with detail.",
            contract.ExitCode.BAKE,
        )


def _sources(scene: bpy.types.Scene, shot: Path, take: str) -> tuple[Take, Path | None]:
    """A take, and the first image of its plate if there is one. Raises JobError if the take has no frames."""
    try:
        frozen = take_files.take_of(contract.ShotFolder(shot).takes / take, scene_objects.depth_scale(scene, shot))
    except FileNotFoundError as error:
        raise contract.JobError(
            f"The take {take!r} of {shot.name} has no frozen frames.", "Freeze first.", contract.ExitCode.BAKE
        ) from error
    plate = contract.ShotFolder(shot).plate(frozen.first)
    return frozen, plate if plate.is_file() else None


def _footage(scene: bpy.types.Scene, shot: Path, plate: Path | None) -> list[Path]:
    """Files by which a node that shows the plate is recognised: the undistorted plate, the clip's imported and current
    locations, and the panel's clip."""
    state = inventory.read(shot)
    clips = [str(state.info.get("source", "")), places.source_of(state), paths.absolute(settings_of(scene).clip)]
    return [*([plate] if plate is not None else []), *(Path(clip) for clip in dict.fromkeys(clips) if clip)]


def remove(scene: bpy.types.Scene) -> bool:
    """Removes the freeze from the scene's compositor. True if there was one."""
    return compositor.remove(scene)


def fit_take(scene: bpy.types.Scene, shot: Path, take: str, new: bool = False) -> list[str]:
    """Sets the scene's frame rate and range to a take's, and a size that keeps every pixel. Returns the changes.

    Args:
        scene: the scene. Settings of the artist stay, and the render size is not reduced.
        shot: shot folder.
        take: name of the take.
        new: the scene is new and gets the plate's size.
    """
    frozen, state, render = (
        take_files.take_of(contract.ShotFolder(shot).takes / take),
        inventory.read(shot),
        scene.render,
    )
    width, height = size = _plate_size(state) if new else (render.resolution_x, render.resolution_y)
    alike = abs(width * frozen.size[1] - height * frozen.size[0]) <= 0.02 * width * frozen.size[1]
    if frozen.size[0] > width or (new and not alike):  # a take from the artist's camera
        size = frozen.size
    elif not new:
        size = None
    fps = float(state.info.get("fps", 0.0))
    return scene_setup.fit_clip(scene, size, fps, (frozen.first, frozen.last), over=new)


def _plate_size(state: ShotState) -> tuple[int, int]:
    """Width and height of the undistorted plate in pixels, (0, 0) before the import."""
    solved = contract.ShotFolder(state.folder).cameras
    if not solved.is_file():
        return state.size
    path = contract.CameraPath.load(solved)
    return path.width, path.height


def insert_freeze(scene: bpy.types.Scene, shot: Path, take: str, warp: bool | None = None) -> list[str]:
    """Puts a take or its warp into the scene's compositor, and preserves the plate's colours if that setting is on.

    Writes the footage's timecode into the metadata of rendered files.
    """
    with rollback.scene_of(scene):
        changes = scene_setup.keep_plate_colours(scene) if settings_of(scene).keep_colours else []
        changes += scene_setup.note(scene, timecode_note(inventory.read(shot)))
        return insert(scene, shot, take, warp) + changes


def timecode_note(state: ShotState) -> str:
    """Timecode note for the metadata of rendered files; empty if the footage has no timecode."""
    # Blender's own Time stamp counts from frame 0 and supports no other start.
    first = state.frame_range[0]
    code = state.timecode_at(first)
    return f"Timecode {code} at frame {first}, {state.info['fps']:g} fps." if code else ""


def combine_cg(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Composites the scene's objects with the frozen frames. Raises JobError if the freeze is not in the compositor."""
    compositor.may_combine_cg(scene)
    with rollback.scene_of(scene):
        changes = scene_setup.render_cg(scene)  # first: without the depth pass the node lacks its socket
        changes += cg_camera.use_matching_camera(scene, _shown_take(scene), rendering.frames_of(scene))
        return compositor.combine_cg(scene) + changes


def _shown_take(scene: bpy.types.Scene) -> Path:
    """Folder of the take that the compositor shows. Raises JobError if its image is missing."""
    shown = freeze_group.shown(scene)
    if shown is None:
        raise contract.JobError(
            "The freeze in this compositor shows no take.", "Insert it again.", contract.ExitCode.BAKE
        )
    return shown[0]


def bring_in(scene: bpy.types.Scene, shot: Path, take: str, alone: bool = True) -> None:
    """Inserts a take into the compositor and renders it, in steps run by the timer. Each step blocks Blender's window.

    Args:
        shot: shot folder.
        take: name of a take.
        alone: change only this scene, not other scenes that use the shot.
    """
    job_timer.work(shot, "bake", _turns(scene.session_uid, shot, take, scene.session_uid if alone else 0))


def _turns(scene_uid: int, shot: Path, take: str, only: int) -> Iterator[None]:
    """Steps of `bring_in`: load one image each, then set up the compositor, then render. The last two block longest."""
    if session.scene_of(scene_uid) is None:
        return
    with contextlib.suppress(
        contract.JobError, OSError, RuntimeError, ValueError
    ):  # `insert_freeze` reports the same error
        yield from prefetch(present(session.scene_of(scene_uid)), shot, take)
    seen = 0

    def put_in(scene: bpy.types.Scene) -> list[str]:
        nonlocal seen
        changes = insert_freeze(scene, shot, take)
        if job_timer.window_of(scene) is not None:
            changes += rendering.choose_output(scene, shot, take)  # now, as part of the same undo step
            seen = scene.session_uid
        else:
            changes.append(f"{scene.name} is not open in any window, so it was not rendered.")
        return changes

    job_timer.change(job_timer.watch_of(shot), "bake", put_in, only)
    if not seen:
        return
    yield None
    scene = session.scene_of(seen)
    window = job_timer.window_of(scene) if scene is not None else None
    if window is not None:
        with bpy.context.temp_override(window=window, scene=window.scene):  # pyright: ignore[reportUnknownMemberType]
            ops: Any = bpy.ops  # our operators are not in the stubs
            ops.splannequin.render("INVOKE_DEFAULT")
