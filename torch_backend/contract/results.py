"""Results of a step: its verdict, and the figures of a whole run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .files import is_json_object, printable
from .shot_folder import ShotFolder, TakeFolder
from .typed import CONTRACT_VERSION, from_dict


def measured(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """(seconds of training, dB on held-out frames) of a measurement; None if one of them is missing or not a number."""
    seconds, quality = _plain_number(row.get("seconds")), _plain_number(row.get("heldout_psnr_db"))
    return (seconds, quality) if seconds is not None and quality is not None else None


def _plain_number(value: object) -> float | None:
    """`value` as a float; None unless it is a number between -1e9 and 1e9."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
        return None
    return float(value)


VERDICT_WORDS = {"good": "Good.", "fair": "Fair.", "poor": "Poor."}
"""Word of a verdict -> its text. Good: usable. Fair: usable but for the named problems. Poor: not worth continuing."""
_MOST_LINES = 12
DEPTH_KINDS = ("depth", "inverse depth")
"""Quantities in which the maps of a depth sequence may be linear."""


@dataclass
class Verdict:
    """Assessment of a run or a take for the artist, stored in a run's summary.json and in a take.json."""

    word: str
    """One of `VERDICT_WORDS`."""
    sentences: list[str]
    """Findings, a sentence each."""
    where: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """Parts that will look wrong, worst first: `first` and `last` frame number, `region` of the picture in words."""
    advice: list[str] = field(default_factory=list[str])
    """What to do about the findings, a sentence each."""
    instants: list[int] = field(default_factory=list[int])
    """First and last frame number of the span that t* should be chosen from; empty if any frame will do."""

    def lines(self) -> list[str]:
        """Lines of the verdict as printed and drawn; the word precedes the first sentence."""
        return [f"{VERDICT_WORDS[self.word]} {self.sentences[0]}", *self.sentences[1:], *self.advice]


def verdict_of(facts: Mapping[str, Any]) -> Verdict | None:
    """The verdict in a summary.json or take.json, which may come from anywhere; None if there is no valid one."""
    data = facts.get("verdict")
    if not is_json_object(data):
        return None
    try:
        found: Verdict = from_dict(Verdict, data)
    except ValueError:
        return None
    texts: list[object] = [*found.sentences, *found.advice]
    if found.word not in VERDICT_WORDS or not found.sentences or not all(isinstance(text, str) for text in texts):
        return None
    shown, advice = ([printable(text, 300) for text in part[:_MOST_LINES]] for part in (found.sentences, found.advice))
    span = found.instants if len(found.instants) == 2 and all(type(n) is int for n in found.instants) else []
    return Verdict(found.word, shown, found.where, advice, span)


def verdict_lines(*facts: Mapping[str, Any]) -> list[str]:
    """Lines of all verdicts in summaries or takes, each line once."""
    found = (verdict_of(one) for one in facts)
    lines = (line for verdict in found if verdict is not None for line in verdict.lines())
    return list(dict.fromkeys(lines))  # a take repeats the findings of its run's verdict


def depth_line(facts: Mapping[str, Any]) -> str:
    """Sentence on how well the depth sequence of a run fits its solve; empty if there is none. `facts`: the run's
    summary.json, which may come from anywhere."""
    found = facts.get("depth")
    if not is_json_object(found):
        return ""
    residual, frames, of_frames = (_plain_number(found.get(key)) for key in ("residual", "frames", "of_frames"))
    kind = found.get("linear_in")
    if residual is None or frames is None or of_frames is None or kind not in DEPTH_KINDS:
        return ""
    return (
        f"The depth sequence fits the solve: linear in {kind}, half of the points are off by less than "
        f"{100 * residual:.1f} %; {frames:.0f} of {of_frames:.0f} frames have depth."
    )


def take_figures(facts: Mapping[str, Any], folder: TakeFolder) -> dict[str, Any]:
    """Entries of DIR/summary.json for a take.

    Args:
        facts: take.json, or the result of the job "freeze".
        folder: current folder of the take, as the shot may have been moved since it was frozen.
    """
    detail: Mapping[str, Any] = facts.get("detail") or {}
    places = {"exr_dir": folder.root, **{k: getattr(folder, k) for k in ("contact_sheet", "video", "ply")}}
    return {
        **{k: detail.get(k) for k in ("plate_share", "invented_share")},
        "t_star_frame": facts.get("t_star_frame"),
        **{k: str(place) for k, place in places.items()},
        "take": facts.get("take"),
    }


def summarise(
    shot: str, source: str, results: Mapping[str, Mapping[str, Any]], stages: Mapping[str, float], wall_seconds: float
) -> dict[str, Any]:
    """Figures of a whole run, as in DIR/summary.json; units in the key names.

    Args:
        shot: absolute path of the shot folder.
        source: path of the footage as the user entered it.
        results: results of the jobs "solve", "train" and "freeze" in their `done` events.
        stages: seconds by kind of job.
        wall_seconds: total seconds.
    """
    train, freeze, solve = results["train"], results["freeze"], results["solve"]
    return {
        "version": CONTRACT_VERSION,
        "shot": shot,
        "source": source,
        **{k: solve[k] for k in ("frames", "solved_frames", "registered", "reprojection_error_px")},
        **{k: train[k] for k in ("gaussians", "moving_share", "train_seconds", "iterations", "heldout_psnr_db")},
        "train_width_px": train["width_px"],
        "modelled": train.get("modelled", []),
        "quality": train.get("quality", ""),
        "verdict": verdict_lines(train, freeze),
        **take_figures(freeze, TakeFolder(ShotFolder(shot).take(freeze["take"]))),
        "run": train["run"],
        "wall_seconds_by_stage": dict(stages),
        "wall_seconds": round(wall_seconds, 2),
    }
