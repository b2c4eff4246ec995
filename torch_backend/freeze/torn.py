"""What is right as t*'s camera sees it and falls apart from aside: a hand of shards and of the screen behind it.

A field that was trained for long explains every plate from that plate's own camera, by Gaussians at whatever depth: one
camera sees an instant, and no other contradicts. So nothing is missing of such a hand, and a step aside it is none.
Nor does it need another plate to tell: what plate t* shows, carried by the scene's own depth to
where another camera has it, is to be what the scene shows there, or the scene contradicts itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..scene import evenly_spaced
from ..torch_types import from_numpy
from .frozen import FrozenGaussians, FrozenImage, render_frozen
from .instant_bench import InstantBench, disc, large, low_passed
from .reproject import inside, project


@dataclass(frozen=True)
class TornConfig:
    """When a scene falls apart. Lengths are in pixels of pictures 320 wide."""

    views: int = 8
    """Cameras from aside that are asked, at most."""
    aside: tuple[float, float] = (4.0, 20.0)
    """Degrees from t*'s camera, seen from what moves, between which those are: nearer nothing falls apart, and from
    farther a whole hand shows another side."""
    least: int = 2
    """So many at least have to have a place in view."""
    blur: float = 2.0
    """Standard deviation of the low-pass before colours are compared."""
    shift: float = 1.0
    """Places may be off by this."""
    before: float = 0.07
    """What stands still and is nearer than a place by this share hides it, and tells nothing of it."""
    off: float = 0.12
    """Mean difference, display-referred, from which on a place has fallen apart,"""
    off_too: float = 0.05
    """and from which on what hangs together with such a one has."""
    least_area: float = 250.0
    """Square pixels of such a region; a smaller one is left alone."""
    gap: float = 2.0
    """Half the width of gaps in it."""
    thin: float = 1.0
    """Half the width below which it is an outline; the tip of a finger is lost by that, too."""
    mended: float = 0.5
    """Share of its difference that what stands for it has at most."""


@dataclass
class Torn:
    """What has fallen apart of a frozen scene, as t*'s camera sees it."""

    where: NDArray[np.bool_]
    """[h, w]."""
    off: NDArray[np.float32]
    """[h, w] as `fallen_apart`."""


def torn(bench: InstantBench, frozen: FrozenGaussians, image: FrozenImage, config: TornConfig | None = None) -> Torn:
    """Regions of what moves, by the mattes and the run, that have fallen apart; arguments as `fallen_apart`."""
    import cv2

    config, unit, matte = config or TornConfig(), bench.unit, bench.matte()
    off = fallen_apart(bench, frozen, image, config)
    found = off > config.off_too
    if matte is not None:
        found &= matte > 0.5
    closed = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, disc(config.gap * unit))
    opened = np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc(config.thin * unit)) > 0, np.bool_)
    return Torn(large(opened, off > config.off, config.least_area * unit**2), off)


def mends(
    bench: InstantBench, frozen: FrozenGaussians, before: Torn, anew: NDArray[np.bool_],
    config: TornConfig | None = None,
) -> bool:  # fmt: skip
    """True if a scene holds together much better than one `before` it, where that had fallen apart and this has it
    `anew` [h, w]."""
    config, where = config or TornConfig(), before.where & anew
    if not where.any():
        return False
    after = fallen_apart(bench, frozen, bench.render(frozen), config)
    return bool(after[where].mean() <= config.mended * before.off[where].mean())


def fallen_apart(
    bench: InstantBench, frozen: FrozenGaussians, image: FrozenImage, config: TornConfig | None = None
) -> NDArray[np.float32]:
    """[h, w] how far a scene frozen at t* differs from aside from what plate t* shows, display-referred; 0 where that
    cannot be told, or nothing moves.

    Args:
        image: what t*'s camera sees of `frozen`, `InstantBench.render`.
    """
    import cv2

    config = config or TornConfig()
    depth = np.ascontiguousarray(image.depth.numpy().clip(0.0, 1e6), np.float32)
    depth = np.asarray(cv2.medianBlur(depth, 5), np.float64)
    moves, grid = image.motion.numpy() > 0.5, bench.view.grid()
    places = from_numpy(bench.view.unproject(grid[..., 0], grid[..., 1], depth)).float()
    off, told = np.zeros((2, bench.height, bench.width), np.float32)
    if not moves.any():
        return off
    plate = low_passed(bench.view.picture, config.blur * bench.unit)
    for index in _aside(bench, places[from_numpy(moves)], config):
        camera = bench.scene.viewmats[index], bench.Ks[index]
        shown = render_frozen(frozen, *camera, bench.width, bench.height, bench.exposure, bench.time)
        pixels, away = project(places, *camera)
        differs = _differs(shown, plate, pixels.numpy() - np.float32(0.5), away.numpy(), bench.unit, config)
        seen = np.isfinite(differs) & (inside(pixels, bench.width, bench.height, 1.0).numpy() > 0.5)
        off, told = off + np.where(seen, differs, np.float32(0.0)), told + seen
    return np.where(moves & (told >= config.least), off / np.maximum(told, 1.0), 0.0).astype(np.float32)


def _aside(bench: InstantBench, movers: Tensor, config: TornConfig) -> list[int]:
    """Delivered frames whose cameras see what moves, at [M, 3], from aside, but not from behind."""
    middle, centres = movers.median(dim=0).values, bench.scene.camera_centres()
    own = torch.nn.functional.normalize(centres[bench.index] - middle, dim=0)
    cosine = torch.nn.functional.normalize(centres - middle, dim=1) @ own
    angle = torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))
    first, last = config.aside
    good = [n for n, degrees in enumerate(angle.numpy()) if first <= degrees <= last]
    return [good[n] for n in evenly_spaced(len(good), config.views)]


def _differs(
    shown: FrozenImage, plate: NDArray[np.float32], at: NDArray[np.float32], away: NDArray[np.float32], unit: float,
    config: TornConfig,
) -> NDArray[np.float32]:  # fmt: skip
    """[h, w] by how much what is `shown` from aside differs from plate t* [h, w, 3] at places that are `at` [h, w, 2]
    there and `away` [h, w]; NaN where something still hides them."""
    import cv2

    def there(values: NDArray[np.float32]) -> NDArray[np.float32]:
        values = np.ascontiguousarray(values, np.float32)
        return np.asarray(cv2.remap(values, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.float32)

    picture = low_passed(shown.color.numpy(), config.blur * unit)
    side = 2 * max(1, round(config.shift * unit)) + 1
    around = np.ones((side, side), np.uint8)
    most, least = (
        there(np.asarray(cv2.dilate(picture, around), np.float32)),
        there(np.asarray(cv2.erode(picture, around), np.float32)),
    )
    off = np.maximum(np.maximum(plate - most, least - plate).max(axis=-1), 0.0)
    nearer = there(shown.depth.numpy().clip(0.0, 1e6)) < (1.0 - config.before) * away
    hidden = (nearer & (there(shown.motion.numpy()) < 0.5)) | (away <= 0.0)
    return np.where(hidden, np.float32(np.nan), off).astype(np.float32)
