"""The Gaussians of a layer: pixels of plate t*, a pixel apart, as deep as what they show.

What is missing is found at the size that the run was trained at (`missing_layer.py`), and drawn at the plate's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..gaussians.model import SH_C0
from ..torch_types import from_numpy
from ..train.exposure import Exposure
from .frozen import FrozenGaussians, FrozenImage
from .instant_bench import InstantBench, disc, low_passed, resized_array
from .instant_track import Track

_NOTHING = 0.15
"""Share of the way from what is behind to a thing's colour below which a pixel has nothing of it."""


@dataclass
class Part:
    """What one region or thing adds to the layer, at the size at which it was found."""

    soft: NDArray[np.float32]
    """[h, w] in 0..1: how much of each pixel it covers."""
    inverse: NDArray[np.float32]
    """[h, w] inverse depths where it does."""
    thing: Track | None
    """The small thing that it is; None: a region."""

    def enlarged(self, fine: InstantBench, image: FrozenImage) -> Part:
        """The same at the size of `image`, less what there has nothing of a small thing's colour."""
        inverse, soft = _enlarged(self.inverse, self.soft, fine.width, fine.height)
        if self.thing is not None:
            soft = np.where(share_of(fine, image, self.thing) > _NOTHING, soft, np.float32(0.0))
        return Part(soft, inverse, self.thing)


def gaussians_of(
    bench: InstantBench, frozen: FrozenGaussians, image: FrozenImage, parts: list[Part]
) -> tuple[dict[str, Tensor], NDArray[np.float32]]:
    """(state, as `FrozenGaussians.state`, of the Gaussians of all parts, their opacity [h, w] where they were found).

    They are drawn from as many of the plate's pixels as are delivered; outlines are taken apart.

    Args:
        image: what t*'s camera sees of `frozen`, which they are to stand in front of.
    """
    fine = bench.as_plate()
    if fine is not bench:
        image = fine.render(frozen)
        parts = [part.enlarged(fine, image) for part in parts]
    cover, inverse = np.zeros((2, fine.height, fine.width), np.float32)
    for part in parts:
        stronger = part.soft > cover
        inverse[stronger], cover[stronger] = part.inverse[stronger], part.soft[stronger]
    colors, cover = _matted(fine.view.picture, image.color.numpy(), cover, fine.unit)
    rows, columns = np.nonzero(cover > 0.1)
    means = fine.view.unproject(columns + 0.5, rows + 0.5, 1.0 / np.maximum(inverse[rows, columns], 1e-9))
    state = _gaussians(fine, frozen, means, rows, columns, inverse, cover, colors)
    return state, resized_array(cover, bench.width, bench.height)


def _enlarged(
    inverse: NDArray[np.float32], cover: NDArray[np.float32], width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(inverse depths, cover) [h, w] at a larger size; depths are those of what is covered alone."""
    import cv2

    known = ((inverse > 0.0) & (cover > 0.0)).astype(np.float32)
    inverse = inverse * known
    soft, depths, weight = (
        cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR) for values in (cover, inverse, known)
    )
    depths = np.where(weight > 1e-3, depths / np.maximum(weight, 1e-3), 0.0)
    return depths.astype(np.float32), np.where(weight > 1e-3, soft, 0.0).astype(np.float32)


def share_of(bench: InstantBench, image: FrozenImage, thing: Track) -> NDArray[np.float32]:
    """How far each pixel [h, w] of plate t* is on the way from what is behind to a small thing's colour."""
    plate, behind = bench.view.picture, image.color.numpy()
    way = thing.color - behind
    return ((plate - behind) * way).sum(-1) / np.maximum(np.square(way).sum(-1), 1e-4)


def _gaussians(
    bench: InstantBench, frozen: FrozenGaussians, means: NDArray[np.float64], rows: NDArray[np.intp],
    columns: NDArray[np.intp], inverse: NDArray[np.float32], cover: NDArray[np.float32], colors: NDArray[np.float32],
) -> dict[str, Tensor]:  # fmt: skip
    """Gaussians [M] at `means`, coloured by the pixels (rows, columns) of plate t*, one pixel apart on the screen."""
    like, c = frozen.state, bench.config
    count = len(means)
    size = c.sigma / (bench.view.K[0, 0] * np.maximum(inverse[rows, columns], 1e-9))
    opacity = from_numpy(np.clip(c.opacity * cover[rows, columns], 1e-4, 1.0 - 1e-4))
    color = _unexposed(from_numpy(colors[rows, columns]), bench.exposure, bench.time)
    quats = torch.zeros(count, 4, device="cpu")
    quats[:, 0] = 1.0
    state = {
        "means": from_numpy(means),
        "quats": quats,
        "log_scales": from_numpy(np.log(np.repeat(size[:, None], 3, axis=1))),
        "opacity_logits": torch.logit(opacity),
        "sh0": ((color - 0.5) / SH_C0)[:, None, :],
        "shN": torch.zeros(count, like["shN"].shape[1], 3, device="cpu"),
    }
    return {name: state[name].to(value) for name, value in like.items()}


def _matted(
    picture: NDArray[np.float32], behind: NDArray[np.float32], cover: NDArray[np.float32], unit: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(colours [h, w, 3], cover [h, w]) of a layer, its outline taken apart into its own colour and what is behind.

    A pixel of the outline is a mixture: how far it is on the way from the model's colour there to that of the inside
    beside it is what the layer covers. From another pose what it has of the wall would be a rim around the hand.
    """
    import cv2

    inside = np.asarray(cv2.erode((cover > 0.9).astype(np.float32), disc(1.0 * unit)), np.float32)
    weight = low_passed(inside, 1.5 * unit)
    own = low_passed(picture * inside[..., None], 1.5 * unit) / np.maximum(weight, 1e-6)[..., None]
    way, length = own - behind, np.square(own - behind).sum(-1)
    share = np.clip(((picture - behind) * way).sum(-1) / np.maximum(length, 1e-6), 0.0, 1.0)
    rim = (cover > 0.0) & (inside < 0.5) & (weight > 0.02) & (length > 0.15**2)
    mixed = share[..., None] * picture + (1.0 - share[..., None]) * own
    color = np.where(rim[..., None], mixed, picture).astype(np.float32)
    return color, np.where(rim, np.minimum(cover, share), cover).astype(np.float32)


def _unexposed(color: Tensor, exposure: Exposure, time: float) -> Tensor:
    """The colour [M, 3] that the camera shows as `color` at a time."""
    if not exposure.config.on:
        return color
    gain, offset = exposure.at(time)
    return (color - offset.cpu()) / gain.cpu()
