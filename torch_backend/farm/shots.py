"""Shots and clips for a farm: what is known of each, and the takes that are wanted of it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import (
    PARAMS,
    SHOT_SUFFIX,
    ExitCode,
    ImportParams,
    JobError,
    RunFolder,
    ShotFolder,
    check_params,
    checked_name,
    from_dict,
    is_shot,
    read_json,
    write_json,
)
from ..contract.files import is_json_object
from ..footage.numbering import renumbered, shift_of
from ..footage.opening import open_source

TAKE_DIGITS = 4
"""Of the instant in the name of a take that is one of several."""


@dataclass(frozen=True)
class FarmShot:
    """One shot of a job."""

    name: str
    """What the steps of the job are called by; no two of a job have the same."""
    root: Path
    """Shot folder, on the computer that submits."""
    clip: str
    """Footage that it is to be imported from; empty: it is imported."""
    first: int
    """First frame of its takes."""
    last: int
    """Last frame of its takes, inclusive."""
    working: tuple[int, int]
    """Width and height in pixels of the working frames."""
    source: tuple[int, int]
    """Width and height in pixels of the footage."""
    takes: dict[str, str]
    """Instant as a number, or empty where it is suggested -> name of the take."""
    requests: dict[str, dict[str, Any]]
    """Step -> its parameters; paths among them are those of the computer that submits."""
    solved: bool
    """It has cameras: there is nothing to solve."""
    trained: bool
    """The run that is to be frozen is finished, and is not to be another: there is nothing to train."""

    @property
    def frames(self) -> int:
        """Frames of a take."""
        return self.last - self.first + 1


def gather(
    given: Sequence[str], requests: dict[str, Any], instants: Sequence[int], table: dict[str, list[int]],
    shots_folder: str, trained_counts: bool = True,
) -> list[FarmShot]:  # fmt: skip
    """Looks at shots and clips.

    Args:
        given: shot folders, and clips.
        requests: kind of job -> its dataclass of parameters.
        instants: of shots that the table does not name; none: suggested.
        table: shot's name -> instants.
        shots_folder: where shots of clips are made; empty: beside each.
        trained_counts: a finished run is not trained again, even where `requests` ask for another.

    Raises:
        JobError: a shot or clip that cannot be used, or a name in the table that none has; ValueError: parameters.
    """
    shots: list[FarmShot] = []
    for path in given:
        shot = _of_shot(path, requests) if is_shot(path) else _of_clip(path, requests, shots_folder)
        names = {one.name for one in shots}
        name, count = shot.name, 2
        while name in names:
            name, count = f"{shot.name} {count}", count + 1
        own = table.get(shot.name, list(instants))
        for t_star in own:
            if not shot.first <= t_star <= shot.last:
                raise JobError(
                    f"t* is frame {t_star}: {shot.name} has frames {shot.first} to {shot.last}.",
                    "Choose a frame of the shot.",
                    ExitCode.USAGE,
                )
        base = requests["freeze"].take
        takes = {"": base} if not own else {str(own[0]): base}
        if len(own) > 1:
            takes = {str(t): f"{base}_{t:0{TAKE_DIGITS}d}" for t in dict.fromkeys(own)}
        keep = shot.trained and trained_counts
        shots.append(dataclasses.replace(shot, name=name, takes=takes, trained=keep))
    known = {shot.name for shot in shots}
    lost = sorted(set(table) - known)
    if lost:
        raise JobError(
            f"The list of instants names {lost[0]}, which is none of the shots.",
            f"The shots are {', '.join(sorted(known)[:10])}.",
            ExitCode.USAGE,
        )
    return shots


def _of_shot(path: str, requests: dict[str, Any]) -> FarmShot:
    folder = ShotFolder(path)
    try:
        info, record = read_json(folder.info_path), read_json(folder.listing)
        numbers = [int(row["frame"]) for row in record["frames"]]
        working = int(record["width"]), int(record["height"])
        width, height = record.get("source_size") or working
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError(
            f"{folder.root} holds no imported clip ({error}).", "Import the clip first, or name the clip itself.",
            ExitCode.USAGE,
        ) from error  # fmt: skip
    asked = {kind: dataclasses.asdict(params) for kind, params in requests.items() if kind != "import"}
    _keep_camera_path(folder, asked["freeze"])
    freeze = requests["freeze"]
    span = numbers
    if asked["freeze"]["camera_path"]:
        span = [int(row["frame"]) for row in read_json(folder.root / asked["freeze"]["camera_path"])["frames"]]
    first = span[0] if freeze.first is None else max(span[0], freeze.first)
    last = span[-1] if freeze.last is None else min(span[-1], freeze.last)
    run = RunFolder(folder.run(requests["freeze"].run))
    name = str(info.get("name") or folder.root.name.removesuffix(SHOT_SUFFIX))
    return FarmShot(
        _plain(name), folder.root, "", first, last, working, (int(width), int(height)), {}, asked,
        folder.cameras.is_file(), run.summary.is_file() and run.checkpoint.is_file(),
    )  # fmt: skip


def _of_clip(path: str, requests: dict[str, Any], shots_folder: str) -> FarmShot:
    """A clip's shot. JobError if it is no footage, or does not say how long it is."""
    clip = path if "://" in path else str(Path(path).absolute())
    taken: ImportParams = dataclasses.replace(requests["import"], source=clip)
    opened = open_source(clip, taken.fps, taken.layer)
    shift = shift_of(opened.info, taken)
    info = renumbered(opened, shift).info
    if info.last is None:
        raise JobError(f"{clip} does not say how many frames it has.", "Import it, and name the shot.", ExitCode.USAGE)
    first = info.first if taken.first is None else max(info.first, taken.first + shift)
    last = info.last if taken.last is None else min(info.last, taken.last + shift)
    stem = _plain(re.split(r"[\\/]", clip.rstrip("\\/"))[-1].partition(".")[0])
    folder = Path(shots_folder).absolute() if shots_folder else Path(clip).parent
    high = taken.working_height or min(720, info.height)
    asked = {kind: dataclasses.asdict(params) for kind, params in requests.items()}
    asked["import"]["source"] = clip
    if asked["freeze"]["camera_path"]:
        raise JobError("A camera path is for a shot that is solved.", "Name the shot folder.", ExitCode.USAGE)
    return FarmShot(
        stem, folder / (stem + SHOT_SUFFIX), clip, first, last,
        (round(info.width * high / info.height), high), (info.width, info.height), {}, asked, False, False,
    )  # fmt: skip


def _keep_camera_path(folder: ShotFolder, freeze: dict[str, Any]) -> None:
    """A camera's path goes into the shot, where every computer finds it; the request names it from there."""
    if freeze["camera_path"]:
        data = read_json(freeze["camera_path"])
        kept = folder.camera_path(checked_name(freeze["take"], "take"))
        if not kept.is_file() or read_json(kept) != data:
            write_json(kept, data)
        freeze["camera_path"] = kept.relative_to(folder.root).as_posix()


def _plain(name: str) -> str:
    """A name that a step of a template may have: short, without control characters and braces."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f{}]", "_", name)[:40].strip() or "shot"


def read_requests(path: str, requests: dict[str, Any]) -> dict[str, Any]:
    """Parameters of the steps with those of a file over them: {kind: {name: value}}.

    JobError names what is no parameter, or cannot be read.
    """
    if path:
        try:
            told = read_json(path)
            for kind, values in told.items():
                if kind not in PARAMS or not is_json_object(values):
                    raise ValueError(f"{kind!r} is none of {', '.join(PARAMS)}")
                requests[kind] = from_dict(PARAMS[kind], {**dataclasses.asdict(requests[kind]), **values})
        except (OSError, ValueError) as error:
            raise JobError(f"{path} cannot be used as parameters: {error}.", "", ExitCode.USAGE) from error
    for params in requests.values():
        check_params(params)
    return requests


def parse_instants(text: str) -> list[int]:
    """ "34,60" as [34, 60]; empty: none. JobError on what is no number."""
    try:
        return [int(word) for word in re.split(r"[\s,]+", text.strip()) if word]
    except ValueError:
        message = f"{text!r} are no instants."
        raise JobError(message, "Give frame numbers with commas, such as 34,60.", ExitCode.USAGE) from None


def read_instants(path: str) -> dict[str, list[int]]:
    """A file with a line per shot, its name and then its instants; # begins a comment. JobError names a wrong line."""
    found: dict[str, list[int]] = {}
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()  # editors on Windows begin with a mark
    except (OSError, ValueError) as error:
        raise JobError(f"{path} cannot be read: {error}.", "", ExitCode.USAGE) from error
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        said = re.fullmatch(r"(.*?)[\s,:;]+(-?\d+(?:[\s,]+-?\d+)*)", text)
        if said is None:
            raise JobError(
                f"Line {number} of {path} is not the name of a shot and its instants.",
                "Write one line per shot, such as: kitchen 34, 60",
                ExitCode.USAGE,
            )
        found.setdefault(_plain(said.group(1).removesuffix(SHOT_SUFFIX)), []).extend(parse_instants(said.group(2)))
    return found
