"""Combines several instants in one take: objects under a matte come from a source take, or from the live plate.

Wherever an object is in the base take or in its source take, the pixels of the source take are used. The object is then
shown at the source take's instant, and the background that it hid at the base's instant is visible. Around objects,
both takes have the same pixels, because nothing moves there. The border may therefore be a few pixels away from the
object.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...contract import (
    LIVE_SOURCE,
    CombineParams,
    ExitCode,
    JobError,
    Reporter,
    TakeFolder,
    checked_name,
    read_json,
    sweep_half_written,
)
from ...footage.images import read_png, write_png
from ...footage.plates import Plates
from ...shot import Shot, content_key, disk_error, is_disk_full, make_folder, need_disk, remove_file, write_json
from ..exr import DetailLayers, FrozenFrame, read_frozen_exr, read_key, read_metadata, write_frozen_exr
from ..take.contact_sheet import write_contact_sheet
from ..take.folder import frames_of
from ..take.video import write_video
from .files import is_current, matte_file, read_matte
from .job import current_keys

VERSION = 4
"""Version of combined frames. Raise it when older ones must not be used any more."""
GROW = 4.0
"""Radius by which a matte is dilated, in pixels at width 640: its edge is soft, and hair extends beyond it."""
FAR = 2.0
"""Ratio of depths up to which a moving pixel can belong to a frozen object."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Source:
    """A finished take whose pixels are used."""

    name: str
    """Name of the take."""
    folder: TakeFolder
    """Folder of the take."""
    facts: dict[str, Any]
    """Content of take.json."""
    matte_keys: dict[str, str]
    """Name of a finished matte -> key of its files."""
    matte_format: str
    """Suffix of the take's single mattes."""
    is_stale: bool = False
    """True if the mattes were made for other frames than the take has now."""

    @property
    def margin(self) -> tuple[int, int]:
        """Pixels of overscan left and right, and above and below."""
        across, down = self.facts.get("margin", (0, 0))
        return int(across), int(down)

    def matte(self, name: str, frame: int) -> Array:
        """Matte [H, W] in 0..1, with overscan. JobError if the file is missing or its key differs."""
        path = matte_file(self.folder, name, frame, self.matte_format)
        if not is_current(path, self.matte_keys[name]):
            raise JobError(
                f"The matte {name} of take {self.name} lacks frame {frame}.",
                "Create the mattes again.",
                ExitCode.FREEZE,
            )
        return read_matte(path, self.margin)

    def shows(self, name: str, number: int, frame: FrozenFrame, is_live: bool) -> Array:
        """[3, H, W] in 0..1 of this take's frame `number`: an object's matte, the union of all others, and motion.

        For a frozen object, motion farther than `FAR` times its depth is set to 0, such as sky in the motion mattes.
        """
        matte, motion = self.matte(name, number), frame.motion
        remaining = [self.matte(key, number) for key in self.matte_keys if key != name]
        if not is_live and (matte > 0.5).any():
            motion = motion * (frame.depth < FAR * np.quantile(frame.depth[matte > 0.5], 0.9))
        return np.stack([matte, np.maximum.reduce([np.zeros_like(matte), *remaining]), motion])


def combine(shot: Shot, params: CombineParams, report: Reporter) -> dict[str, Any]:
    """Writes a take whose objects come from the takes that `params` name. Returns the content of its take.json.

    Frames with the same inputs that already exist are kept. JobError if the takes cannot be combined.
    """
    things = things_of(params.things)
    base = _opened(shot, params.base)
    sources = {name: None if name == LIVE_SOURCE else _opened(shot, name) for name in dict.fromkeys(things.values())}
    frames = _check(base, things, sources)
    if base.facts.get("deep"):
        report.warning("A combined take has no deep EXRs.", "Combine the deep EXRs of its takes with their mattes.")
    folder = TakeFolder(shot.own(shot.take(checked_name(params.take, "take"))))
    _refuse_frozen(folder, params)
    live = Plates(shot, (int(base.facts["width"]), int(base.facts["height"]))) if None in sources.values() else None
    lacking = [] if live is None else sorted(set(frames) - set(live.frames))
    if lacking:
        report.warning(
            f"The footage lacks {len(lacking)} frames of the take, the first is {lacking[0]}: in them, what should "
            f"keep moving stands still as in take {params.base}."
        )
    for inner in (folder.root, folder.previews):
        make_folder(shot.own(inner))
        sweep_half_written(inner)
    pixels = int(base.facts["width"]) * int(base.facts["height"])
    need_disk(folder.root, len(frames) * pixels * 50.0, "the take")
    try:
        remove_file(folder.facts)  # marks the take as unfinished until all frames exist
        for done, number in enumerate(frames):
            report.progress("combining takes", done, len(frames), f"frame {number}")
            report.check_cancelled()
            _write_frame(folder, number, base, things, sources, live)
        return _finish(shot, params, folder, base, frames, report)
    except OSError as error:
        raise (disk_error(folder.root) if is_disk_full(error) else error) from error


def things_of(text: str) -> dict[str, str]:
    """Name of a matte -> name of the take that its object comes from, parsed from "MATTE=TAKE, ...".

    JobError if the text is malformed.
    """
    found: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        matte, is_pair, take = (word.strip() for word in part.partition("="))
        if not (matte and is_pair and take):
            raise JobError(
                f"--things {part!r} names no matte and no take.", "Write MATTE=TAKE, ... or MATTE=live.", ExitCode.USAGE
            )
        found[checked_name(matte, "matte")] = checked_name(take, "take")
    if not found:
        raise JobError("Nothing says which thing comes from which take.", "Write --things MATTE=TAKE.", ExitCode.USAGE)
    return found


def combined(base: FrozenFrame, overlay: FrozenFrame, mask: Array) -> FrozenFrame:
    """`overlay` where `mask` [H, W] is 1, `base` where it is 0. Depth, `source` and `more` are chosen, not blended."""
    is_overlay = mask > 0.5

    def mixed(a: object, b: object) -> Array:
        one, two = np.asarray(a, np.float32), np.asarray(b, np.float32)
        share = mask if one.ndim == 2 else mask[..., None]
        return np.asarray(one * (1.0 - share) + two * share, np.float32)

    def chosen(a: object, b: object) -> Array:
        one, two = np.asarray(a, np.float32), np.asarray(b, np.float32)
        return np.where(is_overlay if one.ndim == 2 else is_overlay[..., None], two, one)

    detail = None
    if base.detail is not None and overlay.detail is not None:
        one, two = base.detail, overlay.detail
        detail = DetailLayers(
            mixed(one.splat, two.splat), mixed(one.plate, two.plate), chosen(one.source, two.source)
        )  # fmt: skip
    return dataclasses.replace(
        base,
        rgba=mixed(base.rgba, overlay.rgba),
        depth=chosen(base.depth, overlay.depth),
        support=mixed(base.support, overlay.support),
        motion=mixed(base.motion, overlay.motion),
        grain=None if base.grain is None or overlay.grain is None else mixed(base.grain, overlay.grain),
        detail=detail,
        more={name: chosen(layer, overlay.more[name]) for name, layer in base.more.items() if name in overlay.more},
    )


def dilated(matte: Array, width: int) -> Array:
    """A matte [H, W] dilated by `GROW` pixels at width 640, with a soft border."""
    reach = max(1, round(GROW * width / 640))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.GaussianBlur(cv2.dilate(matte, kernel), (0, 0), 0.5 * reach), np.float32)


def with_motion(matte: Array, neighbours: Array, motion: Array) -> Array:
    """A matte [H, W] extended by the moving regions that touch it.

    Such a region is a hand that the matte missed, or the object at its place in the live plate. `motion` [H, W] is the
    layer of a frozen frame: pixels that move at t* or in the frame's own plate. Moving pixels nearer to `neighbours`
    [H, W], the union of all other mattes, are left out.
    """
    in_object, in_neighbours = matte > 0.5, (neighbours > 0.5) & (neighbours > matte)
    joined = in_object | (motion > 0.5)
    if in_neighbours.any():
        # With every touching mover, the whole picture lost up to 2.4 dB; with the nearest object's, 0.3
        # (docs/decisions.md).
        joined &= _distance(in_object) <= _distance(in_neighbours)
    _, labels = cv2.connectedComponents(joined.astype(np.uint8))
    touched = np.unique(labels[in_object & joined])
    return np.maximum(matte, np.isin(labels, touched[touched > 0]).astype(np.float32))


def _distance(mask: NDArray[np.bool_]) -> Array:
    """[H, W] distance in pixels to the nearest pixel of a mask."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _opened(shot: Shot, name: str) -> Source:
    """A finished take. JobError if it does not exist."""
    folder = TakeFolder(shot.own(shot.take(checked_name(name, "take"))))
    if not folder.facts.is_file():
        raise JobError(f"{shot.root.name} has no finished take {name!r}.", "Freeze it first.", ExitCode.FREEZE)
    facts, record = read_json(folder.facts), dict[str, Any]()
    if folder.mattes_record.is_file():
        record = read_json(folder.mattes_record)
    keys = record.get("keys") if record.get("finished") else None
    known = {name: str(key) for name, key in cast("dict[str, Any]", keys or {}).items()}
    is_stale = bool(known) and known != current_keys(folder, facts)
    return Source(name, folder, facts, known, str(record.get("format", "exr")), is_stale)


def _check(base: Source, things: Mapping[str, str], sources: Mapping[str, Source | None]) -> list[int]:
    """The frames that can be combined. JobError if the takes are incompatible, or if a matte is missing."""
    frames = set(frames_of(base.folder))
    for matte, take in things.items():
        source = sources[take]
        for candidate in (base, source):
            if candidate is not None and matte not in candidate.matte_keys:
                raise JobError(
                    f"Take {candidate.name} has no matte {matte!r}.",
                    "Draw it there, or create its mattes again.",
                    ExitCode.FREEZE,
                )
            if candidate is not None and candidate.is_stale:
                raise JobError(
                    f"The mattes of take {candidate.name} were made for other frames than it has now.",
                    "Create its mattes again.",
                    ExitCode.FREEZE,
                )
        if source is None:
            if base.facts.get("camera_path"):
                raise JobError(
                    f"{matte} cannot keep moving in take {base.name}, which has another camera: only the clip's own "
                    "camera shows the plate.", "Use a take with the clip's own camera.", ExitCode.FREEZE,
                )  # fmt: skip
            continue
        placed = ("placement",) if base.facts.get("passes") else ()  # the layer Position depends on it
        for name in ("width", "height", "margin", "shutter", *placed):
            if (source.facts.get(name) or 0) != (base.facts.get(name) or 0):
                raise JobError(
                    f"Takes {base.name} and {source.name} differ in {name.replace('_', ' ')}.",
                    "Freeze both with the same size, overscan, camera and motion blur.", ExitCode.FREEZE,
                )  # fmt: skip
        both = frames & set(frames_of(source.folder))
        # A camera path may be stored in a file for each take, and a file may have changed since.
        if bool(source.facts.get("camera_path")) != bool(base.facts.get("camera_path")) or not all(
            _is_same_camera(base.folder.frame(n), source.folder.frame(n)) for n in both
        ):
            raise JobError(
                f"Takes {base.name} and {source.name} differ in camera.",
                "Freeze both with the same size, overscan, camera and motion blur.", ExitCode.FREEZE,
            )  # fmt: skip
        frames = both
    if not frames:
        raise JobError("The takes have no frame in common.", "Freeze the same frames of each.", ExitCode.FREEZE)
    return sorted(frames)


def _is_same_camera(one: Path, two: Path) -> bool:
    """True if two frozen frames have the same pose and intrinsics, up to rounding."""
    a, b = read_metadata(one), read_metadata(two)
    return np.allclose(a.viewmat, b.viewmat, 1e-4, 1e-4) and np.allclose(a.K, b.K, 1e-4)


def _refuse_frozen(folder: TakeFolder, params: CombineParams) -> None:
    """Raises JobError if the result would overwrite frozen frames."""
    if params.take in (params.base, *things_of(params.things).values()) or (
        folder.facts.is_file() and "combined" not in read_json(folder.facts)
    ):
        raise JobError(
            f"The take {params.take} contains frozen frames, which a combined take would replace.",
            "Give it another name with --take.", ExitCode.USAGE,
        )  # fmt: skip


def _write_frame(
    folder: TakeFolder, number: int, base: Source, things: Mapping[str, str], sources: Mapping[str, Source | None],
    live: Plates | None,
) -> None:  # fmt: skip
    """Writes a frame and its preview, unless files with the same key exist."""
    key = content_key(
        VERSION, GROW, read_key(base.folder.frame(number)), None if live is None else live.key,
        [[matte, take, base.matte_keys, *_keys(sources[take], number)] for matte, take in things.items()],
    )  # fmt: skip
    if is_current(folder.preview(number), key) and is_current(folder.frame(number), key):
        return
    frame = read_frozen_exr(base.folder.frame(number))
    preview = read_png(base.folder.preview(number)).astype(np.float32)
    (height, width), (across, down) = frame.depth.shape, base.margin
    inner = slice(down, height - down), slice(across, width - across)
    for matte, take in things.items():
        source = sources[take]
        if source is None and live is not None and number not in live.frames:
            continue
        shows = base.shows(matte, number, frame, is_live=source is None)
        if source is None:
            assert live is not None
            object_mask, mask = dilated(with_motion(*shows), width), np.zeros_like(frame.depth)
            mask[inner] = object_mask[inner]  # the plate does not cover the overscan
            overlay = _living_frame(frame, live, number, inner)
            picture = np.asarray(live.display(number).clamp(0.0, 1.0).numpy() * 255.0, np.float32)
        else:
            overlay = read_frozen_exr(source.folder.frame(number))
            mask = dilated(with_motion(*np.maximum(shows, source.shows(matte, number, overlay, is_live=False))), width)
            picture = read_png(source.folder.preview(number)).astype(np.float32)
        share = mask[inner][..., None]
        preview = preview * (1.0 - share) + picture * share
        frame = combined(frame, overlay, mask)
    write_png(folder.preview(number), (preview + 0.5).astype(np.uint8), key)
    write_frozen_exr(
        folder.frame(number), frame.rgba, frame.depth, frame.support, frame.motion,
        dataclasses.replace(frame.metadata, key=key), frame.margin, frame.grain, frame.detail, frame.more,
    )  # fmt: skip


def _keys(source: Source | None, number: int) -> list[Any]:
    """Inputs of an object's pixels for the key: frame and mattes of its take; empty for the live plate."""
    return [] if source is None else [read_key(source.folder.frame(number)), source.matte_keys]


def _living_frame(base: FrozenFrame, plates: Plates, number: int, inner: tuple[slice, slice]) -> FrozenFrame:
    """A frame of the live plate, with the depth of the frozen scene."""
    rgba = np.zeros_like(base.rgba)
    rgba[inner] = np.concatenate(
        [plates.linear(number).numpy(), np.ones((*base.depth[inner].shape, 1), np.float32)], axis=2
    )
    ones = np.ones_like(base.depth)
    detail = None
    if base.detail is not None:
        detail = DetailLayers(base.detail.splat, ones, ones * number)
    grain = None if base.grain is None else np.zeros_like(base.grain)
    # The depth of a moving object is unknown: that of the frozen scene stays.
    return dataclasses.replace(base, rgba=rgba, support=ones, motion=ones, grain=grain, detail=detail)


def _finish(
    shot: Shot, params: CombineParams, folder: TakeFolder, base: Source, frames: list[int], report: Reporter
) -> dict[str, Any]:  # fmt: skip
    """Writes contact sheet, video and take.json, and removes frames that do not belong to the take."""
    for number in frames_of(folder):
        if number not in frames:
            for old in (folder.frame(number), folder.preview(number)):
                remove_file(old)
    previews = [folder.preview(number) for number in frames]
    title = f"{shot.info().name}: {params.take}, {params.base} with {params.things}"
    write_contact_sheet(folder.contact_sheet, None, previews, frames, title, mark=int(base.facts["t_star_frame"]))
    note = write_video(folder.video, (read_png(path) for path in previews), shot.info().fps or 24.0)
    if note:
        report.warning(note)
    take_specific = ("deep", "detail", "warp_dir", "verdict", "ply", "usd", "redistort")
    facts = {
        **{name: value for name, value in base.facts.items() if name not in take_specific},
        "take": params.take,
        "combined": {"base": params.base, "things": things_of(params.things)},
        "key": content_key([read_key(folder.frame(number)) for number in frames]),
        "exr_dir": str(folder.root),
        "contact_sheet": str(folder.contact_sheet),
        "video": str(folder.video),
        "redistort": "",
        "first": frames[0],
        "last": frames[-1],
        "frames": len(frames),
    }
    write_json(folder.facts, facts)
    report.image("contact sheet", folder.contact_sheet)
    report.progress("combining takes", len(frames), len(frames), f"{len(frames)} frames")
    return facts
