"""Floor detection in a solve, on rooms with a known floor."""

from __future__ import annotations

import numpy as np
import pytest

from torch_backend.cameras.floor import find_floor


def turned(seed: int) -> np.ndarray:
    """Random rotation [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def room(seed: int, floor_share: float = 0.15, count: int = 3000, pitch: float = 25.0):
    """Points, camera centres and up vectors of a room: floor z = 0, a table with more points, walls, people,
    outliers."""
    rng = np.random.default_rng(seed)
    on_floor = int(floor_share * count)
    ground = np.concatenate([rng.uniform(-3, 3, (on_floor, 2)), rng.normal(0, 0.01, (on_floor, 1))], axis=1)
    table = np.concatenate([rng.uniform(-1, 1, (count // 4, 2)), rng.normal(0.8, 0.005, (count // 4, 1))], axis=1)
    wall = np.stack([rng.uniform(-3, 3, count // 3), np.full(count // 3, 3.0), rng.uniform(0.1, 2.5, count // 3)], 1)
    outliers = rng.uniform(-4, 4, (count // 33, 3))
    people = rng.normal((0, 0, 1.0), (0.6, 0.6, 0.25), (count - on_floor - count // 4 - count // 3 - count // 33, 3))
    centres = np.array([0, -3, 1.6]) + np.stack([np.linspace(-0.5, 0.5, 20), *rng.normal(0, 0.03, (2, 20))], 1)
    tilt = np.radians(pitch)  # the camera looks down at the table: its up vector leans forward
    ups = np.array([0, np.sin(tilt), np.cos(tilt)]) + rng.normal(0, 0.03, (20, 3))
    return np.concatenate([ground, table, wall, outliers, people]), centres, ups


@pytest.mark.parametrize("seed", range(4))
def test_the_floor_is_found_under_a_table_among_outliers(seed):
    points, centres, ups = room(seed)
    rotation, shift, size = turned(seed + 10), np.array([2.0, -7.0, 0.5]), 0.3
    found = find_floor(size * points @ rotation.T + shift, size * centres @ rotation.T + shift, ups @ rotation.T)
    assert found is not None
    normal, height = found
    assert np.degrees(np.arccos(min(1.0, normal @ rotation[:, 2]))) < 0.5
    assert height == pytest.approx(shift @ rotation[:, 2], abs=0.02 * size)
    again = find_floor(size * points @ rotation.T + shift, size * centres @ rotation.T + shift, ups @ rotation.T)
    assert np.array_equal(again[0], normal) and again[1] == height, "the same points, the same floor"


def test_no_floor_is_invented():
    points, centres, ups = room(0)
    assert find_floor(points[:49], centres, ups) is None
    rng = np.random.default_rng(1)
    assert find_floor(rng.normal((0, 3, 0), 1, (2000, 3)), centres, ups) is None, "a cloud has none"
    walls = points[np.abs(points[:, 1] - 3) < 1e-6]
    assert find_floor(walls, centres, ups) is None, "a wall is none"
