"""Which numbered picture belongs to which frame: one decision over the whole set, for masks and for cameras.

Numbers alone do not tell how the pictures were counted: as the shot, as the footage, or from 0 or 1. Each way is tried
for all pictures together, and the one that fits is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from .numbering import recorded_shift


@dataclass(frozen=True)
class Counted:
    """How a shot counts its frames."""

    frames: list[int]
    """Frame numbers of the shot, ascending."""
    clip: tuple[int, int] | None = None
    """First and last frame that the whole footage has, in the shot's numbers; None if it is not known."""
    shift: int = 0
    """What the import added to the footage's own numbers."""


@dataclass(frozen=True)
class Pairing:
    """Pictures and the frames they belong to."""

    numbers: dict[int, int]
    """Frame -> number of its picture, ascending."""
    by_own_number: bool = True
    """True if each picture has the number of its frame."""
    is_certain: bool = True
    """False if another way to count the pictures fits as well."""


def counted_of(record: dict[str, Any]) -> Counted:
    """How an imported shot counts; `record` is its frames.json."""
    numbers = [int(row["frame"]) for row in record["frames"]]
    clip = record.get("clip")
    span = (int(clip[0]), max(int(clip[1] or 0), numbers[-1])) if clip else None
    return Counted(numbers, span, recorded_shift(record))


def pair(pictures: Sequence[int], counted: Counted, needs_all: bool = False, may_shift: bool = True) -> Pairing:
    """The picture of each frame.

    A way to count is better if the pictures are exactly the frames; then if all pictures lie within the clip; then if
    most frames have one. If two are alike, the shot's own numbers win, then the footage's;
    but pictures from 0 are counted from 0 where the footage begins at 1.

    Args:
        pictures: numbers of the pictures, ascending.
        counted: how the shot counts.
        needs_all: only ways that give every frame a picture are of use, where there are any.
        may_shift: False if the pictures are numbered as the shot or the footage for certain.
    """
    if not pictures:
        return Pairing({})
    frames, first = counted.frames, pictures[0]
    steps = [0, counted.shift]
    clip = counted.clip or (frames[0], frames[-1])
    # Numbers from 0 or 1 are a count of the pictures' own; so are others that miss most frames and are as many.
    strange = 2 * len(set(pictures) & set(frames)) < len(frames)
    as_many = len(pictures) in (len(frames), clip[1] - clip[0] + 1)
    may_count_anew = may_shift and (first in (0, 1) or (strange and as_many))
    if may_count_anew:
        steps += [clip[0] - first, frames[0] - first]
    if may_shift and first == 0 and clip[0] - counted.shift == 1:  # programs count from 0 what people count from 1
        steps.insert(0, clip[0])
    ways = [_Way(step, pictures, counted, needs_all) for step in dict.fromkeys(steps)]
    best = max(ways, key=lambda way: way.worth)
    if may_count_anew and len(pictures) == len(frames) and _is_even(pictures) and not best.worth.enough:
        return Pairing(dict(zip(frames, pictures, strict=True)), by_own_number=False)
    certain = [way.worth for way in ways].count(best.worth) == 1
    return Pairing(best.numbers, best.step == 0, certain)


class _Worth(NamedTuple):
    """How well a way to count fits, the weightiest first."""

    complete: bool
    """Every frame has a picture, where that is needed."""
    exact: bool
    """Pictures and frames are the same."""
    inside: int
    """Minus the number of pictures outside of the clip."""
    enough: bool
    """Every frame has a picture, or half of them where not all need one: beyond that more pictures tell nothing."""


class _Way:
    """One way to count pictures: `step` is added to their numbers."""

    def __init__(self, step: int, pictures: Sequence[int], counted: Counted, needs_all: bool) -> None:
        self.step = step
        wanted = set(counted.frames)
        self.numbers = {n + step: n for n in pictures if n + step in wanted}
        covers = len(self.numbers)
        first, last = counted.clip or (pictures[0] + step, pictures[-1] + step)
        outside = sum(not first <= n + step <= last for n in pictures) if covers else len(pictures)
        enough = covers == len(wanted) if needs_all else 2 * covers >= len(wanted)
        self.worth = _Worth(needs_all and enough, covers == len(wanted) == len(pictures), -outside, enough)


def _is_even(numbers: Sequence[int]) -> bool:
    """True if numbers go up by one step: they count something."""
    return len({b - a for a, b in pairwise(numbers)}) <= 1


def pairing_words(name: str, pictures: Sequence[int], paired: Pairing) -> tuple[str, str] | None:
    """(sentence, hint) for the artist about how pictures were taken; None where nothing else was possible.

    `name` is the subject, such as "The mask m.####.png".
    """
    if not paired.numbers or (paired.by_own_number and paired.is_certain):
        return None
    frame, picture = next(iter(paired.numbers.items()))
    last = list(paired.numbers)[-1]
    how = "each is taken for the frame of its number" if paired.by_own_number else "they are taken in order"
    return (
        f"{name} is numbered {pictures[0]} to {pictures[-1]}, the frames {frame} to {last}: picture {picture} is taken "
        f"for frame {frame}, {how}.",
        "If that is not the right frame, number the pictures as the shot's frames.",
    )
