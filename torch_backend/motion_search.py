"""Motion search: writes a motion matte of every frame, and points of still surfaces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from .cameras.stored import load_cameras
from .contract import MOTION_FILE, MOTION_UNFINISHED_FILE, PICTURE, SURFACE, Cancelled, JobError, Reporter
from .footage.images import is_whole_png
from .motion.flow import FlowConfig
from .motion.mattes import MOTION_VERSION, MOVING, STILL, UNKNOWN, read_found, record_of, solve_key, write_matte
from .motion.moving import Clip, Labels, StaticViews, prefetched_scores
from .motion.surface import BORDER_DISTANCE, KeyEvidence, is_damaged, surface_points, write_surface
from .sfm.masks import IGNORE, PEOPLE, limited, load_mask
from .sfm.verdict import doubt_of
from .shot import Shot, make_folder, need_disk, write_json
from .train.static_world import static_views

StaticModel = Callable[[Shot, Reporter], StaticViews]
"""Trains a static model of the clip with its solved cameras. JobError if that fails."""


class MotionResult(TypedDict):
    """What `find_motion` returns."""

    motion_pixels_share: float
    """Share of the pixels of all frames that are labelled moving, 0 to 1."""
    unknown_share: float
    """Share of the pixels of all frames that are labelled unknown, 0 to 1."""


def find_motion(
    shot: Shot, report: Reporter, with_points: bool = False, static_model: StaticModel | None = static_views
) -> MotionResult:
    """Writes the motion matte of every delivered frame, and points of still surfaces. A pixel moves if its optical flow
    does not fit the camera's motion, or if a static model of the clip cannot reproduce it.

    Existing mattes of the same cameras are kept, and an interrupted search is resumed. Raises JobError if the shot is
    not solved or a frame is damaged, and Cancelled.

    Args:
        with_points: repeat the search if an older version stored mattes without points.
        static_model: makes the static model. None: use optical flow alone, which misses arms.
    """
    config = FlowConfig()
    key = solve_key(shot, config)
    folder = shot.own(shot.motion)
    done = record_of(folder / MOTION_FILE)
    path = load_cameras(shot)
    files = {camera.frame: shot.matte(camera.frame) for camera in path.frames}
    anew = with_points and done.get("key") == key and not any(folder.glob("*" + SURFACE))
    if not anew and done.get("key") == key and all(_is_whole(shot, frame) for frame in files):
        return MotionResult(**done["result"])
    need_disk(shot.root, 0.1 * path.width * path.height * len(files), "The motion matte")
    _begin(folder, key)
    clip = Clip(shot)
    written = {n for n, frame in enumerate(clip.frames) if not anew and _is_whole(shot, frame)}
    shares = np.zeros((len(files), 3))
    for n in written:
        shares[n] = _shares(read_found(files[clip.frames[n]]))
    with prefetched_scores(clip, config, written, report) as scored:
        labels_of = Labels(clip, _static_views(shot, static_model, report), config)
        for count, frame in enumerate(scored, start=len(written) + 1):
            report.check_cancelled()
            n, labels = frame.index, labels_of(frame)
            ignored, people = (load_mask(shot, kind, clip.frames[n]) for kind in (IGNORE, PEOPLE))
            if frame.evidence is not None:
                _keep_surface(shot, clip, n, frame.evidence, labels, ignored)
            limited(labels, ignored, people)
            write_matte(files[clip.frames[n]], labels)
            shares[n] = _shares(labels)
            report.progress("solve: motion", count, len(files), f"frame {clip.frames[n]}")
    mean = shares.mean(0)
    result = MotionResult(motion_pixels_share=round(float(mean[2]), 4), unknown_share=round(float(mean[1]), 4))
    write_json(folder / MOTION_FILE, {"version": MOTION_VERSION, "key": key, "result": result})
    (folder / MOTION_UNFINISHED_FILE).unlink(missing_ok=True)
    return result


def _is_whole(shot: Shot, frame: int) -> bool:
    """True if the matte of a frame is whole, and the points found with it are not damaged."""
    return is_whole_png(shot.matte(frame)) and not is_damaged(shot.surface(frame))


def _static_views(shot: Shot, static_model: StaticModel | None, report: Reporter) -> StaticViews | None:
    """Views of the static model. None without a model or if its training fails; flow is used alone then."""
    if static_model is None:
        return None
    try:
        return static_model(shot, report)
    except JobError as error:
        report.warning(f"Motion is found by optical flow only: {error}", error.hint)
        return None


def _keep_surface(
    shot: Shot, clip: Clip, n: int, found: KeyEvidence, labels: NDArray[np.uint8], ignored: NDArray[np.bool_] | None
) -> None:
    """Writes the points of still surfaces in key frame `n`. They lie where the matte `labels` [H, W] is still, far from
    all other labels. Some matches of a mover fit a still point by chance, at a depth without a surface."""
    not_still = (labels != STILL).astype(np.uint8)
    reach = 2 * round(BORDER_DISTANCE * clip.width / 640) + 1
    not_still = cv2.dilate(not_still, np.ones((reach, reach), np.uint8)) > 0
    excluded = not_still if ignored is None else not_still | ignored
    points = surface_points(found, clip.unit, np.asarray(excluded, np.bool_), clip.frames[n])
    write_surface(shot.surface(clip.frames[n]), *points)


def _begin(folder: Path, key: str) -> None:
    """Deletes mattes of other keys, before the first matte of this key is written."""
    make_folder(folder)
    names = MOTION_FILE, MOTION_UNFINISHED_FILE
    if all(record_of(folder / name).get("key") != key for name in names):
        for name in names:  # without both records, the mattes belong to no key
            (folder / name).unlink(missing_ok=True)
        for file in (*folder.glob("*" + PICTURE), *folder.glob("*" + SURFACE)):
            file.unlink(missing_ok=True)  # another task may delete the same files
    write_json(folder / MOTION_UNFINISHED_FILE, {"version": MOTION_VERSION, "key": key})
    (folder / MOTION_FILE).unlink(missing_ok=True)


def _shares(labels: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Shares of a matte that are still, unknown and moving, 0 to 1."""
    still, unknown, moving = (float((labels == value).mean()) for value in (STILL, UNKNOWN, MOVING))
    return still, unknown, moving


def motion_after_solve(
    shot: Shot, report: Reporter, static_model: StaticModel | None = static_views
) -> MotionResult | None:
    """Result of `find_motion`. If the search fails, warns and returns None, so that the artist keeps the cameras."""
    try:
        found = find_motion(shot, report, with_points=True, static_model=static_model)
    except Cancelled:
        raise
    except Exception as error:  # OpenCV raises its own exception classes
        report.warning(
            f"Moving areas could not be found: {' '.join(str(error).split())[:300]}",
            "The cameras are fine. Solve again to retry.",
        )
        return None
    if (doubt := doubt_of(found["motion_pixels_share"])) is not None:
        report.warning(*doubt)
    return found
