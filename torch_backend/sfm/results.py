"""Writes the results of a solve: undistorted frames, cameras, points and the record, from the worker's files."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from ..array_types import save_arrays
from ..cameras.floor import floor_of
from ..cameras.poses import camera_centre, fill_poses
from ..contract import (
    CAMERAS_FILE,
    COLMAP_FOLDER,
    PICTURE,
    POINTS_FILE,
    SOLVE_FILE,
    CameraFrame,
    CameraPath,
    Reporter,
    frame_file,
)  # fmt: skip
from ..footage import load_frames
from ..footage.display import display_of
from ..footage.images import read_frame, write_png
from ..footage.masks import Mask
from ..footage.sources import frame_words
from ..lens.lens_verdict import lens_remarks
from ..lens.undistort import Undistorter, of_frames
from ..lens.zoom import zoom_words
from ..replacing import Staged
from ..shot import Shot, atomic_path, replace_file, write_json
from .flat import flat_words
from .imported_cameras import doubts, refuse_misfit
from .masks import write_undistorted
from .points import filter_points
from .verdict import FAIR_ERROR_PX, quality_words

SOLVE_VERSION = 1
# Number of threads that undistort frames. Half of the time is spent in fsync: on two cores 4 threads take 0.62 to 0.76
# of the time of 2, 8 threads 0.52 to 0.62. More would need too much memory: a 4K frame in floats takes 300 MB.
_WRITERS = 4


class SolveResult(TypedDict):
    """Result of `solve_shot`, repeated in summary.json."""

    frames: int
    """Source frames of the range; each has a camera."""
    solved_frames: int
    """Frames passed to the mapper."""
    registered: int
    """Of these, frames that the mapper placed."""
    localised: int
    """Further frames placed against the model."""
    interpolated: int
    """Frames whose pose is interpolated, or copied from the nearest frame with a pose."""
    reprojection_error_px: float
    """Mean error over the model's observations, in pixels."""
    points: int
    """Points in points.npz."""
    focal_px: float
    """Focal length of the undistorted frames in pixels."""
    quality: str
    """Summary in words, see `verdict.quality_words`."""


@dataclass(frozen=True)
class SolveInputs:
    """Inputs of a solve."""

    shot: Shot
    frames: dict[str, Any]
    """Contents of frames.json."""
    masks: dict[str, Mask]
    facts: dict[str, Any]
    """Part of solve.json that records the solve's settings."""


def write_results(
    inputs: SolveInputs, answer: dict[str, Any], scratch: Path, staged: Staged, report: Reporter
) -> SolveResult:
    """Writes the solve's files into `staged`, from the worker's files in `scratch`.

    Args:
        answer: answer of the worker; for imported cameras, that of `imported_cameras.take_over`.
    """
    frames = inputs.frames
    solved = sum(f["solve"] for f in frames["frames"])
    poses = json.loads((scratch / "poses.json").read_text(encoding="utf-8"))
    maps = [scratch / f"undistort_{n}.npz" for n in range(1 + max(p.get("lens", 0) for p in poses.values()))]
    path, lenses = _camera_path(frames, poses, [_pinhole(file) for file in maps])
    with np.load(scratch / POINTS_FILE, allow_pickle=False) as data:
        points = filter_points({name: data[name] for name in data.files}, _centres(path))
    if "given" in answer:
        refuse_misfit(answer, len(points["xyz"]))
    _undistort_all(inputs, lenses, maps, staged, report)
    with atomic_path(staged.solve / POINTS_FILE) as partial:
        save_arrays(partial, points)
    replace_file(scratch / "model", staged.solve / COLMAP_FOLDER)
    write_json(staged.solve / CAMERAS_FILE, path.to_json())
    misled = flat_words(points["xyz"]) or zoom_words(
        {int(Path(name).stem): change for name, change in answer.get("focal_changes", {}).items() if change is not None}
    )
    result = _result(answer, path, solved, len(points["xyz"]), path.frames[0].K[0], misled is not None)
    warnings = _warnings(frames, path, result, "given" in answer)
    warnings = ([misled] if misled is not None else []) + warnings
    warnings += doubts(answer) if "given" in answer else lens_remarks(answer)
    for message, hint in warnings:
        report.warning(message, hint)
    write_json(
        staged.solve / SOLVE_FILE,
        {
            "version": SOLVE_VERSION,
            **_record(answer, result),
            **inputs.facts,
            "solved_frames": solved,
            "lenses": [_lens(file) for file in maps],
            "lens_of_frame": lenses,
            "floor": floor_of(path, points["xyz"]),
            "warnings": [" ".join(w).strip() for w in warnings],
            "result": result,
        },
    )
    return result


def _record(answer: dict[str, Any], result: SolveResult) -> dict[str, Any]:
    """Fields of solve.json that repeat the worker's answer and the result."""
    return {
        "registered": result["registered"],
        "total_frames": result["frames"],
        "reprojection_error_px": result["reprojection_error_px"],
        "points": result["points"],
        "camera_model": answer["camera_model"],
        "distortion": answer["distortion"],
        "focal_px": answer["focal_px"],
        "focal_start_px": answer.get("lens", {}).get("start_px", 0.0),
        "triangulation_angle_deg": answer["triangulation_angle_deg"],
        "quality": result["quality"],
        "cameras_from": answer.get("given", "solve"),
        "world": answer.get("world", ""),
        "rung": answer.get("rung"),
        "tries": answer.get("tries", []),
        "agreement": answer.get("agreement"),
    }


def _pinhole(file: Path) -> NDArray[np.float64]:
    with np.load(file, allow_pickle=False) as data:
        return data["pinhole"]


def _lens(file: Path) -> dict[str, Any]:
    """A lens of the working frames: COLMAP's model name and parameters."""
    with np.load(file, allow_pickle=False) as data:
        return {"model": str(data["model"]), "params": data["params"].tolist()}


def _camera_path(
    frames: dict[str, Any], poses: dict[str, Any], pinholes: list[NDArray[np.float64]]
) -> tuple[CameraPath, list[int]]:
    """A camera for every frame (registered, localised, or interpolated in time), and the index of each frame's lens.

    `pinholes` are fx, fy, cx, cy of each lens. A frame without a pose gets the lens of the nearest frame with a pose.
    """
    listed = frames["frames"]
    names = [Path(f["file"]).name for f in listed]
    known = {i: np.array(poses[name]["pose"]) for i, name in enumerate(names) if name in poses}
    filled = fill_poses(np.array([f["seconds"] for f in listed]), known)
    nearest = _nearest(sorted(known), len(names))
    lenses = [int(poses[names[k]].get("lens", 0)) for k in nearest]
    cameras: list[CameraFrame] = []
    for frame, name, pose, lens in zip(listed, names, filled, lenses, strict=True):
        viewmat = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]]).ravel().tolist()
        source = poses[name]["source"] if name in poses else "interpolated"
        cameras.append(CameraFrame(frame["frame"], viewmat, pinholes[lens].tolist(), source))
    return CameraPath(frames["width"], frames["height"], cameras), lenses


def _nearest(known: list[int], count: int) -> list[int]:
    """For each of 0 to `count` - 1 the nearest of the ascending indices `known`; the lower one of two equally near."""
    spots = np.array(known)
    indices = np.arange(count)
    above = np.searchsorted(spots, indices).clip(0, len(spots) - 1)
    below = (above - 1).clip(0)
    return np.where(indices - spots[below] <= spots[above] - indices, spots[below], spots[above]).tolist()


def _centres(path: CameraPath) -> NDArray[np.float64]:
    return np.array([camera_centre(np.reshape(f.viewmat, (4, 4))) for f in path.frames])


def _undistort_all(inputs: SolveInputs, lenses: list[int], maps: list[Path], into: Staged, report: Reporter) -> None:
    """Writes the undistorted frames and masks, one lens at a time."""
    done = 0
    # One map in memory at a time: it takes 128 bytes per pixel.
    for number, file in enumerate(maps):
        rows = [frame for frame, lens in zip(inputs.frames["frames"], lenses, strict=True) if lens == number]
        if rows:
            _undistort(inputs, rows, file, into, (done, len(lenses)), report)
        done += len(rows)


def _undistort(
    inputs: SolveInputs,
    listed: list[dict[str, Any]],
    file: Path,
    into: Staged,
    counts: tuple[int, int],
    report: Reporter,
) -> None:
    """Writes the frames of one lens. `counts` holds the number of frames done before, and of all frames."""
    before, total = counts
    with np.load(file, allow_pickle=False) as data:
        where = data["where"]
    undistort = Undistorter(where)
    of_frame = of_frames(undistort, where, display_of(load_frames(inputs.shot)))

    def one(frame: dict[str, Any]) -> int:
        pixels = read_frame(inputs.shot.frames / frame["file"])
        write_png(into.frames / frame_file(frame["frame"], PICTURE), of_frame(pixels))
        if inputs.masks:
            write_undistorted(inputs.masks, frame["frame"], undistort, into.solve)
        return frame["frame"]

    with ThreadPoolExecutor(_WRITERS) as pool:
        waiting = [pool.submit(one, frame) for frame in listed]
        try:
            for done, future in enumerate(waiting, start=1 + before):
                report.check_cancelled()
                report.progress("solve: undistort", done, total, f"frame {future.result()}")
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _result(
    answer: dict[str, Any], path: CameraPath, solved: int, points: int, focal: float, misled: bool
) -> SolveResult:
    sources = [f.source for f in path.frames]
    error = round(float(answer["reprojection_error_px"]), 4)
    registered = int(answer["registered"])
    return SolveResult(
        frames=len(sources),
        solved_frames=solved,
        registered=registered,
        localised=sources.count("localised"),
        interpolated=sources.count("interpolated"),
        reprojection_error_px=error,
        points=points,
        focal_px=round(focal, 3),
        quality=quality_words(registered, solved, error, "given" in answer, misled),
    )


def _warnings(
    frames: dict[str, Any], path: CameraPath, result: SolveResult, is_imported: bool = False
) -> list[tuple[str, str]]:
    warnings: list[tuple[str, str]] = []
    lost = [
        camera.frame
        for camera, frame in zip(path.frames, frames["frames"], strict=True)
        if frame["solve"] and camera.source != "registered"
    ]
    if lost and not is_imported:  # missing imported cameras were reported when the file was matched
        warnings.append(
            (
                f"The mapper did not register {len(lost)} solved frames: {frame_words(lost)}.",
                "Their cameras are interpolated from their neighbours.",
            )
        )
    guessed = [i for i, camera in enumerate(path.frames) if camera.source == "interpolated"]
    placed = [i for i, camera in enumerate(path.frames) if camera.source != "interpolated"]
    clamped = [path.frames[i].frame for i in guessed if i < placed[0] or i > placed[-1]]
    if clamped:
        warnings.append(
            (
                f"The camera holds its pose before the first or after the last solved frame: {frame_words(clamped)}.",
                "Leave these frames out of the range.",
            )
        )
    if result["reprojection_error_px"] > FAIR_ERROR_PX:
        hint = "Check that they are for this clip and its lens." if is_imported else "Try the OPENCV camera model."
        warnings.append(("The reprojection error is high: the picture will be soft.", hint))
    return warnings
