"""Verdict on a run: its quality, where it fails and what to do, as sentences. `evidence` measures the figures."""

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
    """Thresholds of the verdict. They were tuned on preview runs of three Mannequin Challenge clips in which people
    hold still (`sitting`, `kitchen`, `hall`), and of two synthetic scenes, one with a walker and one without motion
    (docs/synthetic.md). Fields below call the three clips "the clips"."""

    poor_median_db: float = 21.5
    """PSNR of the median frame below which a run is poor. Runs of the presets on clips of people holding still reach
    24.6 to 28.8 dB on held-out frames (docs/benchmarks.md). The bundled clip, the hardest of them, has 24.4 and 22.8 dB
    (median, worst tenth) on held-out frames, and 25.7 and 23.4 dB on training frames. With a painted figure that walks
    through the whole clip, 1200 preview steps reached 18.9 and 17.6 dB (training frames: 19.7 and 17.9)."""
    poor_tenth_db: float = 18.0
    """PSNR of the worst tenth of the frames below which a run is poor."""
    lost: float = 0.3
    """Share of a cell of the image above which the cell counts as lost; the clips have at most 0.18 in any cell."""
    poor_lost: float = 0.5
    """Share of frames with a lost cell above which a run is poor."""
    far: float = 0.05
    """Travel, as a share of the width, above which an object walks instead of swaying. The clips' maximum is 0.04."""
    far_share: float = 0.002
    """Mean share of the image that must travel that far for the verdict to report it."""
    still_lost: float = 0.05
    """Unexplained share of still pixels (by the motion mattes) above which the camera solve is blamed. The clips have
    at most 0.01."""
    still: float = 0.008
    """Sway, as a share of the width, below which nothing moves: 0.004 in a scene without motion, 0.016 to 0.021 in the
    clips."""
    unlearnt: float = 0.01
    """Moving share of the pixels (by the motion mattes) above which a run without motion has missed motion. An empty
    room has less; the clips have 0.056 to 0.087."""


@dataclass(frozen=True)
class RunFigures:
    """Figures on which a run's verdict is based."""

    width: int
    """Width in pixels of the working frames, in which travel is reported."""
    frames: list[int]
    """[F] numbers of the examined frames, ascending."""
    unexplained: NDArray[np.floating]
    """[F, GRID, GRID], see `FrameEvidence.unexplained`."""
    travel: NDArray[np.floating]
    """[F, GRID, GRID], see `FrameEvidence.travel`."""
    sway: float
    """95th percentile of the travel of moving pixels, as a share of the width."""
    far: float
    """Share of the image that travels more than `RunLimits.far`, averaged over the frames."""
    farthest: float
    """99th percentile of the travel of moving pixels, as a share of the width."""
    median_db: float
    """Median PSNR over the held-out frames, or over all examined frames if none is held out."""
    tenth_db: float
    """10th percentile of PSNR over the same frames."""
    held_out: bool
    """True if the PSNRs are those of held-out frames."""
    still_unexplained: float | None = None
    """Mean unexplained share of still pixels (by the motion mattes); None without mattes."""
    matte_moving: float | None = None
    """Mean share of pixels that the motion mattes mark as moving; None without mattes."""

    def learnt_no_motion(self, limits: RunLimits) -> bool:
        """True if nothing moves in the run although the motion mattes mark motion in the clip."""
        return self.sway < limits.still and (self.matte_moving or 0.0) > limits.unlearnt


def figures_of(seen: Sequence[FrameEvidence], width: int, pixels: int) -> RunFigures:
    """Figures of a run. `width`: width of the working frames; `pixels`: number of pixels of a training image."""
    known = [row for row in seen if math.isfinite(row.psnr_db)]
    kept = [row for row in known if row.held_out]
    values = [row.psnr_db for row in kept or known] or [0.0]  # clips that are masked entirely are rejected earlier
    moving = np.concatenate([row.moving for row in seen])
    sampled = len(seen) * pixels / 16  # `moving` has every 16th pixel
    still = [row.still_unexplained for row in seen if row.still_unexplained is not None]
    mattes = [row.matte_moving for row in seen if row.matte_moving is not None]
    return RunFigures(
        width,
        [row.frame for row in seen],
        np.stack([row.unexplained for row in seen]),
        np.stack([row.travel for row in seen]),
        float(np.percentile(moving, 95)) if len(moving) else 0.0,
        float((moving > RunLimits.far).sum()) / sampled,
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
    # A span is recommended only if some frames are unexplained: a walker that the run shows can be frozen at any
    # instant. No span is recommended for a dim run, which should be trained again.
    advised = [*span] if span is not None and places and not dim else []
    return Verdict(word, sentences, [*places, *walks], advice, advised)


def _sentences(
    figures: RunFigures, limits: RunLimits, dim: bool, places: list[dict[str, Any]], walks: list[dict[str, Any]]
) -> list[str]:
    """Findings as sentences: how well the run fits, where it fails, what moves and how far."""
    width, sentences = figures.width, list[str]()
    if dim:
        on = "held-out frames" if figures.held_out else "training frames"
        sentences.append(
            f"It does not match the clip: {figures.median_db:.1f} dB on half of its {on}, {figures.tenth_db:.1f} dB "
            "on the worst tenth."
        )
    elif not places:
        sentences.append(EXPLAINED)
    sentences += [f"It does not match the clip in {span_text(place)}." for place in places]
    if figures.learnt_no_motion(limits):
        share = 100.0 * (figures.matte_moving or 0.0)
        sentences.append(f"Nothing moves in it, but the motion mattes mark {share:.0f} % of the frames as moving.")
    elif figures.sway < limits.still:
        sentences.append("Nothing moves in it.")
    elif walks:
        farthest, place = round(figures.farthest * width), span_text(walks[0])
        sentences.append(f"Something does not hold still: it travels up to {farthest} of {width} pixels in {place}.")
    else:
        sentences.append(f"Moving parts sway by up to {max(1, round(figures.sway * width))} of {width} pixels.")
    return sentences


def _advice(
    figures: RunFigures, dim: bool, span: tuple[int, int] | None, places: list[dict[str, Any]],
    walks: list[dict[str, Any]], limits: RunLimits,
) -> list[str]:  # fmt: skip
    """Advice as sentences. `span`: first and last frame of the longest span without lost cells or walkers."""
    if figures.learnt_no_motion(limits) and not places and not dim:
        return ["Train with more steps; where the mattes are wrong, paint over them."]
    if figures.sway < limits.still and not places and not dim:
        return ["Any frame works as t*."]
    if dim or (places and span is None):
        still = figures.still_unexplained
        return [_LOOK if still is None else _SOLVE if still > limits.still_lost else _HOLD]
    if span is not None and places:
        return [f"Choose t* in frames {span[0]} to {span[1]}, or train only on that range."]
    if span is not None and walks:
        return [f"If it shows in the freeze, train only on frames {span[0]} to {span[1]}, where everyone holds still."]
    if walks:
        return ["Paint walking people in the motion matte, or choose a range in which everyone holds still."]
    return []


EXPLAINED = "It matches the whole clip."
_HOLD = "Somebody walks through: choose a range in which everyone holds still."
_SOLVE = "Even static parts are missing: solve the camera again, or choose a range with a good solve."
_LOOK = (
    "Check its previews. If somebody walks through, choose a range in which everyone holds still; if the camera is "
    "wrong, solve again."
)


# --------------------------------------------------------------------------------------------------- where


_REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)


def region_text(cells: NDArray[np.floating]) -> str:
    """Region of the image where the weight of cells [GRID, GRID] (top row first) is centred, such as "lower left"."""
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
    """Spans of frames with lost cells, worst first: `first` and `last` frame and `region` of the image.

    Args:
        frames: [F] frame numbers, ascending.
        cells: [F, GRID, GRID] values of the cells.
        lost: [F, GRID, GRID] True for cells whose value is too large.
        most: maximum number of spans.
    """
    bad = np.flatnonzero(lost.any(axis=(1, 2)))
    if not len(bad):
        return []
    gaps = np.asarray(np.diff(bad), np.int64) > 2  # a single good frame does not split a span
    groups: list[NDArray[np.int64]] = np.split(bad, np.flatnonzero(gaps) + 1)
    weights: list[NDArray[np.float64]] = [(cells[group] * lost[group]).sum(axis=0) for group in groups]
    worst = sorted(range(len(groups)), key=lambda n: -float(weights[n].sum()))[:most]
    return [
        {
            "first": int(frames[int(groups[n][0])]),
            "last": int(frames[int(groups[n][-1])]),
            "region": region_text(weights[n]),
        }
        for n in worst
    ]


def span_text(place: dict[str, Any]) -> str:
    """A span of `spans_of` in words, for instance 'frames 10 to 30, lower left'."""
    if place["first"] == place["last"]:
        return f"frame {place['first']}, {place['region']}"
    return f"frames {place['first']} to {place['last']}, {place['region']}"


def _longest_good(frames: Sequence[int], bad: NDArray[np.bool_], least: int = 4) -> tuple[int, int] | None:
    """First and last number of the longest sequence of good frames; None if it is shorter than `least`."""
    groups: list[NDArray[np.int64]] = np.split(np.arange(len(bad)), np.flatnonzero(bad))
    good = max(([int(n) for n in group if not bad[n]] for group in groups), key=len)
    return (int(frames[good[0]]), int(frames[good[-1]])) if len(good) >= least else None


# --------------------------------------------------------------------------------------------------- a summary's part


def verdict_fields(figures: RunFigures) -> dict[str, Any]:
    """Verdict of a run and its figures, for summary.json."""
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
    """Warns if the summary's verdict is poor."""
    verdict = Verdict(**summary["verdict"])
    if verdict.word == "poor":
        report.warning(verdict.lines()[0], " ".join([*verdict.sentences[1:], *verdict.advice]))
