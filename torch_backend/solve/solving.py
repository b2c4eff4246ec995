"""Cameras from the working frames: COLMAP in a child process, then undistorted frames and plain files."""

from __future__ import annotations

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from ..array_types import save_arrays
from ..contract import (
    CAMERA_MODELS,
    CAMERAS_FILE,
    CAMERAS_KNOWN,
    COLMAP_FOLDER,
    MASK_FOUND,
    MASK_KINDS,
    MOTION_UNFINISHED_FILE,
    PICTURE,
    POINTS_FILE,
    SOLVE_FILE,
    ST_MAP_WAYS,
    STMAP_FILES,
    CameraFrame,
    CameraPath,
    Cancelled,
    ExitCode,
    JobError,
    Reporter,
    UserError,
    frame_file,
    open_regular,
)
from ..footage import load_frames
from ..footage.display import display_of
from ..footage.images import is_whole_png, read_frame, write_png
from ..footage.lens_tags import focal_px
from ..footage.masks import Mask, read_masks
from ..footage.sources import frame_words
from ..replacing import Staged, replacing_solve, settle_solve
from ..shot import Shot, atomic_path, content_key, make_folder, need_disk, replace_file, write_json
from . import foreign, map_reading
from .flat import flat_words
from .floor import floor_of
from .given import doubts, prepare, refuse_misfit, take_over
from .ladder import climb
from .lens_verdict import lens_remarks
from .map_lens import MapLens
from .masks import facts_of, given_masks, more_features, wants_wide, write_matching, write_undistorted
from .points import filter_points
from .poses import camera_centre, fill_poses
from .stored import load_cameras, load_points, load_record
from .straight import Straight
from .undistort import Undistorter, of_frames
from .verdict import FAIR_ERROR_PX, doubt_of, quality_words
from .zoom import zoom_words

if TYPE_CHECKING:
    from .motion import StaticModel

SOLVE_VERSION = 1
_WRITERS = 2
_LOG_END_BYTES = 16_384


@dataclass
class SolveConfig:
    """How cameras are found."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model, one camera for all frames: SIMPLE_RADIAL, OPENCV for strong or tangential distortion, or
    OPENCV_FISHEYE."""
    overlap: int = 15
    """Each solved frame is matched with those 1, 2, 4, ... 2^(overlap - 1) frames after it."""
    features: int = 4096
    """Most SIFT features per frame, from the upsampled octave on."""
    localise: bool = True
    """Place frames that the step left out against the model, each by itself; else they are interpolated."""
    neighbours: int = 2
    """A frame to be placed is matched with this many registered frames on either side of it."""
    ignore_mask: str = ""
    """Mask of what is no part of the scene, as `footage.masks.read_masks` takes it, or `MASK_FOUND`; empty: none."""
    people_mask: str = ""
    """Mask of what alone may move; empty: everything may."""
    focal_mm: float = 0.0
    """Focal length of the lens in mm, with which the solve begins; 0: it is not known."""
    sensor_mm: float = 36.0
    """Width in mm of the part of the sensor that the picture shows."""
    refine_focal: bool = True
    """Refine `focal_mm`; else it is held."""
    st_map: str = ""
    """File of an ST map that holds the lens; empty: the solve finds it."""
    st_map_way: str = "undistort"
    """One of `contract.ST_MAP_WAYS`."""
    st_map_layer: str = ""
    """Layer of the file; empty: red and green."""
    retry: bool = True
    """Try again in other ways where the solve is refused or poor, as `ladder.climb` does."""


class SolveResult(TypedDict):
    """What `solve_shot` returns, and summary.json repeats."""

    frames: int
    """Source frames of the range; each has a camera."""
    solved_frames: int
    """Frames given to the mapper."""
    registered: int
    """Of these, frames that the mapper placed."""
    localised: int
    """Further frames placed against the model."""
    interpolated: int
    """Frames whose pose is interpolated or held."""
    reprojection_error_px: float
    """Mean over the model's observations."""
    points: int
    """Points in points.npz."""
    focal_px: float
    """Focal length of the undistorted frames in pixels."""
    quality: str
    """The same in words."""
    motion_pixels_share: NotRequired[float]
    """Share of the frames' pixels that move by themselves; absent if it could not be found out."""
    unknown_share: NotRequired[float]
    """Share of them of which that is not known."""


def solve_shot(
    shot: Shot, config: SolveConfig, report: Reporter, cameras: str = "", static_model: StaticModel | None = None
) -> SolveResult:
    """Finds the camera of every frame of `shot` and writes the undistorted frames.

    Writes frames/NNNNNN.png, solve/points.npz, solve/colmap/, solve/cameras.json and, last, solve/solve.json: a
    contract.CameraPath in COLMAP's world ("solve units"), OpenCV axes, world-to-camera, pinhole of the undistorted
    frames. They take the place of a solve of before when all of them are written; until then, and if this one fails,
    that one stays. A shot already solved from the same frames with the same configuration is left alone.

    With an ST map in `config` the frames are undistorted through it first, and the solve finds the focal length alone.

    With `cameras`, a path that `foreign.read` understands, the cameras of that file are taken instead of solving: in
    its world, frames without one interpolated.

    Then the motion matte of every frame is found (`motion.find_motion`, which `static_model` is for); the solve holds
    without it. Between the two `report` hears a metric `CAMERAS_KNOWN`.

    Raises JobError (SOLVE) in one sentence if cameras cannot be found, and Cancelled.
    """
    _check(config, cameras)
    for folder in (
        shot.frames,
        shot.colmap,
        *(shot.masks(kind) for kind in MASK_KINDS),
    ):  # files of before are replaced
        shot.own(folder)
    settle_solve(shot)
    frames = load_frames(shot)
    source = [foreign.fingerprint(cameras)] if cameras else []
    source += [map_reading.fingerprint(config.st_map)] if config.st_map else []
    masks = read_masks(shot, _mask_sources(shot, config), report)
    key = _key(config, frames, source, masks)
    done = _finished(shot, frames, key)
    if done is not None:
        report.progress("solve", 1, 1, "already solved")
        report.metric(CAMERAS_KNOWN, dict(done["result"]))
        return _with_motion(shot, done["result"], report, static_model)
    taken = prepare(frames, cameras, report) if cameras else None
    lens = _lens_of_map(config, frames, report)
    _refuse_damaged(shot, frames)
    # Undistorted frames are as large as the imported ones; features and matches take about 1 MB a frame.
    size = (1.2 if lens is None else 2.4) * sum((shot.frames / f["file"]).stat().st_size for f in frames["frames"])
    need_disk(shot.root, size + (len(frames["frames"]) << 20), "The camera solve")
    scratch = shot.solve / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    make_folder(scratch)
    try:
        if taken is None:
            straight = None if lens is None else Straight(shot, frames, lens, scratch / "straight", report)
            request = _request(shot, frames, config, masks, scratch, straight)
            climbed = climb(request, frames, config.retry, scratch, shot.colmap_log, report)
            answer = {**climbed.best.answer["result"], "rung": climbed.best.rung, "tries": climbed.tries}
            left = climbed.best.folder
            if straight is not None:
                answer |= straight.told(left)
        else:
            options = _matching(frames, config, masks, scratch)
            answer, left = take_over(shot, frames, taken, options, scratch, report), scratch
        mapped = any((shot.solve / name).is_file() for name in STMAP_FILES)
        with replacing_solve(shot) as staged:
            result = _finish(shot, frames, answer, masks, config, left, staged, key, report)
            _mark_motion_unfinished(shot)
    except JobError as error:
        error.add_note(_log_end(shot.colmap_log))
        raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if mapped:
        report.warning("The ST maps of the solve before were of its lens: they are gone.", "Write them again.")
    report.metric(CAMERAS_KNOWN, dict(result))
    result = _with_motion(shot, result, report, static_model)
    report.metric("solve", dict(result))
    return result


def _lens_of_map(config: SolveConfig, frames: dict[str, Any], report: Reporter) -> MapLens | None:
    """The lens that the ST map holds; None without one."""
    if not config.st_map:
        return None
    return map_reading.read_lens(config.st_map, config.st_map_way, config.st_map_layer, frames, report)


def _mask_sources(shot: Shot, config: SolveConfig) -> dict[str, str]:
    """Kind of mask -> where it comes from; empty: there is none."""
    ignored = config.ignore_mask
    if ignored == MASK_FOUND:
        ignored = str(shot.burnt_in) if shot.burnt_in.is_file() else ""
    return dict(zip(MASK_KINDS, (ignored, config.people_mask), strict=True))


def _key(config: SolveConfig, frames: dict[str, Any], source: list[str], masks: dict[str, Mask]) -> str:
    """Tells a solve from others. Masks count by what they cover, wherever they lie."""
    settings = asdict(config)
    new = ["ignore_mask", "people_mask"]  # solves of before had none of these
    new += ["st_map"] + ([] if config.st_map else ["st_map_way", "st_map_layer"])  # the file counts by what is in it
    new += [] if config.focal_mm else ["focal_mm", "sensor_mm", "refine_focal"]
    new += ["retry"] if config.retry else []  # who switches it on again wants what it may find
    for name in new:
        settings.pop(name)
    return content_key(SOLVE_VERSION, settings, frames.get("key"), *source, *(mask.key for mask in masks.values()))


def _mark_motion_unfinished(shot: Shot) -> None:
    """Has later steps find what moves if the job ends after the cameras are written and before the search begins.

    Mattes that belong to the shot's cameras are not made void by it: should the new solve not come to hold, they stay.
    """
    mark = shot.own(shot.motion) / MOTION_UNFINISHED_FILE
    if not mark.is_file():
        make_folder(mark.parent)
        write_json(mark, {"version": 0})


def _with_motion(
    shot: Shot, result: SolveResult, report: Reporter, static_model: StaticModel | None = None
) -> SolveResult:
    """`result` with what moves in the clip. Cameras took minutes: whatever keeps the matte from them is a warning."""
    try:
        from .motion import find_motion

        found = find_motion(shot, report, with_points=True, static_model=static_model)
        if (doubt := doubt_of(found["motion_pixels_share"])) is not None:
            report.warning(*doubt)
        return {**result, **found}
    except Cancelled:
        raise
    except Exception as error:  # OpenCV raises its own kinds, and is missing where set-up was not run again
        report.warning(
            f"What moves by itself could not be told from the pictures: {' '.join(str(error).split())[:300]}",
            "The cameras are whole; solve again to try once more.",
        )
        return result


def _log_end(log: Path) -> str:
    """What COLMAP said last, for the job's own log."""
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
            "Cameras from elsewhere bring their own lens: an ST map beside them would be a second one.",
            "Give one of the two.",
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
    """solve.json if it is of this key and the solve is whole: to solve again is how a damaged one is mended."""
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
    plates += [shot.mask(kind, n) for kind in given_masks(shot) for n in numbers]
    return record if all(is_whole_png(p) for p in plates) else None


def _refuse_damaged(shot: Shot, frames: dict[str, Any]) -> None:
    """JobError (FOOTAGE) if a frame cannot be read: COLMAP would leave it out, and say so in its log alone."""
    bad = [f["frame"] for f in frames["frames"] if not is_whole_png(shot.frames / f["file"])]
    if bad:
        raise JobError(
            f"Damaged or missing in {shot.raw}: {frame_words(bad)}.",
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
    """What the worker is told of features and matches; writes its masks, of frames that went through `undistort`."""
    options: dict[str, Any] = {"overlap": config.overlap, "features": config.features}
    if not masks:
        return options
    folder = scratch / "not_matched"
    write_matching(masks, {f["frame"]: Path(f["file"]).name for f in frames["frames"]}, folder, undistort)
    options |= {"features": round(config.features * more_features(masks)), "masks": str(folder)}
    return {**options, "wide": True} if wants_wide(masks) else options


def _focal_of_file(frames: dict[str, Any]) -> float:
    """Focal length in pixels of the working frames that the footage's file tells; 0 if it does not."""
    told = frames.get("reading", {}).get("focal_35mm")
    return focal_px(told, frames["width"], frames["height"]) if told else 0.0


def _request(
    shot: Shot,
    frames: dict[str, Any],
    config: SolveConfig,
    masks: dict[str, Mask],
    scratch: Path,
    straight: Straight | None,
) -> dict[str, Any]:
    """What the worker is asked for at first: of frames whose lens was taken out before, no bend."""
    scale = 1.0 if straight is None else straight.focal_scale
    names: dict[bool, list[str]] = {True: [], False: []}
    for frame in frames["frames"]:
        names[bool(frame["solve"])].append(Path(frame["file"]).name)
    return {
        "images": str(shot.raw if straight is None else straight.folder),
        "solved": names[True],
        "others": names[False],
        "camera_model": config.camera_model if straight is None else "SIMPLE_RADIAL",
        "hold_bend": straight is not None,
        "size": [frames["width"], frames["height"]],
        "focal_px": config.focal_mm / config.sensor_mm * frames["width"] * scale,
        "hold_focal": not config.refine_focal,
        "start_focal_px": _focal_of_file(frames) * scale,
        **_matching(frames, config, masks, scratch, None if straight is None else straight.undistort),
        "neighbours": config.neighbours if config.localise else 0,
        "threads": max(1, min(os.cpu_count() or 1, 16)),
    }


def _finish(
    shot: Shot,
    frames: dict[str, Any],
    answer: dict[str, Any],
    masks: dict[str, Mask],
    config: SolveConfig,
    scratch: Path,
    staged: Staged,
    key: str,
    report: Reporter,
) -> SolveResult:
    """Writes the solve's files, from what the worker left in `scratch`, to where they wait until they are whole."""
    solved = sum(f["solve"] for f in frames["frames"])
    poses = json.loads((scratch / "poses.json").read_text(encoding="utf-8"))
    maps = [scratch / f"undistort_{n}.npz" for n in range(1 + max(p.get("lens", 0) for p in poses.values()))]
    path, lenses = _camera_path(frames, poses, [_pinhole(file) for file in maps])
    with np.load(scratch / POINTS_FILE, allow_pickle=False) as data:
        points = filter_points({name: data[name] for name in data.files}, _centres(path))
    if "given" in answer:
        refuse_misfit(answer, len(points["xyz"]))
    _undistort_all(shot, frames, lenses, maps, masks, staged, report)
    with atomic_path(staged.solve / POINTS_FILE) as beside:
        save_arrays(beside, points)
    replace_file(scratch / "model", staged.solve / COLMAP_FOLDER)
    write_json(staged.solve / CAMERAS_FILE, path.to_json())
    misled = flat_words(points["xyz"]) or zoom_words(
        {int(Path(name).stem): change for name, change in answer.get("focal_changes", {}).items() if change is not None}
    )
    result = _result(answer, path, solved, len(points["xyz"]), path.frames[0].K[0], misled is not None)
    warnings = _warnings(frames, path, result, "given" in answer)
    warnings = ([misled] if misled is not None else []) + warnings
    warnings += doubts(answer) if "given" in answer else lens_remarks(answer)
    for message, hint in warnings:
        report.warning(message, hint)
    record = {
        "version": SOLVE_VERSION,
        "key": key,
        "registered": result["registered"],
        "solved_frames": solved,
        "total_frames": result["frames"],
        "reprojection_error_px": result["reprojection_error_px"],
        "points": result["points"],
        "camera_model": answer["camera_model"],
        "distortion": answer["distortion"],
        "focal_px": answer["focal_px"],
        "focal_start_px": answer.get("lens", {}).get("start_px", 0.0),
        "lenses": [_lens(file) for file in maps],
        "lens_of_frame": lenses,
        "triangulation_angle_deg": answer["triangulation_angle_deg"],
        "quality": result["quality"],
        "cameras_from": answer.get("given", "solve"),
        "world": answer.get("world", ""),
        "rung": answer.get("rung"),
        "tries": answer.get("tries", []),
        "agreement": answer.get("agreement"),
        "floor": floor_of(path, points["xyz"]),
        "masks": facts_of(masks, _mask_sources(shot, config)),
        "st_map": [config.st_map, config.st_map_way, config.st_map_layer] if config.st_map else None,
        "warnings": [" ".join(w).strip() for w in warnings],
        "result": result,
    }
    write_json(staged.solve / SOLVE_FILE, record)
    return result


def _pinhole(file: Path) -> NDArray[np.float64]:
    with np.load(file, allow_pickle=False) as data:
        return data["pinhole"]


def _lens(file: Path) -> dict[str, Any]:
    """A lens of the working frames, as COLMAP names and orders it."""
    with np.load(file, allow_pickle=False) as data:
        return {"model": str(data["model"]), "params": data["params"].tolist()}


def _camera_path(
    frames: dict[str, Any], poses: dict[str, Any], pinholes: list[NDArray[np.float64]]
) -> tuple[CameraPath, list[int]]:
    """A camera for every frame: registered, localised, or interpolated in time between those; and its lens's index.

    `pinholes` are fx, fy, cx, cy of each lens. A frame between two lenses has the nearer frame's.
    """
    listed = frames["frames"]
    names = [Path(f["file"]).name for f in listed]
    known = {i: np.array(poses[name]["pose"]) for i, name in enumerate(names) if name in poses}
    filled = fill_poses(np.array([f["seconds"] for f in listed]), known)
    nearest = _nearest(sorted(known), len(names))
    lenses = [int(poses[names[k]].get("lens", 0)) for k in nearest]
    cameras: list[CameraFrame] = []
    for frame, name, pose, lens in zip(listed, names, filled, lenses, strict=True):
        viewmat = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]]).ravel().tolist()
        source = poses[name]["source"] if name in poses else "interpolated"
        cameras.append(CameraFrame(frame["frame"], viewmat, pinholes[lens].tolist(), source))
    return CameraPath(frames["width"], frames["height"], cameras), lenses


def _nearest(known: list[int], count: int) -> list[int]:
    """The nearest of some ascending indices to each of 0 to `count` - 1; of two as near the lower."""
    spots = np.array(known)
    every = np.arange(count)
    above = np.searchsorted(spots, every).clip(0, len(spots) - 1)
    below = (above - 1).clip(0)
    return np.where(every - spots[below] <= spots[above] - every, spots[below], spots[above]).tolist()


def _centres(path: CameraPath) -> NDArray[np.float64]:
    return np.array([camera_centre(np.reshape(f.viewmat, (4, 4))) for f in path.frames])


def _undistort_all(
    shot: Shot,
    frames: dict[str, Any],
    lenses: list[int],
    maps: list[Path],
    masks: dict[str, Mask],
    into: Staged,
    report: Reporter,
) -> None:
    """Writes the undistorted frames and masks, lens by lens: a map takes 128 bytes per pixel."""
    done = 0
    for number, file in enumerate(maps):
        rows = [frame for frame, lens in zip(frames["frames"], lenses, strict=True) if lens == number]
        if rows:
            _undistort(shot, rows, file, masks, into, (done, len(lenses)), report)
        done += len(rows)


def _undistort(
    shot: Shot,
    listed: list[dict[str, Any]],
    file: Path,
    masks: dict[str, Mask],
    into: Staged,
    counts: tuple[int, int],
    report: Reporter,
) -> None:
    """Frames of one lens; `counts` are the frames done before these, and all there are."""
    before, total = counts
    with np.load(file, allow_pickle=False) as data:
        where = data["where"]
    undistort = Undistorter(where)
    of_frame = of_frames(undistort, where, display_of(load_frames(shot)))

    def one(frame: dict[str, Any]) -> int:
        pixels = read_frame(shot.frames / frame["file"])
        write_png(into.frames / frame_file(frame["frame"], PICTURE), of_frame(pixels))
        if masks:
            write_undistorted(masks, frame["frame"], undistort, into.solve)
        return frame["frame"]

    with ThreadPoolExecutor(_WRITERS) as pool:
        waiting = [pool.submit(one, frame) for frame in listed]
        try:
            for done, future in enumerate(waiting, start=1 + before):
                report.check_cancelled()
                report.progress("solve: undistort", done, total, f"frame {future.result()}")
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _result(
    answer: dict[str, Any], path: CameraPath, solved: int, points: int, focal: float, misled: bool
) -> SolveResult:
    sources = [f.source for f in path.frames]
    error = round(float(answer["reprojection_error_px"]), 4)
    registered = int(answer["registered"])
    return SolveResult(
        frames=len(sources),
        solved_frames=solved,
        registered=registered,
        localised=sources.count("localised"),
        interpolated=sources.count("interpolated"),
        reprojection_error_px=error,
        points=points,
        focal_px=round(focal, 3),
        quality=quality_words(registered, solved, error, "given" in answer, misled),
    )


def _warnings(
    frames: dict[str, Any], path: CameraPath, result: SolveResult, given: bool = False
) -> list[tuple[str, str]]:
    warnings: list[tuple[str, str]] = []
    lost = [
        camera.frame
        for camera, frame in zip(path.frames, frames["frames"], strict=True)
        if frame["solve"] and camera.source != "registered"
    ]
    if lost and not given:  # given cameras were told of when they were matched
        warnings.append(
            (
                f"The mapper did not register {len(lost)} solved frames: {frame_words(lost)}.",
                "Their cameras are placed from their neighbours.",
            )
        )
    guessed = [i for i, camera in enumerate(path.frames) if camera.source == "interpolated"]
    placed = [i for i, camera in enumerate(path.frames) if camera.source != "interpolated"]
    held = [path.frames[i].frame for i in guessed if i < placed[0] or i > placed[-1]]
    if held:
        warnings.append(
            (
                f"The camera holds its pose in {frame_words(held)}, beyond the last frame that was placed.",
                "Cut them off.",
            )
        )
    if result["reprojection_error_px"] > FAIR_ERROR_PX:
        hint = "Are they of this clip and its lens?" if given else "Try the OPENCV camera model."
        warnings.append(("The reprojection error is high: the picture will be soft.", hint))
    return warnings
