"""What is tried where the first solve is refused or poor: one thing after the other, each said before it runs.

A try is a request of the worker's in a folder of its own. COLMAP's database is moved on from one to the next, so that
features are found twice at most. Where nothing can help (the camera stands still, only turns, or moves too little for
depth) nothing is tried.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import REQUEST_FILE, JobError, Reporter
from ..lens.lens_verdict import FISHEYE, like_a_fisheye
from ..shot import make_folder, need_disk, replace_file, write_json
from .child import run_worker
from .verdict import FAIR_SHARE, Fault, fault_of, quality_words

DATABASE_FILE = "database.db"

MORE_FEATURES = 2.0
"""Times as many features are asked for, FAINT_PEAK being enough for one."""
FAINT_PEAK = 0.0025
"""Least contrast of a feature where more are wanted; COLMAP's own is 0.0067."""
FIRST = "first"
NO_FOCAL = {"start_focal_px": 0.0}


@dataclass(frozen=True)
class Rung:
    """One thing to try."""

    name: str
    words: str
    """What is done, after "trying again with"."""
    changes: Mapping[str, Any]
    """What of the request is another."""
    stays: bool = True
    """Later tries have these changes, too."""


@dataclass(frozen=True)
class Attempt:
    """A try that was made."""

    rung: str
    """FIRST, or its name."""
    folder: Path
    answer: dict[str, Any]
    """The worker's, {"result"} or {"failure"}."""
    fault: Fault | None
    solved: int
    """Frames that were to be placed."""

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Larger is better: one that can be used, then more frames placed, then a smaller error."""
        found = self.answer.get("result", {})
        usable = self.fault is None or not self.fault.refused
        return usable, self.share, -float(found.get("reprojection_error_px", 0.0))

    @property
    def share(self) -> float:
        """Of the solved frames, those that have a place."""
        return self.answer.get("result", {}).get("registered", 0) / max(1, self.solved)

    @property
    def words(self) -> str:
        """What it came to, in a sentence."""
        if self.fault is not None:
            return self.fault.error.message
        found = self.answer["result"]
        return quality_words(found["registered"], self.solved, float(found["reprojection_error_px"]))


@dataclass(frozen=True)
class Climbed:
    """What came of all tries."""

    best: Attempt
    tries: list[dict[str, str]]
    """Each try in its order: {"rung", "found": a sentence}."""


def climb(
    request: dict[str, Any], frames: dict[str, Any], retry: bool, scratch: Path, log: Path, report: Reporter
) -> Climbed:
    """Solves; if that is refused or poor and `retry`, tries what may help until one is neither. The best of all.

    Args:
        request: the worker's.
        frames: frames.json.
        retry: False: the first solve is the only one.
        scratch: folder that gets one for each try; those that were not the best are gone afterwards.
        log: takes COLMAP's words, one try after the other.
        report: hears what is wrong and what is tried next, as warnings.

    Raises:
        JobError: in the words of the best try, if not even that can be used; or the first one broke off.
        Cancelled: between tries and in them.
    """
    best = last = _attempt(FIRST, request, frames, None, scratch, log, report)
    current, tries = dict(request), [_told(best.rung, best.words)]
    while retry and best.fault is not None:
        rung = next_rung(best, current, {row["rung"] for row in tries})
        if rung is None:
            break
        report.check_cancelled()
        report.warning(f"{best.words} Trying again with {rung.words}.")
        now = {**current, **rung.changes}
        current = now if rung.stays else current
        fresh = "features" in rung.changes
        need_disk(scratch, len(frames["frames"]) << 21, "Another try of the camera solve")
        try:
            attempt = _attempt(rung.name, now, frames, None if fresh else last, scratch, log, report)
        except JobError as error:  # COLMAP broke off: what was found before holds
            tries.append(_told(rung.name, error.message))
            continue
        tries.append(_told(rung.name, attempt.words))
        last = attempt
        best, worse = (attempt, best) if attempt.rank > best.rank else (best, attempt)
        for file in worse.folder.iterdir():
            if file.name != DATABASE_FILE:
                shutil.rmtree(file) if file.is_dir() else file.unlink()
    if best.fault is not None and best.fault.refused:
        raise _refusal(best.fault.error, [row["rung"] for row in tries])
    return Climbed(best, tries)


def next_rung(best: Attempt, asked: dict[str, Any], done: set[str]) -> Rung | None:
    """What to try after the `best` so far, `asked` being the last request's; None if nothing that is left can help."""
    fault = best.fault
    if fault is None or fault.kind in ("still", "turning", "narrow"):
        return None
    more = round(MORE_FEATURES * asked["features"])
    features = Rung(
        "features", f"up to {more} features a frame, faint ones too", {"features": more, "peak": FAINT_PEAK}
    )
    pairs = None if asked.get("wide") else Rung("pairs", "more frames matched with each other", {"wide": True})
    mapper = Rung("global", "all cameras placed at once (global mapper)", {"mapper": "global"})
    free: list[Rung | None] = [None]
    if asked.get("start_focal_px") and not asked.get("focal_px"):
        free = [Rung("focal", "no focal length to begin with (the file's may be of the whole sensor)", NO_FOCAL)]
    if "failure" in best.answer:
        rungs = [*free, features, pairs]
    elif fault.kind == "bent":
        rungs = [*free, _other_lens(best, asked)]
    elif fault.kind == "lens" or best.share >= FAIR_SHARE:
        rungs = [*free, _other_lens(best, asked), pairs]
    else:
        rungs = [*free, features, pairs, _other_lens(best, asked), mapper]
    return next((rung for rung in rungs if rung is not None and rung.name not in done), None)


def _other_lens(best: Attempt, asked: dict[str, Any]) -> Rung | None:
    """Another model of the lens: a fisheye's only where the solve looks like one."""
    model = asked["camera_model"]
    if model == FISHEYE or asked.get("hold_bend") or "failure" in best.answer:
        return None
    if like_a_fisheye(best.answer["result"]):
        return Rung("lens", "the lens of a fisheye (OPENCV_FISHEYE)", {"camera_model": FISHEYE}, stays=False)
    if model == "OPENCV":
        return None
    return Rung("lens", "a lens that may bend more (OPENCV)", {"camera_model": "OPENCV"}, stays=False)


def _attempt(
    rung: str,
    request: dict[str, Any],
    frames: dict[str, Any],
    before: Attempt | None,
    scratch: Path,
    log: Path,
    report: Reporter,
) -> Attempt:
    """One try; with COLMAP's database of the one `before`, which loses it."""
    folder = scratch / rung
    make_folder(folder)
    reuse = before is not None and (before.folder / DATABASE_FILE).is_file()
    if before is not None and reuse:
        replace_file(before.folder / DATABASE_FILE, folder / DATABASE_FILE)
    write_json(folder / REQUEST_FILE, {**request, "reuse": reuse})
    answer = run_worker(folder / REQUEST_FILE, log, report, keep_log=rung != FIRST)
    return Attempt(rung, folder, answer, fault_of(answer, frames), len(request["solved"]))


def _told(rung: str, found: str) -> dict[str, str]:
    return {"rung": rung, "found": found}


_HELPED = {
    "focal": "no focal length to begin with",
    "features": "more features",
    "pairs": "more pairs",
    "lens": "another lens model",
    "global": "the global mapper",
}


def _refusal(error: JobError, rungs: list[str]) -> JobError:
    """The sentence of the best try, and what was tried in vain."""
    tried = [_HELPED[rung] for rung in rungs if rung != FIRST]
    if not tried:
        return error
    listed = " and ".join([", ".join(tried[:-1]), tried[-1]] if len(tried) > 1 else tried)
    return JobError(error.message, f"{error.hint} Tried in vain: {listed}.".strip(), error.exit_code)
