"""The cameras of a take: the clip's own, with interpolated ones for missing frames, or a camera path from Blender."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ...cameras.poses import interpolate_pose
from ...contract import CameraPath, ExitCode, FreezeParams, JobError
from ...footage.plates import Plates
from ...scene import Scene
from ...shot import Shot
from ...torch_types import from_numpy
from ..frozen import OutputFrame

LONGEST_GAP = 2.0
"""Longest gap in the footage, in seconds, across which cameras are interpolated: handheld motion is not linear."""


def output_size(shot: Shot, scene: Scene, params: FreezeParams) -> tuple[int, int]:
    """(width, height) of the frozen frames: `params.width` or the plates' width, with the aspect of clip or path."""
    plates = Plates(shot)
    if not params.camera_path and params.width in (0, plates.width):
        return plates.width, plates.height
    width = min(max(16, params.width or plates.width), 16_384)
    shape = CameraPath.load(params.camera_path) if params.camera_path else scene
    return width, max(16, round(shape.height * width / shape.width))


def plan(scene: Scene, params: FreezeParams, t_star: int, width: int, height: int) -> list[OutputFrame]:
    """All possible frames of a take: the clip's poses with gaps interpolated, or the poses of a camera path.

    JobError if one of `params.t_star_per_frame` lies outside the clip.
    """
    if params.camera_path:
        viewmats, Ks, numbers = _path_cameras(scene, CameraPath.load(params.camera_path), width, height)
    else:
        viewmats, Ks, numbers = _without_gaps(scene, scene.camera_at(width, height))
    ramp = {int(k): float(v) for k, v in params.t_star_per_frame.items()}
    for n, at in ramp.items():
        if not scene.frames[0] <= at <= scene.frames[-1]:
            raise JobError(
                f"t* at frame {n} is frame {at:g}, the shot has frames {scene.frames[0]} to {scene.frames[-1]}.",
                "Choose a frame of the shot.",
                ExitCode.FREEZE,
            )
    frames: list[OutputFrame] = []
    for i, n in enumerate(numbers):
        at = ramp.get(n, float(t_star))
        frames.append(OutputFrame(n, viewmats[i], Ks[i], at, at if params.camera_path else float(n)))
    return frames


def _without_gaps(scene: Scene, Ks: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """(viewmats, Ks, frame numbers) of the clip, with gaps of up to `LONGEST_GAP` filled by interpolation."""
    viewmats, intrinsic, numbers = [scene.viewmats[0]], [Ks[0]], [scene.frames[0]]
    for i, (before, after) in enumerate(pairwise(scene.frames)):
        lacking = range(before + 1, after) if scene.seconds[i + 1] - scene.seconds[i] <= LONGEST_GAP else range(0)
        for number in lacking:
            share = (number - before) / (after - before)
            pose = np.eye(4)
            pose[:3] = interpolate_pose(scene.viewmats[i].numpy(), scene.viewmats[i + 1].numpy(), share)
            viewmats.append(from_numpy(pose).float())
            intrinsic.append((1.0 - share) * Ks[i] + share * Ks[i + 1])
            numbers.append(number)
        viewmats.append(scene.viewmats[i + 1])
        intrinsic.append(Ks[i + 1])
        numbers.append(after)
    return torch.stack(viewmats), torch.stack(intrinsic), numbers


def in_range(frames: list[OutputFrame], params: FreezeParams) -> list[OutputFrame]:
    """The frames selected by `params.first`, `last` and `step`; `frames` ascend. JobError if no frame is selected."""
    numbers = [f.frame for f in frames]
    first = numbers[0] if params.first is None else params.first
    last = numbers[-1] if params.last is None else params.last
    chosen_numbers = range(first, last + 1, max(1, params.step))
    chosen = [f for f in frames if f.frame in chosen_numbers]
    if not chosen:
        raise JobError(
            f"No frame lies between {first} and {last}.", f"The path has frames {numbers[0]} to {numbers[-1]}.",
            ExitCode.FREEZE,
        )  # fmt: skip
    return chosen


def intrinsics(frames: list[OutputFrame]) -> np.ndarray:
    """[F, 4]: fx, fy, cx, cy of the frames, in pixels of the output size."""
    return np.array([[f.K[0, 0], f.K[1, 1], f.K[0, 2], f.K[1, 2]] for f in frames], np.float64)


def _path_cameras(scene: Scene, path: CameraPath, width: int, height: int) -> tuple[Tensor, Tensor, list[int]]:
    """(viewmats, Ks, frame numbers) of a Blender path, converted from solve units to scene units and output size."""
    if not path.frames:
        raise JobError("The camera path has no frames.", "Send at least one pose.", ExitCode.FREEZE)
    viewmats = np.array([f.viewmat for f in path.frames], dtype=np.float64).reshape(-1, 4, 4)
    x, y = width / path.width, height / path.height
    Ks = [[[f.K[0] * x, 0, f.K[2] * x], [0, f.K[1] * y, f.K[3] * y], [0, 0, 1]] for f in path.frames]
    return scene.from_solve(viewmats), torch.tensor(Ks, device="cpu").float(), [f.frame for f in path.frames]
