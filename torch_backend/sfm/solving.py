"""The solve: computes cameras from the working frames with COLMAP in a child process, and writes the results."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..cameras import imported
from ..cameras.stored import load_cameras, load_points, load_record
from ..contract import (
    CAMERA_MODELS,
    CAMERAS_KNOWN,
    MASK_FOUND,
    MASK_KINDS,
    MOTION_UNFINISHED_FILE,
    ST_MAP_WAYS,
    STMAP_FILES,
    ExitCode,
    JobError,
    Reporter,
    UserError,
    open_regular,
)
from ..footage import load_frames
from ..footage.images import is_whole_png
from ..footage.lens_tags import focal_px
from ..footage.masks import Mask, read_masks
from ..footage.sources import frame_words
from ..lens import map_reading
from ..lens.map_lens import MapLens
from ..lens.undistort import Undistorter
from ..lens.undistort_first import UndistortedFrames
from ..replacing import replacing_solve, settle_solve
from ..shot import Shot, content_key, make_folder, need_disk, write_json
from .imported_cameras import prepare, take_over
from .masks import facts_of, more_features, needs_wide, recorded_masks, write_matching
from .results import SOLVE_VERSION, SolveInputs, SolveResult, write_results
from .retries import solve_with_retries

_LOG_END_BYTES = 16_384


@dataclass
class SolveConfig:
    """Settings of a camera solve."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model, one camera for all frames: SIMPLE_RADIAL, OPENCV for strong or tangential distortion, or
    OPENCV_FISHEYE."""
    overlap: int = 15
    """Each solved frame is matched with those 1, 2, 4, ... 2^(overlap - 1) frames after it."""
    features: int = 4096
    """Largest number of SIFT features per frame; the first octave is the upsampled one."""
    localise: bool = True
    """Localise frames that the import's step left out, each against the model; else those frames are interpolated."""
    neighbours: int = 2
    """Number of registered frames on either side with which a frame to be localised is matched."""
    ignore_mask: str = ""
    """Mask of pixels outside the scene, as for `footage.masks.read_masks`, or `MASK_FOUND`; empty: none."""
    people_mask: str = ""
    """Mask of the only pixels that may move; empty: all may move."""
    focal_mm: float = 0.0
    """Initial focal length of the lens in mm; 0: unknown."""
    sensor_mm: float = 36.0
    """Width in mm of the part of the sensor that the picture shows."""
    refine_focal: bool = True
    """Refine `focal_mm`; else it is fixed."""
    st_map: str = ""
    """File of an ST map that holds the lens distortion; empty: the solve estimates the distortion."""
    st_map_way: str = "undistort"
    """One of `contract.ST_MAP_WAYS`."""
    st_map_layer: str = ""
    """Layer of the ST map's file; empty: channels red and green."""
    retry: bool = True
    """Retry a refused or poor solve with other strategies, see `retries.solve_with_retries`."""


def solve_shot(shot: Shot, config: SolveConfig, report: Reporter, cameras: str = "") -> SolveResult:
    """Finds the camera of every frame of `shot` and writes the undistorted frames.

    Writes frames/NNNNNN.png, solve/points.npz, solve/colmap/, solve/cameras.json and, last, solve/solve.json.
    cameras.json is a contract.CameraPath in COLMAP's world ("solve units"): OpenCV axes, world-to-camera, pinhole of
    the undistorted frames. The files replace an earlier solve once all are written; if the solve fails, the earlier one
    stays. A shot already solved from the same frames with the same configuration is not solved again.

    With an ST map in `config` the frames are undistorted first, and the solve estimates only the focal length.

    With `cameras`, a path that `imported.read` can read, the cameras of that file replace the solve. They keep the
    file's world; frames without a camera are interpolated.

    `report` receives the metric `CAMERAS_KNOWN` at the end.

    Raises JobError (SOLVE) if cameras cannot be found, and Cancelled.
    """
    _check(config, cameras)
    for folder in (shot.frames, shot.colmap, *map(shot.masks, MASK_KINDS)):  # refuses links: earlier files are replaced
        shot.own(folder)
    settle_solve(shot)
    frames = load_frames(shot)
    source = [imported.fingerprint(cameras)] if cameras else []
    source += [map_reading.fingerprint(config.st_map)] if config.st_map else []
    masks = read_masks(shot, _mask_sources(shot, config), report)
    key = _key(config, frames, source, masks)
    done = _finished(shot, frames, key)
    if done is not None:
        report.progress("solve", 1, 1, "already solved")
        result = SolveResult(**done["result"])
    else:
        result = _solved_anew(
            SolveInputs(shot, frames, masks, _facts(shot, config, masks, key)), config, cameras, report
        )
    report.metric(CAMERAS_KNOWN, dict(result))
    return result


def _solved_anew(inputs: SolveInputs, config: SolveConfig, cameras: str, report: Reporter) -> SolveResult:
    """Solves, and replaces the files of the earlier solve."""
    shot, frames = inputs.shot, inputs.frames
    imported_cameras = prepare(frames, cameras, report) if cameras else None
    lens = _lens_of_map(config, frames, report)
    _refuse_damaged(shot, frames)
    # Undistorted frames are as large as the imported ones. Per frame, features and matches take about 1 MB, and the
    # copies of the database during matching up to 1.5 MB.
    size = (1.2 if lens is None else 2.4) * sum((shot.frames / f["file"]).stat().st_size for f in frames["frames"])
    need_disk(shot.root, size + 2.5 * (len(frames["frames"]) << 20), "The camera solve")
    scratch = shot.solve / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    make_folder(scratch)
    try:
        if imported_cameras is None:
            answer, left = _mapped(inputs, config, lens, scratch, report)
        else:
            options = _matching(frames, config, inputs.masks, scratch)
            answer, left = take_over(shot, frames, imported_cameras, options, scratch, report), scratch
        had_maps = any((shot.solve / name).is_file() for name in STMAP_FILES)
        with replacing_solve(shot) as staged:
            result = write_results(inputs, answer, left, staged, report)
            _mark_motion_unfinished(shot)
    except JobError as error:
        error.add_note(_log_end(shot.colmap_log))
        raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if had_maps:
        report.warning(
            "The ST maps of the previous solve were for its lens and have been removed.", "Write them again."
        )
    return result


def _mapped(
    inputs: SolveInputs, config: SolveConfig, lens: MapLens | None, scratch: Path, report: Reporter
) -> tuple[dict[str, Any], Path]:
    """COLMAP's answer, and the folder of its files."""
    shot, frames = inputs.shot, inputs.frames
    undistorted = None if lens is None else UndistortedFrames(shot, frames, lens, scratch / "straight", report)
    request = _request(shot, frames, config, inputs.masks, scratch, undistorted)
    outcome = solve_with_retries(request, frames, config.retry, scratch, shot.colmap_log, report)
    answer = {**outcome.best.answer["result"], "rung": outcome.best.strategy, "tries": outcome.tries}
    if undistorted is not None:
        answer |= undistorted.answer_changes(outcome.best.folder)
    return answer, outcome.best.folder


def _facts(shot: Shot, config: SolveConfig, masks: dict[str, Mask], key: str) -> dict[str, Any]:
    """The solve's settings that solve.json records."""
    return {
        "key": key,
        "masks": facts_of(masks, _mask_sources(shot, config)),
        "st_map": [config.st_map, config.st_map_way, config.st_map_layer] if config.st_map else None,
    }


def _lens_of_map(config: SolveConfig, frames: dict[str, Any], report: Reporter) -> MapLens | None:
    """The lens from the ST map; None without an ST map."""
    if not config.st_map:
        return None
    return map_reading.read_lens(config.st_map, config.st_map_way, config.st_map_layer, frames, report)


def _mask_sources(shot: Shot, config: SolveConfig) -> dict[str, str]:
    """Maps each kind of mask to its source; an empty source means no mask."""
    ignored = config.ignore_mask
    if ignored == MASK_FOUND:
        ignored = str(shot.burnt_in) if shot.burnt_in.is_file() else ""
    return dict(zip(MASK_KINDS, (ignored, config.people_mask), strict=True))


def _key(config: SolveConfig, frames: dict[str, Any], source: list[str], masks: dict[str, Mask]) -> str:
    """Key that identifies a solve. It uses the contents of masks and files, not their paths."""
    settings = asdict(config)
    new = ["ignore_mask", "people_mask"]  # not in the keys of earlier solves, which stay valid
    new += ["st_map"] + ([] if config.st_map else ["st_map_way", "st_map_layer"])  # `source` has the file's fingerprint
    new += [] if config.focal_mm else ["focal_mm", "sensor_mm", "refine_focal"]
    new += ["retry"] if config.retry else []  # a solve without retries has another key
    for name in new:
        settings.pop(name)
    return content_key(SOLVE_VERSION, settings, frames.get("key"), *source, *(mask.key for mask in masks.values()))


def _mark_motion_unfinished(shot: Shot) -> None:
    """Marks the shot so that a later step searches for motion if the job ends between the solve and the search.

    The mark does not invalidate mattes that match the shot's cameras. They stay valid if the new solve is discarded.
    """
    mark = shot.own(shot.motion) / MOTION_UNFINISHED_FILE
    if not mark.is_file():
        make_folder(mark.parent)
        write_json(mark, {"version": 0})


def _log_end(log: Path) -> str:
    """The end of COLMAP's log, for the job's log."""
    try:
        with open_regular(log) as handle:
            handle.seek(max(0, os.fstat(handle.fileno()).st_size - _LOG_END_BYTES))
            end = handle.read().decode("utf-8", errors="replace")
    except (OSError, ValueError):
        return ""
    return f"The end of {log}:\n{end}"


def _check(config: SolveConfig, cameras: str) -> None:
    if config.st_map and cameras:
        raise JobError(
            "Imported cameras already have a lens, so they cannot be used with an ST map.",
            "Use only one of the two.",
            ExitCode.USAGE,
        )
    if config.st_map_way not in ST_MAP_WAYS:
        raise UserError(f"st_map_way should be one of {', '.join(ST_MAP_WAYS)}, got {config.st_map_way!r}")
    if config.camera_model not in CAMERA_MODELS:
        raise UserError(f"camera_model should be one of {', '.join(CAMERA_MODELS)}, got {config.camera_model!r}")
    if config.focal_mm < 0 or config.sensor_mm <= 0:
        raise UserError(f"focal_mm and sensor_mm should be lengths, got {config.focal_mm} and {config.sensor_mm}")
    if not 1 <= config.overlap <= 31 or config.features < 128 or config.neighbours < 1:
        raise UserError(
            "overlap should be 1 to 31, features at least 128 and neighbours at least 1, got "
            f"{config.overlap}, {config.features} and {config.neighbours}"
        )


def _finished(shot: Shot, frames: dict[str, Any], key: str) -> dict[str, Any] | None:
    """solve.json if its key is `key` and the solve is complete; else None, so that a damaged solve is repeated."""
    try:
        record = load_record(shot)
        if record.get("key") != key or not isinstance(record.get("result"), dict):
            return None
        load_cameras(shot)
        load_points(shot)
    except (JobError, ValueError):
        return None
    numbers = [f["frame"] for f in frames["frames"]]
    plates = [shot.plate(n) for n in numbers]
    plates += [shot.mask(kind, n) for kind in recorded_masks(shot) for n in numbers]
    return record if all(is_whole_png(p) for p in plates) else None


def _refuse_damaged(shot: Shot, frames: dict[str, Any]) -> None:
    """Raises JobError (FOOTAGE) if a frame cannot be read: COLMAP would skip it and report that only in its log."""
    damaged = [f["frame"] for f in frames["frames"] if not is_whole_png(shot.frames / f["file"])]
    if damaged:
        raise JobError(
            f"Damaged or missing in {shot.raw}: {frame_words(damaged)}.",
            "Import the clip again.",
            ExitCode.FOOTAGE,
        )


def _matching(
    frames: dict[str, Any],
    config: SolveConfig,
    masks: dict[str, Mask],
    scratch: Path,
    undistort: Undistorter | None = None,
) -> dict[str, Any]:
    """The request's fields about features and matches. Also writes COLMAP's masks, undistorted by `undistort`."""
    options: dict[str, Any] = {"overlap": config.overlap, "features": config.features}
    if not masks:
        return options
    folder = scratch / "not_matched"
    write_matching(masks, {f["frame"]: Path(f["file"]).name for f in frames["frames"]}, folder, undistort)
    options |= {"features": round(config.features * more_features(masks)), "masks": str(folder)}
    return {**options, "wide": True} if needs_wide(masks) else options


def _focal_of_file(frames: dict[str, Any]) -> float:
    """Focal length in pixels of the working frames, from the footage's metadata; 0 if it has none."""
    focal = frames.get("reading", {}).get("focal_35mm")
    return focal_px(focal, frames["width"], frames["height"]) if focal else 0.0


def _request(
    shot: Shot,
    frames: dict[str, Any],
    config: SolveConfig,
    masks: dict[str, Mask],
    scratch: Path,
    undistorted: UndistortedFrames | None,
) -> dict[str, Any]:
    """The first request to the worker. For frames that were undistorted first, the distortion is fixed at 0."""
    scale = 1.0 if undistorted is None else undistorted.focal_scale
    names: dict[bool, list[str]] = {True: [], False: []}
    for frame in frames["frames"]:
        names[bool(frame["solve"])].append(Path(frame["file"]).name)
    return {
        "images": str(shot.raw if undistorted is None else undistorted.folder),
        "solved": names[True],
        "others": names[False],
        "camera_model": config.camera_model if undistorted is None else "SIMPLE_RADIAL",
        "hold_bend": undistorted is not None,
        "size": [frames["width"], frames["height"]],
        "focal_px": config.focal_mm / config.sensor_mm * frames["width"] * scale,
        "hold_focal": not config.refine_focal,
        "start_focal_px": _focal_of_file(frames) * scale,
        **_matching(frames, config, masks, scratch, None if undistorted is None else undistorted.undistort),
        "neighbours": config.neighbours if config.localise else 0,
        "threads": max(1, min(os.cpu_count() or 1, 16)),
    }
