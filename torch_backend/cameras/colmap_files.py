"""Reads and writes COLMAP models (cameras, images and points3D, as .bin or .txt) without COLMAP.

The format is documented at https://colmap.github.io/format.html: world-to-camera poses as a quaternion wxyz and a
translation, OpenCV axes, pixel centres at +0.5. The reader skips the 2D keypoints of images. It validates all values,
because the folder may come from an untrusted source.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import LONGEST_ARRAYS, MissingError, UnreadableFile, open_regular
from ..shot import atomic_path
from .poses import quat_to_rotation, rotation_to_quat

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
"""COLMAP's id of a camera model -> (name, number of parameters)."""
PARTS = ("cameras", "images", "points3D")
_MOST_POINTS = 50_000_000
_PIXEL_BYTES = 24


@dataclass
class ColmapCamera:
    """One camera. Several images may share it."""

    number: int
    """COLMAP's camera id."""
    model: str
    """Name of the camera model."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    params: tuple[float, ...]
    """Parameters in COLMAP's order for this model."""


@dataclass
class ColmapImage:
    """One image and its pose."""

    number: int
    """COLMAP's image id."""
    name: str
    """File name, relative to the folder of images."""
    camera: int
    """Id of the camera that took the image."""
    pose: NDArray[np.float64]
    """[3, 4] world-to-camera, OpenCV axes."""


@dataclass
class ColmapPoints:
    """The sparse points."""

    xyz: NDArray[np.float64]
    """[P, 3]."""
    rgb: NDArray[np.uint8]
    """[P, 3]."""
    error: NDArray[np.float64]
    """[P] mean reprojection error in pixels of the images; negative where unknown."""
    tracks: list[NDArray[np.int64]]
    """P arrays: ids of the images that see each point; empty where unknown."""


@dataclass
class ColmapModel:
    """Contents of a COLMAP model folder."""

    cameras: dict[int, ColmapCamera]
    """By id."""
    images: list[ColmapImage]
    """In the file's order."""
    points: ColmapPoints
    """May be empty."""


def model_files(folder: Path) -> list[Path]:
    """The files of the COLMAP model in a folder; empty if the folder holds no model.

    The .bin files take precedence over the .txt files, as in COLMAP. The points3D file is optional: the poses are
    useful without points.
    """
    for suffix in (".bin", ".txt"):
        found = [folder / (part + suffix) for part in PARTS]
        if found[0].is_file() and found[1].is_file():
            return [path for path in found if path.is_file()]
    return []


def read_model(folder: Path) -> ColmapModel:
    """Reads the COLMAP model in a folder.

    Raises:
        FileNotFoundError: the folder holds no model.
        ValueError: a file is damaged or truncated, or has an unknown camera model. The message names the file.
    """
    files = model_files(folder)
    if not files:
        raise MissingError(f"{folder} contains no COLMAP model (cameras and images, as .bin or .txt)")
    binary = files[0].suffix == ".bin"
    points = ColmapPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), [])
    at = files[0]
    try:
        cameras = {c.number: c for c in (_cameras_bin(at) if binary else _cameras_txt(at))}
        at = files[1]
        images = list(_images_bin(at) if binary else _images_txt(at))
        if len(files) > 2:
            at = files[2]
            points = _points_bin(at) if binary else _points_txt(at)
    except UnreadableFile:
        raise
    except (struct.error, IndexError, OverflowError, UnicodeDecodeError) as error:
        raise ValueError(f"{at} is not a COLMAP model file, or it is truncated: {error}") from error
    except ValueError as error:
        raise ValueError(f"{at} is not a COLMAP model file: {error}") from error
    for image in images:
        if image.camera not in cameras:
            raise ValueError(
                f"{files[1]}: image {image.name} uses camera {image.camera}, which is missing from {files[0].name}"
            )
    return ColmapModel(cameras, images, points)


def write_model(folder: Path, model: ColmapModel, text: bool = False) -> list[Path]:
    """Writes a model into a folder, as .txt if `text`, otherwise as .bin. Returns the files.

    Creates the folder if it is missing. Does not write tracks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    suffix = ".txt" if text else ".bin"
    written = [folder / (part + suffix) for part in PARTS]
    contents = (
        (_cameras_as_text(model), _images_as_text(model), _points_as_text(model))
        if text
        else (_cameras_as_bytes(model), _images_as_bytes(model), _points_as_bytes(model))
    )
    for path, content in zip(written, contents, strict=True):
        with atomic_path(path) as partial:
            partial.write_bytes(content)
    return written


# ------------------------------------------------------------------------------------------------- reading


class _Bytes:
    """Sequential reader of a binary file. Raises struct.error if the file ends too early."""

    def __init__(self, path: Path) -> None:
        with open_regular(path, LONGEST_ARRAYS) as source:
            self.data = source.read()
        self.at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def word(self) -> str:
        end = self.data.index(b"\0", self.at)
        start, self.at = self.at, end + 1
        return self.data[start:end].decode("utf-8")

    def skip(self, count: int) -> None:
        if count < 0 or self.at + count > len(self.data):
            raise struct.error("it ends too early")
        self.at += count


def _camera(number: int, model: str, width: int, height: int, params: tuple[float, ...]) -> ColmapCamera:
    counts = {name: count for name, count in MODELS.values()}
    if model in counts and len(params) != counts[model]:
        raise ValueError(f"camera {number} is {model} with {len(params)} parameters instead of {counts[model]}")
    if not (width > 0 and height > 0 and all(map(math.isfinite, params))):
        raise ValueError(f"camera {number} has no size or its parameters are not finite")
    return ColmapCamera(number, model, width, height, params)


def _image(number: int, name: str, camera: int, quat: tuple[float, ...], shift: tuple[float, ...]) -> ColmapImage:
    if not all(map(math.isfinite, (*quat, *shift))) or math.hypot(*quat) < 1e-9:
        raise ValueError(f"the pose of image {name} is not finite")
    rotation = quat_to_rotation(np.array(quat))
    return ColmapImage(number, name, camera, np.concatenate([rotation, np.array(shift)[:, None]], axis=1))


def _cameras_bin(path: Path) -> Iterator[ColmapCamera]:
    file = _Bytes(path)
    for _ in range(file.take("Q")[0]):
        number, model, width, height = file.take("iiQQ")
        if model not in MODELS:  # without the number of parameters, the next record cannot be located
            raise ValueError(f"camera {number} has the unknown model number {model}")
        name, count = MODELS[model]
        yield _camera(number, name, width, height, file.take(f"{count}d"))


def _images_bin(path: Path) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    for _ in range(file.take("Q")[0]):
        number, *pose, camera = file.take("i7di")
        name = file.word()
        file.skip(file.take("Q")[0] * _PIXEL_BYTES)
        yield _image(number, name, camera, tuple(pose[:4]), tuple(pose[4:]))


def _points_bin(path: Path) -> ColmapPoints:
    file = _Bytes(path)
    count = file.take("Q")[0]
    if count > _MOST_POINTS:
        raise ValueError(f"it claims to have {count} points")
    rows: list[list[float]] = []
    tracks: list[NDArray[np.int64]] = []
    for _ in range(count):
        *row, length = file.take("Q3d3BdQ")
        start = file.at
        file.skip(8 * length)
        tracks.append(np.frombuffer(file.data, "<i4", 2 * length, start)[::2].astype(np.int64))
        rows.append(row[1:])
    return _points(rows, tracks)


def _points(rows: list[list[float]], tracks: list[NDArray[np.int64]]) -> ColmapPoints:
    table = np.array(rows, np.float64).reshape(-1, 7)
    return ColmapPoints(table[:, :3], np.clip(table[:, 3:6], 0, 255).astype(np.uint8), table[:, 6], tracks)


def _lines(path: Path) -> list[str]:
    """The lines of a text file without comments. Keeps empty lines."""
    with open_regular(path, LONGEST_ARRAYS) as source:
        text = source.read().decode("utf-8")
    # Empty lines stay: an image without keypoints has one.
    return [line for line in text.splitlines() if not line.lstrip().startswith("#")]


def _cameras_txt(path: Path) -> Iterator[ColmapCamera]:
    for line in _lines(path):
        if not line.strip():
            continue
        number, model, width, height, *params = line.split()
        yield _camera(int(number), model, int(width), int(height), tuple(map(float, params)))


def _images_txt(path: Path) -> Iterator[ColmapImage]:
    lines = _lines(path)
    at = 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        number, *pose, name = lines[at].split(maxsplit=9)
        camera = int(pose.pop())
        values = tuple(map(float, pose))
        yield _image(int(number), name.strip(), camera, values[:4], values[4:])
        at += 2  # the second line of an image holds its keypoints


def _points_txt(path: Path) -> ColmapPoints:
    rows: list[list[float]] = []
    tracks: list[NDArray[np.int64]] = []
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 8:
            raise ValueError(f"a point has {len(words)} values instead of 8 or more")
        rows.append([float(w) for w in words[1:8]])
        tracks.append(np.array([int(w) for w in words[8::2]], np.int64))
    return _points(rows, tracks)


# ------------------------------------------------------------------------------------------------- writing


def _cameras_as_bytes(model: ColmapModel) -> bytes:
    numbers = {name: number for number, (name, _) in MODELS.items()}
    parts = [struct.pack("<Q", len(model.cameras))]
    for c in model.cameras.values():
        parts.append(struct.pack("<iiQQ", c.number, numbers[c.model], c.width, c.height))
        parts.append(struct.pack(f"<{len(c.params)}d", *c.params))
    return b"".join(parts)


def _images_as_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.images))]
    for image in model.images:
        pose = [*rotation_to_quat(image.pose[:, :3]), *image.pose[:, 3]]
        parts.append(struct.pack("<i7di", image.number, *pose, image.camera))
        parts.append(image.name.encode("utf-8") + b"\0" + struct.pack("<Q", 0))
    return b"".join(parts)


def _points_as_bytes(model: ColmapModel) -> bytes:
    points = model.points
    parts = [struct.pack("<Q", len(points.xyz))]
    rows = zip(points.xyz.tolist(), points.rgb.tolist(), points.error.tolist(), strict=True)
    # Tracks of length 0: they would index keypoints, and COLMAP rejects tracks without keypoints.
    parts += [struct.pack("<Q3d3BdQ", n, *xyz, *rgb, error, 0) for n, (xyz, rgb, error) in enumerate(rows, start=1)]
    return b"".join(parts)


def _numbers(values: NDArray[Any] | tuple[float, ...]) -> str:
    """Numbers as text with enough digits to restore the same float64 values."""
    return " ".join(repr(float(v)) for v in values)


def _cameras_as_text(model: ColmapModel) -> bytes:
    rows = [f"{c.number} {c.model} {c.width} {c.height} {_numbers(c.params)}" for c in model.cameras.values()]
    return _text("CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", rows)


def _images_as_text(model: ColmapModel) -> bytes:
    rows: list[str] = []
    for i in model.images:
        pose = np.concatenate([rotation_to_quat(i.pose[:, :3]), i.pose[:, 3]])
        rows += [f"{i.number} {_numbers(pose)} {i.camera} {i.name}", ""]
    return _text("IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of POINTS2D[]", rows)


def _points_as_text(model: ColmapModel) -> bytes:
    points = model.points
    rows = [
        f"{n} {_numbers(xyz)} {' '.join(map(str, rgb.tolist()))} {float(error)!r}"
        for n, (xyz, rgb, error) in enumerate(zip(points.xyz, points.rgb, points.error, strict=True), start=1)
    ]
    return _text("POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)", rows)


def _text(head: str, rows: list[str]) -> bytes:
    return ("\n".join([f"# {head}", *rows]) + "\n").encode("utf-8")
