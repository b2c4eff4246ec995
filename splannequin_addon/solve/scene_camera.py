"""An animated camera of a Blender scene as the camera of a clip: sampled, and written as a transforms.json.

The file uses the scene's world, so that the solve is placed where the camera is.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..access import fully_named
from ..scene import scene_setup, session
from ..shot import seen_camera
from . import camera_samples

if TYPE_CHECKING:
    import bpy

# Maximum relative difference of aspect ratios, to allow for rounding to whole pixels.
_ASPECT_SLACK = 0.01


def write_in_turns(scene: bpy.types.Scene, name: str, shot: Path) -> Generator[tuple[int, int], None, Path]:
    """Samples a camera at every frame of a shot, one frame per step. Yields (frames done, total frames).

    Frame n of the scene is frame n of the clip. Returns SHOT/tracking/transforms.json. Frames without motion before the
    first and after the last keyframe are left out. Keeps no bpy data between steps and restores the scene's current
    frame.

    Args:
        scene: the scene, for its pixel aspect.
        name: `name_full` of the camera object.
        shot: shot folder.

    Raises:
        contract.JobError: the shot is not imported, or the render's aspect ratio differs from the frames. Also if the
            camera is missing, is not a perspective camera or does not move.
    """
    uid, (numbers, size) = scene.session_uid, camera_samples.frames_of(shot)
    _check_aspect_ratio(scene, size)
    samples: list[camera_samples.Sample] = []
    with seen_camera.frame_kept(uid):
        for number in numbers:
            seen = seen_camera.evaluated(session.scene_of(uid), name, number, size, camera_samples.MOVING_CAMERA_HINT)
            samples.append(camera_samples.sample_of(number, seen[0], seen[1], size))
            del seen
            yield len(samples), len(numbers)
    if not camera_samples.moves(samples):
        raise contract.JobError(
            f"{name} stands still from frame {numbers[0]} to {numbers[-1]}.",
            camera_samples.MOVING_CAMERA_HINT,
            contract.ExitCode.USAGE,
        )
    found = session.scene_of(uid)
    camera = fully_named(found.objects, name) if found is not None else None
    covered = camera_samples.without_ends(samples, camera_samples.keyed(camera) if camera is not None else None)
    return camera_samples.write(shot, camera_samples.transforms(covered, size, is_numbered_as_shot=True))


def _check_aspect_ratio(scene: bpy.types.Scene, size: tuple[int, int]) -> None:
    """Raises JobError if the render's aspect ratio differs from the clip's."""
    width, height = scene_setup.render_size(scene)
    # A camera's field of view depends on the render's aspect ratio.
    if abs((width / height) / (size[0] / size[1]) - 1.0) > _ASPECT_SLACK:
        raise contract.JobError(
            f"The scene renders {width} x {height} pixels, but the clip has a different aspect ratio, {size[0]} x "
            f"{size[1]}.",
            "Set the scene's resolution and pixel aspect to the clip's.",
            contract.ExitCode.USAGE,
        )
