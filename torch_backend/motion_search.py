"""The search for what moves: motion mattes of every frame, and points of what stands still."""

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
from .motion.moving import Clip, Labels, StaticViews, scored_ahead
from .motion.surface import AWAY, KeyEvidence, is_damaged, surface_points, write_surface
from .sfm.masks import IGNORE, PEOPLE, limited, load_mask
from .sfm.verdict import doubt_of
from .shot import Shot, make_folder, need_disk, write_json
from .train.static_world import static_views

StaticModel = Callable[[Shot, Reporter], StaticViews]
"""Learns the clip as a world that stands still, of the cameras that it has. JobError if that cannot be done."""


class MotionResult(TypedDict):
    """What `find_motion` returns."""

    motion_pixels_share: float
    """Share of the frames' pixels that move by themselves."""
    unknown_share: float
    """Share of them of which nothing is known."""


def find_motion(
    shot: Shot, report: Reporter, with_points: bool = False, static_model: StaticModel | None = static_views
) -> MotionResult:
    """Writes the motion matte of every delivered frame, from optical flow against the camera's own motion and from what
    a static model of the clip cannot show; and points of what stands still.

    Mattes that are there and belong to these cameras are left alone; a run that was stopped is gone on with. JobError
    if the shot is not solved or a frame is damaged, and Cancelled.

    Args:
        with_points: mattes without points, of a solve before those were kept, are found once more.
        static_model: makes that model; None: flow alone tells, and misses arms.
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
    with scored_ahead(clip, config, written, report) as scored:
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
    """What a static model shows; None without one, or if a clip cannot be learnt: flow has to do then."""
    if static_model is None:
        return None
    try:
        return static_model(shot, report)
    except JobError as error:
        report.warning(f"What moves is told by optical flow alone: {error}", error.hint)
        return None


def _keep_surface(
    shot: Shot, clip: Clip, n: int, found: KeyEvidence, labels: NDArray[np.uint8], ignored: NDArray[np.bool_] | None
) -> None:
    """Writes the points of a key frame's still surfaces, frame `n`: of what its matte [H, W] calls still, away from all
    else. Some matches of a mover fit a still point by chance, at a depth where there is no surface."""
    apart = (labels != STILL).astype(np.uint8)
    reach = 2 * round(AWAY * clip.width / 640) + 1
    apart = cv2.dilate(apart, np.ones((reach, reach), np.uint8)) > 0
    excluded = apart if ignored is None else apart | ignored
    points = surface_points(found, clip.unit, np.asarray(excluded, np.bool_), clip.frames[n])
    write_surface(shot.surface(clip.frames[n]), *points)


def _begin(folder: Path, key: str) -> None:
    """Empties the folder of mattes that are not of this key, before the first one is written."""
    make_folder(folder)
    names = MOTION_FILE, MOTION_UNFINISHED_FILE
    if all(record_of(folder / name).get("key") != key for name in names):
        for name in names:  # while neither is there, the mattes belong to nothing
            (folder / name).unlink(missing_ok=True)
        for file in (*folder.glob("*" + PICTURE), *folder.glob("*" + SURFACE)):
            file.unlink(missing_ok=True)  # another task may be at the same
    write_json(folder / MOTION_UNFINISHED_FILE, {"version": MOTION_VERSION, "key": key})
    (folder / MOTION_FILE).unlink(missing_ok=True)


def _shares(labels: NDArray[np.uint8]) -> tuple[float, float, float]:
    """How much of a matte is still, unknown and moving."""
    still, unknown, moving = (float((labels == value).mean()) for value in (STILL, UNKNOWN, MOVING))
    return still, unknown, moving


def motion_after_solve(
    shot: Shot, report: Reporter, static_model: StaticModel | None = static_views
) -> MotionResult | None:
    """`find_motion`; None with a warning where it fails. Cameras took minutes: nothing keeps them from the artist."""
    try:
        found = find_motion(shot, report, with_points=True, static_model=static_model)
    except Cancelled:
        raise
    except Exception as error:  # OpenCV raises its own kinds
        report.warning(
            f"What moves by itself could not be told from the pictures: {' '.join(str(error).split())[:300]}",
            "The cameras are whole; solve again to try once more.",
        )
        return None
    if (doubt := doubt_of(found["motion_pixels_share"])) is not None:
        report.warning(*doubt)
    return found
