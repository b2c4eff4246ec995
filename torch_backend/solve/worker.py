"""The child process in which COLMAP runs: `python -m torch_backend.solve.worker REQUEST.json`.

A process of its own because pycolmap and OpenImageIO cannot share one (see footage/images.py), because COLMAP ends its
process on a failed check, and because a process can be stopped at any moment. No other module imports pycolmap, but for
`colmap_types.py`, which says what types it has.

Standard input is held open by the parent: when it closes, the parent is gone and so is the worker. Standard output
carries JSON lines: {"stage"} when one begins, with {"done", "total"} where COLMAP calls back; {"result": {...}} or
{"failure": "reason"} at the end.
Beside the request it writes: model/ (binary COLMAP model), points.npz, poses.json (cameras from world, 3x4) and, for
each lens, undistort_N.npz (the lens, camera of the undistorted frames, where its pixels lie in the distorted ones).

A request with "known" cameras ({"lenses": [{"model", "width", "height", "params"}], "images": {name: {"lens",
"pose"}}, "triangulate"}) is not solved: the lenses are undistorted and, if asked for, points are triangulated with the
poses held.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from bisect import bisect
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..contract import POINTS_FILE
from . import colmap_types as colmap
from .lens_verdict import FISHEYE, FISHEYE_START, angle_deg, doubt_of, impossible

SEED = 0
STILL_SHARE = 0.008
"""Largest median flow between any two frames, as a share of the image width, below which the camera stands still."""
TURNING_SHARE = 0.8
"""Share of image pairs explained by a homography above which a failed solve is put down to a turning camera."""
LOCALISE_MAX_ERROR_PX = 4.0
LOCALISE_LEAST_INLIERS = 24
LOCALISE_LEAST_RATIO = 0.4
HELD_SHARE, HELD_WORSE, HELD_ERROR_PX = 0.9, 1.25, 1.0
"""A usual lens is taken instead of a doubtful one if it places this share of the frames, with errors no more than so
many times as large, or no more than so many pixels."""
MASKED_INLIERS = (50, 15)
"""Matches that a first pair and a further image need where masks leave few, half of COLMAP's: what would mislead is
masked. A room of which 70 % of 320 x 240 pixels were masked: 26 of 30 images instead of 4."""
WIDEST_ZOOM = 16.0
TRIANGULATE_LEAST_DEG = 1.0
"""Smallest angle under which a point is triangulated from known cameras."""


class Request:
    """What the parent asks for, from its JSON."""

    def __init__(self, path: Path) -> None:
        data = json.loads(path.read_text(encoding="utf-8"))
        self.scratch = path.parent
        self.database = self.scratch / "database.db"
        self.images = Path(data["images"])
        self.solved: list[str] = data["solved"]
        self.others: list[str] = data["others"]
        self.order: list[str] = sorted(self.solved + self.others, key=lambda name: int(Path(name).stem))
        self.camera_model: str = data["camera_model"]
        self.overlap: int = data["overlap"]
        self.features: int = data["features"]
        self.neighbours: int = data["neighbours"]
        self.threads: int = data["threads"]
        self.size: list[int] = data.get("size", [0, 0])
        """Pixels of the images, for a lens that is told beforehand."""
        self.focal: float = data.get("focal_px", 0.0)
        """Focal length that the lens is known to have, pixels; 0: not known."""
        self.hold_focal: bool = bool(self.focal) and bool(data.get("hold_focal"))
        self.masks = data.get("masks", "")
        """Folder of COLMAP's masks; empty: nothing is masked."""
        self.known: dict[str, Any] | None = data.get("known")


def say(**message: Any) -> None:
    """One line to the parent."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def main(path: str) -> int:
    """Runs the request; 0 unless something broke that no sentence covers."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    request = Request(Path(path))
    pycolmap.set_random_seed(SEED)
    if request.known is not None:
        return take_over(request, request.known)
    extract(request, request.solved, None)
    match(request)
    flow, width = median_flow(request)
    if flow < STILL_SHARE * width:
        say(failure="still", flow_px=flow)
        return 0
    models = build(request)
    if not models:
        say(failure="turning" if turning_share(request) > TURNING_SHARE else "no_pair", flow_px=flow)
        return 0
    doubt = lens_doubt(request, models[0])
    first, held = first_camera(models[0]), False
    if doubt:
        again = build(request, hold_lens=True)
        held = bool(again) and as_good(again[0], models[0])
        models = again if held else models
    model = models[0]
    poses = localise(request, model)
    write_answers(request, model, poses)
    camera = first_camera(model)
    say(
        result={
            "registered": model.num_reg_images(),
            "parts": [sorted(image.name for image in posed(m)) for m in models],
            "reprojection_error_px": model.compute_mean_reprojection_error(),
            "points": model.num_points3D(),
            "triangulation_angle_deg": triangulation_angle(model),
            "camera_model": camera.model_name,
            "focal_px": camera.mean_focal_length(),
            "distortion": [float(camera.params[i]) for i in camera.extra_params_idxs()],
            "flow_px": flow,
            "turning": turning_share(request) > TURNING_SHARE,
            "localised": len(poses) - model.num_reg_images(),
            "lens": {
                "doubt": doubt,
                "held": held,
                "found_px": first.mean_focal_length(),
                "found_deg": angle_deg(*lens_of(first)),
                "view_deg": angle_deg(*lens_of(camera)),
                "impossible": impossible(*lens_of(camera)),
                "given_px": request.focal,
                "width": camera.width,
                "height": camera.height,
            },
        }
    )
    return 0


# --------------------------------------------------------------------------------------------------- known cameras


def take_over(request: Request, known: dict[str, Any]) -> int:
    """Undistorts the lenses of known cameras and triangulates points between them, if asked; 0."""
    lenses = [
        pycolmap.Camera(model=n["model"], width=n["width"], height=n["height"], params=n["params"])
        for n in known["lenses"]
    ]
    for number, lens in enumerate(lenses):
        say(stage="lens", done=number, total=len(lenses))
        write_undistortion(request, lens, number)
    if not known["triangulate"]:
        say(result={})
        return 0
    poses = {name: (image["lens"], np.array(image["pose"], np.float64)) for name, image in known["images"].items()}
    model = triangulate(request, lenses, poses)
    if not model.num_points3D():
        say(result={"points": 0})
        return 0
    write_points(request, model)
    folder = request.scratch / "model"
    folder.mkdir()
    colmap.write_binary(model, folder)
    say(
        result={
            "points": model.num_points3D(),
            "reprojection_error_px": model.compute_mean_reprojection_error(),
            "triangulation_angle_deg": triangulation_angle(model),
            "agreement": agreement(request, model),
        }
    )
    return 0


def agreement(request: Request, model: pycolmap.Reconstruction) -> float:
    """Share of the keypoints matched between frames that found a point: with cameras held, errors alone look good
    whatever the cameras are, since what does not fit them is left out."""
    matched: dict[int, list[NDArray[np.uint32]]] = {}
    with closing_database(request) as database:
        pairs, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        if len(geometry.inlier_matches):
            for image, side in zip(pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches.T, strict=True):
                matched.setdefault(image, []).append(side)
    total = sum(len(np.unique(np.concatenate(sides))) for sides in matched.values())
    return sum(image.num_points3D for image in colmap.images(model).values()) / max(total, 1)


def triangulate(
    request: Request, lenses: list[pycolmap.Camera], poses: dict[str, tuple[int, NDArray[np.float64]]]
) -> pycolmap.Reconstruction:
    """Features and matches of the solved images, then points from known cameras, which are held.

    `poses` gives each image's lens, as an index, and its world-to-camera pose, [3, 4]; all solved images are in it.
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
                # Pairs are verified without the lens, as in a solve of our own, unless it bends their epipolar lines.
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


# --------------------------------------------------------------------------------------------------- COLMAP's stages


def extract(
    request: Request,
    names: list[str],
    camera_id: int | None,
    mode: pycolmap.CameraMode = pycolmap.CameraMode.SINGLE,
) -> None:
    """SIFT features of `names` into the database; one camera for all, an existing one if `camera_id` is given."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = request.camera_model
    reader.camera_params = start_params(request)
    if request.masks:
        reader.mask_path = request.masks
    if camera_id is not None:
        reader.existing_camera_id = camera_id
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = request.threads
    options.sift.max_num_features = request.features
    # Numbers given beforehand, in the clip's order: else the first thread to finish would choose them.
    with closing_database(request):
        pass  # makes the file
    colmap.import_images(request.database, request.images, mode, names, reader)
    say(stage="features" if camera_id is None else "other features")
    colmap.extract_features(request.database, request.images, mode, names, reader, options)


def _matching() -> tuple[pycolmap.FeatureMatchingOptions, pycolmap.TwoViewGeometryOptions]:
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    # Two threads at once in the sgemm of pycolmap 4.2.1's OpenBLAS get wrong products (18 of 15,000; alone 0 of 6000):
    # now and then two pairs lose half of their matches, and the cameras differ. One thread matches, one verifies.
    options.num_threads = 1
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = SEED
    return options, geometry


def match(request: Request) -> None:
    """Matches each frame with its next ones at distances 1, 2, 4, ... within the overlap (quadratic overlap)."""
    options, geometry = _matching()
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap = request.overlap
    pairing.quadratic_overlap = True
    pairing.num_threads = request.threads
    say(stage="matches")
    colmap.match_sequential(request.database, options, pairing, geometry)


def median_flow(request: Request) -> tuple[float, int]:
    """Largest over image pairs of the median displacement in pixels of their matches, and the image width."""
    largest = 0.0
    with closing_database(request) as database:
        width = database.read_all_cameras()[0].width
        keypoints = {i.image_id: database.read_keypoints(i.image_id)[:, :2] for i in database.read_all_images()}
        pairs, geometries = database.read_two_view_geometries()
        for pair, geometry in zip(pairs, geometries, strict=True):
            matches = geometry.inlier_matches
            if len(matches) < 15:
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair)
            shift = np.linalg.norm(keypoints[a][matches[:, 0]] - keypoints[b][matches[:, 1]], axis=1)
            largest = max(largest, float(np.median(shift)))
    return largest, width


def turning_share(request: Request) -> float:
    """Share of matched image pairs that a homography explains: a camera that turns on the spot, or a bare wall."""
    kinds = pycolmap.TwoViewGeometryConfiguration
    with closing_database(request) as database:
        _, geometries = database.read_two_view_geometries()
    flat = {kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC}
    found = [kinds(g.config) in flat for g in geometries if len(g.inlier_matches)]
    return float(np.mean(found)) if found else 0.0


def first_camera(model: pycolmap.Reconstruction) -> pycolmap.Camera:
    """The lens of a solve of our own: all its images share one."""
    return next(iter(colmap.cameras(model).values()))


def posed(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images that have a place in the model."""
    return [image for image in colmap.images(model).values() if image.has_pose]


def start_params(request: Request) -> str:
    """The lens before any picture was seen, as COLMAP's parameters in a row; empty: COLMAP's own guess.

    With it pairs are verified through the lens: the epipolar lines of a fisheye are bent.
    """
    focal, (width, height) = request.focal, request.size
    if not focal and request.camera_model == FISHEYE:
        focal = FISHEYE_START * width
    if not focal:
        return ""
    single = request.camera_model == "SIMPLE_RADIAL"
    params = (
        [focal, 0.5 * width, 0.5 * height, 0.0] if single else [focal, focal, 0.5 * width, 0.5 * height, *[0.0] * 4]
    )
    return ", ".join(repr(value) for value in params)


def lens_of(camera: pycolmap.Camera) -> tuple[str, int, int, list[float]]:
    """Model, width, height and parameters of a camera, as `lens_verdict` wants them."""
    return camera.model_name, camera.width, camera.height, [float(value) for value in camera.params]


def lens_doubt(request: Request, model: pycolmap.Reconstruction) -> str:
    """`lens_verdict.doubt_of` a model's lens."""
    return doubt_of(*lens_of(first_camera(model)), request.focal)


def as_good(held: pycolmap.Reconstruction, free: pycolmap.Reconstruction) -> bool:
    """True if a model explains the clip with a usual lens about as well as another with a lens of its own."""
    if held.num_reg_images() < HELD_SHARE * free.num_reg_images():
        return False
    error = held.compute_mean_reprojection_error()
    return error <= max(HELD_WORSE * free.compute_mean_reprojection_error(), HELD_ERROR_PX)


def build(request: Request, hold_lens: bool = False) -> list[pycolmap.Reconstruction]:
    """Incremental mapping; every model that it finds, the largest first.

    With `hold_lens` the lens stays as it was before any picture was seen: a usual focal length, no distortion.
    """
    options = pycolmap.IncrementalPipelineOptions()
    # One thread repeats bit for bit, and costs nothing: a clip of 75 frames is below what Ceres shares out.
    options.num_threads = 1
    options.random_seed = SEED
    options.mapper.random_seed = SEED
    options.triangulation.random_seed = SEED
    # A clip of 75 frames needs no global adjustment every 10 % of growth: 37 % less time, error unchanged (0.795 px
    # against 0.797 px on examples/sitting.mp4).
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    options.ba_global_max_refinements = 2
    options.ba_local_max_refinements = 1
    if request.masks:
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = MASKED_INLIERS
    if hold_lens or request.hold_focal:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    if hold_lens:
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
    # The first model that the mapper writes is often a fragment: the largest is meant.
    models = [m for m in found.values() if m.num_reg_images() >= 2]
    return sorted(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)


# --------------------------------------------------------------------------------------------------- other frames


def localise(request: Request, model: pycolmap.Reconstruction) -> dict[str, dict[str, Any]]:
    """Poses of all frames that can be had: {name: {"pose": 3x4 list, "source", "inliers"}}.

    Registered ones are the model's. Each other one is matched with its nearest registered frames on either side and
    placed against their points (P3P in LO-RANSAC, then refined), if enough points agree.
    """
    poses: dict[str, dict[str, Any]] = {}
    ids: dict[str, int] = {}
    for image in posed(model):
        ids[image.name] = image.image_id
        poses[image.name] = {"pose": colmap.pose(image).tolist(), "source": "registered"}
    missing = [name for name in request.order if name not in ids]
    if not missing or request.neighbours < 1:
        return poses
    pairs = _nearest_registered(request, missing, ids)
    new = [name for name in request.others if name in pairs]
    if new:
        extract(request, new, next(iter(colmap.cameras(model))))
    _match_pairs(request, pairs)
    camera = first_camera(model)
    with closing_database(request) as database:
        for name in missing:
            found = _place(database, model, camera, name, [ids[other] for other in pairs[name]])
            if found is not None:
                poses[name] = found
    return poses


def _nearest_registered(request: Request, missing: list[str], ids: dict[str, int]) -> dict[str, list[str]]:
    """The nearest registered frames on either side of each frame that is not."""
    at = {name: i for i, name in enumerate(request.order)}
    known = [i for i, name in enumerate(request.order) if name in ids]
    pairs: dict[str, list[str]] = {}
    for name in missing:
        after = bisect(known, at[name])
        near = known[max(0, after - request.neighbours) : after + request.neighbours]
        pairs[name] = [request.order[i] for i in near]
    return pairs


def _match_pairs(request: Request, pairs: dict[str, list[str]]) -> None:
    lines = [f"{name} {other}" for name, others in pairs.items() for other in others]
    listing = request.scratch / "pairs.txt"
    listing.write_text("\n".join(lines) + "\n", encoding="utf-8")
    options, geometry = _matching()
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = 4 * request.neighbours  # COLMAP counts its progress in blocks
    say(stage="other matches")
    colmap.match_image_pairs(request.database, options, pairing, geometry)


def _place(
    database: pycolmap.Database, model: pycolmap.Reconstruction, camera: pycolmap.Camera, name: str, others: list[int]
) -> dict[str, Any] | None:
    """The pose of one image from its matches with registered ones, or None."""
    image = database.read_image_with_name(name)
    if image is None or not database.exists_keypoints(image.image_id):
        return None
    keypoints = database.read_keypoints(image.image_id)[:, :2]
    links: dict[tuple[int, int], None] = {}
    for other in others:
        if not database.exists_matches(image.image_id, other):
            continue
        matches = database.read_two_view_geometry(image.image_id, other).inlier_matches
        points = colmap.images(model)[other].points2D
        for own, theirs in matches:
            point = points[int(theirs)]
            if point.has_point3D():
                links[int(own), int(point.point3D_id)] = None
    if len(links) < LOCALISE_LEAST_INLIERS:
        return None
    xy = np.array([keypoints[own] for own, _ in links], np.float64)
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


# --------------------------------------------------------------------------------------------------- answers


def triangulation_angle(model: pycolmap.Reconstruction) -> float:
    """Median over points (at most 2000) of the widest angle in degrees under which a point is seen."""
    centres = {image.image_id: image.projection_center() for image in posed(model)}
    points = sorted(colmap.points(model).items())
    angles: list[float] = []
    for _, point in points[:: max(1, len(points) // 2000)]:
        seen = np.array([centres[e.image_id] for e in point.track.elements])
        rays = seen - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return float(np.median(angles)) if angles else 0.0


def write_answers(request: Request, model: pycolmap.Reconstruction, poses: dict[str, dict[str, Any]]) -> None:
    """Everything the parent needs, in formats that need no pycolmap."""
    folder = request.scratch / "model"
    folder.mkdir()
    colmap.write_binary(model, folder)
    write_points(request, model)
    (request.scratch / "poses.json").write_text(json.dumps(poses), encoding="utf-8")
    write_undistortion(request, first_camera(model), 0)


def write_points(request: Request, model: pycolmap.Reconstruction) -> None:
    """points.npz of a model: what the parent filters."""
    points = [point for _, point in sorted(colmap.points(model).items())]
    np.savez(
        request.scratch / POINTS_FILE,
        xyz=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        rgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        error=np.array([p.error for p in points], np.float32),
        track=np.array([min(p.track.length(), 65535) for p in points], np.uint16),
        depth=smallest_depths(model, points),
    )


def write_undistortion(request: Request, camera: pycolmap.Camera, number: int) -> None:
    """`undistortion` of a lens, as the parent reads it."""
    pinhole, where = undistortion(camera)
    file = request.scratch / f"undistort_{number}.npz"
    np.savez(file, pinhole=pinhole, where=where, model=camera.model_name, params=camera.params)


def smallest_depths(model: pycolmap.Reconstruction, points: list[pycolmap.Point3D]) -> NDArray[np.float32]:
    """[P]: the least depth of each point over the images that see it, in solve units."""
    rows = {image.image_id: colmap.pose(image)[2] for image in posed(model)}
    return np.array(
        [min(float(rows[e.image_id] @ np.append(p.xyz, 1.0)) for e in p.track.elements) for p in points], np.float32
    )


def undistortion(camera: pycolmap.Camera) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The pinhole camera of the undistorted frames, and where its pixels lie in the distorted ones.

    Same size and principal point; the widest view in which no pixel falls outside of the distorted image (COLMAP's
    blank_pixels = 0). Returns ([fx, fy, cx, cy], [H, W, 2] x and y in pixels, centres at +0.5).
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
    while not inside(high) and high < WIDEST_ZOOM:  # a fisheye
        high *= 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if inside(middle) else (middle, high)
    # A pinhole stays as it is, to the last bit.
    zoom = 1.0 if camera.is_undistorted() else high
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    where = distorted(grid.reshape(-1, 2), zoom).reshape(height, width, 2).astype(np.float32)
    return np.array([*(focal * zoom), cx, cy]), where


# --------------------------------------------------------------------------------------------------- plumbing


def _die_with_parent() -> None:
    # Unbuffered: the interpreter could not close a buffer that a thread still reads.
    while os.read(0, 64):
        pass
    os._exit(1)


@contextmanager
def closing_database(request: Request) -> Generator[pycolmap.Database]:
    """COLMAP's database, closed afterwards."""
    database = colmap.open_database(request.database)
    try:
        yield database
    finally:
        database.close()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
