"""How well is grain measured, and what do its numbers matter? `python -m benchmarks.grain`.

A picture of gradients, a third of which is textured, gets grain of known deviation and softness, is cut at black and
white, and rounded to 8 bits. Printed is the error of the deviation that is measured, in % (mean of absolute values over
deviations of 1, 3 and 8 of 255, softness 0 and 0.8 and all levels but the outer two), as `composite/grain.py` is, and
with each of its numbers halved and doubled; and the grain that is seen in a picture that has none, of 255.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from torch_backend.freeze.composite import grain

NUMBERS = ("_BLOCK", "_FEWEST", "_LEAST", "_STANDS_OUT", "_MOST")
FRAMES, HEIGHT, WIDTH = 3, 192, 320


def picture() -> NDArray[np.float64]:
    """[H, W, 3] in 0..1."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    made = np.stack([0.05 + 0.9 * x / WIDTH, 0.05 + 0.9 * y / HEIGHT, 0.5 + 0.4 * np.sin(x / 60) * np.cos(y / 50)], -1)
    return made + 0.1 * (np.sin(1.3 * x + 0.7 * y) * ((x // 32 + y // 32) % 3 == 1))[..., None]


def frames(deviation: float, softness: float) -> list[NDArray[np.uint8]]:
    """The picture with grain of `deviation` / 255."""
    made = list[NDArray[np.uint8]]()
    for seed in range(FRAMES):
        noise = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH, 3))
        noise = gaussian_filter(noise, (softness, softness, 0)) if softness else noise
        made.append(np.clip(np.round(picture() * 255 + deviation * noise / noise.std()), 0, 255).astype(np.uint8))
    return made


def error() -> tuple[float, float]:
    """(error of the deviation in %, deviation of a picture without grain, of 255)."""
    for cache in (grain._basis, grain._kept):  # pyright: ignore[reportPrivateUsage]
        cache.cache_clear()
    off = [
        np.abs(grain.measure(frames(deviation, softness)).deviation[:, 1:-1] * 255 / deviation - 1).mean()
        for deviation in (1.0, 3.0, 8.0)
        for softness in (0.0, 0.8)
    ]
    return 100 * float(np.mean(off)), 255 * float(grain.measure(frames(0.0, 0.0)).deviation[:, 1:-1].mean())


def cell(name: str = "", factor: float = 1.0) -> str:
    """`error` with a number of `grain` times a factor, as a cell; – if the softest grain does not fit a block then."""
    before = getattr(grain, name, None)
    try:
        if before is not None:
            setattr(grain, name, type(before)(before * factor))
        return "{:.1f} %, {:.2f}".format(*error())
    except ValueError:
        return "–"
    finally:
        if before is not None:
            setattr(grain, name, before)


def main() -> int:
    """Command line; returns an exit code."""
    print("| number | as it is | half | twice |\n|---|---:|---:|---:|")
    today = cell()
    for name in NUMBERS:
        print(f"| `{name}` {getattr(grain, name)} | {today} | {cell(name, 0.5)} | {cell(name, 2.0)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
