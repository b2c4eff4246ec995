"""The matte job: renders the mattes of a take from lassos, as single sequences and a Cryptomatte."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...contract import (
    ExitCode,
    JobError,
    MatteParams,
    Reporter,
    TakeFolder,
    check_version,
    frame_number,
    read_json,
    sweep_half_written,
)
from ...footage.color import linear_to_srgb8
from ...scene import Scene, load_scene
from ...shot import Shot, content_key, disk_error, is_disk_full, make_folder, need_disk, remove_file, write_json
from ...torch_types import from_numpy
from ...train import choose_device, load_run
from ..exr import read_frozen_exr, read_key
from ..instant.instants import Instants
from ..take.folder import frames_of
from .carry import TakeFrame, carry, in_order
from .cryptomatte import write_cryptomatte
from .files import is_current, matte_file, read_matte, remaining_suffixes, write_matte
from .lassos import Lasso, json_list, lasso_of, read_lassos
from .segment import Matte, SegmentConfig

MATTES_VERSION = 1
"""Version of mattes.json."""
_METHOD = 3
"""Version of mattes. Raise it when older ones must not be used any more; their lassos are kept."""


@dataclass(frozen=True)
class _Take:
    """A finished take for which mattes are made."""

    folder: TakeFolder
    facts: dict[str, Any]
    """Content of take.json."""
    frames: list[int]
    """Numbers of the take's frames, ascending."""

    @property
    def margin(self) -> tuple[int, int]:
        """Pixels of overscan left and right, and above and below."""
        across, down = self.facts.get("margin", (0, 0))
        return int(across), int(down)


def make_mattes(shot: Shot, params: MatteParams, report: Reporter) -> dict[str, Any]:
    """Makes the missing and outdated mattes of a take, and their Cryptomatte.

    Returns {take, frames: number of frames, mattes: name -> folder, made: names of the mattes that were made,
    cryptomatte: folder}. JobError if the mattes cannot be made.
    """
    take = _opened(shot, params.take)
    lassos = _lassos(take, params)
    lassos_by_name: dict[str, list[Lasso]] = {}
    for lasso in lassos:
        lassos_by_name.setdefault(lasso.name, []).append(lasso)
    for inner in (take.folder.mattes, take.folder.cryptomattes, *map(take.folder.matte_frames, lassos_by_name)):
        make_folder(shot.own(inner))
        sweep_half_written(inner)
    pixels = (int(take.facts["width"]) + 2 * take.margin[0]) * (int(take.facts["height"]) + 2 * take.margin[1])
    need_disk(take.folder.root, len(take.frames) * pixels * (4.0 + len(lassos_by_name)), "the mattes")
    keys = _keys(take, lassos_by_name)
    stale = {
        name: of for name, of in lassos_by_name.items()
        if not all(is_current(matte_file(take.folder, name, n, params.matte_format), keys[name]) for n in take.frames)
    }  # fmt: skip
    record = {
        "version": MATTES_VERSION,
        "finished": False,
        "format": params.matte_format,
        "keys": keys,
        "mattes": [lasso.to_json() for lasso in lassos],
    }
    try:
        write_json(take.folder.mattes_record, record)  # a cancelled job must not lose lassos
        _write(shot, take, params, lassos_by_name, stale, keys, report)
        _sweep(take, params, lassos_by_name)
        write_json(take.folder.mattes_record, {**record, "finished": True})
    except OSError as error:
        raise (disk_error(take.folder.root) if is_disk_full(error) else error) from error
    return {
        "take": params.take,
        "frames": len(take.frames),
        "mattes": {name: str(take.folder.matte_frames(name)) for name in lassos_by_name},
        "made": list(stale),
        "cryptomatte": str(take.folder.cryptomattes) if lassos_by_name else "",
    }


def stored_lassos(folder: TakeFolder, width: int, height: int) -> list[Lasso]:
    """The lassos of a take's mattes; empty if it has no mattes. JobError if their record is damaged."""
    if not folder.mattes_record.is_file():
        return []
    record = read_json(folder.mattes_record)
    check_version(record, str(folder.mattes_record), MATTES_VERSION)
    rows = json_list(record.get("mattes"))
    return [lasso_of(row, f"Lasso {n} of {folder.mattes_record}", width, height) for n, row in enumerate(rows, 1)]


def current_keys(folder: TakeFolder, facts: dict[str, Any]) -> dict[str, str]:
    """Name -> key that each matte of a take has if it was made for the take's present frames.

    `facts`: content of take.json. JobError if the record of its mattes is damaged.
    """
    lassos_by_name: dict[str, list[Lasso]] = {}
    for lasso in stored_lassos(folder, int(facts["width"]), int(facts["height"])):
        lassos_by_name.setdefault(lasso.name, []).append(lasso)
    return _keys(_Take(folder, facts, frames_of(folder)), lassos_by_name)


def _opened(shot: Shot, name: str) -> _Take:
    """A finished take. JobError if it does not exist, is damaged, or is combined from others."""
    folder = TakeFolder(shot.own(shot.take(name)))
    if not folder.facts.is_file():
        raise JobError(f"{shot.root.name} has no finished take {name!r}.", "Freeze it first.", ExitCode.FREEZE)
    facts = read_json(folder.facts)
    if not all(name in facts for name in ("run", "checkpoint", "width", "height", "query")):
        raise JobError(f"{folder.facts} is damaged.", "Freeze the take again.", ExitCode.FREEZE)
    if "combined" in facts:  # mattes are propagated by the frozen scene of a single instant
        raise JobError(
            f"The take {name} is combined from others: its mattes would only be right for one instant.",
            "Create the mattes in the takes that it was combined from.", ExitCode.USAGE,
        )  # fmt: skip
    return _Take(folder, facts, frames_of(folder))


def _lassos(take: _Take, params: MatteParams) -> list[Lasso]:
    """The stored lassos and those of the file; the file's lassos replace stored ones of the same name."""
    size = int(take.facts["width"]), int(take.facts["height"])
    lassos = stored_lassos(take.folder, *size)
    if params.remove:
        if params.remove not in {lasso.name for lasso in lassos}:
            raise JobError(f"The take has no matte {params.remove!r}.", "Check its name.", ExitCode.USAGE)
        lassos = [lasso for lasso in lassos if lasso.name != params.remove]
    if params.polygons:
        added = read_lassos(params.polygons, *size)
        names = {lasso.name for lasso in added}
        lassos = [lasso for lasso in lassos if lasso.name not in names] + added
    if not lassos and not params.remove:
        raise JobError("The take has no lassos yet.", "Provide a file of lassos with --polygons.", ExitCode.USAGE)
    folded = [name.casefold() for name in dict.fromkeys(lasso.name for lasso in lassos)]
    if len(set(folded)) < len(folded):
        raise JobError(
            "Two mattes have names that differ only in upper and lower case: on some systems their folders would be "
            "the same.",
            "Rename one of them.",
            ExitCode.USAGE,
        )
    for lasso in lassos:
        x, y = lasso.corners().T
        if lasso.frame not in take.frames:
            span = f"frames {take.frames[0]} to {take.frames[-1]}" if take.frames else "none"
            raise JobError(
                f"{lasso.name} was lassoed at frame {lasso.frame}, which is not in the take: it has {span}.",
                "Lasso it at a frame of the take.",
                ExitCode.USAGE,
            )
        if x.max() <= 0.0 or y.max() <= 0.0 or x.min() >= size[0] or y.min() >= size[1]:
            raise JobError(
                f"The lasso of {lasso.name} lies outside frame {lasso.frame}, which is {size[0]} x {size[1]} pixels.",
                "Draw it within the frame.",
                ExitCode.USAGE,
            )
    return lassos


def _keys(take: _Take, lassos_by_name: Mapping[str, list[Lasso]]) -> dict[str, str]:
    """Name -> key of the matte's inputs."""
    # All frames, because every frame votes on the matte.
    frame_keys = [[n, read_key(take.folder.frame(n))] for n in take.frames]
    settings = dataclasses.asdict(SegmentConfig())
    return {
        name: content_key(_METHOD, frame_keys, [[lasso.frame, lasso.polygon] for lasso in of], settings)
        for name, of in lassos_by_name.items()
    }


def _write(
    shot: Shot, take: _Take, params: MatteParams, lassos_by_name: Mapping[str, list[Lasso]],
    stale: Mapping[str, list[Lasso]], keys: Mapping[str, str], report: Reporter,
) -> None:  # fmt: skip
    """Writes the outdated mattes, and the Cryptomattes that contain one of these or a removed matte."""
    if not lassos_by_name:
        return
    cryptomatte_key = content_key(_METHOD, {name: keys[name] for name in lassos_by_name})
    none: Iterator[tuple[int, dict[str, Matte]]] = ((number, {}) for number in take.frames)
    carried = _carried(shot, take, params, stale, report) if stale else none
    for done, (number, mattes) in enumerate(carried):
        report.progress("making mattes", done, len(take.frames), f"frame {number}")
        report.check_cancelled()
        for name, matte in mattes.items():
            write_matte(matte_file(take.folder, name, number, params.matte_format), matte, take.margin, keys[name])
        path = take.folder.cryptomatte(number)
        if mattes or not is_current(path, cryptomatte_key):
            every = {
                name: mattes[name] if name in mattes
                else read_matte(matte_file(take.folder, name, number, params.matte_format), take.margin)
                for name in lassos_by_name
            }  # fmt: skip
            write_cryptomatte(path, every, take.margin, cryptomatte_key)
    report.progress("making mattes", len(take.frames), len(take.frames), f"{len(take.frames)} frames")


def _carried(
    shot: Shot, take: _Take, params: MatteParams, stale: Mapping[str, list[Lasso]], report: Reporter
) -> Iterator[tuple[int, dict[str, Matte]]]:
    """Yields (frame number, mattes by name), starting with the lassoed frames."""
    run = load_run(shot, str(take.facts["run"]), choose_device(params.device, report, "Making mattes"))
    if run.stamp != take.facts["checkpoint"]:
        raise JobError(
            f"The run {take.facts['run']!r} was trained after the take was frozen, so the two do not match.",
            "Freeze the take again.",
            ExitCode.FREEZE,
        )
    scene = load_scene(shot)
    polygons: dict[str, dict[int, list[np.ndarray]]] = {}
    for name, of in stale.items():
        for lasso in of:
            polygons.setdefault(name, {}).setdefault(lasso.frame, []).append(lasso.corners())
    order = in_order(polygons, take.frames)
    cached: dict[int, TakeFrame] = {}

    def read(number: int) -> TakeFrame:
        if number not in cached:
            cached.clear()  # one frame is enough: a single lassoed frame is requested twice in a row
            cached[number] = read_take_frame(take.folder, number, scene)
        return cached[number]

    instants = [read(n).t_star for n in take.frames] if take.facts.get("t_star_per_frame") else [read(order[0]).t_star]
    frozen = Instants(shot, run, scene, str(take.facts["query"]), instants, "developed" in take.facts)
    frozen.prepare(instants, report)
    for frame, mattes in carry(polygons, take.frames, read, lambda t_star: frozen.at(t_star, report)):
        yield frame.number, mattes


def read_take_frame(folder: TakeFolder, number: int, scene: Scene) -> TakeFrame:
    """A frame of a take, from its EXR. ValueError if the EXR cannot be read."""
    frame = read_frozen_exr(folder.frame(number))
    viewmat = scene.from_solve(frame.metadata.viewmat.astype(np.float64)[None])[0]
    K = from_numpy(frame.metadata.K.copy())
    K[0, 2] += frame.margin[0]
    K[1, 2] += frame.margin[1]
    picture = linear_to_srgb8(np.clip(frame.rgba[..., :3], 0.0, 1.0))
    depth = frame.depth * np.float32(scene.scale)
    return TakeFrame(number, picture, depth, viewmat, K, frame.margin, frame.metadata.t_star_frame)


def _sweep(take: _Take, params: MatteParams, lassos_by_name: Mapping[str, list[Lasso]]) -> None:
    """Removes single mattes of other names and formats, and mattes of frames that are not in the take."""
    keep = set(take.frames)
    with contextlib.suppress(FileNotFoundError):
        for old in [*take.folder.single_mattes.iterdir()]:
            if old.name not in lassos_by_name and old.is_dir() and not old.is_symlink():
                shutil.rmtree(old, ignore_errors=True)
    for name in lassos_by_name:
        for suffix in (params.matte_format, *remaining_suffixes(params.matte_format)):
            for file in take.folder.matte_frames(name).glob(f"*.{suffix}"):
                if suffix != params.matte_format or not _is_of(file, keep):
                    remove_file(file)
    for file in take.folder.cryptomattes.glob("*.exr"):
        if not lassos_by_name or not _is_of(file, keep):
            remove_file(file)


def _is_of(file: Path, frames: set[int]) -> bool:
    """True if a file belongs to one of the frames."""
    return frame_number(file.stem) in frames
