"""Detects letterbox and pillarbox bars, filled with one colour or with a blurred copy of the picture.

A bar has a straight border at the same row or column in every frame, while the camera moves. It has one colour, or it
has far less detail than the picture and a step at the border. The edge of a dark part of the scene moves, or is not
straight. A false bar would cut off a part of the scene, so the code rejects doubtful bars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Minimum number of pictures for a decision.
_LEAST_FRAMES = 12
# Minimum and maximum size of one bar, as a share of the picture's side. Thinner borders are camera artefacts.
_LEAST, _MOST = 0.012, 0.45
# Largest difference of a bar's pixel from the bar's colour, in steps of 255. Compression causes no more.
_FLAT = 6.0
# Minimum share of pixels with the bar's colour in a line, in nearly every frame. The rest may be a subtitle.
_FLAT_SHARE = 0.7
# Minimum difference between bar and picture at the border, in steps of 255.
_STEP = 14.0
# Minimum share of the border with a difference of `_STEP` just inside it, less that share just outside. Measured in
# three compressed clips: 0.67 to 0.99 with added bars, at most 0.06 if underexposed until blacks clip.
_STEP_SHARE = 0.4
# Minimum share of frames that agree.
_OFTEN = 0.9
# Largest ratio of detail in a blurred bar to detail in the picture. Measured in three clips: 0.16 to 0.38.
_SMOOTH = 0.45
# Minimum ratio of the step at a blurred bar's border to the steps of the picture nearby.
_STANDS_OUT = 1.4
# Number of lines on each side of a border that scaling and compression blur.
_NEAR = 3


# Number of lines of the picture that scaling and compression mix with a bar.
_MIXED = 2


@dataclass(frozen=True)
class Bars:
    """Number of lines covered by a bar at each side of the frame."""

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    @property
    def sides(self) -> list[str]:
        """Names of the sides with a bar, for messages."""
        named = {"above": self.top, "below": self.bottom, "left": self.left, "right": self.right}
        return [name for name, size in named.items() if size]

    @property
    def widened(self) -> Bars:
        """The bars extended by the `_MIXED` lines of the picture at their border."""
        return Bars(*(side + _MIXED if side else 0 for side in (self.top, self.bottom, self.left, self.right)))

    def inner(self, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns of the picture in a frame of that size."""
        return slice(self.top, height - self.bottom), slice(self.left, width - self.right)

    def mask(self, height: int, width: int) -> NDArray[np.bool_]:
        """Mask of the bars, [height, width] bool."""
        covered = np.ones((height, width), bool)
        covered[self.inner(height, width)] = False
        return covered


def recorded_bars(record: dict[str, Any], height: int, width: int) -> Bars:
    """The bars recorded in frames.json (`bars`: shares of the frame's sides), for a frame of this size."""
    shares: dict[str, float] = record.get("bars") or {}
    lengths = {"top": height, "bottom": height, "left": width, "right": width}
    return Bars(**{side: round(float(shares.get(side, 0.0)) * length) for side, length in lengths.items()})


def find_bars(pictures: Sequence[NDArray[np.uint8]]) -> Bars:
    """The bars of a clip, from grey pictures [H, W] spread over it; empty if the evidence is weak."""
    if len(pictures) < _LEAST_FRAMES:
        return Bars()
    stack = np.stack(pictures).astype(np.float32)
    if float(np.abs(stack - stack.mean(axis=0)).mean()) < 1.0:  # in a static clip every edge stays in place
        return Bars()
    top, bottom, left, right = _flat(stack)
    picture = stack[:, top : stack.shape[1] - bottom, left : stack.shape[2] - right]
    if not (left or right):
        left = right = _blurred(picture)
    if not (top or bottom):
        top = bottom = _blurred(picture.swapaxes(1, 2))
    return Bars(top, bottom, left, right)


def _flat(stack: NDArray[np.float32]) -> tuple[int, int, int, int]:
    """Sizes of bars of one colour at the top, bottom, left and right of [F, H, W]."""
    top, bottom = _flat_sides(stack)
    return top, bottom, *_flat_sides(stack[:, top : stack.shape[1] - bottom].swapaxes(1, 2))


def _flat_sides(stack: NDArray[np.float32]) -> tuple[int, int]:
    """Sizes of bars of one colour at the first and the last rows of [F, H, W]."""
    first, last = _flat_side(stack), _flat_side(stack[:, ::-1])
    # If the picture is as dark as one of the bars, the opposite bar defines the size of both.
    if first and not last and _has_colour_of(stack, stack[:, ::-1], first):
        last = first
    elif last and not first and _has_colour_of(stack[:, ::-1], stack, last):
        first = last
    return first, last


def _has_colour_of(found: NDArray[np.float32], region: NDArray[np.float32], lines: int) -> bool:
    """True if the first rows of `region` [F, H, W], up to near the border, have the colour of the bar in `found`."""
    difference = np.abs(region[:, : max(1, lines - _NEAR)] - np.median(found[:, :lines]))
    return bool((np.quantile((difference <= _FLAT).mean(axis=2), 1.0 - _OFTEN, axis=0) >= _FLAT_SHARE).all())


def _flat_side(stack: NDArray[np.float32]) -> int:
    """Size of a bar of one colour at the first rows of [F, H, W]; 0 without a bar."""
    height = stack.shape[1]
    most = int(_MOST * height)
    head = stack[:, : most + 2 * _NEAR]
    difference = np.abs(head - np.median(head[:, : max(1, int(_LEAST * height))]))
    flat = np.quantile((difference <= _FLAT).mean(axis=2), 1.0 - _OFTEN, axis=0) >= _FLAT_SHARE
    lines = int(np.argmin(flat)) if not flat.all() else len(flat)
    if not _LEAST * height <= lines <= most:
        return 0
    inside = (difference[:, lines : lines + _NEAR].max(axis=1) > _STEP).mean(axis=1)
    outside = (difference[:, max(0, lines - 2 * _NEAR) : lines - _NEAR + 1].max(axis=1) > _STEP).mean(axis=1)
    return lines if np.quantile(inside - outside, 1.0 - _OFTEN) >= _STEP_SHARE else 0


def _blurred(stack: NDArray[np.float32]) -> int:
    """Size of two equal blurred bars at the left and right of [F, H, W]; 0 without bars."""
    width = stack.shape[2]
    least, most = max(int(_LEAST * width), 2 * _NEAR), int(_MOST * width)
    if width < 8 * _NEAR:
        return 0
    step = np.abs(stack[:, :, 2:] - stack[:, :, :-2]).mean(axis=1)  # [F, W - 2], of column n + 1
    middle = np.median(step, axis=0)
    found = [side for side in range(least, most) if _is_border(stack, step, middle, side)]
    return max(found, key=lambda side: middle[side - 1], default=0)


def _is_border(stack: NDArray[np.float32], step: NDArray[np.float32], middle: NDArray[np.float32], side: int) -> bool:
    """True if pictures [F, H, W] have a step at `side` columns from the left and right, and are smooth outside."""
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
    """Mean absolute second difference between the rows of each picture [F, H, W], as [F]."""
    return np.abs(2.0 * stack[:, 1:-1] - stack[:, :-2] - stack[:, 2:]).mean(axis=(1, 2))
