"""Ignored pixels of plates: the artist's mask for the solve excludes them from the scene."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ...sfm.masks import IGNORE, load_mask, recorded_masks
from ...shot import Shot
from ...torch_types import from_numpy

IgnoredOf = Callable[[int], "Tensor | None"]
"""Frame number -> [h, w] in 0..1: 1 on ignored pixels of its plate. None: no pixel is ignored."""


def ignore_mattes(shot: Shot) -> IgnoredOf:
    """The ignored pixels of a shot's plates, as an `IgnoredOf`."""
    if IGNORE not in recorded_masks(shot):
        return lambda frame: None

    def ignored(frame: int) -> Tensor | None:
        mask = load_mask(shot, IGNORE, frame)
        return None if mask is None else from_numpy(mask).float()

    return ignored
