"""Samples of an animated camera, and the transforms.json that stores them in the world of a Blender scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...torch_backend import contract
from ..scene import axes

if TYPE_CHECKING:
    import bpy
    from mathutils import Matrix

MOVING_CAMERA_HINT = "Choose a camera that moves like the clip's camera."
"""Hint for a camera that cannot be the clip's."""
# Largest change in a still camera's matrix elements, relative to its position, because Blender's matrices are float32.
_STILL = 1e-6


@dataclass(frozen=True)
class Sample:
    """A camera at one frame."""

    number: int
    """Frame number."""
    pose: np.ndarray
    """Camera-to-world, [4, 4] float64, Blender's camera axes. The axes have length 1, but may be sheared or
    mirrored."""
    K: tuple[float, ...]
    """fx, fy, cx, cy in pixels, pixel centres at +0.5."""


def frames_of(shot: Path) -> tuple[list[int], tuple[int, int]]:
    """(frame numbers of an imported shot in ascending order, (width, height) of its frames in pixels).

    Raises JobError if the shot is not imported.
    """
    try:
        listing = contract.read_json(contract.ShotFolder(shot).listing)
        numbers = [int(row["frame"]) for row in listing["frames"]]
        return numbers, (int(listing["width"]), int(listing["height"]))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE) from error


def sample_of(number: int, matrix: Matrix, window: Matrix, size: tuple[int, int]) -> Sample:
    """A camera at a frame.

    Args:
        number: frame number.
        matrix: camera-to-world, Blender's camera axes, [4, 4]; its scale does not matter.
        window: perspective projection, [4, 4].
        size: width and height of the image in pixels.
    """
    pose = np.array(matrix, dtype=np.float64)
    pose[:3, :3] /= np.maximum(np.sqrt((pose[:3, :3] ** 2).sum(axis=0)), 1e-30)
    return Sample(number, pose, tuple(axes.k_from_window(window, size)))


def moves(samples: Sequence[Sample]) -> bool:
    """True if the camera's pose changes between the samples."""
    poses = np.array([s.pose for s in samples])
    reach = max(1.0, float(np.abs(poses[:, :3, 3]).max()))
    return bool(np.abs(poses - poses[0]).max() > _STILL * reach)


def keyed(camera: bpy.types.Object) -> tuple[float, float] | None:
    """First and last frame of the keyframes of a camera, its lens and its parents; None without keyframes."""
    spans: list[tuple[float, float]] = []
    owner: bpy.types.Object | None = camera
    while owner is not None:
        for block in (owner, owner.data):
            spans += _spans(block.animation_data if block is not None else None)
        owner = owner.parent
    return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None


def _spans(data: bpy.types.AnimData | None) -> list[tuple[float, float]]:
    """(first, last) frame of the action and of each NLA strip of animation data."""
    if data is None:
        return []
    action: Any = data.action
    action_spans = [tuple(action.curve_frame_range)] if action is not None else []
    return action_spans + [(s.frame_start, s.frame_end) for track in data.nla_tracks for s in track.strips]


def without_ends(samples: Sequence[Sample], span: tuple[float, float] | None) -> list[Sample]:
    """Samples without those at both ends where the camera does not move, because it was not tracked there.

    Args:
        samples: samples in frame order, with some motion between them.
        span: first and last keyframe; samples in this range stay. None: the camera has no keyframes.
    """
    first, last = 0, len(samples) - 1
    while _alike(samples[first], samples[first + 1]) and not (span and samples[first].number >= span[0]):
        first += 1
    while _alike(samples[last], samples[last - 1]) and not (span and samples[last].number <= span[1]):
        last -= 1
    return list(samples[first : last + 1])


def _alike(first: Sample, second: Sample) -> bool:
    """True if a camera is bitwise identical at two frames, as between frames without motion."""
    return first.K == second.K and bool((first.pose == second.pose).all())


def transforms(
    samples: Sequence[Sample],
    size: tuple[int, int],
    is_numbered_as_shot: bool = False,
    notes: Sequence[tuple[str, str]] = (),
) -> dict[str, Any]:
    """Content of a transforms.json for samples of a camera in the world of a scene.

    Args:
        samples: samples in frame order.
        size: width and height in pixels of the images that K refers to.
        is_numbered_as_shot: the frame numbers are the shot's. Otherwise the backend matches them.
        notes: (sentence, hint) of each note for the artist.
    """
    lenses: list[dict[str, Any]] = [dict(zip(("fl_x", "fl_y", "cx", "cy"), s.K, strict=True)) for s in samples]
    shared: dict[str, Any] = {}
    if all(lens == lenses[0] for lens in lenses):
        shared, lenses = lenses[0], [{} for _ in lenses]
    return {
        "w": size[0],
        "h": size[1],
        **shared,
        "camera_model": "PINHOLE",
        contract.CAMERA_FACTS_KEY: {
            "world": contract.SCENE_WORLD,
            "is_numbered_as_shot": is_numbered_as_shot,
            "notes": [list(note) for note in notes],
        },
        "frames": [
            {"file_path": f"{s.number}.png", "transform_matrix": s.pose.tolist(), **lens}
            for s, lens in zip(samples, lenses, strict=True)
        ],
    }


def write(shot: Path, data: dict[str, Any]) -> Path:
    """Writes a transforms.json into a shot for the solve. Raises OSError if it cannot be written."""
    file = contract.ShotFolder(shot).tracking
    contract.ShotFolder(shot).own(file.parent)
    contract.write_json(file, data, parents=False)
    return file


def whole_frames(span: tuple[float, float]) -> range:
    """Whole frames in a span of time. Tolerates rounding, because files store rounded times in seconds."""
    return range(math.ceil(span[0] - 0.01), math.floor(span[1] + 0.01) + 1)
