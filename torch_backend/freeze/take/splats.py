"""Exports the splats of a take, in the axes and units of Blender's scene, as frozen.ply and frozen.usdc."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from ...cameras.placement import Similarity, placement_for
from ...cameras.stored import load_cameras
from ...contract import (
    PLY_FILE,
    USD_FILE,
    CameraFrame,
    CameraPath,
    ExitCode,
    JobError,
    Placement,
    Reporter,
    TakeFolder,
    UserError,
    placement_of,
    read_json,
)
from ...gaussians.ply import PlyGaussians, read_ply, write_ply
from ...scene import Scene, load_scene
from ...shot import Shot, remove_file
from ...torch_types import from_numpy
from ..exr import read_metadata
from ..frozen import FrozenGaussians
from ..placed import placed
from ..usd import NoUsdError, write_usd
from .folder import frames_of

FORMATS = ("ply", "usd")
_NO_USD = (
    "The backend has no usd-core, so the USD stage is not written.",
    "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
)
PLAIN_FPS = 24.0
"""Frames per second of a stage if the footage has no frame rate."""


def placed_splats(frozen: FrozenGaussians, scene: Scene, transform: Similarity) -> PlyGaussians:
    """A frozen instant transformed to Blender's scene; `transform` is the similarity from solve units."""
    state = {name: value.cpu() for name, value in frozen.state.items()}
    in_solve = PlyGaussians(
        (state["means"].double() / scene.scale + from_numpy(scene.centre)).float().numpy(),
        state["quats"].numpy(),
        (state["log_scales"] - math.log(scene.scale)).numpy(),
        state["opacity_logits"].numpy(),
        torch.cat([state["sh0"], state["shN"]], dim=1).numpy(),
    )
    return placed(in_solve, transform)


def camera_path_of(shot: Shot, file: str) -> CameraPath:
    """The camera path of a take, solve units: the path `file` from Blender, or the clip's own if it is empty.

    Raises the errors of `CameraPath.load` and `load_cameras`.
    """
    return CameraPath.load(file) if file else load_cameras(shot)


def refuse_other_solve(shot: Shot, facts: dict[str, Any]) -> None:
    """Raises JobError if the shot was solved again after a take was frozen. `facts`: content of its take.json.

    The splats of such a take have the axes and units of the former solve, which no placement of the new one fits.
    """
    scale = facts.get("scale")  # takes of early versions lack it
    if isinstance(scale, float) and not math.isclose(scale, load_scene(shot).scale, rel_tol=1e-6):
        raise JobError(
            f"The camera of {shot.root.name} was solved again after the take was frozen.",
            "Train the run and freeze the take again.",
            ExitCode.USAGE,
        )


def _frozen_cameras(take: TakeFolder, facts: dict[str, Any]) -> CameraPath:
    """The cameras of a take's frames, solve units, from their EXRs: the file of its path may be moved or changed.

    JobError if the take has no frames.
    """
    frames: list[CameraFrame] = []
    for number in frames_of(take):
        seen = read_metadata(take.frame(number))
        lens = [float(seen.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
        frames.append(CameraFrame(number, seen.viewmat.ravel().tolist(), lens, "blender"))
    if not frames:
        raise JobError(f"Take {take.root.name} has no frames.", "Freeze it again.", ExitCode.USAGE)
    return CameraPath(int(facts["width"]), int(facts["height"]), frames)


def write_stage(
    path: Path, splats: PlyGaussians, cameras: CameraPath, placement: Placement, fps: float, report: Reporter
) -> None:
    """Writes a take's USD stage. Without usd-core, it warns and removes the stage of an earlier freeze.

    OSError if the file cannot be written.
    """
    transform = Similarity.of(placement)
    try:
        write_usd(path, splats, cameras, transform, placement.metres_per_unit, fps or PLAIN_FPS)
    except NoUsdError:
        remove_file(path)
        report.warning(*_NO_USD)


def export_splats(shot: Shot, kind: str, folder: Path, take: str, placement: str = "") -> list[Path]:
    """Writes the splats of a finished take with the current placement, so that Set Scale needs no new freeze.

    Args:
        shot: a solved shot.
        kind: one of `FORMATS`. "ply" writes frozen.ply; "usd" writes frozen.usdc, with the animated camera.
        folder: output folder, created if missing.
        take: name of the take.
        placement: see `placement_for`.

    Returns:
        The files written.

    Raises:
        ValueError: unknown format, or `placement` or the take's files are damaged.
        JobError: the take does not exist or is of another solve, or the environment cannot write USD.
    """
    if kind not in FORMATS:
        raise UserError(f"format is {kind!r}: it should be one of {', '.join(FORMATS)}")
    take_folder = TakeFolder(shot.take(take))
    if not take_folder.facts.is_file() or not take_folder.ply.is_file():
        raise JobError(f"Take {take} of {shot.root.name} has no splats.", "Freeze it first.", ExitCode.USAGE)
    facts = read_json(take_folder.facts)
    refuse_other_solve(shot, facts)
    target = placement_for(shot, placement)
    change = Similarity.of(target).after(Similarity.of(placement_of(facts)).inverse())
    splats = placed(read_ply(take_folder.ply), change)
    if kind == "ply":
        return [write_ply(folder / PLY_FILE, *splats)]
    cameras = _frozen_cameras(take_folder, facts) if facts.get("camera_path") else load_cameras(shot)
    transform, fps = Similarity.of(target), shot.info().fps or PLAIN_FPS
    try:
        return [write_usd(folder / USD_FILE, splats, cameras, transform, target.metres_per_unit, fps)]
    except NoUsdError as error:
        raise JobError(*_NO_USD, ExitCode.ENVIRONMENT) from error
