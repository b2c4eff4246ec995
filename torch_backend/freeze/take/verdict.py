"""A take in words: how much of it is plate, how much a guess, where it will not hold, and what to do about it.

A take is no better than its run. A person who walks through the clip is in no other plate where they stood at t*, and
the model has another shape for them at every instant. So the faults in the run's verdict are repeated for the take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...contract import VERDICT_WORDS, Verdict
from ...train.verdict import EXPLAINED, spans_of, where_words


@dataclass(frozen=True)
class TakeLimits:
    """Where a take stops being good. Tuned on takes of preview runs of three clips of people who hold still (`sitting`,
    `kitchen`, `hall`, at the suggested t*)."""

    good_invented: float = 0.06
    """Share of the picture that may be a guess in a good take, on average over its frames; the clips have 0.007 to
    0.028."""
    fair_invented: float = 0.2
    """The same of a fair one."""
    lost: float = 0.6
    """Share of a cell of the picture that may be a guess: a person's place in it, not all of it. The clips have 0.12 to
    0.53 in the worst cell of the worst frame."""
    steady: float = 0.6
    """Share of the frames from which on a place counts as one that is a guess all along."""
    named: float = 0.1
    """Share of a frame that is a guess from which on the worst one is named, if no place is: `sitting` has 0.05 on
    average, and 0.14 where it shows a man from a side that t* did not see."""


def judge_take(
    facts: Mapping[str, Any], run: Verdict | None = None, limits: TakeLimits | None = None
) -> Verdict | None:
    """The verdict on a take; None for one of before there was detail.

    Args:
        facts: of take.json: `t_star_frame`, `t_star_per_frame`, `camera_path`, and `detail` ({"plate_share",
            "invented_share", "per_frame": [{"frame", "regions": 4x4 shares that are invented, ...}]}), None for a take
            of splats alone.
        run: the verdict on the run that was frozen, if it has one.
    """
    if "detail" not in facts:
        return None
    limits, detail = limits or TakeLimits(), facts["detail"]
    if not detail or not detail["per_frame"]:
        return _with_run(Verdict("fair", ["Its frames are splats alone, softer than the plate: Detail is off."]), run)
    rows = detail["per_frame"]
    frames = [int(row["frame"]) for row in rows]
    cells = np.array([row["regions"] for row in rows], np.float64)
    lost = np.asarray(cells > limits.lost)
    places = spans_of(frames, cells, lost)
    invented = float(detail["invented_share"])
    if invented > limits.fair_invented:
        word = "poor"
    else:
        word = "fair" if invented > limits.good_invented or places else "good"
    plate = _percent(float(detail["plate_share"]))
    sentences = [f"{plate} % of the picture is plate, {100 - plate} % is a guess."]
    sentences += [f"Mostly a guess in {where_words(place)}." for place in places]
    worst = min(rows, key=lambda row: float(row["plate_share"]))
    if not places and 1.0 - float(worst["plate_share"]) >= limits.named:
        sentences.append(f"Most of it in frame {worst['frame']}: {_percent(1.0 - float(worst['plate_share']))} %.")
    steady = bool(lost.any(axis=0).any()) and float(lost.mean(axis=0).max()) >= limits.steady
    span = run.instants if run is not None else []
    return _with_run(Verdict(word, sentences, places, _advice(facts, frames, places, steady, word, span)), run)


def _with_run(take: Verdict, run: Verdict | None) -> Verdict:
    """A take's verdict with what its run's has found amiss."""
    if run is None or run.word == "good":
        return take
    words = list(VERDICT_WORDS)
    word = max(take.word, run.word, key=words.index)
    run_sentences = [sentence for sentence in run.sentences if sentence != EXPLAINED]
    advice = [*take.advice, *(line for line in run.advice if line not in take.advice)]
    return Verdict(word, [*take.sentences, *run_sentences], [*take.where, *run.where], advice, run.instants)


def unsure(verdict: Verdict, frames: list[int]) -> set[int]:
    """Those of `frames` that a verdict says will not hold."""
    return {n for n in frames for place in verdict.where if place["first"] <= n <= place["last"]}


def _percent(share: float) -> int:
    """Whole percent. A share above 0 is at least 1 %, one below 1 at most 99 %."""
    return min(max(round(100.0 * share), 1 if share > 0.0 else 0), 99 if share < 0.9995 else 100)


def _advice(
    facts: Mapping[str, Any], frames: list[int], places: list[dict[str, Any]], steady: bool, word: str,
    advised: list[int],
) -> list[str]:  # fmt: skip
    """What to do about the worst of them. `advised`: `Verdict.instants` of the run."""
    if not places and word == "good":
        return []
    sentences: list[str] = []
    if steady:
        sentences.append("If nothing moves there, paint it black in the motion matte.")
    worst = places[0] if places else None
    if facts.get("camera_path"):
        sentences.append("Keep the camera nearer to the clip's own path there.")
    elif worst is not None and not steady:
        middle = (worst["first"] + worst["last"]) // 2
        if advised:  # never advise an instant that the run's own verdict warns of
            middle = min(max(middle, advised[0]), advised[1])
        if not facts.get("t_star_per_frame"):
            sentences.append(f"Try a t* nearer to frame {middle}.")
        span = _longer_part(frames, worst)
        if span is not None:
            sentences.append(f"Or deliver frames {span[0]} to {span[1]}.")
    elif not sentences:
        sentences.append("Try another t*, or train a larger preset.")
    return sentences


def _longer_part(frames: list[int], worst: dict[str, Any]) -> tuple[int, int] | None:
    """The longer part of a take before or after a place, if it is half of it or more."""
    before = [n for n in frames if n < worst["first"]]
    after = [n for n in frames if n > worst["last"]]
    longer = max(before, after, key=len)
    return (longer[0], longer[-1]) if 2 * len(longer) >= len(frames) else None
