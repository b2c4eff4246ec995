"""Ignored pixels of training frames: pixels that the user's mask excludes from the scene."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..scene import Scene
from ..torch_types import from_numpy

# Masked share of a training pixel above which the pixel is ignored. It is low because mixed pixels at the mask's edge
# would still train the model on the colour of a logo.
_COVERED = 0.1

Masks = Callable[[int], "NDArray[np.bool_] | None"]
"""Frame number -> bool [h, w] ignored pixels; None if there are none."""


def load_ignored(masks: Masks, scene: Scene, indices: list[int], width: int, height: int) -> dict[int, Tensor]:
    """Index of a scene frame -> bool [height, width] ignored pixels, on the CPU, for frames that have any.

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
