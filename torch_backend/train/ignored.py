"""Pixels of trained frames that teach nothing: what the artist's mask says is no part of the scene."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..scene import Scene
from ..torch_types import from_numpy

_COVERED = 0.1
"""Share of a training pixel that has to be covered before the pixel is: a logo's edge is half its colour."""

Masks = Callable[[int], "NDArray[np.bool_] | None"]
"""Frame number -> what is ignored in it, bool [h, w]; None where nothing is."""


def load_ignored(masks: Masks, scene: Scene, indices: list[int], width: int, height: int) -> dict[int, Tensor]:
    """Index of a frame of the scene -> bool [height, width] on the CPU, of those that have something to ignore.

    Frames with the same mask share a tensor. JobError if a mask is damaged.
    """
    found: dict[int, Tensor] = {}
    same: dict[bytes, Tensor] = {}
    for index in indices:
        mask = masks(scene.frames[index])
        if mask is None or not mask.any():
            continue
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        covered = np.asarray(share) > _COVERED
        found[index] = same.setdefault(covered.tobytes(), from_numpy(covered))
    return found
