"""Flat scenes are distinguished from scenes with depth by their points, despite outliers."""

import numpy as np
import pytest

from torch_backend.sfm.flat import flat_words, plane_share
from torch_backend.sfm.verdict import quality_words

RNG = np.random.default_rng(0)


def turned(points):
    """Points in a random frame of reference."""
    axes = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    return points @ axes * 7.0 + RNG.normal(size=3) * 30.0


@pytest.fixture
def poster():
    """[3000, 3] points of a plane, 1 % of them misplaced."""
    points = np.concatenate([RNG.uniform(-1, 1, (3000, 2)) * [2.0, 1.0], RNG.normal(0, 1e-3, (3000, 1))], axis=1)
    points[:30] += RNG.normal(0, 0.5, (30, 3))
    return points


def test_a_pan_over_a_still_is_flat_and_poor_however_small_its_error(poster):
    words = flat_words(turned(poster))
    assert words is not None and "one plane" in words[0]
    assert quality_words(40, 40, 0.01, misled=True).startswith("Poor") and quality_words(40, 40, 0.01).startswith(
        "Good"
    )


def test_a_wall_with_people_before_it_a_room_and_few_points_are_not_flat(poster):
    poster[:450] += RNG.normal([0.0, 0.0, 0.4], 0.1, (450, 3))  # 15 %
    assert flat_words(turned(poster)) is None
    room = RNG.uniform(-1, 1, (3000, 3))
    room[np.arange(3000), RNG.integers(0, 3, 3000)] = RNG.choice([-1.0, 1.0], 3000)  # on six walls
    assert plane_share(turned(room)) < 0.3
    assert flat_words(poster[:3]) is None
