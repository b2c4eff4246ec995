"""Imports cameras from a COLMAP model, a nerfstudio transforms.json, or a CameraPath, and matches them to frames.

Each format is converted to world-to-camera poses with OpenCV axes, and to lenses of four COLMAP models: PINHOLE,
OPENCV, FULL_OPENCV, OPENCV_FISHEYE. The module needs neither pycolmap nor the pictures.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..contract import (
    CAMERA_FACTS_KEY,
    LONGEST_ARRAYS,
    SCENE_WORLD,
    CameraPath,
    ExitCode,
    JobError,
    numbered_files,
    open_regular,
    printable,
    read_json,
)
from ..contract.files import is_json_object
from ..footage.pairing import Counted, Pairing, pair, pairing_words
from ..footage.sources import frame_words
from .colmap_files import ColmapModel, model_files, read_model
from .poses import camera_centre

LEAST_CAMERAS = 8
LEAST_SHARE = 0.25
"""Minimum share of the clip's frames with a camera: with fewer, most of the path would be interpolated."""
ASPECT_SLACK = 0.01
"""Tolerance of the aspect ratio, relative: rounding to whole pixels changes the ratio."""
RIGID_SLACK = 1e-2
"""Tolerance for a rotation R: the largest absolute element of R^T R - I."""
MODEL_FOLDERS = ("", "sparse/0", "sparse", "0", "colmap/sparse/0")
"""Subfolders of the chosen folder in which a COLMAP model is searched."""
_ANGLE_POINTS = 2000
_MOST_NOTES = 8
# File extensions that only Blender's importers read, see `splannequin_addon/solve/camera_file.py`.
_BLENDERS = (".abc", ".fbx", ".usd", ".usda", ".usdc", ".usdz")


@dataclass(frozen=True)
class Lens:
    """Projection of a camera: model and parameters."""

    model: str
    """PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    params: tuple[float, ...]
    """fx, fy, cx, cy in pixels, centres at +0.5, then the distortion coefficients in COLMAP's order."""

    def scaled(self, width: int, height: int) -> Lens:
        """The same lens for pictures of another size in pixels. The distortion coefficients do not change."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy, *bend = self.params
        return Lens(self.model, width, height, (fx * x, fy * y, cx * x, cy * y, *bend))


@dataclass
class ImportedCamera:
    """One camera of the file."""

    name: str
    """Name of its picture in the file."""
    pose: NDArray[np.float64]
    """[3, 4] world-to-camera, OpenCV axes."""
    lens: int
    """Index into `ImportedSolve.lenses`."""
    number: int | None = None
    """Frame number in the shot if the file states it; None if only the picture's name suggests one."""


@dataclass
class ImportedSolve:
    """Contents of a file with cameras."""

    path: Path
    """The file, or the folder of the model."""
    kind: str
    """COLMAP model, transforms.json or camera path."""
    lenses: list[Lens]
    """Lenses at the size of the pictures that were solved."""
    cameras: list[ImportedCamera]
    """In the file's order."""
    points: dict[str, Any] | None = None
    """xyz float64 [P, 3], rgb uint8 [P, 3], error float64 [P] px (negative: unknown), seen: P arrays of indices into
    `cameras`, empty where unknown. None if the file holds no points."""
    world: str = ""
    """Coordinate system of the cameras: `contract.SCENE_WORLD`, or empty if arbitrary."""
    notes: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """Messages of the file for the artist, as (sentence, hint)."""


@dataclass
class Matched:
    """Imported cameras assigned to the frames of a clip."""

    cameras: dict[int, ImportedCamera]
    """By frame number."""
    missing: list[int]
    """Frame numbers without a camera."""
    notes: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(sentence, hint) about the matching, if the pictures are numbered differently or the match is ambiguous."""


# ------------------------------------------------------------------------------------------------- finding and reading


def find(path: str | Path) -> tuple[str, list[Path]]:
    """(kind, files) of the cameras at a path; kind is "colmap" or "json". Raises JobError if it finds none."""
    path = Path(path)
    if not path.exists():
        raise _refusal(f"{path} does not exist.", "Name a COLMAP folder, a transforms.json or a camera path.")
    if path.is_file():
        if path.suffix.lower() == ".json":
            return "json", [path]
        if path.suffix.lower() in _BLENDERS:
            raise _refusal(
                f"Only Blender can read {path.name}.",
                "Solve in Blender, or with `blender --background --command splannequin`.",
            )
        path = path.parent  # the user chose one file of a COLMAP model
    for below in MODEL_FOLDERS:
        files = model_files(path / below)
        if files:
            return "colmap", files
    if (path / "transforms.json").is_file():
        return "json", [path / "transforms.json"]
    raise _refusal(
        f"{path} contains no cameras. It needs a COLMAP model (cameras and images, .bin or .txt, also in sparse/0) "
        "or a transforms.json.",
        "Choose the model's folder, or the file.",
    )


def fingerprint(path: str | Path) -> str:
    """SHA-256 of the files that `find` returns, used to skip a repeated import. Raises JobError as `find` does."""
    digest = hashlib.sha256()
    for file in find(path)[1]:
        digest.update(file.name.encode())
        with open_regular(file, LONGEST_ARRAYS) as source:
            while block := source.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def read(path: str | Path) -> ImportedSolve:
    """Reads the cameras at a path, in any supported format. Raises JobError (SOLVE) if they are unreadable."""
    kind, files = find(path)
    try:
        if kind == "colmap":
            return _from_colmap(files[0].parent)
        data = read_json(files[0])
        frames = data.get("frames")
        if not isinstance(frames, list) or not frames or not all(map(is_json_object, cast("list[Any]", frames))):
            raise ValueError(f"{files[0]} lists no frames, or some of its entries are not frames")
        return _from_path(files[0], data) if "viewmat" in frames[0] else _from_transforms(files[0], data)
    except (ValueError, TypeError) as error:
        raise _refusal(
            f"These cameras cannot be used: {printable(str(error)).rstrip('.')}.",
            "Export them again, or solve the camera here.",
        ) from error


# ------------------------------------------------------------------------------------------------- the three formats


def _from_colmap(folder: Path) -> ImportedSolve:
    model = read_model(folder)
    numbers = {camera: n for n, camera in enumerate(model.cameras)}
    lenses = [lens_from_colmap(c.model, c.width, c.height, c.params) for c in model.cameras.values()]
    cameras = [ImportedCamera(i.name, i.pose, numbers[i.camera]) for i in model.images]
    return ImportedSolve(folder, "COLMAP model", lenses, cameras, _colmap_points(model))


def _colmap_points(model: ColmapModel) -> dict[str, Any] | None:
    points = model.points
    if not len(points.xyz):
        return None
    at = {image.number: n for n, image in enumerate(model.images)}
    seen = [np.unique([at[i] for i in track.tolist() if i in at]).astype(np.int64) for track in points.tracks]
    return {"xyz": points.xyz, "rgb": points.rgb, "error": points.error, "seen": seen}


def lens_from_colmap(model: str, width: int, height: int, params: Sequence[float]) -> Lens:
    """Converts a COLMAP camera to one of the four lens models. Raises ValueError for an unsupported model."""
    p = tuple(map(float, params))
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        p = (p[0], *p)  # these models have a single focal length
    bend = (*p[4:], 0.0, 0.0, 0.0, 0.0)[:4]
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return _lens("PINHOLE", width, height, p)
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return _lens("OPENCV", width, height, (*p[:4], *bend))
    if model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return _lens("OPENCV_FISHEYE", width, height, (*p[:4], *bend))
    if model in ("OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"):
        return _lens(model, width, height, p)
    raise ValueError(f"the lens model {model} is not supported: use a pinhole, radial, OpenCV or OpenCV fisheye model")


def _lens(model: str, width: int, height: int, params: tuple[float, ...]) -> Lens:
    if width < 1 or height < 1:
        raise ValueError(f"a camera's image size is {width} x {height} pixels")
    if not all(map(math.isfinite, params)) or params[0] <= 0 or params[1] <= 0:
        raise ValueError("a focal length is not above 0, or a lens parameter is not finite")
    if model != "OPENCV_FISHEYE" and not any(params[4:]):
        return Lens("PINHOLE", width, height, params[:4])
    return Lens(model, width, height, params)


def _from_path(file: Path, data: dict[str, Any]) -> ImportedSolve:
    path = CameraPath.from_json(data)
    lenses: dict[Lens, int] = {}
    cameras: list[ImportedCamera] = []
    for frame in path.frames:
        lens = lenses.setdefault(_lens("PINHOLE", path.width, path.height, tuple(frame.K)), len(lenses))
        pose = _rigid(np.reshape(frame.viewmat, (4, 4)), f"frame {frame.frame}")
        cameras.append(ImportedCamera(f"frame {frame.frame}", pose, lens, frame.frame))
    return ImportedSolve(file, "camera path", list(lenses), cameras)


def _from_transforms(file: Path, data: dict[str, Any]) -> ImportedSolve:
    """Cameras of a nerfstudio transforms.json: camera-to-world, OpenGL axes.

    Lens values at the top level of the file are the defaults for frames that lack them.
    """
    lenses: dict[Lens, int] = {}
    cameras: list[ImportedCamera] = []
    extra: Any = data.get(CAMERA_FACTS_KEY)
    facts = cast("dict[str, Any]", extra) if isinstance(extra, dict) else {}
    for n, frame in enumerate(data["frames"]):
        name = frame.get("file_path")
        matrix = np.array(frame.get("transform_matrix", []), np.float64)
        if not isinstance(name, str) or matrix.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"frame {n} of {file} has no file_path or no transform_matrix of 4 x 4 numbers")
        full = np.eye(4)
        full[: len(matrix)] = matrix
        rotated = _rigid(full, name) * [1.0, -1.0, -1.0, 1.0]  # OpenGL camera axes to OpenCV's
        pose = np.concatenate([rotated[:, :3].T, -(rotated[:, :3].T @ rotated[:, 3:])], axis=1)
        lens = lenses.setdefault(_transforms_lens(file, {**data, **frame}), len(lenses))
        number = int(Path(name).stem) if facts.get("is_numbered_as_shot") is True else None
        cameras.append(ImportedCamera(name, pose, lens, number))
    world = SCENE_WORLD if facts.get("world") == SCENE_WORLD else ""
    return ImportedSolve(file, "transforms.json", list(lenses), cameras, None, world, _notes(facts))


def _notes(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Messages for the artist that Blender stored in the file, as (sentence, hint). Skips malformed rows."""
    rows: Any = facts.get("notes")
    rows = cast("list[Any]", rows) if isinstance(rows, list) else []
    pairs = [cast("list[Any]", row) for row in rows[:_MOST_NOTES] if isinstance(row, list)]
    pairs = [row for row in pairs if len(row) == 2 and all(isinstance(text, str) for text in row)]
    return [(printable(sentence, 300), printable(hint, 300)) for sentence, hint in pairs]


def _transforms_lens(file: Path, values: dict[str, Any]) -> Lens:
    def number(name: str, otherwise: float | None = None) -> float:
        value = values.get(name, otherwise)
        if value is None or isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{file} has no {name}, so the lens is unknown")
        return float(value)

    width, height = int(number("w")), int(number("h"))
    if "fl_x" not in values and "camera_angle_x" in values:  # instant-ngp's key, radians
        values = {**values, "fl_x": 0.5 * width / math.tan(0.5 * number("camera_angle_x"))}
    fx = number("fl_x")
    pinhole = (fx, number("fl_y", fx), number("cx", 0.5 * width), number("cy", 0.5 * height))
    k1, k2, k3, k4, p1, p2 = (number(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(values.get("camera_model", "OPENCV"))
    if model == "OPENCV_FISHEYE":
        return _lens(model, width, height, (*pinhole, k1, k2, k3, k4))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"):
        raise ValueError(f"the camera_model {model} in {file} is not supported: use OPENCV or OPENCV_FISHEYE")
    if k4:
        raise ValueError(f"{file} has a k4 for a lens that is not a fisheye, which is not supported")
    if k3:
        return _lens("FULL_OPENCV", width, height, (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    return _lens("OPENCV", width, height, (*pinhole, k1, k2, p1, p2))


def _rigid(matrix: NDArray[Any], name: str) -> NDArray[np.float64]:
    """The [3, 4] pose of a rigid [4, 4] matrix, with an exact rotation.

    Raises ValueError if the matrix is not finite or not rigid.
    """
    if not np.isfinite(matrix).all():
        raise ValueError(f"the camera of {name} is not finite")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_SLACK or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"the camera of {name} is scaled, sheared or mirrored: only a rotation and a position are supported"
        )
    # The nearest exact rotation: files round their numbers.
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, matrix[:3, 3:]], axis=1)


# ------------------------------------------------------------------------------------------------- matching


def match(
    solve: ImportedSolve, counted: Counted, size: tuple[int, int], solved: Sequence[int] | None = None
) -> Matched:
    """Assigns a camera to each frame by the numbers in the picture names, see `pairing`.

    Args:
        solve: the imported cameras.
        counted: the shot's frames.
        size: width and height of the working frames in pixels.
        solved: frame numbers used in training; None: all.

    Raises:
        JobError: too few training frames have a camera, several sequences of pictures match the clip, or the pictures
            have another aspect ratio.
    """
    frames = counted.frames
    needed = list(frames if solved is None else solved)
    least = max(min(LEAST_CAMERAS, len(needed)), LEAST_SHARE * len(needed))
    tables = _tables(solve)
    shifts = any(c.number is None for c in solve.cameras)  # frame numbers of the shot need no shift
    paired = [(name, table, pair(sorted(table), counted, may_shift=shifts)) for name, table in tables.items()]
    fitting = [one for one in paired if sum(n in one[2].numbers for n in needed) >= least]
    fitting = [one for one in fitting if one[2].by_frame_number] or fitting
    if len(fitting) > 1:
        names = ", ".join(name for name, _, _ in fitting[:4])
        raise _refusal(
            f"The cameras' pictures form {len(fitting)} sequences that could be this clip: {names}.",
            "Use a solve of this clip only.",
        )
    closest = max(fitting or paired, key=lambda one: len(one[1]), default=None)
    table, chosen = closest[1:] if closest else ({}, Pairing({}))
    cameras = {frame: table[number] for frame, number in chosen.numbers.items()}
    missing = [n for n in frames if n not in cameras]
    found = sum(n in cameras for n in needed)
    if not fitting:
        numbering = (
            f"its pictures are numbered {min(table)} to {max(table)}" if table else "its pictures have no numbers"
        )
        raise _refusal(
            f"Only {found} of the {len(needed)} frames needed, from {frames[0]} to {frames[-1]}, have a camera in "
            f"{solve.path.name or solve.path}: {numbering}.",
            "Pictures are matched by the frame number in their names: number them like the clip's frames.",
        )
    for lens in (solve.lenses[n] for n in sorted({c.lens for c in cameras.values()})):
        ratio = (lens.width / lens.height) / (size[0] / size[1])
        if abs(ratio - 1.0) > ASPECT_SLACK:
            raise _refusal(
                f"The cameras' pictures are {lens.width} x {lens.height} pixels, but the shot's frames have another "
                f"aspect ratio, {size[0]} x {size[1]}.",
                "Use cameras of the same, uncropped clip.",
            )
    words = pairing_words("The cameras' file", sorted(table), chosen)
    return Matched(cameras, missing, [words] if words else [])


def _tables(solve: ImportedSolve) -> dict[str, dict[int, ImportedCamera]]:
    """Pattern of each picture sequence in the file -> cameras by number. Raises JobError for duplicate numbers."""
    if all(c.number is not None for c in solve.cameras):
        return {"": {c.number: c for c in solve.cameras if c.number is not None}}
    of_name: dict[str, ImportedCamera] = {}
    for camera in solve.cameras:
        name = camera.name.replace("\\", "/")
        if name in of_name:
            raise _refusal(f"{name} has two cameras in {solve.path.name}.", "Use a solve of this clip only.")
        of_name[name] = camera
    tables: dict[str, dict[int, ImportedCamera]] = {}
    for found in numbered_files(of_name):
        if found.twice:
            raise _refusal(
                f"The pictures {found.twice[0]} and {found.twice[1]} of the cameras have the same frame number.",
                "Use a solve of this clip only.",
            )
        tables[found.pattern] = {number: of_name[name] for number, name in found.files.items()}
    return tables


def remarks(solve: ImportedSolve, matched: Matched) -> list[tuple[str, str]]:
    """Messages for the artist about the import and the matching, as (sentence, hint)."""
    remarks = [*solve.notes, *matched.notes]
    if matched.missing:
        remarks.append(
            (
                f"{len(matched.missing)} frames have no camera in {solve.path.name}: {frame_words(matched.missing)}.",
                "Their cameras are interpolated from their neighbours.",
            )
        )
    return remarks


def stored_points(solve: ImportedSolve, matched: Matched, size: tuple[int, int]) -> dict[str, NDArray[Any]] | None:
    """The imported points in the layout of points.npz, before filtering. None if the file holds no points.

    Returns:
        xyz float32 [P, 3]; rgb uint8 [P, 3]; error float32 [P] in px of the working frames (0 where unknown).
        track uint16 [P]: number of the clip's cameras that see the point. Without tracks in the file, the number of
        cameras whose picture contains the point.
        depth float32 [P]: smallest depth over these cameras; -inf if there are none.
        angle float64 []: median over points of the widest triangulation angle, degrees.
    """
    if solve.points is None:
        return None
    chosen = list(matched.cameras.values())
    indices = {id(camera): n for n, camera in enumerate(solve.cameras)}
    row_of = {indices[id(camera)]: n for n, camera in enumerate(chosen)}
    xyz = solve.points["xyz"]
    poses = np.array([camera.pose for camera in chosen])
    lenses = [solve.lenses[c.lens] for c in chosen]
    pictures = np.array([[*lens.params[:4], lens.width, lens.height] for lens in lenses])
    has_tracks = any(len(seen) for seen in solve.points["seen"])
    track, depth, scale = np.zeros(len(xyz)), np.full(len(xyz), -np.inf), np.ones(len(xyz))
    sight: list[NDArray[np.int64]] = []
    for n, seen in enumerate(solve.points["seen"]):
        at = poses[:, :, :3] @ xyz[n] + poses[:, :, 3]
        if has_tracks:
            rows = np.array([row_of[i] for i in seen.tolist() if i in row_of], np.int64)
        else:
            rows = _in_picture(at, pictures)
        track[n] = len(rows)
        if len(rows):
            depth[n], scale[n] = at[rows, 2].min(), (size[0] / pictures[rows, 4]).mean()
        sight.append(rows)
    return {
        "xyz": xyz.astype(np.float32),
        "rgb": solve.points["rgb"],
        "error": (np.maximum(np.nan_to_num(solve.points["error"], nan=0.0), 0.0) * scale).astype(np.float32),
        "track": np.minimum(track, 65535).astype(np.uint16),
        "depth": depth.astype(np.float32),
        "angle": np.array(_angle(xyz, poses, sight)),
    }


def _in_picture(at: NDArray[Any], pictures: NDArray[Any]) -> NDArray[np.int64]:
    """Indices of the cameras whose undistorted picture contains a point.

    `at` [C, 3] is the point in the axes of each camera; `pictures` [C, 6] holds fx, fy, cx, cy, width, height.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = pictures[:, :2] * at[:, :2] / at[:, 2:] + pictures[:, 2:4]
    return np.flatnonzero((at[:, 2] > 0) & ((pixels >= 0) & (pixels < pictures[:, 4:])).all(axis=1))


def _angle(xyz: NDArray[Any], poses: NDArray[Any], sight: list[NDArray[np.int64]]) -> float:
    centres = np.array([camera_centre(pose) for pose in poses])
    angles: list[float] = []
    for n in range(0, len(xyz), max(1, len(xyz) // _ANGLE_POINTS)):
        rays = centres[sight[n]] - xyz[n]
        lengths = np.linalg.norm(rays, axis=1, keepdims=True)
        if len(rays) < 2 or not (lengths > 0).all():
            continue
        rays = rays / lengths
        angles.append(math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return float(np.median(angles)) if angles else 0.0


def _refusal(message: str, hint: str) -> JobError:
    return JobError(message, hint, ExitCode.SOLVE)
