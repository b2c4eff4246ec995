"""Files that the worker writes next to its request, in formats that need no pycolmap."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..contract import POINTS_FILE
from ..lens.zoom import focal_change
from . import colmap_types as colmap
from .mapping import first_camera, registered_images
from .request import Request

WIDEST_ZOOM = 16.0


def write_answers(request: Request, model: pycolmap.Reconstruction, poses: dict[str, dict[str, Any]]) -> None:
    """Writes everything the parent needs, in formats that it reads without pycolmap."""
    folder = request.scratch / "model"
    folder.mkdir()
    colmap.write_binary(model, folder)
    write_points(request, model)
    (request.scratch / "poses.json").write_text(json.dumps(poses), encoding="utf-8")
    write_undistortion(request, first_camera(model), 0)


def write_points(request: Request, model: pycolmap.Reconstruction) -> None:
    """Writes points.npz of a model, which the parent filters."""
    points = [point for _, point in sorted(colmap.points(model).items())]
    np.savez(
        request.scratch / POINTS_FILE,
        xyz=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        rgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        error=np.array([p.error for p in points], np.float32),
        track=np.array([min(p.track.length(), 65535) for p in points], np.uint16),
        depth=smallest_depths(model, points),
    )


def focal_changes(model: pycolmap.Reconstruction) -> dict[str, float | None]:
    """Maps the name of each posed image to its `zoom.focal_change`, or to None where that is unknown."""
    xyz, found = {number: p.xyz for number, p in colmap.points(model).items()}, dict[str, float | None]()
    camera = first_camera(model)
    for image in registered_images(model):
        observed = [p for p in image.points2D if p.has_point3D()]
        seen = np.array(camera.cam_from_img(np.array([p.xy for p in observed], np.float64).reshape(-1, 2)), np.float64)
        points = np.array([xyz[p.point3D_id] for p in observed], np.float64).reshape(-1, 3)
        change = focal_change(seen, points, colmap.pose(image), camera.mean_focal_length())
        found[image.name] = change if np.isfinite(change) else None
    return found


def write_undistortion(request: Request, camera: pycolmap.Camera, number: int) -> None:
    """Writes a lens and its `undistortion` to undistort_N.npz, for the parent."""
    pinhole, where = undistortion(camera)
    file = request.scratch / f"undistort_{number}.npz"
    np.savez(file, pinhole=pinhole, where=where, model=camera.model_name, params=camera.params)


def smallest_depths(model: pycolmap.Reconstruction, points: list[pycolmap.Point3D]) -> NDArray[np.float32]:
    """[P]: smallest depth of each point over the images that see it, in solve units."""
    rows = {image.image_id: colmap.pose(image)[2] for image in registered_images(model)}
    return np.array(
        [min(float(rows[e.image_id] @ np.append(p.xyz, 1.0)) for e in p.track.elements) for p in points], np.float32
    )


def undistortion(camera: pycolmap.Camera) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The pinhole camera of the undistorted frames, and the position of each of its pixels in the distorted frames.

    The pinhole camera keeps the size and the principal point. Its view is the widest in which no pixel falls outside
    the distorted image (COLMAP's blank_pixels = 0).

    Returns ([fx, fy, cx, cy], [H, W, 2] x and y in pixels, centres at +0.5).
    """
    width, height = camera.width, camera.height
    cx, cy = camera.principal_point_x, camera.principal_point_y
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    border = np.concatenate(
        [
            np.stack([x, np.full_like(x, y[0])], 1),
            np.stack([x, np.full_like(x, y[-1])], 1),
            np.stack([np.full_like(y, x[0]), y], 1),
            np.stack([np.full_like(y, x[-1]), y], 1),
        ]
    )

    def distorted(pixels: NDArray[Any], zoom: float) -> NDArray[Any]:
        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - [cx, cy]) / (focal * zoom)
        return np.asarray(camera.img_from_cam(rays))

    def inside(zoom: float) -> bool:
        at = distorted(border, zoom)
        slack = 1e-6
        low, high = 0.5 - slack, np.array([width, height]) - 0.5 + slack
        return bool(((at >= low) & (at <= high)).all())

    low, high = 0.5, 2.0
    while not inside(high) and high < WIDEST_ZOOM:  # only a fisheye needs more than 2
        high *= 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if inside(middle) else (middle, high)
    # Exactly 1, so that a pinhole lens is not changed in its last bit.
    zoom = 1.0 if camera.is_undistorted() else high
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    where = distorted(grid.reshape(-1, 2), zoom).reshape(height, width, 2).astype(np.float32)
    return np.array([*(focal * zoom), cx, cy]), where
