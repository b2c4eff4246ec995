"""Computes cameras and points from the matches with COLMAP's mappers, and triangulates points for known cameras."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..lens.lens_verdict import doubt_of
from . import colmap_types as colmap
from .matching import extract, match
from .request import SEED, Request, closing_database, say

FIXED_SHARE, FIXED_WORSE, FIXED_ERROR_PX = 0.9, 1.25, 1.0
"""A usual lens replaces an implausible one if it registers the first value's share of the frames. Its error must also
be at most the second value times as large, or at most the third value in pixels."""
MASKED_INLIERS = (50, 15)
"""Matches that a first pair and a further image need under masks: half of COLMAP's defaults. Masks leave few matches,
but remove the misleading ones. With 70 % of a room's 320 x 240 pixels masked: 26 of 30 images instead of 4."""
LONG_TRACK = 128
"""Length of a track, in images, above which the triangulation angle is measured on a part of the images."""
TRIANGULATE_LEAST_DEG = 1.0
"""Smallest angle under which a point is triangulated from known cameras."""


def build(request: Request, hold_lens: bool = False) -> list[pycolmap.Reconstruction]:
    """Every model that the mapper finds, the largest first. The mapper is incremental unless the request says global.

    With `hold_lens` the lens keeps its initial values: a usual focal length, no distortion.
    """
    if request.mapper == "global":
        return build_globally(request, hold_lens)
    options = pycolmap.IncrementalPipelineOptions()
    # One thread makes results repeat bit for bit. It costs nothing: Ceres does not parallelise a clip of 75 frames.
    options.num_threads = 1
    options.random_seed = SEED
    options.mapper.random_seed = SEED
    options.triangulation.random_seed = SEED
    # A clip of 75 frames needs no global adjustment every 10 % of growth. Each adjustment keeps COLMAP's default number
    # of rounds. With only two global rounds or one local round, the mapper kept a start from two frames with little
    # depth, and a whole walk was solved wrongly at an error of 0.9 px (docs/decisions.md).
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    # Ceres' default. With COLMAP's 0 an adjustment runs all 50 iterations even when it has converged.
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-6
    if request.reuse:  # the database may hold frames that an earlier attempt placed
        options.image_names = request.solved
    if request.masks:
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = MASKED_INLIERS
    if hold_lens or request.hold_focal:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    if hold_lens or request.hold_bend:
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    folder = request.scratch / ("models_held" if hold_lens else "models")
    folder.mkdir()
    total = len(request.solved)
    done = 2
    say(stage="cameras", done=0, total=total)

    def next_image() -> None:
        nonlocal done
        done += 1
        say(stage="cameras", done=min(done, total), total=total)

    found = colmap.incremental_mapping(request.database, request.images, folder, options, next_image)
    say(stage="cameras", done=total, total=total)
    return _largest_first(found)


def build_globally(request: Request, hold_lens: bool = False) -> list[pycolmap.Reconstruction]:
    """Models as from `build`, by global mapping (GLOMAP): first all rotations, then all positions at once.

    Global mapping needs an initial focal length. If the request has none, it is estimated from the image pairs.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = request.solved
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = SEED
    options.mapper.rotation_averaging.random_seed = options.mapper.global_positioning.random_seed = SEED
    options.mapper.retriangulation.random_seed = SEED
    adjustment = options.mapper.bundle_adjustment
    options.mapper.global_positioning.use_gpu = adjustment.ceres.use_gpu = False
    if hold_lens or request.hold_focal:
        adjustment.refine_focal_length = False
    if hold_lens or request.hold_bend:
        adjustment.refine_extra_params = False
    if not request.start_focal:
        colmap.calibrate_view_graph(request.database)
    folder = request.scratch / ("models_held" if hold_lens else "models")
    folder.mkdir()
    say(stage="cameras")
    return _largest_first(colmap.global_mapping(request.database, request.images, folder, options))


def _largest_first(found: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    # The first model that the mapper writes is often a fragment.
    models = [m for m in found.values() if m.num_reg_images() >= 2]
    return sorted(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)


def first_camera(model: pycolmap.Reconstruction) -> pycolmap.Camera:
    """The lens of a solved model, which all its images share."""
    return next(iter(colmap.cameras(model).values()))


def left_bend(model: pycolmap.Reconstruction) -> float:
    """First radial coefficient that fits a model of undistorted frames best; 0 if no distortion is left in them."""
    freed = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = True
    options.print_summary = False
    colmap.adjust(freed, options)
    camera = first_camera(freed)
    return float(camera.params[camera.extra_params_idxs()[0]])


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images that have a pose in the model."""
    return [image for image in colmap.images(model).values() if image.has_pose]


def lens_of(camera: pycolmap.Camera) -> tuple[str, int, int, list[float]]:
    """Model, width, height and parameters of a camera, as arguments of `lens_verdict`."""
    return camera.model_name, camera.width, camera.height, [float(value) for value in camera.params]


def lens_doubt(request: Request, model: pycolmap.Reconstruction) -> str:
    """Reason to doubt the lens of a COLMAP reconstruction (`lens_verdict.doubt_of`); empty if there is none."""
    return doubt_of(*lens_of(first_camera(model)), request.focal)


def is_as_good(fixed: pycolmap.Reconstruction, free: pycolmap.Reconstruction) -> bool:
    """True if `fixed`, a model with a usual lens, explains the clip about as well as `free`, with an estimated lens."""
    if fixed.num_reg_images() < FIXED_SHARE * free.num_reg_images():
        return False
    error = fixed.compute_mean_reprojection_error()
    return error <= max(FIXED_WORSE * free.compute_mean_reprojection_error(), FIXED_ERROR_PX)


def triangulation_angle(model: pycolmap.Reconstruction) -> float:
    """Median, over at most 4000 points, of the widest angle in degrees between two rays to a point."""
    centres = {image.image_id: image.projection_center() for image in registered_images(model)}
    points = sorted(colmap.points(model).items())
    angles: list[float] = []
    for _, point in points[:: max(1, len(points) // 2000)]:
        track = point.track.elements
        # Long tracks are thinned, because every two images of a track are compared.
        seen = np.array([centres[e.image_id] for e in track[:: 1 + len(track) // LONG_TRACK]])
        rays = seen - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return float(np.median(angles)) if angles else 0.0


def triangulate(
    request: Request, lenses: list[pycolmap.Camera], poses: dict[str, tuple[int, NDArray[np.float64]]]
) -> pycolmap.Reconstruction:
    """Extracts and matches features of the solved images, then triangulates points with the known cameras fixed.

    `poses` holds every solved image: the index of its lens, and its world-to-camera pose, [3, 4].
    """
    single = len(lenses) == 1
    extract(request, request.solved, None, pycolmap.CameraMode.SINGLE if single else pycolmap.CameraMode.PER_IMAGE)
    known = pycolmap.Reconstruction()
    with closing_database(request) as database:
        images = {image.name: image for image in database.read_all_images()}
        for name in request.solved:
            lens, pose = poses[name]
            stored = images[name]
            if stored.camera_id not in known.cameras:
                camera = pycolmap.Camera(
                    model=lenses[lens].model, width=lenses[lens].width, height=lenses[lens].height,
                    params=lenses[lens].params, camera_id=stored.camera_id,
                )  # fmt: skip
                # Pairs are verified without the lens, as in a solve, unless distortion bends their epipolar lines.
                camera.has_prior_focal_length = camera.model != pycolmap.CameraModelId.PINHOLE
                database.update_camera(camera)
                known.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(name=name, camera_id=stored.camera_id, image_id=stored.image_id)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    match(request)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.triangulation.min_angle = TRIANGULATE_LEAST_DEG
    folder = request.scratch / "triangulated"
    folder.mkdir()
    say(stage="points")
    return colmap.triangulate_points(known, request.database, request.images, folder, options)


def agreement(request: Request, model: pycolmap.Reconstruction) -> float:
    """Share of the matched keypoints that were triangulated to a point.

    With fixed cameras the reprojection error looks good even for wrong cameras, because misfits are left out.
    """
    matched: dict[int, list[NDArray[np.uint32]]] = {}
    with closing_database(request) as database:
        pairs, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        if len(geometry.inlier_matches):
            for image, side in zip(pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches.T, strict=True):
                matched.setdefault(image, []).append(side)
    total = sum(len(np.unique(np.concatenate(sides))) for sides in matched.values())
    return sum(image.num_points3D for image in colmap.images(model).values()) / max(total, 1)
