"""Bars beside the picture: letterbox and pillars, of one colour or a blurred copy of the picture. They are no scene.

A bar ends at a straight border that stands at the same row or column in every frame, while the camera moves. Outside of
it there is one colour, or far less detail than inside and a step at the border. What is merely dark ends where the
scene says: somewhere else in every frame, or along no line. A false bar would cut off a part of the scene, so a
doubtful edge is not a bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LEAST_FRAMES = 12
"""Of fewer pictures nothing is said."""
_LEAST, _MOST = 0.012, 0.45
"""Share of the picture's side that one bar takes, at least (less is a camera's own rim) and at most."""
_FLAT = 6.0
"""Steps of 255 that a pixel of a bar may differ from the bar's colour: compression does not leave more."""
_FLAT_SHARE = 0.7
"""Share of the pixels of a bar's line that have the bar's colour, in nearly every frame: the rest may be a subtitle."""
_STEP = 14.0
"""Steps of 255 by which the picture differs from the bar just inside of the border, where it is not as dark itself."""
_STEP_SHARE = 0.4
"""By how much larger a share of the border's length does so inside than outside, in nearly every frame. Of three clips,
compressed, with bars added it is 0.67 to 0.99; of the same ones underexposed until their blacks clip, 0.06 at most."""
_OFTEN = 0.9
"""Share of the frames that have to agree."""
_SMOOTH = 0.45
"""Detail outside of a blurred bar's border, as a share of that inside: 0.16 to 0.38 of three clips, compressed."""
_STANDS_OUT = 1.4
"""By how much a blurred bar's step exceeds the steps of the picture near it."""
_NEAR = 3
"""Lines on either side of a border that are blurred by scaling and compression."""


_MIXED = 2
"""Lines of the picture that scaling and compression mix with a bar."""


@dataclass(frozen=True)
class Bars:
    """Lines of the frame that belong to no picture, at each side."""

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    @property
    def sides(self) -> list[str]:
        """Words for where they are."""
        named = {"above": self.top, "below": self.bottom, "left": self.left, "right": self.right}
        return [name for name, size in named.items() if size]

    @property
    def widened(self) -> Bars:
        """The same with the lines of the picture that are mixed with them."""
        return Bars(*(side + _MIXED if side else 0 for side in (self.top, self.bottom, self.left, self.right)))

    def inner(self, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns of the picture in a frame of that size."""
        return slice(self.top, height - self.bottom), slice(self.left, width - self.right)

    def mask(self, height: int, width: int) -> NDArray[np.bool_]:
        """[height, width] bool: the bars."""
        covered = np.ones((height, width), bool)
        covered[self.inner(height, width)] = False
        return covered


def recorded_bars(record: dict[str, Any], height: int, width: int) -> Bars:
    """The bars of a frame of that size that an import noted in its frames.json: `bars`, shares of the frame's sides."""
    shares: dict[str, float] = record.get("bars") or {}
    lengths = {"top": height, "bottom": height, "left": width, "right": width}
    return Bars(**{side: round(float(shares.get(side, 0.0)) * length) for side, length in lengths.items()})


def find_bars(pictures: Sequence[NDArray[np.uint8]]) -> Bars:
    """The bars of grey pictures [H, W], spread over a clip; none where the evidence is weak."""
    if len(pictures) < _LEAST_FRAMES:
        return Bars()
    stack = np.stack(pictures).astype(np.float32)
    if float(np.abs(stack - stack.mean(axis=0)).mean()) < 1.0:  # nothing moves: any edge stands
        return Bars()
    top, bottom, left, right = _flat(stack)
    rest = stack[:, top : stack.shape[1] - bottom, left : stack.shape[2] - right]
    if not (left or right):
        left = right = _blurred(rest)
    if not (top or bottom):
        top = bottom = _blurred(rest.swapaxes(1, 2))
    return Bars(top, bottom, left, right)


def _flat(stack: NDArray[np.float32]) -> tuple[int, int, int, int]:
    """Lines of one colour at the top, bottom, left and right of [F, H, W]."""
    top, bottom = _flat_sides(stack)
    return top, bottom, *_flat_sides(stack[:, top : stack.shape[1] - bottom].swapaxes(1, 2))


def _flat_sides(stack: NDArray[np.float32]) -> tuple[int, int]:
    """How many of the first and last rows of [F, H, W] are bars of one colour."""
    first, last = _flat_side(stack), _flat_side(stack[:, ::-1])
    # Where the picture is as dark as the bar, the border on the other side tells where it is.
    if first and not last and _has_colour_of(stack, stack[:, ::-1], first):
        last = first
    elif last and not first and _has_colour_of(stack[:, ::-1], stack, last):
        first = last
    return first, last


def _has_colour_of(found: NDArray[np.float32], other: NDArray[np.float32], lines: int) -> bool:
    """True if the first rows of `other` [F, H, W] have the colour of the bar of `found`, up to near its border."""
    off = np.abs(other[:, : max(1, lines - _NEAR)] - np.median(found[:, :lines]))
    return bool((np.quantile((off <= _FLAT).mean(axis=2), 1.0 - _OFTEN, axis=0) >= _FLAT_SHARE).all())


def _flat_side(stack: NDArray[np.float32]) -> int:
    """How many of the first rows of [F, H, W] are a bar of one colour."""
    height = stack.shape[1]
    most = int(_MOST * height)
    head = stack[:, : most + 2 * _NEAR]
    off = np.abs(head - np.median(head[:, : max(1, int(_LEAST * height))]))
    flat = np.quantile((off <= _FLAT).mean(axis=2), 1.0 - _OFTEN, axis=0) >= _FLAT_SHARE
    lines = int(np.argmin(flat)) if not flat.all() else len(flat)
    if not _LEAST * height <= lines <= most:
        return 0
    inside = (off[:, lines : lines + _NEAR].max(axis=1) > _STEP).mean(axis=1)
    outside = (off[:, max(0, lines - 2 * _NEAR) : lines - _NEAR + 1].max(axis=1) > _STEP).mean(axis=1)
    return lines if np.quantile(inside - outside, 1.0 - _OFTEN) >= _STEP_SHARE else 0


def _blurred(stack: NDArray[np.float32]) -> int:
    """How many columns at the left and as many at the right of [F, H, W] are a blurred copy of what is between."""
    width = stack.shape[2]
    least, most = max(int(_LEAST * width), 2 * _NEAR), int(_MOST * width)
    if width < 8 * _NEAR:
        return 0
    step = np.abs(stack[:, :, 2:] - stack[:, :, :-2]).mean(axis=1)  # [F, W - 2], of column n + 1
    middle = np.median(step, axis=0)
    found = [side for side in range(least, most) if _is_border(stack, step, middle, side)]
    return max(found, key=lambda side: middle[side - 1], default=0)


def _is_border(stack: NDArray[np.float32], step: NDArray[np.float32], middle: NDArray[np.float32], side: int) -> bool:
    """True if pictures [F, H, W] have a step `side` columns from either border, and are smooth beyond it."""
    width = stack.shape[2]
    for at in (side, width - side):
        near = step[:, max(0, at - 12) : at + 11]
        place = near.argmax(axis=1) + max(0, at - 12) + 1
        if (np.abs(place - at + 0.5) <= 1.5).mean() < _OFTEN:
            return False
        inside = middle[at + _NEAR : at + 24] if at == side else middle[at - 26 : at - _NEAR - 2]
        if middle[at - 1] < _STANDS_OUT * float(inside.max(initial=0.0)):
            return False
    outside = np.concatenate([stack[:, :, : side - _NEAR], stack[:, :, width - side + _NEAR :]], axis=2)
    return bool(
        (_detail(outside) <= _SMOOTH * _detail(stack[:, :, side + _NEAR : width - side - _NEAR])).mean() >= _OFTEN
    )


def _detail(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """[F]: how much the rows of each picture [F, H, W] differ from a straight line between their neighbours."""
    return np.abs(2.0 * stack[:, 1:-1] - stack[:, :-2] - stack[:, 2:]).mean(axis=(1, 2))
