"""Exports the solve to other programs: as a COLMAP model, a nerfstudio transforms.json, or a camera for Nuke.

The export does not copy pictures. A COLMAP model lists the file names of the plates in the shot's frames/ folder; a
transforms.json stores paths to them. Both keep the axes and units of the solve unless the caller names a placement, so
that an exported solve can be imported again. The camera for Nuke uses the shot's placement in Blender's scene.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import PICTURE, CameraPath, ExitCode, JobError, UserError, frame_file
from ..shot import Shot, write_atomic, write_json
from .colmap_files import PARTS, ColmapCamera, ColmapImage, ColmapModel, ColmapPoints, write_model
from .nuke import chan_text, nk_text
from .placement import Similarity, path_viewmats, placement_for
from .stored import load_cameras, load_points

FORMATS = ("colmap", "nerfstudio", "chan", "nk")
_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def export_cameras(shot: Shot, kind: str, folder: Path, text: bool = False, placement: str = "") -> list[Path]:
    """Writes the cameras and points of a solved shot for other programs.

    Args:
        shot: a solved shot.
        kind: one of `FORMATS`. colmap: cameras, images and points3D, PINHOLE. nerfstudio: transforms.json and
            points.ply. chan, nk: the animated camera in Nuke's axes, camera.chan or camera.nk.
        folder: output folder; created if it is missing.
        text: write a COLMAP model as .txt instead of .bin.
        placement: see `placement_for`; for colmap and nerfstudio, empty keeps the axes and units of the solve.

    Returns:
        The files written.

    Raises:
        ValueError: `kind` is not in `FORMATS`, or the file `placement` holds no placement.
        JobError: the shot is not solved, or the folder already holds a COLMAP model in the other format (.bin, .txt).
    """
    if kind not in FORMATS:
        raise UserError(f"format is {kind!r}: it should be one of {', '.join(FORMATS)}")
    path, points = load_cameras(shot), load_points(shot)
    where = Similarity.of(placement_for(shot, placement))
    if kind in ("chan", "nk"):
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"camera.{kind}"
        write_atomic(file, (chan_text if kind == "chan" else nk_text)(path, where, shot.info().name).encode())
        return [file]
    if placement:
        path, points = moved(path, where), {**points, "xyz": where.points(points["xyz"])}
    if kind == "nerfstudio":
        return _write_transforms(shot, path, points, folder)
    conflicting = [folder / (part + (".bin" if text else ".txt")) for part in PARTS]
    existing = next((file for file in conflicting if file.is_file()), None)
    if existing is not None:
        raise JobError(
            f"{folder} already contains another COLMAP model ({existing.name}).",
            "Choose another folder.",
            ExitCode.USAGE,
        )
    return write_model(folder, _model(path, points), text)


def moved(path: CameraPath, where: Similarity) -> CameraPath:
    """A camera path in solve units, transformed to the scene by `where`."""
    viewmats = where.viewmats(path_viewmats(path))
    frames = [dataclasses.replace(f, viewmat=v.ravel().tolist()) for f, v in zip(path.frames, viewmats, strict=True)]
    return dataclasses.replace(path, frames=frames)


def _model(path: CameraPath, points: dict[str, NDArray[Any]]) -> ColmapModel:
    lenses: dict[tuple[float, ...], int] = {}
    images: list[ColmapImage] = []
    for number, frame in enumerate(path.frames, start=1):
        lens = lenses.setdefault(tuple(frame.K), len(lenses) + 1)
        pose = np.reshape(np.array(frame.viewmat, np.float64), (4, 4))[:3]
        images.append(ColmapImage(number, frame_file(frame.frame, PICTURE), lens, pose))
    cameras = {n: ColmapCamera(n, "PINHOLE", path.width, path.height, K) for K, n in lenses.items()}
    xyz, error = points["xyz"].astype(np.float64), points["error"].astype(np.float64)
    return ColmapModel(cameras, images, ColmapPoints(xyz, points["rgb"], error, [np.zeros(0, np.int64)] * len(xyz)))


def _write_transforms(shot: Shot, path: CameraPath, points: dict[str, NDArray[Any]], folder: Path) -> list[Path]:
    shared = path.frames[0].K
    frames: list[dict[str, Any]] = []
    for frame in path.frames:
        to_world = np.linalg.inv(np.reshape(np.array(frame.viewmat, np.float64), (4, 4))) @ _TO_OPENGL
        row: dict[str, Any] = {"file_path": _seen_from(folder, shot.plate(frame.frame))}
        row["transform_matrix"] = to_world.tolist()
        if shared != frame.K:
            row |= _intrinsics(frame.K)
        frames.append(row)
    data: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "w": path.width,
        "h": path.height,
        **_intrinsics(shared),
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "points.ply", _ply(points["xyz"], points["rgb"]))
    write_json(folder / "transforms.json", data)
    return [folder / "transforms.json", folder / "points.ply"]


def _intrinsics(K: list[float]) -> dict[str, float]:
    return dict(zip(("fl_x", "fl_y", "cx", "cy"), K, strict=True))


def _seen_from(folder: Path, file: Path) -> str:
    """A file's path relative to a folder, with forward slashes; absolute if the file is on another drive."""
    try:
        return Path(os.path.relpath(file, folder.absolute())).as_posix()
    except ValueError:
        return file.as_posix()


def _ply(xyz: NDArray[Any], rgb: NDArray[Any]) -> bytes:
    """Points with colours as binary PLY."""
    rows = np.empty(len(xyz), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    rows["xyz"], rows["rgb"] = xyz, rgb
    names = [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *names, "end_header", ""]
    return "\n".join(head).encode("ascii") + rows.tobytes()
