"""Small fast things that no flow finds, in pictures drawn here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from torch_backend.solve.fleeting import Fleeting, Other, Shades, Sight
from torch_backend.solve.flow import FlowConfig

WIDTH, HEIGHT, WALL, NEAR = 160, 120, 4.0, 2.0
K = np.array([[256.0, 0.0, WIDTH], [0.0, 256.0, HEIGHT], [0.0, 0.0, 1.0]])
"""In flow pixels, two to a point of the grid."""
X, Y = (v.astype(np.float32) for v in np.meshgrid(np.arange(1, 2 * WIDTH, 2), np.arange(1, 2 * HEIGHT, 2)))
KEY, STEPS, RADIUS = 8, (1, 2, 4, 8), 5.0
RED = (200, 30, 30)


def wall() -> np.ndarray:
    rng = np.random.default_rng(3)
    coarse = rng.uniform(60, 190, (40, 60, 1)) + rng.uniform(-15, 15, (40, 60, 3))
    return cv2.resize(np.clip(coarse, 0, 255).astype(np.uint8), (600, 400), interpolation=cv2.INTER_CUBIC)


def sight(key: int, places: list[tuple[float, float]], gain: float = 1.0) -> Sight:
    """A camera that goes to the right before a wall, and red discs at x, y in metres, NEAR before it."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -0.06 * key
    x = (X - K[0, 2]) / K[0, 0] * WALL + 0.06 * key
    y = (Y - K[1, 2]) / K[1, 1] * WALL
    x, y = (v.astype(np.float32) for v in (300 + 64 * x, 200 + 64 * y))
    picture = cv2.remap(wall(), x, y, cv2.INTER_LINEAR)
    for at in places:
        u, v = ((c - o) / NEAR * 256.0 + m for c, o, m in zip(at, (0.06 * key, 0.0), K[:2, 2], strict=True))
        picture[np.hypot(X - u, Y - v) < RADIUS] = RED
    return Sight(Shades(np.clip(picture * gain, 0, 255).astype(np.uint8)), viewmat, K)


def disc(at: tuple[float, float]) -> np.ndarray:
    u, v = ((c - o) / NEAR * 256.0 + m for c, o, m in zip(at, (0.06 * KEY, 0.0), K[:2, 2], strict=True))
    return np.hypot(X - u, Y - v) < RADIUS


def found(place, gain: float = 1.0, static: Shades | None = None) -> np.ndarray:
    """The mask of the middle frame; `place(key)` is where the disc is, `static` what a static model shows there."""
    inverse = np.full((HEIGHT, WIDTH), 1.0 / WALL, np.float32)  # flow has seen the wall only
    others = [
        Other(side, step, sight(KEY + side * step, [place(KEY + side * step)], gain), inverse)
        for side in (-1, 1)
        for step in STEPS
    ]
    masks = Fleeting((X, Y), 0.5, FlowConfig()).masks(sight(KEY, [place(KEY)]), others, inverse, WALL, static)
    return masks[0] | masks[1]


def swings(key: int) -> tuple[float, float]:
    return 0.5 + 0.2 * np.sin(0.9 * key), 0.1 + 0.03 * np.cos(1.8 * key)


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_a_small_thing_that_is_elsewhere_in_every_frame_is_found_and_nothing_else(gain: float) -> None:
    mask, truth = found(swings, gain), disc(swings(KEY))
    assert truth.sum() < 30
    assert (mask & truth).sum() >= 0.8 * truth.sum()
    assert not (mask & ~cv2.dilate(truth.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)).any()


def test_a_thing_that_stands_still_before_the_wall_is_no_motion_though_its_depth_is_wrong() -> None:
    assert not found(lambda key: (0.55, 0.1)).any()


def test_a_frame_that_is_unlike_all_others_says_nothing() -> None:
    inverse = np.full((HEIGHT, WIDTH), 1.0 / WALL, np.float32)
    others = [Other(s, n, sight(KEY + s * n, []), inverse) for s in (-1, 1) for n in STEPS]
    flash = Sight(Shades(255 - sight(KEY, []).shades.colors), sight(KEY, []).viewmat, K)
    assert not np.any(Fleeting((X, Y), 0.5, FlowConfig()).masks(flash, others, inverse, WALL))


def test_too_few_frames_around_say_nothing() -> None:
    inverse = np.full((HEIGHT, WIDTH), 1.0 / WALL, np.float32)
    others = [Other(1, n, sight(KEY + n, []), inverse) for n in STEPS[:2]]
    assert not np.any(Fleeting((X, Y), 0.5, FlowConfig()).masks(sight(KEY, [swings(KEY)]), others, inverse, WALL))


def comes(key: int) -> tuple[float, float]:
    """Out of the picture, and from the middle frame on at rest."""
    return (0.55, 0.1) if key >= KEY else (99.0, 99.0)


def test_what_came_and_stays_moves_if_a_static_model_shows_what_was_there_before() -> None:
    """The key frames before and after do not agree about what is behind it; a model of the whole clip knows."""
    truth = disc(comes(KEY))
    assert not (found(comes) & truth).any()
    mask = found(comes, static=sight(KEY, []).shades)
    assert (mask & truth).sum() >= 0.8 * truth.sum()
    assert not (mask & ~cv2.dilate(truth.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)).any()


def test_where_a_static_model_is_poor_nothing_moves_that_the_frames_around_show_as_well() -> None:
    shown = sight(KEY, []).shades.colors.copy()
    shown[20:35, 30:60] = 255 - shown[20:35, 30:60]
    assert not found(lambda key: (99.0, 99.0), static=Shades(shown)).any()


def test_a_static_model_that_is_wrong_about_the_whole_frame_says_nothing() -> None:
    assert not found(comes, static=Shades(255 - sight(KEY, []).shades.colors)).any()


def test_where_hardly_another_frame_looks_a_static_model_is_not_believed() -> None:
    """At the rim of a clip's view: the model saw it once or twice, and learnt it badly."""
    inverse = np.full((HEIGHT, WIDTH), 1.0 / WALL, np.float32)
    others = [Other(1, n, sight(KEY + n, []), inverse) for n in STEPS]
    shown = sight(KEY, []).shades.colors.copy()
    shown[20:50, :4] = 255 - shown[20:50, :4]
    frame = sight(KEY, [])
    assert not np.any(Fleeting((X, Y), 0.5, FlowConfig()).masks(frame, others, inverse, WALL, Shades(shown)))
    careless = FlowConfig(asked=0)
    assert np.any(Fleeting((X, Y), 0.5, careless).masks(frame, others, inverse, WALL, Shades(shown)))
