"""Motion blur of a camera's move: between which poses a frame is composited, how many, and how much grain that costs.

The shutter is a box centred on the frame, as Cycles centres it: open from frame - shutter / 720 to frame + shutter /
720. Poses between two frames of the path lie on a line, rotations on a slerp; before the first frame and after the last
the camera moves on as it does on the other side.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...cameras.poses import interpolate_pose
from ...contract import NO_DEPTH
from ...torch_types import floats, from_numpy
from ..frozen import OutputFrame
from ..views.reproject import project, unproject

_STILL = 0.05
"""Pixels of blur up to which a frame stays as it is: poses are float32, and a camera that stands would move by them."""
_GRID = 128
"""Rows and columns of pixels, about, in which a frame's blur is measured."""
_WHITE = 0.4
"""Softness in pixels, as `Grain.softness`, of white noise that is read linearly between its pixels: with it the share
that a blur leaves is right to 0.06, see `test_motion_blur.py`."""


@dataclass(frozen=True)
class MotionBlurConfig:
    """How many times a frame is composited."""

    spacing: float = 1.0
    """Distance in pixels between two samples of the longest blur of a frame: further apart, edges show as steps."""
    most: int = 33
    """Samples of a frame, at most: a blur of 32 pixels has one each pixel, a longer one shows faint steps, and no frame
    takes more than this many times as long."""


@dataclass(frozen=True)
class MotionBlur:
    """Where the camera is while the shutter is open."""

    frames: Sequence[OutputFrame]
    """All frames of the take, ascending."""
    shutter: float
    """Degrees of 360, a whole frame, for which the shutter is open."""
    config: MotionBlurConfig = field(default_factory=MotionBlurConfig)
    """How many times a frame is composited."""

    def facts(self, output: OutputFrame) -> list[Any]:
        """What a frame's blur depends on beside its own picture, for its key."""
        near = [(each.frame, floats(each.viewmat.flatten()), floats(each.K.flatten())) for each in self._beside(output)]
        return [self.shutter, dataclasses.asdict(self.config), near]

    def at(self, output: OutputFrame, share: float) -> OutputFrame:
        """A frame's camera at a share of the shutter's interval, -0.5 (it opens) to 0.5 (it closes)."""
        offset = share * self.shutter / 360.0
        near = self._beside(output)
        if not offset or not near:
            return output
        other = near[-1] if offset > 0.0 else near[0]
        way = offset / (other.frame - output.frame)  # below 0 at the ends of the path, where the other side tells
        viewmat = np.eye(4)
        viewmat[:3] = interpolate_pose(output.viewmat.numpy(), other.viewmat.numpy(), way)
        return replace(output, viewmat=from_numpy(viewmat).float(), K=output.K + way * (other.K - output.K))

    def is_still(self, output: OutputFrame) -> bool:
        """True if the camera does not move while the shutter is open for a frame."""
        return not any(
            bool((each.viewmat != output.viewmat).any() or (each.K != output.K).any()) for each in self._beside(output)
        )

    def beside_middle(self, output: OutputFrame, K: Tensor, depth: Tensor) -> list[OutputFrame]:
        """The cameras that are composited beside a frame's own, evenly spread over the shutter; empty if it stands.

        Args:
            output: the frame.
            K: [3, 3] its camera in pixels of `depth`, overscan included.
            depth: [H, W] along the camera's axis, scene units; `NO_DEPTH` where nothing is.
        """
        if self.is_still(output):
            return []
        step = max(1, min(depth.shape) // _GRID)
        lengths = self.lengths(output, K, depth[::step, ::step], 0, step)
        lengths = lengths[depth[::step, ::step] < NO_DEPTH]
        # One pixel of a hundred may be sampled more coarsely: a floater before the lens is not worth all frames' time.
        longest = float(torch.quantile(lengths, 0.99)) if len(lengths) else 0.0
        if longest <= _STILL:
            return []
        half = min(math.ceil(longest / (2.0 * self.config.spacing)), (self.config.most - 1) // 2)
        return [self.at(output, n / (2 * half + 1)) for n in range(-half, half + 1) if n]

    def lengths(self, output: OutputFrame, K: Tensor, depth: Tensor, top: int, step: int = 1) -> Tensor:
        """[h, w] pixels that each point of some rows travels while the shutter is open; 0 where nothing is.

        Args:
            output: the frame.
            K: [3, 3] its camera in pixels of the picture, overscan included.
            depth: [h, w] every `step`-th pixel of rows of its depth, scene units.
            top: the row in which they begin.
            step: distance in pixels between two of `depth`.
        """
        y, x = (step * torch.arange(n, dtype=torch.float64, device="cpu") + 0.5 for n in depth.shape)
        at = torch.stack(torch.meshgrid(x, y + top, indexing="xy"), dim=-1)
        solid = depth < NO_DEPTH
        points = unproject(at, torch.where(solid, depth, 1.0).double(), output.viewmat.double(), K.double())
        total = torch.zeros(depth.shape, dtype=torch.float64, device="cpu")
        for share in (-0.5, 0.5):
            camera = self.at(output, share)
            lens = camera.K.double() + (K - output.K).double()  # as much overscan as this frame has
            seen, seen_depth = project(points, camera.viewmat.double(), lens)
            way = torch.hypot(*(seen - at).unbind(-1))
            total += torch.where(solid & (seen_depth > 1e-6), way, 0.0)
        return total

    def _beside(self, output: OutputFrame) -> list[OutputFrame]:
        """The path's frames before and after one, those that there are."""
        at = self._places[output.frame]
        return [self.frames[n] for n in (at - 1, at + 1) if 0 <= n < len(self.frames)]

    @functools.cached_property
    def _places(self) -> dict[int, int]:
        return {each.frame: n for n, each in enumerate(self.frames)}


def kept_grain(lengths: Tensor, softness: float) -> Tensor:
    """Share of the variance of a plate's grain that is left where the picture is blurred over `lengths` pixels.

    The grain's autocorrelation is taken for a Gaussian: exp(-d^2 / 4 s^2) at d pixels, of which this is the mean over
    all pairs of places on the blur's line.

    Args:
        lengths: pixels, any shape.
        softness: as `Grain.softness`, in the same pixels.
    """
    a = lengths / (2.0 * math.hypot(softness, _WHITE))
    safe = a.clamp_min(1e-3)
    share = (math.sqrt(math.pi) * safe * torch.erf(safe) + torch.exp(-safe.square()) - 1.0) / safe.square()
    return torch.where(a > 1e-3, share, 1.0)
