"""A run in words: does it hold, where not, and what to do. Figures in, sentences out; `evidence` has the figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import Reporter, Verdict
from .evidence import GRID, FrameEvidence


@dataclass(frozen=True)
class RunLimits:
    """Where a run stops being good. Tuned on preview runs of three Mannequin Challenge clips in which people hold still
    (`sitting`, `kitchen`, `hall`), and of one synthetic scene each with a walker and a still world (docs/synthetic.md).
    """

    poor_median_db: float = 21.5
    """PSNR of the median frame below which a run is poor. Presets' runs of clips whose people hold still give 24.6 to
    28.8 dB on held-out frames (docs/benchmarks.md); the bundled clip, the hardest of them, 24.4 and 22.8 dB (median,
    worst tenth) there and 25.7 and 23.4 dB on the frames that it trained on. With a figure painted in that walks across
    all of it, 1200 preview steps left it at 18.9 and 17.6 dB (training frames: 19.7 and 17.9)."""
    poor_tenth_db: float = 18.0
    """The same of the worst tenth of the frames."""
    lost: float = 0.3
    """Share of a cell of the picture that may be unexplained; the clips have at most 0.18 in any cell of any frame."""
    poor_lost: float = 0.5
    """Share of the frames with such a cell above which a run is poor."""
    far: float = 0.05
    """Travel as a share of the width, over which something does not sway but goes somewhere: the clips' farthest pixel
    travels 0.04."""
    far_share: float = 0.002
    """Least share of the picture that travels that far, on average over the frames, to be told."""
    still_lost: float = 0.05
    """Share of what the motion mattes call still that may be unexplained: above it the camera is to blame; the clips
    have at most 0.01."""
    still: float = 0.008
    """Sway, as a share of the width, below which nothing moves: 0.004 in a world in which nothing does, 0.016 to 0.021
    in the clips."""
    unlearnt: float = 0.01
    """Share of the frames that the motion mattes may call moving in a run in which nothing moves: an empty room's have
    less, the clips' 0.056 to 0.087."""


@dataclass(frozen=True)
class RunFigures:
    """What a run's verdict is based on."""

    width: int
    """Width in pixels of the working frames, in which travel is told."""
    frames: list[int]
    """[F] numbers of the frames that were examined, ascending."""
    unexplained: NDArray[np.floating]
    """[F, GRID, GRID] as in `FrameEvidence`."""
    travel: NDArray[np.floating]
    """[F, GRID, GRID] as in `FrameEvidence`."""
    sway: float
    """95th percentile of the travel of what moves, as a share of the width."""
    far: float
    """Share of the picture that travels more than `RunLimits.far`, on average."""
    farthest: float
    """99th percentile of the travel of what moves."""
    median_db: float
    """PSNR of the median frame of those held out; of all that were examined if none is."""
    tenth_db: float
    """PSNR that all but the worst tenth of them reach."""
    held_out: bool
    """Those are frames that were held out."""
    still_unexplained: float | None = None
    """Share of what the motion mattes call still that is not explained; None without mattes."""
    matte_moving: float | None = None
    """Share of the frames that the motion mattes call moving; None without mattes."""

    def learnt_no_motion(self, limits: RunLimits) -> bool:
        """True if nothing moves in the run although, by the motion mattes, something moves in the clip."""
        return self.sway < limits.still and (self.matte_moving or 0.0) > limits.unlearnt


def figures_of(seen: Sequence[FrameEvidence], width: int, pixels: int) -> RunFigures:
    """A run's figures from its frames; `width` of the working frames, `pixels` of a frame as it was trained on."""
    known = [one for one in seen if math.isfinite(one.psnr_db)]
    kept = [one for one in known if one.held_out]
    values = [one.psnr_db for one in kept or known] or [0.0]  # a clip that is all mask was refused
    moving = np.concatenate([one.moving for one in seen])
    whole = len(seen) * pixels / 16  # `moving` has every 16th pixel
    still = [one.still_unexplained for one in seen if one.still_unexplained is not None]
    mattes = [one.matte_moving for one in seen if one.matte_moving is not None]
    return RunFigures(
        width,
        [one.frame for one in seen],
        np.stack([one.unexplained for one in seen]),
        np.stack([one.travel for one in seen]),
        float(np.percentile(moving, 95)) if len(moving) else 0.0,
        float((moving > RunLimits.far).sum()) / whole,
        float(np.percentile(moving, 99)) if len(moving) else 0.0,
        float(np.percentile(values, 50)),
        float(np.percentile(values, 10)),
        bool(kept),
        float(np.mean(still)) if still else None,
        float(np.mean(mattes)) if mattes else None,
    )


def judge(figures: RunFigures, limits: RunLimits | None = None) -> Verdict:
    """The verdict on a run."""
    limits = limits or RunLimits()
    lost = figures.unexplained > limits.lost
    bad = lost.any(axis=(1, 2))
    dim = not (figures.median_db >= limits.poor_median_db and figures.tenth_db >= limits.poor_tenth_db)
    places, walks = spans_of(figures.frames, figures.unexplained, lost), []
    if figures.far > limits.far_share:
        far = figures.travel > limits.far
        walks, bad = spans_of(figures.frames, figures.travel, far, most=1), bad | far.any(axis=(1, 2))
    poor = dim or float(lost.any(axis=(1, 2)).mean()) > limits.poor_lost
    word = "poor" if poor else "fair" if places or walks or figures.learnt_no_motion(limits) else "good"
    sentences = _sentences(figures, limits, dim, places, walks)
    span = _longest_good(figures.frames, np.asarray(bad)) if places or walks else None
    advice = _advice(figures, dim, span, places, walks, limits)
    # Only where the run does not show the clip is an instant a bad one. Somebody who walks, and is shown, stands still
    # at any instant. A dim run is advised to be trained anew: no span of it is recommended.
    advised = [*span] if span is not None and places and not dim else []
    return Verdict(word, sentences, [*places, *walks], advice, advised)


def _sentences(
    figures: RunFigures, limits: RunLimits, dim: bool, places: list[dict[str, Any]], walks: list[dict[str, Any]]
) -> list[str]:
    """What is so: how well it fits, what moves and how far, where it does not hold."""
    width, sentences = figures.width, list[str]()
    if dim:
        on = "held-out frames" if figures.held_out else "training frames"
        sentences.append(
            f"It does not show the clip: {figures.median_db:.1f} dB on half of its {on}, "
            f"{figures.tenth_db:.1f} dB on the worst tenth."
        )
    elif not places:
        sentences.append(EXPLAINED)
    sentences += [f"It does not hold in {where_words(place)}." for place in places]
    if figures.learnt_no_motion(limits):
        share = 100.0 * (figures.matte_moving or 0.0)
        sentences.append(f"Nothing moves in it, but the motion mattes call {share:.0f} % of the frames moving.")
    elif figures.sway < limits.still:
        sentences.append("Nothing moves in it.")
    elif walks:
        farthest, place = round(figures.farthest * width), where_words(walks[0])
        sentences.append(f"Something does not hold still: it travels up to {farthest} of {width} pixels in {place}.")
    else:
        sentences.append(f"What moves sways by up to {max(1, round(figures.sway * width))} of {width} pixels.")
    return sentences


def _advice(
    figures: RunFigures, dim: bool, span: tuple[int, int] | None, places: list[dict[str, Any]],
    walks: list[dict[str, Any]], limits: RunLimits,
) -> list[str]:  # fmt: skip
    """What to do about it. `span`: first and last frame of the longest span in which nothing is lost or walks."""
    if figures.learnt_no_motion(limits) and not places and not dim:
        return ["Train with more steps; where the mattes are wrong, paint over them."]
    if figures.sway < limits.still and not places and not dim:
        return ["Any frame will do as t*."]
    if dim or (places and span is None):
        still = figures.still_unexplained
        return [_LOOK if still is None else _SOLVE if still > limits.still_lost else _HOLD]
    if span is not None and places:
        return [f"Choose t* in frames {span[0]} to {span[1]}, or train on that range alone."]
    if span is not None and walks:
        return [f"If it shows in the freeze, train on frames {span[0]} to {span[1]} alone: there all hold still."]
    if walks:
        return ["Paint who walks in the motion matte, or take a range in which all hold still."]
    return []


EXPLAINED = "It shows all of the clip."
_HOLD = "Somebody walks through: take a range in which all hold still."
_SOLVE = "Even what stands still is not there: solve the camera again, or take a range that it follows well."
_LOOK = (
    "Look at its previews. Somebody walks through, or the camera is wrong: take a range in which all hold still, "
    "or solve again."
)


# --------------------------------------------------------------------------------------------------- where


_REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)


def region_words(cells: NDArray[np.floating]) -> str:
    """Where in the picture the weight of cells [GRID, GRID] lies, rows from above: "lower left", "top", "middle"."""
    weights = np.asarray(cells, np.float64)
    total = weights.sum()
    if not total > 0.0 or (weights > 0.25 * weights.max()).mean() > 0.6:
        return "most of the picture"
    rows, columns = np.mgrid[0:GRID, 0:GRID]
    down, across = (float((weights * at).sum() / total) / (GRID - 1) for at in (rows, columns))
    row, column = (0 if at < 0.3 else 2 if at > 0.7 else 1 for at in (down, across))
    return _REGIONS[row][column]


def spans_of(
    frames: Sequence[int], cells: NDArray[np.floating], lost: NDArray[np.bool_], most: int = 3
) -> list[dict[str, Any]]:
    """Where something is lost: `first` and `last` frame of a span and the `region` of the picture; worst first.

    Args:
        frames: [F] ascending numbers.
        cells: [F, GRID, GRID] how much is.
        lost: [F, GRID, GRID] which of them are too large.
        most: how many spans are told.
    """
    bad = np.flatnonzero(lost.any(axis=(1, 2)))
    if not len(bad):
        return []
    gaps = np.asarray(np.diff(bad), np.int64) > 2  # one good frame between does not part them
    groups: list[NDArray[np.int64]] = np.split(bad, np.flatnonzero(gaps) + 1)
    weights: list[NDArray[np.float64]] = [(cells[group] * lost[group]).sum(axis=0) for group in groups]
    worst = sorted(range(len(groups)), key=lambda n: -float(weights[n].sum()))[:most]
    return [
        {
            "first": int(frames[int(groups[n][0])]),
            "last": int(frames[int(groups[n][-1])]),
            "region": region_words(weights[n]),
        }
        for n in worst
    ]


def where_words(place: dict[str, Any]) -> str:
    """'frames 10 to 30, lower left'."""
    if place["first"] == place["last"]:
        return f"frame {place['first']}, {place['region']}"
    return f"frames {place['first']} to {place['last']}, {place['region']}"


def _longest_good(frames: Sequence[int], bad: NDArray[np.bool_], least: int = 4) -> tuple[int, int] | None:
    """First and last number of the longest row of good frames; None if it has fewer than `least`."""
    groups: list[NDArray[np.int64]] = np.split(np.arange(len(bad)), np.flatnonzero(bad))
    good = max(([int(n) for n in group if not bad[n]] for group in groups), key=len)
    return (int(frames[good[0]]), int(frames[good[-1]])) if len(good) >= least else None


# --------------------------------------------------------------------------------------------------- a summary's part


def verdict_fields(figures: RunFigures) -> dict[str, Any]:
    """A run's verdict and the figures behind it, for its summary."""
    verdict = judge(figures)
    return {
        "quality": verdict.word.capitalize(),
        "quality_on": "held-out frames" if figures.held_out else "training frames",
        "median_psnr_db": round(figures.median_db, 2),
        "worst_tenth_psnr_db": round(figures.tenth_db, 2),
        "unexplained_share": round(float(figures.unexplained.mean()), 4),
        "travel_px": round(figures.sway * figures.width, 1),
        "farthest_px": round(figures.farthest * figures.width, 1),
        "verdict": vars(verdict),
    }


def warn_if_poor(summary: dict[str, Any], report: Reporter) -> None:
    """Warns of a poor run, from its summary."""
    verdict = Verdict(**summary["verdict"])
    if verdict.word == "poor":
        report.warning(verdict.lines()[0], " ".join([*verdict.sentences[1:], *verdict.advice]))
