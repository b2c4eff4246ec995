"""Solves with imported cameras: builds the answer that the worker would give, from a file instead of COLMAP's
mapper."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import save_arrays
from ..cameras import imported
from ..cameras.colmap_files import ColmapCamera, ColmapImage, ColmapModel, ColmapPoints, write_model
from ..cameras.poses import camera_centre
from ..contract import POINTS_FILE, REQUEST_FILE, ExitCode, JobError, Reporter
from ..footage.pairing import counted_of
from ..shot import Shot, write_json
from .child import run_worker
from .points import LEAST_POINTS, filter_points, refuse_narrow

LEAST_AGREEMENT = 0.25
"""Least share of matched keypoints that triangulate to a point. Below it, imported cameras belong to another clip.
Cameras of a rendered room: 0.93 (0.76 a frame off, 0.35 four frames off, 0.05 at random); of a real clip: 0.67."""
POOR_AGREEMENT = 0.5
"""Share below which imported cameras are used with a warning."""


@dataclass
class ImportedCameras:
    """Imported cameras, matched to the frames of a clip."""

    solve: imported.ImportedSolve
    """The solve read from the file."""
    matched: imported.Matched
    """Cameras of the frames."""


def prepare(frames: dict[str, Any], cameras: str, report: Reporter) -> ImportedCameras:
    """Reads cameras, matches them to the frames of a frames.json, and warns `report` of missing ones.

    Raises JobError (SOLVE) if the cameras cannot be read, are too few, or have another aspect ratio than the frames.
    """
    solve = imported.read(cameras)
    listed = frames["frames"]
    size, solved = (frames["width"], frames["height"]), [f["frame"] for f in listed if f["solve"]]
    matched = imported.match(solve, counted_of(frames), size, solved)
    for message, hint in imported.remarks(solve, matched):
        report.warning(message, hint)
    return ImportedCameras(solve, matched)


def take_over(
    shot: Shot,
    frames: dict[str, Any],
    cameras: ImportedCameras,
    options: dict[str, Any],
    scratch: Path,
    report: Reporter,
) -> dict[str, Any]:
    """Runs the worker on imported cameras: it undistorts the lenses and triangulates points if needed.

    The points in the file are used if enough of them have errors and tracks. Otherwise points are triangulated with the
    cameras fixed, which also measures how well the cameras fit.

    Args:
        shot: an imported shot.
        frames: its frames.json.
        cameras: result of `prepare`.
        options: the worker's overlap and features.
        scratch: folder that receives poses.json, points.npz, undistort_N.npz and model/, as after a solve.
        report: receives progress.

    Returns:
        The worker's answer as after a solve, plus "given", the kind of the file, and "world", that of its cameras.

    Raises:
        JobError: the worker crashed, or no point agrees with the cameras.
    """
    source, matched = cameras.solve, cameras.matched
    size = (frames["width"], frames["height"])
    used = sorted({camera.lens for camera in matched.cameras.values()})
    lenses = [source.lenses[n].scaled(*size) for n in used]
    names = {f["frame"]: Path(f["file"]).name for f in frames["frames"]}
    poses = {
        names[n]: {"pose": camera.pose.tolist(), "source": "registered", "lens": used.index(camera.lens)}
        for n, camera in matched.cameras.items()
    }
    registered = [f["frame"] for f in frames["frames"] if f["solve"] and f["frame"] in matched.cameras]
    points = _stored_points(cameras, size)
    known = {
        "lenses": [vars(lens) for lens in lenses],
        "images": {name: {"lens": p["lens"], "pose": p["pose"]} for name, p in poses.items()},
        "triangulate": points is None,
    }
    write_json(scratch / REQUEST_FILE, _request(shot, [names[n] for n in registered], known, options))
    answer = run_worker(scratch / REQUEST_FILE, shot.colmap_log, report)["result"]
    (scratch / "poses.json").write_text(json.dumps(poses), encoding="utf-8")
    if points is not None:
        answer = _keep_stored(points, scratch, lenses, poses)
    if not answer["points"]:  # the worker wrote no files
        refuse_misfit(answer, 0)
    fx, fy, _, _, *bend = lenses[0].params
    return {
        **answer,
        "given": source.kind,
        "world": source.world,
        "registered": len(registered),
        "camera_model": lenses[0].model,
        "focal_px": 0.5 * (fx + fy),
        "distortion": bend,
    }


def _stored_points(cameras: ImportedCameras, size: tuple[int, int]) -> dict[str, NDArray[Any]] | None:
    """`imported.stored_points` for pictures of `size` (width, height); None if they are too few to train from."""
    points = imported.stored_points(cameras.solve, cameras.matched, size)
    centres = np.array([camera_centre(camera.pose) for camera in cameras.matched.cameras.values()])
    return points if points is not None and _is_sufficient(points, centres) else None


def _request(shot: Shot, solved: list[str], known: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """The request to the worker. `solved` are names of pictures, `known` their cameras from the file."""
    return {
        "images": str(shot.raw),
        "solved": solved,
        "others": [],
        "camera_model": "PINHOLE",
        "neighbours": 0,
        "threads": max(1, min(os.cpu_count() or 1, 16)),
        **options,
        "known": known,
    }


def _keep_stored(
    points: dict[str, NDArray[Any]], scratch: Path, lenses: list[imported.Lens], poses: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Writes the file's points and their model into `scratch`; returns the figures that the worker would report."""
    angle = float(points.pop("angle"))
    save_arrays(scratch / POINTS_FILE, points)
    _write_model(scratch / "model", lenses, poses, points)
    known = points["error"][points["error"] > 0]
    return {
        "points": len(points["xyz"]),
        "reprojection_error_px": float(known.mean()),
        "triangulation_angle_deg": angle,
    }


def refuse_misfit(answer: dict[str, Any], usable: int) -> None:
    """Raises JobError for imported cameras that leave too few (`usable`) points to train from."""
    agreement = answer.get("agreement", 1.0)
    if usable < LEAST_POINTS or agreement < LEAST_AGREEMENT:
        share = f", and {100 * agreement:.0f} % of the matches" if "agreement" in answer else ""
        raise JobError(
            f"The imported cameras do not fit these frames: only {usable} points of the scene{share} agree with them.",
            "Check that they are for this clip and its lens, and numbered like its frames.",
            ExitCode.SOLVE,
        )
    refuse_narrow(answer["triangulation_angle_deg"])


def doubts(answer: dict[str, Any]) -> list[tuple[str, str]]:
    """(sentence, hint) for imported cameras that are used although they fit the frames badly."""
    if answer.get("agreement", 1.0) >= POOR_AGREEMENT:
        return []
    share = f"{100 * answer['agreement']:.0f}"
    return [
        (
            f"Only {share} % of the matches between frames agree with the imported cameras.",
            "Check that they are for this clip and its lens, and numbered like its frames.",
        )
    ]


def _is_sufficient(points: dict[str, NDArray[Any]], centres: NDArray[Any]) -> bool:
    """True if the points of a file have measured errors and are enough to train from."""
    table = {name: points[name] for name in ("xyz", "rgb", "error", "track", "depth")}
    return bool((points["error"] > 0).any()) and len(filter_points(table, centres)["xyz"]) >= LEAST_POINTS


def _write_model(
    folder: Path, lenses: list[imported.Lens], poses: dict[str, dict[str, Any]], points: dict[str, NDArray[Any]]
) -> None:
    """Writes the imported cameras as the COLMAP model that a solve of the working frames would leave."""
    cameras = {n: ColmapCamera(n, x.model, x.width, x.height, x.params) for n, x in enumerate(lenses, start=1)}
    images = [
        ColmapImage(n, name, camera["lens"] + 1, np.array(camera["pose"]))
        for n, (name, camera) in enumerate(sorted(poses.items()), start=1)
    ]
    count = len(points["xyz"])
    xyz, error = points["xyz"].astype(np.float64), points["error"].astype(np.float64)
    empty = [np.zeros(0, np.int64)] * count
    write_model(folder, ColmapModel(cameras, images, ColmapPoints(xyz, points["rgb"], error, empty)))
