"""Truth in a real clip: where nothing moves, the frozen shot at pose n must equal the plate at pose n, for any t*.
The motion matte of the solve defines where nothing moves (`motion/mattes.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torch_backend.contract import Reporter
from torch_backend.motion.mattes import MOVING, STILL, load_motion
from torch_backend.motion_search import find_motion
from torch_backend.shot import Shot
from torch_backend.torch_types import from_numpy

MARGIN = 8.0
"""Distance to a mover, in pixels of a 640-pixel-wide picture, within which still pixels do not count as truth. Outlines
of movers are soft, and so are their mattes."""


def ensure_motion(shot: Shot) -> None:
    """Computes the motion mattes of a shot solved by a version without them. JobError if the shot is not solved."""
    find_motion(shot, _Mute())


def motion_shares(shot: Shot, frame: int, width: int, height: int) -> dict[str, Tensor]:
    """Shares of each pixel of a [height, width] picture: `rigid`, `still` and `moving`, float32 in [0, 1].

    Rigid pixels are still and far from movers; unknown pixels are neither still nor moving. ValueError if the frame has
    no matte.
    """
    labels = load_motion(shot, frame)
    if labels is None:
        raise ValueError(f"frame {frame} of {shot.root} has no motion matte")
    rigid = (labels == STILL) & ~near(labels == MOVING, MARGIN * labels.shape[1] / 640)
    masks = {"rigid": rigid, "still": labels == STILL, "moving": labels == MOVING}
    return {name: _resized(mask, width, height) for name, mask in masks.items()}


def near(mask: NDArray[np.bool_], distance: float) -> NDArray[np.bool_]:
    """Mask [H, W] dilated by a Euclidean distance in pixels."""
    import cv2

    if not mask.any():
        return mask.copy()
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= distance


def _resized(mask: NDArray[np.bool_], width: int, height: int) -> Tensor:
    return F.interpolate(from_numpy(mask).float()[None, None], (height, width), mode="area")[0, 0]


def far_from(poses: Sequence[int], t_star: int, frames: int) -> list[int]:
    """The poses that test a freeze at t*: more than a quarter of the clip's `frames` away, in frame numbers."""
    return [pose for pose in poses if abs(pose - t_star) > frames / 4]


class _Mute(Reporter):
    """A reporter without output."""
