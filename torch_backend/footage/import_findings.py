"""Errors and warnings about the frames of an import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..contract import (
    PICTURE,
    frame_file,
)
from .analysis import FrameMeasures
from .continuity import small_grey
from .cuts import Frames, Transition, find_transitions
from .display import MOST_LIGHT
from .images import read_frame
from .sources import (
    LEAST_FRAMES,
    footage_error,
    frame_words,
)

MANY_FRAMES = 1500


EXPOSURE_DRIFT_STOPS = 1.0


CLIPPED_SHARE = 0.01


@dataclass
class Extracted:
    """Measurements of the extracted frames, in order."""

    measures: list[FrameMeasures]
    seconds: list[float]
    clipped: float
    width: int
    height: int


def refuse_unusable(measures: list[FrameMeasures]) -> None:
    """Raises JobError for an unusable clip: too few usable frames, or a static camera."""
    if len(measures) < LEAST_FRAMES:
        raise footage_error(
            f"The clip has only {len(measures)} frames: a freeze needs at least {LEAST_FRAMES}.",
            "Choose a longer clip or range.",
        )
    usable = sum(not m.flags for m in measures)
    repeated = sum("duplicate" in m.flags for m in measures)
    if usable < LEAST_FRAMES:
        if repeated > len(measures) // 2:
            raise footage_error(
                f"The picture does not change in {repeated} of {len(measures)} frames: the camera stands still.",
                "A freeze needs a clip in which the camera moves sideways by a step or more.",
            )
        raise footage_error(
            f"Only {usable} of {len(measures)} frames are usable, the others are blank, damaged or repeated.",
            f"A freeze needs at least {LEAST_FRAMES}: choose another range.",
        )


def refuse_cuts(measures: list[FrameMeasures], folder: Path, shift: int) -> None:
    """Raises JobError for a clip of several takes. `folder` holds its working frames. `shift`: see `numbering`."""

    def picture(index: int) -> NDArray[np.uint8]:
        return small_grey(read_frame(folder / frame_file(measures[index].frame, PICTURE)))

    features = [m.features for m in measures]
    frames = Frames([f for f in features if f is not None], [m.exposure for m in measures], picture)
    found = find_transitions(frames, [n for n, m in enumerate(measures) if not m.flags])
    if found:
        raise _cut_error([m.frame - shift for m in measures], found)


def _cut_error(numbers: list[int], found: list[Transition]) -> Exception:
    """The error for a clip with cuts, in the footage's own frame `numbers`."""
    # The user enters ranges in the footage's own numbers.
    starts = [numbers[0], *(numbers[one.after] for one in found)]
    ends = [*(numbers[one.before] for one in found), numbers[-1]]
    longest = max(zip(starts, ends, strict=True), key=lambda take: take[1] - take[0])
    takes = [f"{a} to {b}" for a, b in zip(starts, ends, strict=True) if b - a + 1 >= LEAST_FRAMES]
    where = [_transition_words(one.kind, numbers[one.before], numbers[one.after]) for one in found[:3]]
    where += ["more"] if len(found) > 3 else []
    return footage_error(
        f"The clip has {', '.join(where)}: a freeze needs one continuous take.",
        f"Pass the range of one take: {', '.join(takes[:6])} (for example --first {longest[0]} --last {longest[1]})."
        if takes
        else f"None of its takes has {LEAST_FRAMES} frames: choose another clip.",
    )


def _transition_words(kind: str, before: int, after: int) -> str:
    """A transition as part of a sentence, from the last frame before it and the first frame after it."""
    if kind == "hard cut":
        return f"a hard cut at frame {after}"
    return f"a {kind} between frames {before} and {after}"


def remarks(extracted: Extracted) -> list[tuple[str, str]]:
    """Warnings (message, hint) about a clip that is usable."""
    remarks: list[tuple[str, str]] = []
    measures = extracted.measures
    stops = [m.exposure for m in measures if not m.flags]
    drift = max(stops) - min(stops)
    if drift > EXPOSURE_DRIFT_STOPS:
        remarks.append(
            (
                f"The exposure changes by {drift:.1f} stops over the clip.",
                "Lock exposure and white balance when filming.",
            )
        )
    if extracted.clipped > CLIPPED_SHARE:
        remarks.append(
            (
                f"Up to {100 * extracted.clipped:.0f} % of a frame is brighter than {MOST_LIGHT:.0f} times white: "
                "splats clip these areas.",
                "Lower the exposure.",
            )
        )
    if len(measures) > MANY_FRAMES:
        remarks.append(
            (f"The clip has {len(measures)} frames, which will take a long time.", "Choose a shorter range.")
        )
    for flag, words in (("duplicate", "repeats"), ("blank", "blank"), ("corrupt", "damaged")):
        numbers = [m.frame for m in measures if flag in m.flags]
        if numbers:
            remarks.append(
                (f"Not used for the solve and the training because they are {words}: {frame_words(numbers)}.", "")
            )
    return remarks
