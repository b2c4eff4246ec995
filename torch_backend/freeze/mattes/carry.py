"""Propagates mattes from the lassoed frames to all frames of a take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...scene import resize_intrinsics
from ...torch_types import from_numpy
from ..frozen import FrozenGaussians
from .membership import membership, render_members, rule_out, vote
from .segment import Matte, Picture, SegmentConfig, refine, segment_lasso

VOTE_WIDTH = 320
"""Width in pixels of the pictures on which mattes vote: a vote costs as much as a training step at that width."""


@dataclass
class TakeFrame:
    """A frozen frame for which mattes are made. Arrays include the overscan."""

    number: int
    """Frame number of the clip."""
    picture: Picture
    """[H, W, 3] sRGB picture."""
    depth: NDArray[np.float32]
    """[H, W] along the camera's axis, scene units."""
    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] pixels of the frame with its overscan."""
    beyond: tuple[int, int]
    """Pixels of overscan left and right, and above and below."""
    t_star: float
    """Frame number of the frozen instant."""


Polygons = Mapping[str, Mapping[int, Sequence[NDArray[np.float64]]]]
"""Name of a matte -> frame -> polygons [P, 2] in pixels of the frame without its overscan."""


def in_order(polygons: Polygons, frames: Iterable[int]) -> list[int]:
    """`frames` sorted by their distance to the nearest lassoed frame."""
    lassoed = sorted({frame for of in polygons.values() for frame in of})
    return sorted(frames, key=lambda n: (min((abs(n - at) for at in lassoed), default=0), n))


def carry(
    polygons: Polygons, frames: Iterable[int], read: Callable[[int], TakeFrame],
    frozen_at: Callable[[float], FrozenGaussians], config: SegmentConfig | None = None,
) -> Iterator[tuple[TakeFrame, dict[str, Matte]]]:  # fmt: skip
    """Yields frames of a take, `in_order`, each with a matte [H, W] for every name.

    KeyError if `read` does not know the frame of a polygon.
    """
    order = in_order(polygons, frames)
    lassoed = [number for number in order if any(number in of for of in polygons.values())]
    lasso_mattes: dict[tuple[int, str], Matte] = {}
    votes: dict[str, Tensor] = {}
    for number in lassoed:
        frame = read(number)
        for name, of in polygons.items():
            for polygon in of.get(number, ()):
                found = segment_lasso(frame.picture, frame.depth, polygon + np.array(frame.beyond), config)
                before = lasso_mattes.get((number, name))
                lasso_mattes[number, name] = found if before is None else np.maximum(found, before)
        of_frame = {name: lasso_mattes[number, name] for name in polygons if (number, name) in lasso_mattes}
        _add(votes, _votes_of(of_frame, frame, frozen_at(frame.t_star)))
    for number in order:
        frame = read(number)
        frozen = frozen_at(frame.t_star)
        if number == order[0]:
            votes = {name: rule_out(vote, frozen.state["means"]) for name, vote in votes.items()}
        mattes: dict[str, Matte] = {}
        for name in polygons:
            lasso = lasso_mattes.get((number, name))
            mattes[name] = _refined(votes[name], frozen, frame, config) if lasso is None else lasso
        # Mattes of every frame vote, too: parts that the lassoed frame hides are found once the camera shows them.
        carried = {name: matte for name, matte in mattes.items() if (number, name) not in lasso_mattes}
        _add(votes, _votes_of(carried, frame, frozen))
        yield frame, mattes


def _refined(votes: Tensor, frozen: FrozenGaussians, frame: TakeFrame, config: SegmentConfig | None) -> Matte:
    """The matte [H, W] at a frame of the object with votes [N, 2]."""
    height, width = frame.depth.shape
    rendered = render_members(frozen, membership(votes), frame.viewmat, frame.K, width, height, frame.beyond)
    return refine(frame.picture, frame.depth, rendered[..., 0].numpy(), rendered[..., 1].numpy(), config)


def _add(votes: dict[str, Tensor], added: Mapping[str, Tensor]) -> None:
    """Adds the votes `added` to `votes` in place."""
    for name, counts in added.items():
        votes[name] = votes[name] + counts if name in votes else counts


def _votes_of(mattes: Mapping[str, Matte], frame: TakeFrame, frozen: FrozenGaussians) -> dict[str, Tensor]:
    """Name -> votes [N, 2] of a frame's matte: pixels of each Gaussian inside the matte, and all its pixels."""
    if not mattes:
        return {}
    height, width = frame.depth.shape
    small = min(width, VOTE_WIDTH), max(1, round(height * min(width, VOTE_WIDTH) / width))
    K = resize_intrinsics(frame.K[None], width, height, *small)[0]
    layers = [cv2.resize(matte, small, interpolation=cv2.INTER_AREA) for matte in mattes.values()]
    pictures = np.stack([*layers, np.ones(small[::-1], np.float32)], axis=-1)
    depth = from_numpy(cv2.resize(frame.depth, small, interpolation=cv2.INTER_NEAREST_EXACT))
    pixels = vote(frozen, frame.viewmat, K, from_numpy(pictures), depth) * (width / small[0]) ** 2
    return {name: pixels[:, [n, -1]] for n, name in enumerate(mattes)}
