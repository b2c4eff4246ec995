"""Deep samples of a frozen frame: at depth steps, one sample of the near surface and one of the far surface.

The frame's depth gives the two surfaces that meet around a pixel. The splats give the share of each surface in the
pixel: they are rendered in slabs of depth, front to back, and each splat is in one slab. The slabs composited over each
other give the render of all splats. The samples are scaled so that, composited over each other, they give the frame.

Splats of one surface are spread over some percent of their depth. Their depth is therefore only used to assign them to
one of the two surfaces, and a pixel away from depth steps has one sample. With one sample per splat depth, 94 % of the
pixels of a preview run had two or three samples, and CG behind a wall showed through it.
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
    """Parameters of the search for a pixel's surfaces."""

    slabs: int = 16
    """Number of depth slabs between the 1st and 99th percentile of a frame's depth; two more hold what is outside."""
    step: float = 0.05
    """Relative rise of depth between neighbouring pixels above which they show two surfaces, not one sloped surface."""


_LEAST = float(np.finfo(np.float16).eps)
"""Share of a pixel below which a surface gets no sample: a half float cannot tell 1 from 1 minus a smaller share."""


@dataclass(frozen=True)
class DeepSamples:
    """Two samples per pixel, of the near and the far surface. Float32, on the CPU."""

    weight: Tensor
    """[2, H, W] share of the pixel covered by the splats of each surface."""
    light: Tensor
    """[2, H, W, 3] scene-linear colour of these splats, multiplied by `weight`."""
    depth: Tensor
    """[2, H, W] depth along the camera's axis, scene units of the model."""

    def rows(self, rows: slice, rgba: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Some rows of the samples, as stored in a deep file.

        Args:
            rows: the rows to return.
            rgba: [h, W, 4] these rows of the frame, scene-linear, premultiplied.

        Returns:
            ([2, h, W, 4] scene-linear, premultiplied by the sample's alpha; [2, h, W] depth). The near sample
            composited over the far one gives `rgba`. A missing sample has alpha 0.
        """
        weight = self.weight[:, rows].numpy()
        share = weight[0] / np.maximum(weight.sum(0), 1e-8)
        share[weight.sum(0) <= 0.0] = 1.0  # pixels from plates without splats have one sample
        share[share < _LEAST] = 0.0
        share[share > 1.0 - _LEAST] = 1.0
        alpha = rgba[..., 3]
        alphas = np.stack([share * alpha, (1.0 - share) * alpha / np.maximum(1.0 - share * alpha, 1e-8)])
        alphas[1, share < 1.0] = np.where(alpha == 1.0, 1.0, alphas[1])[share < 1.0]  # exactly opaque, without rounding
        colour = self.light[:, rows].numpy() / np.maximum(weight, 1e-8)[..., None]
        target = rgba[..., :3] / np.maximum(alpha, 1e-8)[..., None]
        mixed = share[..., None] * colour[0] + (1.0 - share[..., None]) * colour[1]
        gain = np.maximum(target, 0.0) / np.maximum(mixed, 1e-8)
        colour = gain * colour + (target - gain * mixed)  # offset for black splats and negative pixels
        samples = np.concatenate([colour * alphas[..., None], alphas[..., None]], axis=-1)
        return samples.astype(np.float32), self.depth[:, rows].numpy()


@torch.no_grad()
def deep_samples(
    frozen: FrozenGaussians, output: OutputFrame, K: Tensor, beyond: tuple[int, int],
    exposure: Exposure | None, exposed_at: float, display: Display, surface: Tensor,
    config: DeepConfig | None = None,
) -> DeepSamples:  # fmt: skip
    """The deep samples of a frame.

    Args:
        frozen: the scene at t*.
        output: camera and instant of the frame.
        K: [3, 3] intrinsics of the frame in pixels, overscan included.
        beyond: pixels of overscan on the left and right, and above and below.
        exposure, exposed_at: as in `render_frozen`.
        display: the display in which the splats' colours are given.
        surface: [H, W] the frame's depth with overscan, scene units of the model; `NO_DEPTH` without a surface.
        config: parameters of the search.
    """
    config, (height, width) = config or DeepConfig(), surface.shape
    between, depth = _surfaces(surface, config.step)
    weight, light = torch.zeros(2, height, width, device="cpu"), torch.zeros(2, height, width, 3, device="cpu")
    transmittance = torch.ones(height, width, device="cpu")
    viewmat = output.viewmat.to(frozen.support.device)
    z = frozen.state["means"] @ viewmat[2, :3] + viewmat[2, 3]
    for near, far in itertools.pairwise(_bounds(surface, config.slabs)):
        part = _part(frozen, (z > near) & (z <= far))
        if not len(part.support):
            continue
        image = render_frozen(part, output.viewmat, K, width, height, exposure, exposed_at, beyond).cpu()
        at = (image.depth > between).long()[None]
        rgba = from_numpy(display.premultiplied_to_light(torch.cat([image.color, image.alpha[..., None]], 2).numpy()))
        weight.scatter_add_(0, at, (transmittance * image.alpha)[None])
        light.scatter_add_(
            0, at[..., None].expand(1, height, width, 3), (transmittance[..., None] * rgba[..., :3])[None]
        )
        transmittance *= 1.0 - image.alpha
    total = weight.sum(0)
    share = torch.where(total > 0.0, weight[0] / total.clamp_min(1e-8), 1.0)
    # A pixel with a single sample gets the frame's depth, although a neighbour is nearer or farther.
    depth[0] = torch.where(share > 1.0 - _LEAST, surface, depth[0])
    depth[1] = torch.where(share < _LEAST, surface, depth[1])
    return DeepSamples(weight, light, depth)


def _surfaces(surface: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """([H, W] depth that separates a pixel's two surfaces, infinite for one surface; [2, H, W] depth of both).

    If depth steps within a 3 x 3 neighbourhood, the pixel has the nearest and the farthest surface in it.
    """
    solid = surface < NO_DEPTH
    nearest = -_highest(torch.where(solid, -surface, -NO_DEPTH))
    farthest = _highest(torch.where(solid, surface, 0.0))
    between = torch.where(farthest > nearest * (1.0 + step), (nearest * farthest).sqrt(), torch.inf)
    is_far = surface > between
    return between, torch.stack([torch.where(is_far, nearest, surface), torch.where(is_far, surface, farthest)])


def _highest(values: Tensor) -> Tensor:
    """[H, W] maximum over 3 x 3 pixels."""
    return torch.nn.functional.max_pool2d(values[None, None], 3, 1, 1)[0, 0]


def _bounds(depth: Tensor, count: int) -> list[float]:
    """Ascending depths of the slabs' borders, with equal ratios between the 1st and 99th percentile of depth."""
    solid = depth[depth < NO_DEPTH].numpy()
    if not solid.size:
        return [0.0, float("inf")]
    near, far = (float(d) for d in np.quantile(solid, (0.01, 0.99)))
    return [0.0, *np.geomspace(near, max(far, near * 1.001), count + 1).tolist(), float("inf")]


def _part(frozen: FrozenGaussians, chosen: Tensor) -> FrozenGaussians:
    """The Gaussians of a scene selected by `chosen`, bool [N]."""
    state = {name: value[chosen] for name, value in frozen.state.items()}
    return replace(
        frozen, state=state, support=frozen.support[chosen], motion=frozen.motion[chosen], descent=None, origin=None
    )
