"""Motion blur of a camera move: number and poses of the samples of a frame, and the share of grain that remains.

The shutter is a box centred on the frame, as in Cycles: it is open from frame - shutter / 720 to frame + shutter / 720.
Between two frames of the path, positions are interpolated linearly and rotations by slerp. Before the first and after
the last frame, the camera's motion is extrapolated.
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
"""Blur in pixels up to which a frame is not blurred: rounding of float32 poses would move a static camera."""
_GRID = 128
"""Approximate number of rows and columns of pixels at which a frame's blur is measured."""
_WHITE = 0.4
"""Softness in pixels, as `Grain.softness`, of white noise that is sampled linearly between pixels. With it, the
remaining share of grain is accurate to 0.06, see `test_motion_blur.py`."""


@dataclass(frozen=True)
class MotionBlurConfig:
    """Number of samples of a frame."""

    spacing: float = 1.0
    """Distance in pixels between two samples of a frame's longest blur. With larger distances, edges show steps."""
    most: int = 33
    """Largest number of samples of a frame, which limits its render time. A blur of 32 pixels has one sample per pixel;
    a longer one shows faint steps."""


@dataclass(frozen=True)
class MotionBlur:
    """Camera poses while the shutter is open."""

    frames: Sequence[OutputFrame]
    """All frames of the take, ascending."""
    shutter: float
    """Shutter angle in degrees; 360 is a whole frame."""
    config: MotionBlurConfig = field(default_factory=MotionBlurConfig)
    """Number of samples of a frame."""

    def facts(self, output: OutputFrame) -> list[Any]:
        """Inputs of a frame's blur for its key, in addition to the inputs of its picture."""
        near = [
            (frame.frame, floats(frame.viewmat.flatten()), floats(frame.K.flatten()))
            for frame in self._adjacent(output)
        ]
        return [self.shutter, dataclasses.asdict(self.config), near]

    def at(self, output: OutputFrame, share: float) -> OutputFrame:
        """A frame's camera at a share of the shutter's interval: -0.5 when it opens, 0.5 when it closes."""
        offset = share * self.shutter / 360.0
        neighbours = self._adjacent(output)
        if not offset or not neighbours:
            return output
        neighbour = neighbours[-1] if offset > 0.0 else neighbours[0]
        way = offset / (neighbour.frame - output.frame)  # negative at the ends of the path: extrapolates
        viewmat = np.eye(4)
        viewmat[:3] = interpolate_pose(output.viewmat.numpy(), neighbour.viewmat.numpy(), way)
        return replace(output, viewmat=from_numpy(viewmat).float(), K=output.K + way * (neighbour.K - output.K))

    def is_still(self, output: OutputFrame) -> bool:
        """True if the camera does not move while the shutter is open for a frame."""
        return not any(
            bool((frame.viewmat != output.viewmat).any() or (frame.K != output.K).any())
            for frame in self._adjacent(output)
        )

    def sample_cameras(self, output: OutputFrame, K: Tensor, depth: Tensor) -> list[OutputFrame]:
        """The cameras to composite in addition to a frame's own, evenly spaced in time; empty without visible motion.

        Args:
            output: the frame.
            K: [3, 3] intrinsics of the frame in pixels of `depth`, overscan included.
            depth: [H, W] along the camera's axis, scene units; `NO_DEPTH` without a surface.
        """
        if self.is_still(output):
            return []
        step = max(1, min(depth.shape) // _GRID)
        lengths = self.lengths(output, K, depth[::step, ::step], 0, step)
        lengths = lengths[depth[::step, ::step] < NO_DEPTH]
        # The 99th percentile: a floater near the lens must not multiply the samples of every frame.
        longest = float(torch.quantile(lengths, 0.99)) if len(lengths) else 0.0
        if longest <= _STILL:
            return []
        half = min(math.ceil(longest / (2.0 * self.config.spacing)), (self.config.most - 1) // 2)
        return [self.at(output, n / (2 * half + 1)) for n in range(-half, half + 1) if n]

    def lengths(self, output: OutputFrame, K: Tensor, depth: Tensor, top: int, step: int = 1) -> Tensor:
        """[h, w] length of the blur in pixels of each point of some rows; 0 without a surface.

        Args:
            output: the frame.
            K: [3, 3] intrinsics of the frame in pixels of the picture, overscan included.
            depth: [h, w] every `step`-th pixel of some rows of the frame's depth, scene units.
            top: row of the picture in which `depth` starts.
            step: distance between the pixels of `depth`, in pixels of the picture.
        """
        y, x = (step * torch.arange(n, dtype=torch.float64, device="cpu") + 0.5 for n in depth.shape)
        at = torch.stack(torch.meshgrid(x, y + top, indexing="xy"), dim=-1)
        solid = depth < NO_DEPTH
        points = unproject(at, torch.where(solid, depth, 1.0).double(), output.viewmat.double(), K.double())
        total = torch.zeros(depth.shape, dtype=torch.float64, device="cpu")
        for share in (-0.5, 0.5):
            camera = self.at(output, share)
            lens = camera.K.double() + (K - output.K).double()  # the same overscan as this frame
            seen, seen_depth = project(points, camera.viewmat.double(), lens)
            way = torch.hypot(*(seen - at).unbind(-1))
            total += torch.where(solid & (seen_depth > 1e-6), way, 0.0)
        return total

    def _adjacent(self, output: OutputFrame) -> list[OutputFrame]:
        """The previous and the next frame of the path, if they exist."""
        at = self._places[output.frame]
        return [self.frames[n] for n in (at - 1, at + 1) if 0 <= n < len(self.frames)]

    @functools.cached_property
    def _places(self) -> dict[int, int]:
        return {frame.frame: n for n, frame in enumerate(self.frames)}


def kept_grain(lengths: Tensor, softness: float) -> Tensor:
    """Share of the variance of a plate's grain that remains where the picture is blurred over `lengths` pixels.

    The grain's autocorrelation is modelled as a Gaussian, exp(-d^2 / 4 s^2) at distance d. The share is its mean over
    all pairs of points on the blur's line.

    Args:
        lengths: length of the blur in pixels, any shape.
        softness: as `Grain.softness`, in the same pixels.
    """
    a = lengths / (2.0 * math.hypot(softness, _WHITE))
    safe = a.clamp_min(1e-3)
    share = (math.sqrt(math.pi) * safe * torch.erf(safe) + torch.exp(-safe.square()) - 1.0) / safe.square()
    return torch.where(a > 1e-3, share, 1.0)
