"""Textures for walls, floors, furniture and posters, drawn with numpy from a random stream.

Each function returns [N, N, 3] uint8 sRGB that tiles (except posters). Textures have many corners, so that COLMAP finds
features in them at a height of 135 lines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .noise import Array, fractal

Picture = NDArray[np.uint8]


def hsv(hue: float, saturation: float, value: float) -> Array:
    """[3] sRGB colour in [0, 1]."""
    channel = (np.array([5.0, 3.0, 1.0]) + hue * 6.0) % 6.0
    return value * (1.0 - saturation * np.clip(np.minimum(channel, 4.0 - channel), 0.0, 1.0))


def colour(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> Array:
    """[3] sRGB colour of random hue, with saturation and value in the given ranges."""
    return hsv(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))


def _picture(rgb: Array) -> Picture:
    return np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)


def halved(picture: Picture) -> Picture:
    """The picture at half size, by averaging 2x2 pixels; this softens hard edges like a camera's pixels."""
    size = len(picture) // 2
    mean = picture.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))
    return np.round(mean).astype(np.uint8)


def _grid(size: int) -> tuple[Array, Array]:
    at = (np.arange(size) + 0.5) / size
    return np.meshgrid(at, at, indexing="ij")


def _per_cell(rng: np.random.Generator, *indices: NDArray[np.int64]) -> Array:
    """Uniform random value per cell, indexed by small non-negative integers."""
    shape = [int(i.max()) + 1 for i in indices]
    return rng.uniform(size=shape)[indices]


def planks(rng: np.random.Generator, size: int) -> Picture:
    """Wooden boards along x with grain."""
    y, x = _grid(size)
    rows, cols = 10, 2
    row = (y * rows).astype(np.int64)
    shift = rng.uniform(size=rows)[row]
    along = (x + shift) % 1.0 * cols
    board = along.astype(np.int64)
    grain = fractal(rng, size, 1.2, (0.15, 3.0))
    base = hsv(rng.uniform(0.05, 0.1), rng.uniform(0.35, 0.6), rng.uniform(0.45, 0.8))
    tone = 0.62 + 0.5 * _per_cell(rng, row, board) + 0.55 * (grain - 0.5)
    gap = np.minimum(
        np.minimum(y * rows % 1.0, 1.0 - y * rows % 1.0) / 0.04, np.minimum(along % 1.0, 1 - along % 1) / 0.006
    )
    return _picture(base * (tone * np.clip(gap, 0.25, 1.0))[..., None])


def bricks(rng: np.random.Generator, size: int) -> Picture:
    """Bricks in running bond with mortar."""
    y, x = _grid(size)
    rows, cols = 16, 8
    row = (y * rows).astype(np.int64)
    along = (x * cols + 0.5 * (row % 2)) % cols
    brick = along.astype(np.int64)
    edge = np.minimum(np.minimum(y * rows % 1, 1 - y * rows % 1), 2.0 * np.minimum(along % 1, 1 - along % 1))
    tint = _per_cell(rng, row, brick)[..., None]
    a, b = hsv(rng.uniform(0.0, 0.06), 0.55, 0.6), hsv(rng.uniform(0.02, 0.1), 0.4, 0.8)
    stone = (a * (1 - tint) + b * tint) * (0.6 + 0.8 * fractal(rng, size, 1.0))[..., None]
    mortar = np.array([0.78, 0.76, 0.72]) * (0.8 + 0.3 * fractal(rng, size, 0.8))[..., None]
    return _picture(np.where((edge > 0.09)[..., None], stone, mortar))


def tiles(rng: np.random.Generator, size: int) -> Picture:
    """Square tiles in two colours with spots and joints."""
    y, x = _grid(size)
    count = 6
    i, j = (y * count).astype(np.int64), (x * count).astype(np.int64)
    u, v = y * count % 1 - 0.5, x * count % 1 - 0.5
    a, b = colour(rng, (0.05, 0.3), (0.75, 0.92)), colour(rng, (0.2, 0.6), (0.3, 0.6))
    odd = ((i + j) % 2)[..., None]
    ground = (a * (1 - odd) + b * odd) * (0.75 + 0.25 * _per_cell(rng, i, j) + 0.3 * (fractal(rng, size, 1.1) - 0.5))[
        ..., None
    ]
    diamond = (np.abs(u) + np.abs(v) < 0.2)[..., None]
    joint = (np.maximum(np.abs(u), np.abs(v)) > 0.475)[..., None]
    return _picture(np.where(joint, 0.35, np.where(diamond, b * odd * 0.2 + a * 0.4, ground)))


def plaster(rng: np.random.Generator, size: int) -> Picture:
    """Painted wall with stains and specks."""
    base = colour(rng, (0.05, 0.35), (0.7, 0.9))
    stains = 0.8 + 0.3 * fractal(rng, size, 1.5) + 0.22 * (fractal(rng, size, 0.7) - 0.5)
    specks = np.where(fractal(rng, size, 0.9) > 0.83, 0.72, 1.0)
    return _picture(base * (stains * specks)[..., None])


def wallpaper(rng: np.random.Generator, size: int) -> Picture:
    """Stripes with a motif of irregular blossoms."""
    y, x = _grid(size)
    a, b, c = (
        colour(rng, (0.1, 0.3), (0.75, 0.9)),
        colour(rng, (0.2, 0.5), (0.55, 0.8)),
        colour(rng, (0.4, 0.8), (0.3, 0.7)),
    )
    stripe = (np.sin(2 * np.pi * 6 * x) > 0.2)[..., None]
    ground = np.where(stripe, a, b) * (0.9 + 0.2 * fractal(rng, size, 1.0))[..., None]
    motif = np.zeros((size, size), bool)
    for _ in range(70):
        cy, cx, petals, radius = rng.uniform(), rng.uniform(), rng.integers(3, 7), rng.uniform(0.02, 0.05)
        dy, dx = (y - cy + 0.5) % 1 - 0.5, (x - cx + 0.5) % 1 - 0.5
        motif |= np.hypot(dy, dx) < radius * (0.65 + 0.35 * np.cos(petals * np.arctan2(dy, dx) + cy * 9))
    return _picture(np.where(motif[..., None], c, ground))


def concrete(rng: np.random.Generator, size: int) -> Picture:
    """Grey with cracks, specks and stains."""
    grey = 0.35 + 0.3 * fractal(rng, size, 1.4) + 0.35 * (fractal(rng, size, 0.5) - 0.5)
    cracks = np.clip(np.abs(fractal(rng, size, 1.5) - 0.5) / 0.012, 0.45, 1.0)
    return _picture((grey * cracks)[..., None] * colour(rng, (0.0, 0.1), (0.95, 1.0)))


def grass(rng: np.random.Generator, size: int) -> Picture:
    """Blades, earth and small flowers."""
    blades = fractal(rng, size, 0.6)
    earth = fractal(rng, size, 1.4)[..., None]
    green = hsv(rng.uniform(0.2, 0.3), 0.55, 0.55) * (0.45 + 0.9 * blades)[..., None]
    brown = hsv(0.09, 0.4, 0.45) * (0.6 + 0.6 * blades)[..., None]
    ground = np.where(earth > 0.6, brown, green)
    flowers = fractal(rng, size, 0.7) > 0.87
    return _picture(np.where(flowers[..., None], colour(rng, (0.2, 0.7), (0.85, 1.0)), ground))


def pavers(rng: np.random.Generator, size: int) -> Picture:
    """Irregular paving stones: cells of scattered points."""
    count = 90
    seeds = rng.uniform(size=(count, 2))
    y, x = _grid(size)
    first, second = np.full((size, size), np.inf), np.full((size, size), np.inf)
    owner = np.zeros((size, size), np.int64)
    for k, (cy, cx) in enumerate(seeds):
        d = np.hypot((y - cy + 0.5) % 1 - 0.5, (x - cx + 0.5) % 1 - 0.5)
        nearer = d < first
        second = np.where(nearer, first, np.minimum(second, d))
        owner = np.where(nearer, k, owner)
        first = np.where(nearer, d, first)
    tone = rng.uniform(0.35, 0.85, count)[owner] * (0.7 + 0.6 * fractal(rng, size, 0.9))
    joint = np.clip((second - first) / 0.006, 0.35, 1.0)
    return _picture((tone * joint)[..., None] * colour(rng, (0.02, 0.25), (0.9, 1.0)))


def gravel(rng: np.random.Generator, size: int) -> Picture:
    """Pebbles in many shades of grey."""
    a, b = fractal(rng, size, 0.9), fractal(rng, size, 0.5)
    return _picture(
        (0.15 + 0.75 * np.round(5 * a) / 5 * (0.6 + 0.8 * b))[..., None] * colour(rng, (0.05, 0.3), (0.8, 1.0))
    )


def fabric(rng: np.random.Generator, size: int) -> Picture:
    """Woven checks in three colours."""
    y, x = _grid(size)
    a, b, c = (colour(rng, (0.3, 0.8), (0.25, 0.9)) for _ in range(3))
    n = int(rng.integers(5, 10))
    warp, weft = (np.sin(2 * np.pi * n * x) > 0.1)[..., None], (np.sin(2 * np.pi * n * y) > 0.3)[..., None]
    thin = ((np.sin(2 * np.pi * 3 * n * x) > 0.9) | (np.sin(2 * np.pi * 3 * n * y) > 0.9))[..., None]
    cloth = np.where(warp & weft, a, np.where(warp | weft, 0.5 * (a + b), b))
    return _picture(np.where(thin, c, cloth) * (0.8 + 0.4 * fractal(rng, size, 0.5))[..., None])


def rug(rng: np.random.Generator, size: int) -> Picture:
    """Borders and mirrored ornament."""
    y, x = _grid(size)
    field = fractal(rng, size, 1.1)
    field = field + field[::-1] + field[:, ::-1] + field[::-1, ::-1]
    colours = np.array([colour(rng, (0.3, 0.8), (0.2, 0.85)) for _ in range(5)])
    band = np.digitize(field, np.quantile(field, [0.2, 0.4, 0.6, 0.8]))
    edge = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    band = np.where(edge < 0.12, (edge / 0.03).astype(np.int64) % 5, band)
    return _picture(colours[band] * (0.8 + 0.4 * fractal(rng, size, 0.5))[..., None])


def cardboard(rng: np.random.Generator, size: int) -> Picture:
    """Brown box with tape, prints and a label."""
    y, x = _grid(size)
    board = hsv(0.09, 0.4, 0.68) * (0.8 + 0.35 * fractal(rng, size, 1.0))[..., None]
    tape = np.abs(y - 0.5) < 0.05
    board = np.where(tape[..., None], np.array([0.82, 0.72, 0.5]), board)
    for _ in range(14):
        cy, cx, h, w = rng.uniform(0.05, 0.9), rng.uniform(0.05, 0.9), rng.uniform(0.01, 0.06), rng.uniform(0.02, 0.2)
        board = np.where(
            ((np.abs(y - cy) < h) & (np.abs(x - cx) < w))[..., None], colour(rng, (0.0, 0.7), (0.1, 0.95)), board
        )
    return _picture(board)


def books(rng: np.random.Generator, size: int) -> Picture:
    """One board of a shelf, seen from the front: spines with titles."""
    rgb = np.full((size, size, 3), 0.08)
    y, x = _grid(size)
    at = 0.0
    while at < 1.0:
        width, height = rng.uniform(0.025, 0.07), rng.uniform(0.62, 0.95)
        spine = (x >= at) & (x < at + width - 0.004) & (y > 1 - height)
        rgb[spine] = colour(rng, (0.1, 0.8), (0.2, 0.9))
        for _ in range(int(rng.integers(1, 4))):
            low = rng.uniform(0.1, 0.8)
            mark = spine & (np.abs(y - (1 - height * low)) < rng.uniform(0.01, 0.05))
            rgb[mark] = colour(rng, (0.0, 0.5), (0.6, 1.0))
        at += width
    return _picture(rgb * (0.85 + 0.3 * fractal(rng, size, 0.7))[..., None])


def poster(rng: np.random.Generator, size: int) -> Picture:
    """Shapes, lines of type and a frame."""
    y, x = _grid(size)
    ground = colour(rng, (0.1, 0.7), (0.5, 0.95)) * (0.75 + 0.4 * fractal(rng, size, 1.3))[..., None]
    for _ in range(int(rng.integers(10, 22))):
        cy, cx, r, turn = rng.uniform(), rng.uniform(), rng.uniform(0.03, 0.2), rng.uniform(0, np.pi)
        u = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        v = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        shape = (np.hypot(u, v) < r, np.maximum(np.abs(u), 2.5 * np.abs(v)) < r, np.abs(u) + np.abs(v) < r)[
            rng.integers(3)
        ]
        ground = np.where(shape[..., None], colour(rng, (0.2, 0.9), (0.1, 1.0)), ground)
    ink = colour(rng, (0.0, 0.4), (0.02, 0.2))
    for line in range(int(rng.integers(2, 6))):
        top, height = 0.08 + 0.16 * line + rng.uniform(0, 0.05), rng.uniform(0.02, 0.06)
        letters = rng.uniform(size=64)[(x * rng.integers(14, 30)).astype(np.int64)] > 0.35
        inside = (y > top) & (y < top + height) & (x > 0.1) & (x < rng.uniform(0.5, 0.9)) & letters
        ground = np.where(inside[..., None], ink, ground)
    frame = np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.47
    return _picture(np.where(frame[..., None], ink, ground))


def leaves(rng: np.random.Generator, size: int) -> Picture:
    """Foliage: many greens and dark holes."""
    a = fractal(rng, size, 0.8)
    rgb = hsv(rng.uniform(0.2, 0.33), 0.6, 0.75) * (0.15 + 1.1 * np.round(4 * a) / 4)[..., None]
    return _picture(np.where((fractal(rng, size, 0.9) > 0.8)[..., None], hsv(0.14, 0.6, 0.75), rgb))


def bark(rng: np.random.Generator, size: int) -> Picture:
    """Fissured trunk."""
    ridges = fractal(rng, size, 1.0, (3.0, 0.4))
    return _picture(hsv(0.07, 0.35, 0.6) * (0.2 + 1.2 * ridges)[..., None])


@dataclass(frozen=True)
class Texture:
    """Drawing function and scale of a texture."""

    draw: Callable[[np.random.Generator, int], Picture]
    metres: float
    """Side of the picture on the surface in metres; 0 stretches it over each face."""
    pixels: int = 1024
    """Side of the picture in pixels."""


TEXTURES = {
    "planks": Texture(planks, 2.0),
    "bricks": Texture(bricks, 2.0),
    "tiles": Texture(tiles, 1.8),
    "plaster": Texture(plaster, 2.4),
    "wallpaper": Texture(wallpaper, 2.0),
    "concrete": Texture(concrete, 2.5),
    "grass": Texture(grass, 2.5),
    "pavers": Texture(pavers, 3.0),
    "gravel": Texture(gravel, 2.0),
    "fabric": Texture(fabric, 0.9, pixels=384),
    "rug": Texture(rug, 0.0, pixels=512),
    "cardboard": Texture(cardboard, 0.0, pixels=384),
    "books": Texture(books, 0.0, pixels=384),
    "poster": Texture(poster, 0.0, pixels=512),
    "leaves": Texture(leaves, 0.8, pixels=384),
    "bark": Texture(bark, 1.0, pixels=384),
}
