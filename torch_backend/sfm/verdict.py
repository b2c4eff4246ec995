"""Judges whether a solve can be used: the fault and message of an unusable solve, and the quality of a usable one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..contract import ExitCode, JobError
from ..lens.lens_verdict import refuse_lens
from .points import LEAST_ANGLE_DEG, LEAST_POINTS, STILL_HINT, narrow_words

LEAST_REGISTERED = 8
REFUSED_SHARE = 0.5
GOOD_SHARE, GOOD_ERROR_PX = 0.95, 1.2
FAIR_SHARE, FAIR_ERROR_PX = 0.8, 1.5 * GOOD_ERROR_PX
SHORT_SECONDS = 1.0
"""If the camera moves too little, a range shorter than this is reported as too short."""
SMEARED, SMEARED_SHARE = 0.3, 0.5
"""A frame is smeared if its sharpness is below the first value's share of the solved frames' upper quartile. The
message mentions it if at least the second value's share of the frames without a pose is smeared."""
ENOUGH_MATCHES = 100
"""Matches that a pair of frames needs to start a solve, COLMAP's default. If typical pairs have that many and the solve
still does not start, the cause is a lack of parallax."""
MUCH_MOVES = 0.2
"""Share of independently moving pixels above which a clip's cameras are doubted. Correct solves had 0.02 to 0.08. A
solve that started from a pair without parallax had 0.31, at an error of 0.9 pixels."""
_TURNING = "The camera only turns on the spot, so depth cannot be estimated."
_RANGE_HINT = "Import a longer range, in which the camera moves sideways by a step or more."
_BARE_HINT = "Choose a sharper range, or film with more light and texture in view."


def doubt_of(moving: float) -> tuple[str, str] | None:
    """(message, hint) if the share `moving` of independently moving pixels is too large; else None."""
    # Without parallax, wrong cameras fit their matches. The only sign is that the whole scene seems to move.
    if moving < MUCH_MOVES:
        return None
    return (
        f"With these cameras, {round(100 * moving)} % of the picture seems to move. If people hold still, the "
        "cameras are wrong, even if their error is small.",
        "Check a few frozen frames. If static things slide in them, mask people who walk, or import a range with "
        "another camera path, and solve again.",
    )


@dataclass(frozen=True)
class Fault:
    """The fault of a solve."""

    kind: str
    """still, turning or narrow: refused, and no retry can help. unmatched, few, bare or lens: refused, but a retry may
    help. poor: usable, but too few frames have a pose, or they fit badly. bent: usable, with a usual lens instead of an
    estimated lens that folds the picture over."""
    error: JobError
    """The error that is shown to the artist if no retry helps."""

    @property
    def refused(self) -> bool:
        """True unless the solve can be used."""
        return self.kind not in ("poor", "bent")


def fault_of(answer: dict[str, Any], frames: dict[str, Any]) -> Fault | None:
    """The fault of a worker's answer, {"result"} or {"failure"}; None if it has none. `frames` is frames.json."""
    if "failure" in answer:
        return _failure(answer, frames)
    found = answer["result"]
    solved = [f for f in frames["frames"] if f["solve"]]
    registered = found["registered"]
    if registered < min(LEAST_REGISTERED, len(solved)) or registered < REFUSED_SHARE * len(solved):
        if found.get("turning"):  # a camera on a tripod: the registered poses are accidental
            return _fault("turning", _TURNING, STILL_HINT)
        return _too_few(found, solved, frames["step"])
    try:
        refuse_lens(found)
    except JobError as error:
        return Fault("lens", error)
    angle = found["triangulation_angle_deg"]
    if angle < LEAST_ANGLE_DEG:
        words, hint = narrow_words(angle), STILL_HINT
        if short := _short(frames):
            words, hint = f"{short}: {words[0].lower()}{words[1:]}", _RANGE_HINT
        return _fault("narrow", words, hint)
    if found["points"] < LEAST_POINTS:
        why = _smeared_words(solved, set()) or "the clip is too blurred or has too little texture"
        return _fault("bare", f"Only {found['points']} points of the scene could be placed: {why}.", _BARE_HINT)
    words = quality_words(registered, len(solved), float(found["reprojection_error_px"]))
    if words.startswith("Poor"):
        return _fault("poor", words, "")
    lens = found["lens"]
    if lens.get("held") and lens.get("doubt") == "bent":
        return _fault("bent", "The solved lens folds the picture over, so a typical lens is used.", "")
    return None


def quality_words(
    registered: int, solved: int, error_px: float, is_imported: bool = False, misled: bool = False
) -> str:
    """One sentence: Good, Fair or Poor, and the figures.

    `is_imported` means imported cameras, which the sentence mentions. `misled` means a flat scene or a zooming lens:
    the solve is Poor however well its points fit.
    """
    share = registered / max(1, solved)
    if misled:
        word = "Poor"
    elif share >= GOOD_SHARE and error_px <= GOOD_ERROR_PX:
        word = "Good"
    else:
        word = "Fair" if share >= FAIR_SHARE and error_px <= FAIR_ERROR_PX else "Poor"
    if is_imported:
        return f"{word}: cameras imported for {registered} of {solved} frames, {error_px:.2f} px."
    return f"{word}: {registered} of {solved} frames registered, {error_px:.2f} px."


def _fault(kind: str, message: str, hint: str) -> Fault:
    return Fault(kind, JobError(message, hint, ExitCode.SOLVE))


def _failure(answer: dict[str, Any], frames: dict[str, Any]) -> Fault:
    """Fault of an answer {"failure"}: the mapper found no model."""
    flow = answer["flow_px"]
    if answer["failure"] == "still":
        if short := _short(frames):
            return _fault("still", f"{short}: features shift by at most {flow:.1f} px in it.", _RANGE_HINT)
        words = f"The camera does not move: features shift by at most {flow:.1f} px over the clip."
        return _fault("still", words, STILL_HINT)
    if answer["failure"] == "turning":
        return _fault("turning", _TURNING, STILL_HINT)
    if answer["failure"] == "bare":
        return _fault(
            "bare",
            f"The frames show too little to match: a frame has about {answer['features']} distinct features, and no "
            "two frames have 15 in common.",
            _BARE_HINT,
        )
    smeared = _smeared_words([f for f in frames["frames"] if f["solve"]], set())
    if answer["matches"] >= ENOUGH_MATCHES and not smeared:
        short = _short(frames) or "The camera moves too little for depth"
        words = f"{short}: no two frames show the scene from places that are far enough apart."
        return _fault("narrow", words, _RANGE_HINT)
    why = f": {smeared}" if smeared else ""
    return _fault(
        "unmatched",
        f"No two frames show enough of the same scene from different places to start a camera solve{why}.",
        f"{STILL_HINT} Blur and bare walls give nothing to match.",
    )


def _short(frames: dict[str, Any]) -> str:
    """Beginning of a sentence that the imported range is too short; empty if it is not."""
    rows = frames["frames"]
    seconds = rows[-1]["seconds"] - rows[0]["seconds"]
    return f"The range of {len(rows)} frames ({seconds:.1f} s) is too short" if seconds < SHORT_SECONDS else ""


def _too_few(found: dict[str, Any], solved: list[dict[str, Any]], step: int) -> Fault:
    """Fault of a solve that registered too few frames: how many, which ones, and whether the others are smeared."""
    numbers = [f["frame"] for f in solved]
    parts = [_spans(numbers, part) for part in found["parts"] if len(part) >= LEAST_REGISTERED]
    worked = f": {_span_words(parts[0])}" if parts else ""
    split = f"; {len(parts)} parts of the clip do not connect" if len(parts) > 1 else ""
    why = _smeared_words(solved, {int(Path(name).stem) for part in found["parts"] for name in part})
    shaken = f"; {why}" if why else ""
    return _fault(
        "few",
        f"Cameras were found for only {found['registered']} of {len(solved)} frames{worked}{split}{shaken}.",
        _range_hint(parts, numbers, step),
    )


def _smeared_words(solved: list[dict[str, Any]], placed: set[int]) -> str:
    """Words for how many of the frames without a pose are smeared; empty if too few are to be the cause."""
    limit = SMEARED * float(np.quantile([f["sharpness"] for f in solved], 0.75))
    lost = [f["sharpness"] for f in solved if f["frame"] not in placed]
    smeared = sum(value < limit for value in lost)
    if not smeared or smeared < SMEARED_SHARE * len(lost):
        return ""
    return f"{smeared} of {'the other ' if placed else ''}{len(lost)} are smeared by shake or fast motion"


def _spans(solved: list[int], names: list[str]) -> list[tuple[int, int, int]]:
    """(first, last, count) of each run of consecutive `solved` frames whose pictures are among `names`."""
    placed = {int(Path(name).stem) for name in names}
    spans: list[tuple[int, int, int]] = []
    before = False
    for frame in solved:
        if frame in placed:
            first, count = (spans[-1][0], spans[-1][2]) if before else (frame, 0)
            spans[-1 if before else len(spans) :] = [(first, frame, count + 1)]
        before = frame in placed
    return spans


def _span_words(spans: list[tuple[int, int, int]]) -> str:
    """The four longest spans in the clip's order, such as '12 to 41, 60 to 74'."""
    longest = sorted(sorted(spans, key=lambda span: span[2], reverse=True)[:4])
    return ", ".join(f"{first} to {last}" if last > first else f"{first}" for first, last, _ in longest)


def _range_hint(parts: list[list[tuple[int, int, int]]], solved: list[int], step: int) -> str:
    """Hint that suggests the longest range that worked and, if the step is above 1, a smaller step."""
    best = max((span for part in parts for span in part), key=lambda span: span[2], default=(0, 0, 0))
    smaller = " A smaller step makes neighbouring frames overlap more." if step > 1 else ""
    if best[2] < LEAST_REGISTERED or best[2] == len(solved):
        return f"Choose a range without fast pans or blur.{smaller}"
    return f"Frames {best[0]} to {best[1]} worked: import that range, or one without fast pans or blur.{smaller}"
