"""Localises the frames that the mapper did not receive or did not place, each one separately against the model."""

from __future__ import annotations

from bisect import bisect
from typing import Any

import numpy as np
import pycolmap

from . import colmap_types as colmap
from .mapping import first_camera, registered_images
from .matching import extract
from .pairs import match_pairs
from .request import SEED, Request, closing_database

LOCALISE_MAX_ERROR_PX = 4.0
LOCALISE_LEAST_INLIERS = 24
LOCALISE_LEAST_RATIO = 0.4


def localise(request: Request, model: pycolmap.Reconstruction) -> dict[str, dict[str, Any]]:
    """Poses of all frames that can be placed: {name: {"pose": 3x4 list, "source", "inliers"}}.

    Registered frames keep the model's poses. Each other frame is matched with its nearest registered frames on either
    side and placed against their points (P3P in LO-RANSAC, then refined), if enough points agree.
    """
    poses: dict[str, dict[str, Any]] = {}
    ids: dict[str, int] = {}
    for image in registered_images(model):
        ids[image.name] = image.image_id
        poses[image.name] = {"pose": colmap.pose(image).tolist(), "source": "registered"}
    missing = [name for name in request.order if name not in ids]
    if not missing or request.neighbours < 1:
        return poses
    pairs = _nearest_registered(request, missing, ids)
    new = [name for name in request.unsolved if name in pairs]
    if new:
        extract(request, new, next(iter(colmap.cameras(model))))
    match_pairs(request, pairs)
    camera = first_camera(model)
    with closing_database(request) as database:
        for name in missing:
            found = _place(database, model, camera, name, [ids[neighbour] for neighbour in pairs[name]])
            if found is not None:
                poses[name] = found
    return poses


def _nearest_registered(request: Request, missing: list[str], ids: dict[str, int]) -> dict[str, list[str]]:
    """Maps each `missing` frame to its nearest registered frames on either side."""
    at = {name: i for i, name in enumerate(request.order)}
    known = [i for i, name in enumerate(request.order) if name in ids]
    pairs: dict[str, list[str]] = {}
    for name in missing:
        after = bisect(known, at[name])
        near = known[max(0, after - request.neighbours) : after + request.neighbours]
        pairs[name] = [request.order[i] for i in near]
    return pairs


def _place(
    database: pycolmap.Database,
    model: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    name: str,
    neighbours: list[int],
) -> dict[str, Any] | None:
    """The pose of one image from its matches with registered images, or None."""
    image = database.read_image_with_name(name)
    if image is None or not database.exists_keypoints(image.image_id):
        return None
    keypoints = database.read_keypoints(image.image_id)[:, :2]
    links: dict[tuple[int, int], None] = {}
    for neighbour in neighbours:
        if not database.exists_matches(image.image_id, neighbour):
            continue
        matches = database.read_two_view_geometry(image.image_id, neighbour).inlier_matches
        points = colmap.images(model)[neighbour].points2D
        for keypoint, reference in matches:
            point = points[int(reference)]
            if point.has_point3D():
                links[int(keypoint), int(point.point3D_id)] = None
    if len(links) < LOCALISE_LEAST_INLIERS:
        return None
    xy = np.array([keypoints[keypoint] for keypoint, _ in links], np.float64)
    xyz = np.array([colmap.points(model)[point].xyz for _, point in links], np.float64)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = LOCALISE_MAX_ERROR_PX
    options.ransac.random_seed = SEED
    found = colmap.absolute_pose(xy, xyz, camera, options)
    if found is None:
        return None
    pose, inliers = found
    if inliers < LOCALISE_LEAST_INLIERS or inliers < LOCALISE_LEAST_RATIO * len(links):
        return None
    return {"pose": pose.tolist(), "source": "localised", "inliers": inliers}
