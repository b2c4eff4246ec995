"""Typed wrappers of pycolmap calls: each function is one call and a cast. Only `worker.py` and its parts use them.

pycolmap's stubs name bare `os.PathLike`, `dict` and containers without the types of their elements.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pycolmap
from numpy.typing import NDArray

_colmap = cast(Any, pycolmap)


def cameras(model: pycolmap.Reconstruction) -> Mapping[int, pycolmap.Camera]:
    """Cameras by their ids."""
    return cast(Any, model).cameras


def images(model: pycolmap.Reconstruction) -> Mapping[int, pycolmap.Image]:
    """Images by their ids, also those without a pose."""
    return cast(Any, model).images


def points(model: pycolmap.Reconstruction) -> Mapping[int, pycolmap.Point3D]:
    """Points by their ids."""
    return cast(Any, model).points3D


def pose(image: pycolmap.Image) -> NDArray[np.float64]:
    """[3, 4] world-to-camera matrix of an image that has a pose."""
    return cast(Any, image).cam_from_world().matrix()


def write_binary(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Writes cameras.bin, images.bin, points3D.bin and COLMAP's further files into an existing folder."""
    cast(Any, model).write_binary(folder)


def open_database(file: Path) -> pycolmap.Database:
    """Opens a database, creating it if it is missing. The caller closes it."""
    return _colmap.Database.open(file)


def import_images(
    database: Path, folder: Path, mode: pycolmap.CameraMode, names: Sequence[str], reader: pycolmap.ImageReaderOptions
) -> None:
    """Adds images to the database, numbered in the order of `names`."""
    _colmap.import_images(database, folder, mode, names, reader)


def extract_features(
    database: Path,
    folder: Path,
    mode: pycolmap.CameraMode,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    options: pycolmap.FeatureExtractionOptions,
) -> None:
    """Extracts features of images into the database, on the CPU."""
    _colmap.extract_features(
        database,
        folder,
        image_names=names,
        camera_mode=mode,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def match_image_pairs(
    database: Path,
    options: pycolmap.FeatureMatchingOptions,
    pairing: pycolmap.ImportedPairingOptions,
    geometry: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Matches the pairs listed in a file, on the CPU."""
    _colmap.match_image_pairs(database, options, pairing, geometry, device=pycolmap.Device.cpu)


def incremental_mapping(
    database: Path,
    folder: Path,
    into: Path,
    options: pycolmap.IncrementalPipelineOptions,
    next_image: Callable[[], None],
) -> dict[int, pycolmap.Reconstruction]:
    """Models by number. `next_image` is called after each image that is registered."""
    return _colmap.incremental_mapping(database, folder, into, options, next_image_callback=next_image)


def global_mapping(
    database: Path, folder: Path, into: Path, options: pycolmap.GlobalPipelineOptions
) -> dict[int, pycolmap.Reconstruction]:
    """Models by number."""
    return _colmap.global_mapping(database, folder, into, options)


def calibrate_view_graph(database: Path) -> None:
    """Estimates focal lengths from the two-view geometries and writes them to the database."""
    _colmap.calibrate_view_graph(database)


def triangulate_points(
    known: pycolmap.Reconstruction,
    database: Path,
    folder: Path,
    into: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """Triangulates the points of a model with its cameras fixed. Its former points are cleared."""
    return _colmap.triangulate_points(known, database, folder, into, True, options)


def adjust(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Runs bundle adjustment on a whole model, in place."""
    _colmap.bundle_adjustment(model, options)


def absolute_pose(
    xy: NDArray[np.float64],
    xyz: NDArray[np.float64],
    camera: pycolmap.Camera,
    options: pycolmap.AbsolutePoseEstimationOptions,
) -> tuple[NDArray[np.float64], int] | None:
    """World-to-camera pose [3, 4] from pixels [N, 2] and points [N, 3], and its number of inliers; None on failure."""
    found = _colmap.estimate_and_refine_absolute_pose(xy, xyz, camera, options)
    return (found["cam_from_world"].matrix(), int(found["num_inliers"])) if found is not None else None
