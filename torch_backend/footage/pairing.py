"""Assigns numbered pictures to frames, for masks, depth maps and cameras. One decision covers the whole set.

Pictures may be numbered like the shot, like the footage, or from 0 or 1, and the numbers alone do not show which. The
code tries each numbering for all pictures together and selects the best fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from .numbering import recorded_shift


@dataclass(frozen=True)
class Counted:
    """Frame numbering of a shot."""

    frames: list[int]
    """Frame numbers of the shot, ascending."""
    clip: tuple[int, int] | None = None
    """First and last frame of the whole footage, in the shot's numbers; None if unknown."""
    shift: int = 0
    """Number that the import added to the footage's own frame numbers."""


@dataclass(frozen=True)
class Pairing:
    """Assignment of pictures to frames."""

    numbers: dict[int, int]
    """Frame -> number of its picture, ascending."""
    by_frame_number: bool = True
    """True if each picture has the number of its frame."""
    is_certain: bool = True
    """False if another numbering of the pictures fits equally well."""


def counted_of(record: dict[str, Any]) -> Counted:
    """Frame numbering of an imported shot, from its frames.json."""
    numbers = [int(row["frame"]) for row in record["frames"]]
    clip = record.get("clip")
    span = (int(clip[0]), max(int(clip[1] or 0), numbers[-1])) if clip else None
    return Counted(numbers, span, recorded_shift(record))


def pair(pictures: Sequence[int], counted: Counted, needs_all: bool = False, may_shift: bool = True) -> Pairing:
    """Assigns a picture to each frame.

    Criteria for a numbering, in this order: pictures and frames match exactly; few pictures lie outside of the clip;
    enough frames have a picture. In a tie, the shot's numbers win, then the footage's numbers. Exception: if the
    footage begins at 1, picture 0 belongs to its first frame.

    Args:
        pictures: numbers of the pictures, ascending.
        counted: frame numbering of the shot.
        needs_all: prefer numberings in which every frame has a picture.
        may_shift: False if the pictures certainly have the numbers of the shot or of the footage.
    """
    if not pictures:
        return Pairing({})
    frames, first = counted.frames, pictures[0]
    steps = [0, counted.shift]
    clip = counted.clip or (frames[0], frames[-1])
    # Pictures may count independently if they start at 0 or 1, or if few numbers match a frame but the total matches.
    few_match = 2 * len(set(pictures) & set(frames)) < len(frames)
    same_count = len(pictures) in (len(frames), clip[1] - clip[0] + 1)
    may_count_anew = may_shift and (first in (0, 1) or (few_match and same_count))
    if may_count_anew:
        steps += [clip[0] - first, frames[0] - first]
    if may_shift and first == 0 and clip[0] - counted.shift == 1:  # programs count from 0, people from 1
        steps.insert(0, clip[0])
    ways = [_Way(step, pictures, counted, needs_all) for step in dict.fromkeys(steps)]
    best = max(ways, key=lambda way: way.worth)
    if may_count_anew and len(pictures) == len(frames) and _is_even(pictures) and not best.worth.is_sufficient:
        return Pairing(dict(zip(frames, pictures, strict=True)), by_frame_number=False)
    certain = [way.worth for way in ways].count(best.worth) == 1
    return Pairing(best.numbers, best.step == 0, certain)


class _Worth(NamedTuple):
    """Quality of a numbering, most important criterion first."""

    complete: bool
    """True if every frame needs a picture and has one."""
    exact: bool
    """True if pictures and frames match one to one."""
    inside: int
    """Minus the number of pictures outside of the clip."""
    is_sufficient: bool
    """True if enough frames have a picture: all if all need one, otherwise half."""


class _Way:
    """One candidate numbering, which adds `step` to the numbers of the pictures."""

    def __init__(self, step: int, pictures: Sequence[int], counted: Counted, needs_all: bool) -> None:
        self.step = step
        frames = set(counted.frames)
        self.numbers = {n + step: n for n in pictures if n + step in frames}
        covers = len(self.numbers)
        first, last = counted.clip or (pictures[0] + step, pictures[-1] + step)
        outside = sum(not first <= n + step <= last for n in pictures) if covers else len(pictures)
        is_sufficient = covers == len(frames) if needs_all else 2 * covers >= len(frames)
        self.worth = _Worth(
            needs_all and is_sufficient, covers == len(frames) == len(pictures), -outside, is_sufficient
        )


def _is_even(numbers: Sequence[int]) -> bool:
    """True if numbers increase by a constant step."""
    return len({b - a for a, b in pairwise(numbers)}) <= 1


def pairing_words(name: str, pictures: Sequence[int], paired: Pairing) -> tuple[str, str] | None:
    """(sentence, hint) for the artist about the assignment; None if it is unambiguous and uses the frames' numbers.

    `name` is the subject, such as "The mask m.####.png".
    """
    if not paired.numbers or (paired.by_frame_number and paired.is_certain):
        return None
    frame, picture = next(iter(paired.numbers.items()))
    last = list(paired.numbers)[-1]
    how = "matched by number" if paired.by_frame_number else "matched in order"
    return (
        f"{name} is numbered {pictures[0]} to {pictures[-1]}, the frames {frame} to {last}: picture {picture} is "
        f"used for frame {frame}, {how}.",
        "If that is not the right frame, number the pictures like the shot's frames.",
    )
