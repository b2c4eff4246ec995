"""Imports footage into a shot folder: extracts working frames, measures them, and selects frames to solve and train."""

from __future__ import annotations

import os
import re
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..contract import (
    BURNT_IN_FILE,
    FOLDERS_OF_FRAMES,
    FRAMES_FILE,
    LAST_FRAME,
    PICTURE,
    RAW_FOLDER,
    UNPUBLISHED_FILE,
    ImportParams,
    JobError,
    Reporter,
    ShotFolder,
    UserError,
    frame_file,
    later,
    mapped,
    read_json,
)
from ..shot import Shot, content_key, make_folder, need_disk, replacing_folder, restore_folder, write_json
from .analysis import FrameMeasures, automatic_step, choose_solved, flag_duplicate, looks_like_log, measure
from .bars import Bars, find_bars
from .burnt_in import WIDTH, find_mark, looked_at
from .display import PLAIN, ROLLED, Display, clipped_share
from .earlier_work import EarlierWork, SamePictures, digest_of, footage_key
from .foreign_files import keep_foreign_files
from .images import is_whole_png, read_frame, resize, working_size, write_png
from .import_findings import Extracted, refuse_cuts, refuse_unusable, remarks
from .numbering import recorded_shift, renumbered, shift_of
from .ocio import Colours
from .opening import open_source
from .reading import read_as
from .sources import (
    FASTEST_FPS,
    LEAST_FRAMES,
    SLOWEST_FPS,
    Source,
    SourceFrame,
    SourceInfo,
    footage_error,
    overrides_of,
)

FRAMES_VERSION = 1
_WRITERS = 2
_DISK_CHECK_FRAMES = 16


FootageConfig = ImportParams
"""Range, size and colour of an import. `import_footage` ignores its `source` and has a separate argument."""


def import_footage(shot: Shot, source: str, config: FootageConfig, report: Reporter) -> dict[str, Any]:
    """Extracts every source frame of the range into `shot`, and writes frames.json and shot.json.

    Frames are frames/raw/NNNNNN.png: 8-bit sRGB, or 16-bit for a deeper source. If the source holds light, they have a
    shoulder (`display` in frames.json). `seconds` in frames.json count from the first frame of the range. A finished
    import of the same source and configuration is kept, also one by a version without the shoulder. Otherwise, the new
    import replaces the old one when complete; files from other programs stay. If the old frames carry work,
    `config.replace` must be set, and frames and work move to SHOT/replaced. An import of the same pictures replaces
    nothing.

    Returns {frames, solved_frames, first, last, step, width, height, fps, colour, reading, read_as, source}.
    Raises JobError (FOOTAGE, DISK) or Cancelled; neither leaves a partial import.
    """
    _check(config)
    opened = open_source(source, config.fps, config.layer, Colours(config.colour_space), overrides_of(config))
    shift = shift_of(opened.info, config)
    _check_range(opened, config, shift)
    key = import_key(opened.info, config, shift=shift)
    for folder in (shot.raw, *(shot.root / name for name in FOLDERS_OF_FRAMES)):
        shot.own(folder)
    shot.publish_frames()
    restore_folder(shot.frames)
    done = _finished(shot, {k for d in (None, PLAIN) for k in import_keys(opened.info, config, d, shift)})
    if done is not None:
        report.progress("import", 1, 1, "already imported")
        if shot.info().source != str(source):  # the same footage was moved: remember its new place
            shot.update(source=str(source))
        return _result(shot, done)
    opened = renumbered(opened, shift)  # all following code uses the shot's numbers
    numbered = _in_the_shots_numbers(config, shift)
    earlier = EarlierWork.of(shot, _listed_before(shot))
    if earlier is not None and not config.replace and not earlier.may_be_same(_recorded(numbered), opened.info):
        raise earlier.refusal()
    order: dict[str, Any] = {}
    try:
        with replacing_folder(shot.frames, keep=earlier is not None) as fresh:
            extracted = _extract(shot, opened, numbered, fresh / RAW_FOLDER, report)
            refuse_unusable(extracted.measures)
            refuse_cuts(extracted.measures, fresh / RAW_FOLDER, shift)
            record = _record(opened, config, extracted, key, shift)
            record["beside"] = _relative_source(shot, source)
            if earlier is not None:
                earlier.stop_if_same(record, fresh)
                if not config.replace:
                    raise earlier.refusal()
                order = earlier.order(record)
            for message, hint in opened.warnings + remarks(extracted) + _log_remark(opened.info, config, extracted):
                report.warning(message, hint)
            record |= _marked(shot, record, fresh, report)
            write_json(fresh / FRAMES_FILE, record)
            write_json(fresh / UNPUBLISHED_FILE, _news(record, source) | order)  # takes effect together with the frames
            keep_foreign_files(shot.frames, fresh, record)
    except SamePictures:
        report.progress("import", 1, 1, "already imported")
        shot.update(source=str(source))
        return _result(shot, load_frames(shot))
    shot.publish_frames()
    if earlier is not None:
        report.warning(*earlier.kept(order))
    return _result(shot, record)


# Settings that are always part of the key. Others only count if not at their default, so that a new option does not
# invalidate finished imports.
_ALWAYS_IN_THE_KEY = ("first", "last", "step", "working_height", "fps")


def display_for(info: SourceInfo) -> Display:
    """The display for new working frames of a source."""
    return ROLLED if info.colour == "linear" else PLAIN


def import_key(info: SourceInfo, config: FootageConfig, display: Display | None = None, shift: int = 0) -> str:
    """Key of an import: identifies the footage, the settings and the display.

    `display` None: the result of `display_for`. `shift`: see `numbering`.
    """
    return _import_key(info.key, config, display or display_for(info), shift)


def import_keys(info: SourceInfo, config: FootageConfig, display: Display | None = None, shift: int = 0) -> set[str]:
    """All keys of a finished import: `import_key`, and the key by an earlier version, which depends on file times."""
    display = display or display_for(info)
    return {_import_key(key, config, display, shift) for key in (info.key, info.former_key) if key}


def _import_key(footage: list[Any], config: FootageConfig, display: Display, shift: int) -> str:
    plain = _recorded(type(config)())
    settings = {n: v for n, v in _recorded(config).items() if n in _ALWAYS_IN_THE_KEY or v != plain[n]}
    settings.pop("start", None)  # `shift` replaces it: a start at the footage's own number changes nothing
    settings |= {"shift": shift} if shift else {}
    return content_key(FRAMES_VERSION, footage, settings, *([display.name] if display.name else []))


def _recorded(config: FootageConfig) -> dict[str, Any]:
    """Settings that determine the imported pictures: all but the footage's path and the consent to replace."""
    return {name: value for name, value in asdict(config).items() if name not in ("source", "replace")}


def _listed_before(shot: Shot) -> dict[str, Any]:
    """frames.json of the shot's present frames; {} if it is missing or damaged."""
    try:
        return load_frames(shot)
    except JobError:
        return {}


def _in_the_shots_numbers(config: FootageConfig, shift: int) -> FootageConfig:
    """The configuration with its range converted from the footage's numbers to the shot's numbers."""
    first, last = (None if number is None else number + shift for number in (config.first, config.last))
    return replace(config, first=first, last=last)


def load_frames(shot: Shot) -> dict[str, Any]:
    """The frames.json of a finished import. Raises JobError if it is missing or damaged."""
    path = shot.listing
    if not path.is_file():
        raise footage_error(f"The shot {shot.root.name} has no frames yet.", "Import footage first.")
    try:
        record = read_json(path)
        rows = [(int(f["frame"]), float(f["seconds"]), str(f["file"]), bool(f["solve"])) for f in record["frames"]]
        for row in record["frames"]:
            row["sharpness"] = float(row.get("sharpness", 0.0))
        numbers = [number for number, *_ in rows]
        is_valid = bool(rows) and numbers == sorted(set(numbers)) and int(record["width"]) * int(record["height"]) > 0
    except (ValueError, TypeError, KeyError, OverflowError):
        record, numbers, is_valid = {}, [], False
    if not is_valid:
        raise footage_error(f"{path} is damaged.", "Import the clip again.")
    if numbers[0] < 0 or numbers[-1] > LAST_FRAME:  # earlier versions read a dash in a file name as a minus
        raise footage_error(
            f"The frames of this shot are numbered {numbers[0]} to {numbers[-1]}: Blender's go from 0 to {LAST_FRAME}.",
            "Import the clip again.",
        )
    return record


def holds_footage(root: Path, config: FootageConfig) -> bool:
    """True if the shot in a folder was imported from footage with the content of `config.source`, at any path.

    Raises JobError if the footage cannot be opened.
    """
    try:
        record = read_json(ShotFolder(root).listing)
    except (OSError, ValueError):
        return False
    opened = open_source(config.source, config.fps, config.layer, Colours(config.colour_space), overrides_of(config))
    return record.get("footage") == footage_key(opened.info, recorded_shift(record))


def source_places(shot: Shot, record: dict[str, Any]) -> list[str]:
    """Paths where a shot's footage may lie, in order of preference.

    These are the recorded path mapped for this machine, the recorded path, the recorded path relative to the shot (both
    may have moved together), and the file's name in the shot's parent folder.
    """
    named, relative = shot.info().source, str(record.get("beside") or "")
    places = [mapped(named), named] if named else []
    if relative:
        places.append(str((shot.root / relative).resolve()))
    if named:
        places.append(str(shot.root.parent / re.split(r"[\\/]", named)[-1]))
    return list(dict.fromkeys(places))


def _check(config: FootageConfig) -> None:
    if config.step < 0 or config.working_height < 0:
        raise UserError(f"step and working_height cannot be negative: {config.step}, {config.working_height}")
    if config.fps and not SLOWEST_FPS <= config.fps <= FASTEST_FPS:  # also rejects NaN
        raise UserError(f"fps is {config.fps}: it should be {SLOWEST_FPS} to {FASTEST_FPS:g}, or 0: the footage's own")
    if config.first is not None and config.last is not None and config.last - config.first + 1 < LEAST_FRAMES:
        raise footage_error(
            f"Frames {config.first} to {config.last} are too few: a freeze needs at least {LEAST_FRAMES}.",
            "Widen the range.",
        )


def _check_range(opened: Source, config: FootageConfig, shift: int) -> None:
    """Raises JobError for a range outside of the footage, or for invalid frame numbers of the shot (own + `shift`)."""
    info = opened.info
    if info.last is None:
        return
    first = info.first if config.first is None else config.first
    last = info.last if config.last is None else config.last
    if first > info.last or last < info.first:
        raise footage_error(f"Frames {first} to {last} lie outside the clip, which has {info.first} to {info.last}.")
    first, last = max(first, info.first) + shift, min(last, info.last) + shift
    if last > LAST_FRAME or first < 0:
        raise footage_error(
            f"The frames are numbered {first} to {last}: Blender's frames end at {LAST_FRAME}.",
            "Number the shot from 1001 (Start, or --start 1001), or choose a range below that.",
        )


def _finished(shot: Shot, keys: set[str]) -> dict[str, Any] | None:
    try:
        record = load_frames(shot)
    except JobError:  # missing or damaged: import again
        return None
    is_complete = record.get("key") in keys and all(is_whole_png(shot.frames / f["file"]) for f in record["frames"])
    return record if is_complete else None


def _extract(shot: Shot, opened: Source, config: FootageConfig, into: Path, report: Reporter) -> Extracted:
    """Decodes, resizes, measures and writes every frame of the range."""
    info = opened.info
    width, height = working_size(info.width, info.height, config.working_height)
    display = display_for(info)
    if config.working_height > info.height:
        report.warning(f"The clip is {info.height} pixels high: the working frames stay that high.")
    total = _expected(opened, config)
    frame_bytes = width * height * (5.0 if info.deep else 2.0)
    # Twice, because the solve also writes undistorted frames.
    need_disk(shot.root, 2.0 * total * frame_bytes + (64 << 20), "The import of this clip")
    make_folder(into)
    measures: list[FrameMeasures] = []
    seconds: list[float] = []
    clipped, distinct = 0.0, None
    pending: deque[Future[FrameMeasures]] = deque()

    def collect() -> None:
        nonlocal distinct
        one = pending.popleft().result()
        repeats = flag_duplicate(one, distinct)
        spent = one if repeats else distinct  # later frames are only compared with the last distinct frame
        if spent is not None:
            spent.luma = np.zeros((0, 0), np.float32)
        distinct = distinct if repeats else one
        measures.append(one)
        report.progress("import", len(measures), max(total, len(measures)), f"frame {one.frame}")

    with ThreadPoolExecutor(_WRITERS) as pool:
        for frame in opened.frames(config.first, config.last):
            report.check_cancelled()
            if len(seconds) % _DISK_CHECK_FRAMES == 0:
                need_disk(shot.root, (_DISK_CHECK_FRAMES + 2) * frame_bytes, "The import of this clip")
            seconds.append(frame.seconds)
            if display.bends:
                clipped = max(clipped, clipped_share(frame.pixels))
            pending.append(pool.submit(_work, frame, width, height, display, into))
            while len(pending) > 2 * _WRITERS:
                collect()
        while pending:
            collect()
    return Extracted(measures, seconds, clipped, width, height)


def _work(frame: SourceFrame, width: int, height: int, display: Display, into: Path) -> FrameMeasures:
    bends = display.bends
    pixels = display.codes_of(frame.pixels, width, height) if bends else resize(frame.pixels, width, height)
    write_png(into / frame_file(frame.number, PICTURE), pixels)
    measures = measure(frame.number, pixels, display)
    measures.digest = digest_of(pixels)
    if frame.corrupt:
        measures.flags.append("corrupt")
    return measures


def _expected(opened: Source, config: FootageConfig) -> int:
    info = opened.info
    if info.last is None:
        return 1 if config.last is None else config.last - (info.first if config.first is None else config.first) + 1
    first = max(info.first, info.first if config.first is None else config.first)
    return min(info.last, info.last if config.last is None else config.last) - first + 1


def _log_remark(info: SourceInfo, config: FootageConfig, extracted: Extracted) -> list[tuple[str, str]]:
    """A warning about a clip that looks like camera log but was read as a picture for a display."""
    tones = looks_like_log(extracted.measures)
    if tones is None or info.colour == "linear" or config.colour_space or config.lut:
        return []
    colour = info.reading.get("colour", "video")
    return [
        (
            f"The picture looks as flat as log footage: its darkest tones are at {100 * tones[0]:.0f} %, its "
            f"brightest at {100 * tones[1]:.0f} %. It was read as {colour}.",
            "If it is log, set its colour space (--colour-space, such as 'ARRI LogC3 (EI800)'), or a look (--lut).",
        )
    ]


def _record(opened: Source, config: FootageConfig, extracted: Extracted, key: str, shift: int) -> dict[str, Any]:
    """The contents of frames.json. `shift`: see `numbering`."""
    measures, info = extracted.measures, opened.info
    step = config.step or automatic_step(len(measures), info.fps)
    solved = choose_solved(measures, step)
    if len(solved) < LEAST_FRAMES:
        raise footage_error(
            f"A step of {step} leaves {len(solved)} frames to solve, at least {LEAST_FRAMES} are needed.",
            "Choose a smaller step.",
        )
    start, timecode = extracted.seconds[0], str(info.reading.get("timecode", ""))
    # The timecode is that of the source's first frame. It cannot count below half a frame per second.
    timecode = later(timecode, measures[0].frame - info.first, info.fps) if timecode and round(info.fps) else ""
    frames = [
        {
            "frame": m.frame,
            "seconds": round(seconds - start, 6),
            "file": f"{RAW_FOLDER}/{frame_file(m.frame, PICTURE)}",
            "solve": m.frame in solved,
            "sharpness": round(m.sharpness, 3),
            "exposure": round(m.exposure, 4),
            "flags": m.flags,
            "digest": m.digest,
        }
        for m, seconds in zip(measures, extracted.seconds, strict=True)
    ]
    return {
        "version": FRAMES_VERSION,
        "width": extracted.width,
        "height": extracted.height,
        "fps": info.fps,
        "colour": info.colour,
        "reading": info.reading,
        "read_as": read_as(info, timecode) + _numbered(measures[0].frame, shift),
        "timecode": timecode,
        "bits": 16 if info.deep else 8,
        "source_size": [info.width, info.height],
        "extended": info.extended,
        **_displayed(info, measures),
        **({"shift": shift} if shift else {}),
        "clip": [info.first, info.last],
        "start": start,
        "step": step,
        "config": _recorded(config),
        "key": key,
        "footage": footage_key(info, shift),
        "frames": frames,
    }


def _numbered(first: int, shift: int) -> list[str]:
    """A sentence about the frame numbers, if the shot and the footage count differently."""
    return [f"Frame {first} of the shot is frame {first - shift} of the footage."] if shift else []


def _marked(shot: Shot, record: dict[str, Any], fresh: Path, report: Reporter) -> dict[str, Any]:
    """Detects bars and burnt-in overlays. Returns their entries for frames.json.

    Also writes their mask into `fresh`, and warns the artist.
    """
    usable = [row["file"] for row in record["frames"] if not row["flags"]]
    pictures: list[NDArray[np.uint8]] = []
    for n in looked_at(len(usable)):
        report.check_cancelled()
        pictures.append(_grey(fresh / usable[n]))
    bars = find_bars(pictures)
    inner = bars.inner(*pictures[0].shape) if pictures else ()
    mark = find_mark([picture[inner] for picture in pictures])
    if mark is None and not bars.sides:
        return {}
    ignored = bars.widened.mask(*pictures[0].shape)
    found: dict[str, Any] = {}
    if bars.sides:
        found["bars"] = _report_bars(bars, pictures[0].shape, record, report)
    if mark is not None:
        ignored[inner] |= mark
        report.warning(
            f"{100 * float(mark.mean()):.1f} % of the picture stands still while the camera moves, for example a "
            "logo or a caption. It is ignored, and frozen frames show what is behind it.",
            "If it is part of the scene, set Ignore to None before the solve (Masks, or --ignore-mask none).",
        )
    write_png(fresh / BURNT_IN_FILE, np.repeat(np.where(ignored, np.uint8(255), np.uint8(0))[..., None], 3, axis=2))
    return {"burnt_in": {"file": BURNT_IN_FILE, "share": round(float(ignored.mean()), 5)}, **found}


def _report_bars(bars: Bars, shape: tuple[int, ...], record: dict[str, Any], report: Reporter) -> dict[str, float]:
    """The entry of frames.json for bars found in pictures [h, w]. Warns the artist.

    The value of each side is a share of the frame's height or width, and includes the mixed lines.
    """
    h, w = shape
    width, height = (int(side) for side in record["source_size"])
    rows, columns = bars.inner(h, w)
    size = f"{round((columns.stop - columns.start) * width / w)}x{round((rows.stop - rows.start) * height / h)}"
    report.warning(
        f"The picture fills only {size} of the frame's {width}x{height}: the bars {' and '.join(bars.sides)} are "
        "ignored, and frozen frames through the clip's own camera keep them.",
        "If they are part of the scene, set Ignore to None before the solve (Masks, or --ignore-mask none).",
    )
    kept = bars.widened
    return {"top": kept.top / h, "bottom": kept.bottom / h, "left": kept.left / w, "right": kept.right / w}


def _grey(path: Path) -> NDArray[np.uint8]:
    """A working frame in grey, at most `WIDTH` wide."""
    pixels = read_frame(path)
    pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    # 48 full frames in 4K would take 400 MB.
    if grey.shape[1] > WIDTH:
        grey = cv2.resize(
            grey, (WIDTH, max(1, round(grey.shape[0] * WIDTH / grey.shape[1]))), interpolation=cv2.INTER_AREA
        )
    return np.asarray(grey, np.uint8)


def _displayed(info: SourceInfo, measures: list[FrameMeasures]) -> dict[str, Any]:
    """The entries of frames.json for the display of the working frames, as `display_of` reads them."""
    display = display_for(info)
    return {"display": display.name, "brightest": max(m.brightest for m in measures)} if display.bends else {}


def _news(record: dict[str, Any], source: str) -> dict[str, Any]:
    """Changes to shot.json by a new import."""
    frames = record["frames"]
    imported = {name: record[name] for name in ("step", "fps", "width", "height", "colour")}
    return {"source": str(source), "first": frames[0]["frame"], "last": frames[-1]["frame"], **imported}


def _relative_source(shot: Shot, source: str) -> str:
    """Path of the footage relative to the shot folder, with slashes, so that both can be moved together."""
    try:
        return Path(os.path.relpath(source, shot.root)).as_posix()
    except ValueError:  # another drive on Windows
        return ""


def _result(shot: Shot, record: dict[str, Any]) -> dict[str, Any]:
    frames = record["frames"]
    return {
        "frames": len(frames),
        "solved_frames": sum(f["solve"] for f in frames),
        "first": frames[0]["frame"],
        "last": frames[-1]["frame"],
        **{name: record[name] for name in ("step", "width", "height", "fps", "colour")},
        "reading": record.get("reading", {}),
        "read_as": record.get("read_as", []),
        "source": shot.info().source,
    }
