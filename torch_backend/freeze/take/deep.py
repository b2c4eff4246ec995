"""Deep samples of a frozen frame: where its depth steps, the surface before the step and the one behind it.

The frame's depth says which two surfaces meet around a pixel. The splats say how much of the pixel each of them is:
they are rendered in slabs of depth, front to back, each once, and over each other the slabs are the picture of all
splats. The frame says how the pixel looks: the samples are scaled so that over each other they are the frame.

Splats of one surface lie some percent of their depth apart. So depth of theirs only tells which of the two surfaces
they belong to, and a pixel away from steps has one sample. Where every depth of a splat was a sample of its own, 94 %
of the pixels of a preview training had two or three, and CG behind a wall showed through it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...contract import NO_DEPTH
from ...footage.display import Display
from ...torch_types import from_numpy
from ...train.exposure import Exposure
from ..frozen import FrozenGaussians, OutputFrame, render_frozen


@dataclass(frozen=True)
class DeepConfig:
    """How the surfaces of a pixel are found."""

    slabs: int = 16
    """Slabs of depth between the nearest and the farthest hundredth of a frame; two more hold what is beyond."""
    step: float = 0.05
    """Share by which depth rises from one pixel to the next where two surfaces meet; within it, one is sloped."""


_LEAST = float(np.finfo(np.float16).eps)
"""Share of a pixel below which a surface has no sample: less is none beside 1 in a half float."""


@dataclass(frozen=True)
class DeepSamples:
    """Two samples of each pixel, the near and the far surface. Float32, on the CPU."""

    weight: Tensor
    """[2, H, W] share of the pixel that the splats of each give."""
    light: Tensor
    """[2, H, W, 3] scene-linear, their colour times that share."""
    depth: Tensor
    """[2, H, W] along the camera's axis, scene units of the model."""

    def rows(self, rows: slice, rgba: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Some rows of the samples as a deep file has them.

        Args:
            rows: which rows.
            rgba: [h, W, 4] those rows of the frame, scene-linear, premultiplied.

        Returns:
            ([2, h, W, 4] scene-linear and premultiplied by their own alpha, [2, h, W] depth). The near over the far
            one is `rgba`. A sample that is not there has alpha 0.
        """
        weight = self.weight[:, rows].numpy()
        share = weight[0] / np.maximum(weight.sum(0), 1e-8)
        share[weight.sum(0) <= 0.0] = 1.0  # plate where no splat is
        share[share < _LEAST] = 0.0
        share[share > 1.0 - _LEAST] = 1.0
        alpha = rgba[..., 3]
        own = np.stack([share * alpha, (1.0 - share) * alpha / np.maximum(1.0 - share * alpha, 1e-8)])
        own[1, share < 1.0] = np.where(alpha == 1.0, 1.0, own[1])[share < 1.0]  # to the last bit
        colour = self.light[:, rows].numpy() / np.maximum(weight, 1e-8)[..., None]
        target = rgba[..., :3] / np.maximum(alpha, 1e-8)[..., None]
        shown = share[..., None] * colour[0] + (1.0 - share[..., None]) * colour[1]
        gain = np.maximum(target, 0.0) / np.maximum(shown, 1e-8)
        colour = gain * colour + (target - gain * shown)  # the remainder: splats are black, or the frame is negative
        samples = np.concatenate([colour * own[..., None], own[..., None]], axis=-1)
        return samples.astype(np.float32), self.depth[:, rows].numpy()


@torch.no_grad()
def deep_samples(
    frozen: FrozenGaussians, output: OutputFrame, K: Tensor, beyond: tuple[int, int],
    exposure: Exposure | None, exposed_at: float, display: Display, surface: Tensor,
    config: DeepConfig | None = None,
) -> DeepSamples:  # fmt: skip
    """The surfaces of each pixel of a frame.

    Args:
        frozen: the scene.
        output: the camera.
        K: [3, 3] its pixels, overscan included.
        beyond: pixels of overscan on the left and right, and above and below.
        exposure, exposed_at: as in `render_frozen`.
        display: what the splats' colours are shown on.
        surface: [H, W] the frame's depth with overscan, scene units of the model; `NO_DEPTH` where nothing is.
        config: see there.
    """
    config, (height, width) = config or DeepConfig(), surface.shape
    between, depth = _surfaces(surface, config.step)
    weight, light = torch.zeros(2, height, width, device="cpu"), torch.zeros(2, height, width, 3, device="cpu")
    left = torch.ones(height, width, device="cpu")
    viewmat = output.viewmat.to(frozen.support.device)
    z = frozen.state["means"] @ viewmat[2, :3] + viewmat[2, 3]
    for near, far in itertools.pairwise(_bounds(surface, config.slabs)):
        part = _part(frozen, (z > near) & (z <= far))
        if not len(part.support):
            continue
        image = render_frozen(part, output.viewmat, K, width, height, exposure, exposed_at, beyond)
        at = (image.depth > between).long()[None]
        shown = from_numpy(display.premultiplied_to_light(torch.cat([image.color, image.alpha[..., None]], 2).numpy()))
        weight.scatter_add_(0, at, (left * image.alpha)[None])
        light.scatter_add_(0, at[..., None].expand(1, height, width, 3), (left[..., None] * shown[..., :3])[None])
        left *= 1.0 - image.alpha
    total = weight.sum(0)
    share = torch.where(total > 0.0, weight[0] / total.clamp_min(1e-8), 1.0)
    # A pixel that keeps one sample is as deep as the frame, though a neighbour is nearer or farther.
    depth[0] = torch.where(share > 1.0 - _LEAST, surface, depth[0])
    depth[1] = torch.where(share < _LEAST, surface, depth[1])
    return DeepSamples(weight, light, depth)


def _surfaces(surface: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """([H, W] depth that parts a pixel's surfaces, infinite where it has one; [2, H, W] depth of both) of a frame's.

    Where depth steps within a 3 x 3 neighbourhood, the pixel holds its nearest and its farthest surface.
    """
    solid = surface < NO_DEPTH
    nearest = -_highest(torch.where(solid, -surface, -NO_DEPTH))
    farthest = _highest(torch.where(solid, surface, 0.0))
    between = torch.where(farthest > nearest * (1.0 + step), (nearest * farthest).sqrt(), torch.inf)
    is_far = surface > between
    return between, torch.stack([torch.where(is_far, nearest, surface), torch.where(is_far, surface, farthest)])


def _highest(values: Tensor) -> Tensor:
    """[H, W] the highest of each pixel and its eight neighbours."""
    return torch.nn.functional.max_pool2d(values[None, None], 3, 1, 1)[0, 0]


def _bounds(depth: Tensor, count: int) -> list[float]:
    """Depths between which the slabs lie, ascending: equal ratios within what most of a picture shows."""
    solid = depth[depth < NO_DEPTH].numpy()
    if not solid.size:
        return [0.0, float("inf")]
    near, far = (float(d) for d in np.quantile(solid, (0.01, 0.99)))
    return [0.0, *np.geomspace(near, max(far, near * 1.001), count + 1).tolist(), float("inf")]


def _part(frozen: FrozenGaussians, chosen: Tensor) -> FrozenGaussians:
    """Some of the Gaussians of a scene; `chosen` [N]."""
    state = {name: value[chosen] for name, value in frozen.state.items()}
    return replace(
        frozen, state=state, support=frozen.support[chosen], motion=frozen.motion[chosen], descent=None, origin=None
    )
