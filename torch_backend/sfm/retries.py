"""Retries a solve that is refused or poor: one strategy after the other, each announced before it runs.

Each attempt is a request to the worker in its own folder. COLMAP's database moves from one attempt to the next.
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
"""Factor on the number of features per frame in the strategy "features", which also lowers the contrast limit."""
FAINT_PEAK = 0.0025
"""Smallest contrast of a feature in the strategy "features"; COLMAP's default is 0.0067."""
FIRST = "first"
NO_FOCAL = {"start_focal_px": 0.0}


@dataclass(frozen=True)
class Strategy:
    """A change of the request that may make the solve succeed."""

    name: str
    words: str
    """The change in words, to follow "Trying again with"."""
    changes: Mapping[str, Any]
    """Fields of the request with their new values."""
    stays: bool = True
    """True if later attempts keep these changes."""


@dataclass(frozen=True)
class Attempt:
    """One attempt to solve, and its result."""

    strategy: str
    """FIRST, or the name of the `Strategy`."""
    folder: Path
    answer: dict[str, Any]
    """Answer of the worker: {"result"} or {"failure"}."""
    fault: Fault | None
    solved: int
    """Number of frames that the attempt had to register."""

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Sort key, larger is better: usable first, then more registered frames, then a smaller error."""
        found = self.answer.get("result", {})
        usable = self.fault is None or not self.fault.refused
        return usable, self.share, -float(found.get("reprojection_error_px", 0.0))

    @property
    def share(self) -> float:
        """Share of the frames that were registered."""
        return self.answer.get("result", {}).get("registered", 0) / max(1, self.solved)

    @property
    def words(self) -> str:
        """The result in a sentence."""
        if self.fault is not None:
            return self.fault.error.message
        found = self.answer["result"]
        return quality_words(found["registered"], self.solved, float(found["reprojection_error_px"]))


@dataclass(frozen=True)
class RetriedSolve:
    """The best attempt, and a list of all attempts."""

    best: Attempt
    tries: list[dict[str, str]]
    """Attempts in order: {"rung": name of the strategy, "found": a sentence}."""


def solve_with_retries(
    request: dict[str, Any], frames: dict[str, Any], retry: bool, scratch: Path, log: Path, report: Reporter
) -> RetriedSolve:
    """Solves, and retries with one strategy after the other until a solve is neither refused nor poor.

    Returns the best attempt of all.

    Args:
        request: the first request to the worker.
        frames: frames.json.
        retry: False solves once only.
        scratch: folder with a subfolder per attempt; only the best attempt's subfolder keeps its files.
        log: file for COLMAP's output of all attempts.
        report: receives a warning for each retry: what is wrong, and what is tried next.

    Raises:
        JobError: even the best attempt is unusable, or the first one crashed.
        Cancelled: the job was cancelled, also between two attempts.
    """
    best = last = _attempt(FIRST, request, frames, None, scratch, log, report)
    current, tries = dict(request), [_row(best.strategy, best.words)]
    while retry and best.fault is not None:
        strategy = next_strategy(best, current, {row["rung"] for row in tries})
        if strategy is None:
            break
        report.check_cancelled()
        report.warning(f"{best.words} Trying again with {strategy.words}.")
        now = {**current, **strategy.changes}
        current = now if strategy.stays else current
        fresh = "features" in strategy.changes
        need_disk(scratch, len(frames["frames"]) << 21, "Retrying the camera solve")
        try:
            attempt = _attempt(strategy.name, now, frames, None if fresh else last, scratch, log, report)
        except JobError as error:  # COLMAP crashed: the best attempt so far stays
            tries.append(_row(strategy.name, error.message))
            continue
        tries.append(_row(strategy.name, attempt.words))
        last = attempt
        best, worse = (attempt, best) if attempt.rank > best.rank else (best, attempt)
        for file in worse.folder.iterdir():
            if file.name != DATABASE_FILE:
                shutil.rmtree(file) if file.is_dir() else file.unlink()
    if best.fault is not None and best.fault.refused:
        raise _refusal(best.fault.error, [row["rung"] for row in tries])
    return RetriedSolve(best, tries)


def next_strategy(best: Attempt, request: dict[str, Any], done: set[str]) -> Strategy | None:
    """The strategy to try after the `best` attempt so far, or None if none can help.

    `request` is the last request, `done` the names of the strategies that were tried.
    """
    fault = best.fault
    # No strategy can help a camera that stands still, only rotates, or moves too little for parallax.
    if fault is None or fault.kind in ("still", "turning", "narrow"):
        return None
    more = round(MORE_FEATURES * request["features"])
    features = Strategy(
        "features", f"up to {more} features per frame, including faint ones", {"features": more, "peak": FAINT_PEAK}
    )
    pairs = None if request.get("wide") else Strategy("pairs", "more frames matched with each other", {"wide": True})
    mapper = Strategy("global", "all cameras placed at once (global mapper)", {"mapper": "global"})
    free: list[Strategy | None] = [None]
    if request.get("start_focal_px") and not request.get("focal_px"):
        free = [Strategy("focal", "no initial focal length (the file's may be for the whole sensor)", NO_FOCAL)]
    if "failure" in best.answer:
        strategies = [*free, features, pairs]
    elif fault.kind == "bent":
        strategies = [*free, _lens_strategy(best, request)]
    elif fault.kind == "lens" or best.share >= FAIR_SHARE:
        strategies = [*free, _lens_strategy(best, request), pairs]
    else:
        strategies = [*free, features, pairs, _lens_strategy(best, request), mapper]
    return next((strategy for strategy in strategies if strategy is not None and strategy.name not in done), None)


def _lens_strategy(best: Attempt, request: dict[str, Any]) -> Strategy | None:
    """Strategy with another lens model; a fisheye only if the solve looks like one."""
    model = request["camera_model"]
    if model == FISHEYE or request.get("hold_bend") or "failure" in best.answer:
        return None
    if like_a_fisheye(best.answer["result"]):
        return Strategy("lens", "a fisheye lens (OPENCV_FISHEYE)", {"camera_model": FISHEYE}, stays=False)
    if model == "OPENCV":
        return None
    return Strategy("lens", "a lens with more distortion (OPENCV)", {"camera_model": "OPENCV"}, stays=False)


def _attempt(
    strategy: str,
    request: dict[str, Any],
    frames: dict[str, Any],
    before: Attempt | None,
    scratch: Path,
    log: Path,
    report: Reporter,
) -> Attempt:
    """Runs one attempt, which takes over COLMAP's database from the attempt `before`."""
    folder = scratch / strategy
    make_folder(folder)
    # With the earlier database, features are extracted twice at most, and earlier pairs are not matched again.
    reuse = before is not None and (before.folder / DATABASE_FILE).is_file()
    if before is not None and reuse:
        replace_file(before.folder / DATABASE_FILE, folder / DATABASE_FILE)
    write_json(folder / REQUEST_FILE, {**request, "reuse": reuse})
    answer = run_worker(folder / REQUEST_FILE, log, report, keep_log=strategy != FIRST)
    return Attempt(strategy, folder, answer, fault_of(answer, frames), len(request["solved"]))


def _row(strategy: str, found: str) -> dict[str, str]:
    return {"rung": strategy, "found": found}


_HELPED = {
    "focal": "no initial focal length",
    "features": "more features",
    "pairs": "more pairs",
    "lens": "another lens model",
    "global": "the global mapper",
}


def _refusal(error: JobError, strategies: list[str]) -> JobError:
    """The error of the best attempt, with the strategies that did not help."""
    tried = [_HELPED[strategy] for strategy in strategies if strategy != FIRST]
    if not tried:
        return error
    listed = " and ".join([", ".join(tried[:-1]), tried[-1]] if len(tried) > 1 else tried)
    return JobError(error.message, f"{error.hint} Tried without success: {listed}.".strip(), error.exit_code)
