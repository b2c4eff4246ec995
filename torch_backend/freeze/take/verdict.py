"""The verdict on a take: shares of plate and guess, frames and places that are unreliable, and advice.

A take is no better than its run. No other plate shows a walking person where they stood at t*, and the model has
another shape of them at every instant. The take's verdict therefore repeats the faults in the run's verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...contract import VERDICT_WORDS, Verdict
from ...train.verdict import EXPLAINED, span_text, spans_of


@dataclass(frozen=True)
class TakeLimits:
    """Thresholds of the verdict. They are tuned on takes of preview runs of three clips of people who hold still
    (`sitting`, `kitchen`, `hall`, at the suggested t*)."""

    good_invented: float = 0.06
    """Largest share of the picture that may be a guess in a good take, mean over frames; the clips have 0.007 to
    0.028."""
    fair_invented: float = 0.2
    """Largest share of the picture that may be a guess in a fair take, mean over frames."""
    lost: float = 0.6
    """Share of a cell of the picture's grid that may be a guess before the whole cell counts as one. It allows for a
    person in part of the cell. The clips have 0.12 to 0.53 in the worst cell of the worst frame."""
    steady: float = 0.6
    """Share of the frames above which a cell counts as a guess throughout the take."""
    named: float = 0.1
    """Share of the worst frame that is a guess, above which the verdict names that frame if it names no place.
    `sitting` has 0.05 on average, and 0.14 where it shows a man from a side that t* did not see."""


def judge_take(
    facts: Mapping[str, Any], run: Verdict | None = None, limits: TakeLimits | None = None
) -> Verdict | None:
    """The verdict on a take; None for takes of versions without plate detail.

    Args:
        facts: content of take.json. Used are `t_star_frame`, `t_star_per_frame`, `camera_path`, and `detail`
            ({"plate_share", "invented_share", "per_frame": [{"frame", "regions": 4x4 shares that are a guess, ...}]}),
            which is None for a take of splats alone.
        run: verdict on the run that was frozen, if it has one.
        limits: thresholds.
    """
    if "detail" not in facts:
        return None
    limits, detail = limits or TakeLimits(), facts["detail"]
    if not detail or not detail["per_frame"]:
        return _with_run(
            Verdict("fair", ["Detail is off: its frames use only splats and are softer than the plate."]), run
        )
    rows = detail["per_frame"]
    frames = [int(row["frame"]) for row in rows]
    cells = np.array([row["regions"] for row in rows], np.float64)
    is_guess = np.asarray(cells > limits.lost)
    places = spans_of(frames, cells, is_guess)
    invented = float(detail["invented_share"])
    if invented > limits.fair_invented:
        word = "poor"
    else:
        word = "fair" if invented > limits.good_invented or places else "good"
    plate = _percent(float(detail["plate_share"]))
    sentences = [f"{plate} % of the picture is plate, {100 - plate} % is a guess."]
    sentences += [f"Mostly a guess in {span_text(place)}." for place in places]
    worst = min(rows, key=lambda row: float(row["plate_share"]))
    if not places and 1.0 - float(worst["plate_share"]) >= limits.named:
        sentences.append(f"Most of it in frame {worst['frame']}: {_percent(1.0 - float(worst['plate_share']))} %.")
    steady = bool(is_guess.any(axis=0).any()) and float(is_guess.mean(axis=0).max()) >= limits.steady
    span = run.instants if run is not None else []
    return _with_run(Verdict(word, sentences, places, _advice(facts, frames, places, steady, word, span)), run)


def _with_run(take: Verdict, run: Verdict | None) -> Verdict:
    """A take's verdict with the faults in its run's verdict added."""
    if run is None or run.word == "good":
        return take
    words = list(VERDICT_WORDS)
    word = max(take.word, run.word, key=words.index)
    run_sentences = [sentence for sentence in run.sentences if sentence != EXPLAINED]
    advice = [*take.advice, *(line for line in run.advice if line not in take.advice)]
    return Verdict(word, [*take.sentences, *run_sentences], [*take.where, *run.where], advice, run.instants)


def unsure(verdict: Verdict, frames: list[int]) -> set[int]:
    """The `frames` that a verdict calls unreliable."""
    return {n for n in frames for place in verdict.where if place["first"] <= n <= place["last"]}


def _percent(share: float) -> int:
    """Whole percent. A share above 0 is at least 1 %, one below 1 at most 99 %."""
    return min(max(round(100.0 * share), 1 if share > 0.0 else 0), 99 if share < 0.9995 else 100)


def _advice(
    facts: Mapping[str, Any], frames: list[int], places: list[dict[str, Any]], steady: bool, word: str,
    advised: list[int],
) -> list[str]:  # fmt: skip
    """Advice about the worst of `places`. `advised`: `Verdict.instants` of the run."""
    if not places and word == "good":
        return []
    sentences: list[str] = []
    if steady:
        sentences.append("If nothing moves there, paint it black in the motion matte.")
    worst = places[0] if places else None
    if facts.get("camera_path"):
        sentences.append("Keep the camera closer to the clip's own path there.")
    elif worst is not None and not steady:
        middle = (worst["first"] + worst["last"]) // 2
        if advised:  # only suggest instants that the run's verdict recommends
            middle = min(max(middle, advised[0]), advised[1])
        if not facts.get("t_star_per_frame"):
            sentences.append(f"Try a t* nearer to frame {middle}.")
        span = _longer_part(frames, worst)
        if span is not None:
            sentences.append(f"Or deliver only frames {span[0]} to {span[1]}.")
    elif not sentences:
        sentences.append("Try another t*, or train a larger preset.")
    return sentences


def _longer_part(frames: list[int], worst: dict[str, Any]) -> tuple[int, int] | None:
    """(first, last) frame of the longer part before or after a place, if it has at least half of the frames."""
    before = [n for n in frames if n < worst["first"]]
    after = [n for n in frames if n > worst["last"]]
    longer = max(before, after, key=len)
    return (longer[0], longer[-1]) if 2 * len(longer) >= len(frames) else None
