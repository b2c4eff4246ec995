"""Shots and clips for a farm: facts of each, and the takes to make of it."""

from __future__ import annotations

import contextlib
import dataclasses
import mimetypes
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import (
    SHORT_JSON,
    SHOT_SUFFIX,
    STEP_PARAMS,
    ExitCode,
    ImportParams,
    JobError,
    RunFolder,
    ShotFolder,
    check_params,
    checked_name,
    collision_key,
    from_dict,
    is_imported_from,
    is_shot,
    open_regular,
    path_digest,
    read_json,
    readable_stem,
    write_json,
)
from ..contract.files import is_json_object
from ..contract.option_table import options_of
from ..footage.images import working_size
from ..footage.numbering import renumbered, shift_of
from ..footage.opening import open_source
from ..footage.sequence_files import PICTURES
from .request import shot_name

_LONGEST = 40
"""Largest length of a shot's name in a job. The name of a step, which contains it, may have 64 characters."""
TAKE_DIGITS = 4
"""Digits of the instant in the name of a take, if a shot has several takes."""


@dataclass(frozen=True)
class FarmShot:
    """One shot of a job."""

    name: str
    """Name of the shot in the steps of the job; unique within the job."""
    called: str
    """Name of the shot, or of its clip."""
    identity: str
    """Absolute path of the shot folder; if the shot is to be imported, of the clip or its first picture."""
    output: str
    """Name of the folder of its baked frames; unique within the job."""
    root: Path
    """Shot folder on the submitting computer."""
    clip: str
    """Footage from which the shot is to be imported; empty: already imported."""
    first: int
    """First frame of its takes."""
    last: int
    """Last frame of its takes, inclusive."""
    working: tuple[int, int]
    """Width and height in pixels of the working frames."""
    source: tuple[int, int]
    """Width and height in pixels of the footage."""
    takes: dict[str, str]
    """Frame number of the instant as text, empty for a suggested one -> name of the take."""
    requests: dict[str, dict[str, Any]]
    """Step -> its parameters, with paths of the submitting computer."""
    solved: bool
    """True if the shot has cameras and need not be solved."""
    trained: bool
    """True if the run to freeze is finished and need not be trained again."""

    @property
    def frames(self) -> int:
        """Frames of a take."""
        return self.last - self.first + 1


def gather(
    paths: Sequence[str], requests: dict[str, Any], instants: Sequence[int], table: dict[str, list[int]],
    shots_folder: str, trained_counts: bool = True,
) -> list[FarmShot]:  # fmt: skip
    """The shots of a job, from shot folders and clips.

    Args:
        given: shot folders, and clips.
        requests: kind of job -> its dataclass of parameters.
        instants: instants of shots that are not in the table; empty: suggested ones.
        table: shot's name -> instants.
        shots_folder: folder for the shots of clips; empty: next to each clip.
        trained_counts: True: a finished run is not trained again, even if `requests` differ from it.

    Raises:
        JobError: a shot or clip cannot be used, or the table has a name that no shot has; ValueError: parameters.
    """
    found = [_of_shot(path, requests) if is_shot(path) else _of_clip(path, requests, shots_folder) for path in paths]
    shots: list[FarmShot] = []
    base, names = requests["freeze"].take, _Names(table)
    for shot in _distinct(found):
        chosen = names.instants_of(shot, list(instants))
        for t_star in chosen:
            if not shot.first <= t_star <= shot.last:
                raise JobError(
                    f"t* is frame {t_star}: {shot.name} has frames {shot.first} to {shot.last}.",
                    "Choose a frame of the shot.",
                    ExitCode.USAGE,
                )
        takes = {"": base} if not chosen else {str(chosen[0]): base}
        if len(chosen) > 1:
            takes = {str(t): f"{base}_{t:0{TAKE_DIGITS}d}" for t in dict.fromkeys(chosen)}
        for take in takes.values():  # reported now, not by every task
            checked_name(take, "take")
        checked_name(requests["freeze"].run, "run")
        shots.append(dataclasses.replace(shot, takes=takes, trained=shot.trained and trained_counts))
    names.refuse_unknown(shots)
    return shots


class _Names:
    """A table of instants by the names of shots."""

    def __init__(self, table: dict[str, list[int]]) -> None:
        self._table, self._found = table, set[str]()

    def instants_of(self, shot: FarmShot, otherwise: list[int]) -> list[int]:
        """Instants of a shot in the table, found by its unique name, its folder's name, or its original name."""
        for name in (shot.name, shot.output, shot.called, _plain(shot.called)):
            if name in self._table:
                self._found.add(name)
                return self._table[name]
        return otherwise

    def refuse_unknown(self, shots: Sequence[FarmShot]) -> None:
        """Raises JobError if the table has a name that no shot has."""
        lost = sorted(set(self._table) - self._found)
        if lost:
            raise JobError(
                f"The list of instants names {lost[0]}, which is not one of the shots.",
                f"The shots are {', '.join(sorted(shot.name for shot in shots)[:10])}.",
                ExitCode.USAGE,
            )


def _distinct(found: Sequence[FarmShot]) -> list[FarmShot]:
    """The shots, each once, with unique folders, names and output folders.

    All shots that would share a name get a digest of their path, or of their clip's, added. The names therefore do not
    depend on the order of the shots.
    """
    shot_roots = {str(shot.root) for shot in found if not shot.clip}
    # Drop a clip if its shot is in the list, too.
    found = [s for s in found if not (s.clip and str(s.root) in shot_roots and is_imported_from(s.root, s.clip))]
    shots = list({shot.identity: shot for shot in found}.values())
    seen = Counter(collision_key(str(shot.root)) for shot in shots)
    shots = [dataclasses.replace(s, root=_hashed(s)) if seen[collision_key(str(s.root))] > 1 else s for s in shots]
    digests = [path_digest(shot.identity) for shot in shots]
    plain = [_plain(shot.called) for shot in shots]
    names = _distinct_names(plain, [f"{_cut(n, d)}-{d}" for n, d in zip(plain, digests, strict=True)])
    folders = [shot_name(shot.root) for shot in shots]
    outputs = _distinct_names(folders, [f"{n}-{d}" for n, d in zip(folders, digests, strict=True)])
    return [
        dataclasses.replace(shot, name=name, output=output)
        for shot, name, output in zip(shots, names, outputs, strict=True)
    ]


def _distinct_names(plain: Sequence[str], longer: Sequence[str]) -> list[str]:
    """The plain name of each shot, or the longer one if a disk could confuse the plain name with another. JobError if
    the names are still not unique."""
    seen = Counter(map(collision_key, plain))
    names = [p if seen[collision_key(p)] == 1 else q for p, q in zip(plain, longer, strict=True)]
    twice = next((name for name, count in Counter(map(collision_key, names)).items() if count > 1), None)
    if twice is not None:
        raise JobError(f"Two shots would be called {twice}.", "Rename one of them.", ExitCode.USAGE)
    return names


def _cut(name: str, digest: str) -> str:
    return name[: _LONGEST - len(digest) - 1].rstrip()


def _of_shot(path: str, requests: dict[str, Any]) -> FarmShot:
    folder = ShotFolder(os.path.abspath(path))  # abspath resolves `..`, which has no name
    try:
        info, record = read_json(folder.info_path), read_json(folder.listing)
        numbers = [int(row["frame"]) for row in record["frames"]]
        working = int(record["width"]), int(record["height"])
        width, height = record.get("source_size") or working
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError(
            f"{folder.root} contains no imported clip ({error}).", "Import the clip first, or pass the clip itself.",
            ExitCode.USAGE,
        ) from error  # fmt: skip
    fields = {kind: dataclasses.asdict(params) for kind, params in requests.items() if kind != "import"}
    _keep_camera_path(folder, fields["freeze"])
    freeze = requests["freeze"]
    span = numbers
    if fields["freeze"]["camera_path"]:
        span = [int(row["frame"]) for row in read_json(folder.root / fields["freeze"]["camera_path"])["frames"]]
    first = span[0] if freeze.first is None else max(span[0], freeze.first)
    last = span[-1] if freeze.last is None else min(span[-1], freeze.last)
    run = RunFolder(folder.run(requests["freeze"].run))
    name = str(info.get("name") or folder.root.name.removesuffix(SHOT_SUFFIX))
    return FarmShot(
        "", name, str(folder.root), "", folder.root, "", first, last, working, (int(width), int(height)), {}, fields,
        folder.cameras.is_file(), run.summary.is_file() and run.checkpoint.is_file(),
    )  # fmt: skip


def _of_clip(path: str, requests: dict[str, Any], shots_folder: str) -> FarmShot:
    """The shot of a clip. JobError if the clip is not footage, or does not state its length."""
    clip = path if "://" in path else str(Path(path).absolute())
    import_params: ImportParams = dataclasses.replace(requests["import"], source=clip)
    opened = open_source(clip, import_params.fps, import_params.layer)
    shift = shift_of(opened.info, import_params)
    info = renumbered(opened, shift).info
    if info.last is None:
        raise JobError(
            f"{clip} does not say how many frames it has.", "Import it, and pass the shot folder.", ExitCode.USAGE
        )
    first = info.first if import_params.first is None else max(info.first, import_params.first + shift)
    last = info.last if import_params.last is None else min(info.last, import_params.last + shift)
    identity = os.path.abspath(info.file or clip)
    called = readable_stem(os.path.basename(identity), Path(identity).suffix.lower() in PICTURES)
    working = working_size(info.width, info.height, import_params.working_height)
    fields = {kind: dataclasses.asdict(params) for kind, params in requests.items()}
    fields["import"]["source"] = clip
    if fields["freeze"]["camera_path"]:
        raise JobError("A camera path needs a solved shot.", "Pass the shot folder.", ExitCode.USAGE)
    return FarmShot(
        "", called, identity, "", _root_of(clip, called, identity, shots_folder), clip, first, last,
        working, (info.width, info.height), {}, fields, False, False,
    )  # fmt: skip


def _root_of(clip: str, called: str, identity: str, shots_folder: str) -> Path:
    """The shot folder of a clip: next to the clip and with its name, if no other footage there has that name.

    Otherwise, and in `shots_folder`, the name gets a digest of the clip's path, so it depends on the clip alone. A shot
    that was already made from the clip under its plain name is used again.
    """
    folder = Path(shots_folder).absolute() if shots_folder else Path(clip).parent
    hashed = folder / _hashed_name(called, identity)
    for name in dict.fromkeys((called, Path(clip).stem, Path(clip).name)):
        plain = folder / (name + SHOT_SUFFIX)
        if any(is_imported_from(plain, place) for place in (clip, identity)):
            return plain
    plain = folder / (called + SHOT_SUFFIX)
    is_free = not shots_folder and called == _plain(called) and not os.path.lexists(plain)
    return plain if is_free and not _is_shared(Path(clip).parent, called, identity) else hashed


def _is_shared(folder: Path, called: str, identity: str) -> bool:
    """True if a folder has other footage with the name of a clip."""
    key, number = collision_key(called), re.compile(r"[0-9]+(?=\.[^.]*$)")
    pattern = number.sub("#", os.path.basename(identity)) if Path(identity).suffix.lower() in PICTURES else ""
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            is_picture = Path(name).suffix.lower() in PICTURES
            is_video = (mimetypes.guess_type(name)[0] or "").startswith("video/") or name.lower().endswith(".mxf")
            is_same_clip = name == os.path.basename(identity) or (is_picture and number.sub("#", name) == pattern)
            if (is_picture or is_video) and not is_same_clip and collision_key(readable_stem(name, is_picture)) == key:
                return True
    return False


def _hashed(shot: FarmShot) -> Path:
    """Folder of a clip's shot with a digest in its name; the folder of an imported shot unchanged."""
    return shot.root.with_name(_hashed_name(shot.called, shot.identity)) if shot.clip else shot.root


def _hashed_name(called: str, identity: str) -> str:
    digest = path_digest(identity)
    return f"{_cut(_plain(called), digest)}-{digest}{SHOT_SUFFIX}"


def _keep_camera_path(folder: ShotFolder, freeze: dict[str, Any]) -> None:
    """Copies the camera path into the shot, where every computer finds it, and stores its relative path in `freeze`."""
    if freeze["camera_path"]:
        data = read_json(freeze["camera_path"])
        kept = folder.camera_path(checked_name(freeze["take"], "take"))
        folder.own(kept.parent)
        if not kept.is_file() or read_json(kept) != data:
            write_json(kept, data)
        freeze["camera_path"] = kept.relative_to(folder.root).as_posix()


def _plain(name: str) -> str:
    """`name` made valid for a step of a template: short, without control characters, braces and invalid UTF-8."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff{}]", "_", name)[:_LONGEST].strip() or "shot"


def read_requests(path: str, requests: dict[str, Any]) -> dict[str, Any]:
    """Parameters of the steps, overridden by those in a file: {kind: {name: value}}.

    JobError names an invalid parameter, or a file that cannot be read.
    """
    if path:
        try:
            record = read_json(path)
            for kind, values in record.items():
                if kind not in STEP_PARAMS or not is_json_object(values):
                    raise ValueError(f"{kind!r} is not one of {', '.join(STEP_PARAMS)}")
                requests[kind] = from_dict(STEP_PARAMS[kind], {**dataclasses.asdict(requests[kind]), **values})
                for field, spec in options_of(STEP_PARAMS[kind]):
                    value: Any = getattr(requests[kind], field.name)
                    if spec.choices and value not in (*spec.choices, field.default):
                        raise ValueError(f"{field.name} is {value!r}, which is not one of {', '.join(spec.choices)}")
        except (OSError, ValueError) as error:
            raise JobError(f"{path} cannot be used as parameters: {error}.", "", ExitCode.USAGE) from error
    for params in requests.values():
        check_params(params)
    return requests


def parse_instants(text: str) -> list[int]:
    """ "34,60" as [34, 60]; [] for an empty text. JobError if a word is not a number."""
    try:
        return [int(word) for word in re.split(r"[\s,]+", text.strip()) if word]
    except ValueError:
        message = f"{text!r} is not a list of instants."
        raise JobError(message, "Give frame numbers with commas, such as 34,60.", ExitCode.USAGE) from None


def read_instants(path: str) -> dict[str, list[int]]:
    """Instants by the name of a shot, from a file with a line per shot: its name, then its instants. # begins a
    comment. JobError names an invalid line."""
    found: dict[str, list[int]] = {}
    try:
        with open_regular(path, SHORT_JSON) as source:
            lines = source.read().decode("utf-8-sig").splitlines()  # Windows editors write a BOM
    except (OSError, ValueError) as error:
        raise JobError(f"{path} cannot be read: {error}.", "", ExitCode.USAGE) from error
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = re.fullmatch(r"(.*?)[\s,:;]+(-?\d+(?:[\s,]+-?\d+)*)", text)
        if match is None:
            raise JobError(
                f"Line {number} of {path} is not the name of a shot and its instants.",
                "Write one line per shot, such as: kitchen 34, 60",
                ExitCode.USAGE,
            )
        found.setdefault(match.group(1).removesuffix(SHOT_SUFFIX), []).extend(parse_instants(match.group(2)))
    return found
