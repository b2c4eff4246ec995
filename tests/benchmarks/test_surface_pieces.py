"""Separate pieces of a fused surface: pieces that most views confirm are kept at any size, others are noise."""

import numpy as np

from torch_backend.freeze.surface.dressed import dress
from torch_backend.freeze.surface.nets import extract
from torch_backend.freeze.surface.volume import SurfaceConfig, View, fuse

WIDTH, HEIGHT, FOCAL, WALL = 160, 120, 150.0, 4.0
HAND, SPECK = (0.0, 0.0, 2.0), (0.9, 0.5, 2.0)
HALF = 0.2
"""Half the side length of hand and speck, in the units of the wall's distance 4."""


def looking(x: float, shows_speck: bool) -> View:
    """View from (x, 0, 0) of a wall with a moving hand in front, and optionally a speck."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    depth, motion = np.full((HEIGHT, WIDTH), WALL, np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    for (at_x, at_y, z), moves in ((HAND, 1.0), *([(SPECK, 0.0)] if shows_speck else [])):
        across, down = (u - K[0, 2]) / FOCAL * z + x - at_x, (v - K[1, 2]) / FOCAL * z - at_y
        is_hit = (np.abs(across) < HALF) & (np.abs(down) < HALF)
        depth[is_hit], motion[is_hit] = z, moves
    color = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    return View(viewmat, K, depth, np.full_like(depth, 0.01), color, motion)


def pieces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(centres [T, 3] of triangles near z 2, bool [T] of people); two of `count` views show the speck."""
    views = [looking(x, n < 2) for n, x in enumerate(np.linspace(-0.4, 0.4, count))]
    volume = fuse(views, SurfaceConfig())
    vertices, triangles = extract(volume)
    cut = (volume.cut * volume.space.scale(vertices)).astype(np.float32)
    surface = dress(vertices, triangles, views, cut, part=0.2)
    middles = surface.vertices[surface.triangles].mean(1)
    near = np.abs(middles[:, 2] - 2.0) < 0.3
    return middles[near], surface.people[near]


def test_a_small_piece_that_views_agree_on_is_kept_and_stays_people():
    middles, people = pieces(9)
    is_hand = np.hypot(middles[:, 0] - HAND[0], middles[:, 1] - HAND[1]) < 0.5
    assert is_hand.sum() > 100 and people[is_hand].all()
    assert is_hand.all(), "two of nine views are too few for the speck"


def test_two_views_confirm_nothing():
    assert not len(pieces(2)[0])
