"""Ignored pixels of plates, by the artist's mask for the solve: they are not part of the scene."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ...sfm.masks import IGNORE, given_masks, load_mask
from ...shot import Shot
from ...torch_types import from_numpy

IgnoredOf = Callable[[int], "Tensor | None"]
"""Frame number -> [h, w] in 0..1, what of its plate is no part of the scene, or None if all of it is."""


def ignore_mattes(shot: Shot) -> IgnoredOf:
    """Pixels that the masks of a shot's solve exclude from the scene."""
    if IGNORE not in given_masks(shot):
        return lambda frame: None

    def ignored(frame: int) -> Tensor | None:
        mask = load_mask(shot, IGNORE, frame)
        return None if mask is None else from_numpy(mask).float()

    return ignored
