"""Extracts and matches features in COLMAP's database, and measures the matches before cameras are computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..lens.lens_verdict import FISHEYE, FISHEYE_START
from . import colmap_types as colmap
from .pairs import match_pairs
from .pure_rotation import is_pure_rotation
from .request import Request, closing_database, say

STILL_SHARE = 0.008
"""The camera stands still if the median flow of every pair of frames is below this share of the image width."""
LEAST_MATCHES = 15
"""Number of matches below which a pair of frames is not evaluated; COLMAP's default."""
ALL_PAIRS = 40
"""Number of frames up to which a wide match takes all pairs: 780 pairs, about 20 a frame as in longer clips."""
TURNING_SHARE = 0.8
"""A camera may count as only rotating if homographies explain more than this share of the image pairs."""
GUESSED_FOCAL = 1.2
"""COLMAP's initial focal length, as a share of the longer side."""


def extract(
    request: Request,
    names: list[str],
    camera_id: int | None,
    mode: pycolmap.CameraMode = pycolmap.CameraMode.SINGLE,
) -> None:
    """Extracts SIFT features of `names` into the database. With `camera_id` the images use that existing camera."""
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
    if request.peak:
        options.sift.peak_threshold = request.peak
    # Images are imported first so that their ids follow the clip's order, not the order in which threads finish.
    with closing_database(request):
        pass  # creates the file
    colmap.import_images(request.database, request.images, mode, names, reader)
    say(stage="features" if camera_id is None else "other features")
    colmap.extract_features(request.database, request.images, mode, names, reader, options)


def start_params(request: Request) -> str:
    """Initial lens as COLMAP's comma-separated parameters; empty if COLMAP guesses it."""
    focal, (width, height) = request.start_focal, request.size
    # With an initial lens, COLMAP verifies pairs through it. A fisheye needs that: its epipolar lines are curves.
    if not focal and request.camera_model == FISHEYE:
        focal = FISHEYE_START * width
    if not focal:
        return ""
    single = request.camera_model == "SIMPLE_RADIAL"
    params = (
        [focal, 0.5 * width, 0.5 * height, 0.0] if single else [focal, focal, 0.5 * width, 0.5 * height, *[0.0] * 4]
    )
    return ", ".join(repr(value) for value in params)


def match(request: Request) -> None:
    """Matches each frame with those 1, 2, 4, ... frames after it, `overlap` distances (COLMAP's quadratic overlap)."""
    if request.reuse or request.wide:
        match_anew(request)
        return
    match_pairs(request, _pairs_at(request.solved, [2**n for n in range(request.overlap)]), "matches")


def match_anew(request: Request) -> None:
    """Adds wide pairs to the matches of an earlier attempt, whose pairs are not matched again.

    Earlier pairs are verified again if only one of the two attempts has an initial focal length.
    """
    pairs = wide_pairs(request.solved) if request.wide else {}
    solved = set(request.solved)
    with closing_database(request) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        verify = set_lens(request, database)
        if verify:
            for pair in database.read_num_matches()[0]:
                one, two = (names[n] for n in pycolmap.pair_id_to_image_pair(pair))
                if one in solved and two in solved and two not in pairs.get(one, []):
                    pairs.setdefault(one, []).append(two)
            database.clear_two_view_geometries()
    if pairs:
        match_pairs(request, pairs, "matches")


def set_lens(request: Request, database: pycolmap.Database) -> bool:
    """Sets the only camera of a database to the request's model.

    Returns True if the camera gains or loses an initial focal length.
    """
    old = database.read_all_cameras()[0]
    focal = start_params(request)
    camera = pycolmap.Camera.create_from_model_name(
        old.camera_id, request.camera_model, GUESSED_FOCAL * max(old.width, old.height), old.width, old.height
    )
    if focal:
        camera.params = [float(value) for value in focal.split(",")]
    camera.has_prior_focal_length = bool(focal)
    database.update_camera(camera)
    return bool(focal) != old.has_prior_focal_length


def wide_pairs(names: Sequence[str]) -> dict[str, list[str]]:
    """Pairs of frames in the clip's order, more than with the quadratic overlap: about 20 a frame in any clip.

    Up to `ALL_PAIRS` frames: all pairs. Beyond: distances 1 to 8, then distances that grow by the root of two.
    """
    distances = list(range(1, len(names) if len(names) <= ALL_PAIRS else 9))
    while distances[-1:] and distances[-1] < len(names):
        distances.append(round(distances[-1] * 2**0.5))
    return _pairs_at(names, distances)


def _pairs_at(names: Sequence[str], distances: Sequence[int]) -> dict[str, list[str]]:
    """Maps each name to the names that follow it at the given distances."""
    return {name: [names[at + d] for d in distances if at + d < len(names)] for at, name in enumerate(names)}


@dataclass(frozen=True)
class Common:
    """Overlap of the solved frames, measured on their matches."""

    flow_px: float
    """Median displacement of a pair's matches in pixels, maximum over the pairs."""
    pairs: int
    """Number of pairs with at least `LEAST_MATCHES` matches."""
    matches: int
    """Median number of matches of such a pair."""
    features: int
    """Median number of features of a frame."""


def common(request: Request) -> Common:
    """Measures the matches of the solved frames."""
    matched = [pair for pair in _shared(request) if len(pair.matches) >= LEAST_MATCHES]
    with closing_database(request) as database:
        found = [database.num_keypoints_for_image(i.image_id) for i in database.read_all_images()]
    matches = int(np.median([len(pair.matches) for pair in matched])) if matched else 0
    features = int(np.median(found)) if found else 0
    return Common(max((pair.shift for pair in matched), default=0.0), len(matched), matches, features)


def only_rotates(request: Request) -> bool:
    """True if the camera only rotates: homographies explain the matches of most pairs, and these are rotations."""
    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = {kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC}
    pairs = [pair for pair in _shared(request) if len(pair.matches)]
    explained = [pair for pair in pairs if pair.kind in flat]
    if not pairs or len(explained) <= TURNING_SHARE * len(pairs):
        return False
    measured = [
        (p.homography, p.shift) for p in explained if p.homography is not None and len(p.matches) >= LEAST_MATCHES
    ]
    homographies = np.array([homography for homography, _ in measured], np.float64).reshape(-1, 3, 3)
    shifts = np.array([shift for _, shift in measured])
    return is_pure_rotation(homographies, shifts, (request.size[0], request.size[1]), request.focal)


@dataclass(frozen=True)
class _Shared:
    """Verified matches of two solved frames."""

    matches: NDArray[np.uint32]
    kind: pycolmap.TwoViewGeometryConfiguration
    homography: NDArray[np.float64] | None
    shift: float
    """Median displacement of the matches in pixels; 0 if there are none."""


def _shared(request: Request) -> list[_Shared]:
    solved = set(request.solved)
    shared: list[_Shared] = []
    with closing_database(request) as database:
        images = {i.image_id for i in database.read_all_images() if i.name in solved}
        keypoints = {image: database.read_keypoints(image)[:, :2] for image in images}
        pairs, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = geometry.inlier_matches
        if a in images and b in images:
            way = np.linalg.norm(keypoints[a][matches[:, 0]] - keypoints[b][matches[:, 1]], axis=1)
            shift = float(np.median(way)) if len(way) else 0.0
            kind = pycolmap.TwoViewGeometryConfiguration(geometry.config)
            shared.append(_Shared(matches, kind, geometry.H, shift))
    return shared
