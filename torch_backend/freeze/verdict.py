"""A take in words: how much of it is plate, how much a guess, where it will not hold, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..contract import Verdict
from ..train.verdict import spans_of, where_words


@dataclass(frozen=True)
class TakeLimits:
    """Where a take stops being good."""

    good_invented: float = 0.06
    """Share of the picture that may be a guess in a good take, on average over its frames."""
    fair_invented: float = 0.2
    """The same of a fair one."""
    lost: float = 0.6
    """Share of a cell of the picture that may be a guess: a person's place in it, not all of it."""
    steady: float = 0.6
    """Share of the frames from which on a place counts as one that is a guess all along."""


def judge_take(facts: Mapping[str, Any], limits: TakeLimits | None = None) -> Verdict | None:
    """The verdict on a take; None for one of before there was detail.

    Args:
        facts: of take.json: `t_star_frame`, `t_star_per_frame`, `camera_path`, and `detail` ({"plate_share",
            "invented_share", "per_frame": [{"frame", "regions": 4x4 shares that are invented, ...}]}), None for a take
            of splats alone.
    """
    if "detail" not in facts:
        return None
    limits, detail = limits or TakeLimits(), facts["detail"]
    if not detail or not detail["per_frame"]:
        return Verdict("fair", ["Its frames are splats alone, softer than the plate: Detail is off."])
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
    plate, guess = (f"{_percent(share)} %" for share in (detail["plate_share"], invented))
    said = [f"{plate} of the picture is plate, {guess} is a guess."]
    said += [f"Mostly a guess in {where_words(place)}." for place in places]
    steady = bool(lost.any(axis=0).any()) and float(lost.mean(axis=0).max()) >= limits.steady
    return Verdict(word, said, places, _advice(facts, frames, places, steady, word))


def unsure(verdict: Verdict, frames: list[int]) -> set[int]:
    """Those of `frames` that a verdict says will not hold."""
    return {n for n in frames for place in verdict.where if place["first"] <= n <= place["last"]}


def _percent(share: float) -> int:
    """Whole percent; what is there is not called 0, what is not whole not 100."""
    return min(max(round(100.0 * share), 1 if share > 0.0 else 0), 99 if share < 0.9995 else 100)


def _advice(
    facts: Mapping[str, Any], frames: list[int], places: list[dict[str, Any]], steady: bool, word: str
) -> list[str]:
    """What to do about the worst of them."""
    if not places and word == "good":
        return []
    said = []
    if steady:
        said.append("If nothing moves there, paint it black in the motion matte.")
    worst = places[0] if places else None
    if facts.get("camera_path"):
        said.append("Keep the camera nearer to the clip's own path there.")
    elif worst is not None and not steady:
        middle = (worst["first"] + worst["last"]) // 2
        if not facts.get("t_star_per_frame"):
            said.append(f"Try a t* nearer to frame {middle}.")
        span = _rest(frames, worst)
        if span is not None:
            said.append(f"Or deliver frames {span[0]} to {span[1]}.")
    elif not said:
        said.append("Try another t*, or train a larger preset.")
    return said


def _rest(frames: list[int], worst: dict[str, Any]) -> tuple[int, int] | None:
    """The longer part of a take before or after a place, if it is half of it or more."""
    before = [n for n in frames if n < worst["first"]]
    after = [n for n in frames if n > worst["last"]]
    longer = max(before, after, key=len)
    return (longer[0], longer[-1]) if 2 * len(longer) >= len(frames) else None
