"""Whether surfaces look as they do at other times, in pictures drawn here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from torch_backend.solve.appearance import Appearance, Sight, StaticView
from torch_backend.solve.flow import FlowConfig

WIDTH, HEIGHT, WALL, NEAR = 160, 120, 4.0, 2.0
K = np.array([[256.0, 0.0, WIDTH], [0.0, 256.0, HEIGHT], [0.0, 0.0, 1.0]])
"""In flow pixels, two to a point of the grid."""
X, Y = (v.astype(np.float32) for v in np.meshgrid(np.arange(1, 2 * WIDTH, 2), np.arange(1, 2 * HEIGHT, 2)))
KEY, OTHERS, RADIUS = 8, (0, 2, 4, 6, 10, 12, 14, 16), 5.0
RED = (200, 30, 30)
AT_WALL = np.full((HEIGHT, WIDTH), 1.0 / WALL, np.float32)


def wall() -> np.ndarray:
    rng = np.random.default_rng(3)
    coarse = rng.uniform(60, 190, (40, 60, 1)) + rng.uniform(-15, 15, (40, 60, 3))
    return cv2.resize(np.clip(coarse, 0, 255).astype(np.uint8), (600, 400), interpolation=cv2.INTER_CUBIC)


def viewmat(key: int) -> np.ndarray:
    """A camera that goes to the right before a wall."""
    view = np.eye(4)
    view[0, 3] = -0.06 * key
    return view


def disc(key: int, at: tuple[float, float]) -> np.ndarray:
    """Where a disc at x, y in metres, `NEAR` before the camera, is seen."""
    u, v = ((c - o) / NEAR * 256.0 + m for c, o, m in zip(at, (0.06 * key, 0.0), K[:2, 2], strict=True))
    return np.hypot(X - u, Y - v) < RADIUS


def picture(key: int, at: tuple[float, float] | None) -> np.ndarray:
    x = (X - K[0, 2]) / K[0, 0] * WALL + 0.06 * key
    y = (Y - K[1, 2]) / K[1, 1] * WALL
    x, y = (v.astype(np.float32) for v in (300 + 64 * x, 200 + 64 * y))
    drawn = cv2.remap(wall(), x, y, cv2.INTER_LINEAR)
    if at is not None:
        drawn[disc(key, at)] = RED
    return drawn


def prepared(key: int, at: tuple[float, float] | None, brighter: int = 0, blur: float = 0.0) -> Appearance:
    """A frame that shows a disc, and a static model that knows the wall alone, or a blurred one."""
    model = picture(key, None)
    model = cv2.GaussianBlur(model, (0, 0), blur) if blur else model
    shown = np.clip(picture(key, at).astype(int) + brighter, 0, 255).astype(np.uint8)
    return Appearance(Sight(shown, viewmat(key), K), StaticView(model, np.full((HEIGHT, WIDTH), WALL, np.float32)))


def swings(key: int) -> tuple[float, float]:
    return 0.5 + 0.2 * np.sin(0.9 * key), 0.1 + 0.03 * np.cos(1.8 * key)


@pytest.mark.parametrize("brighter", [0, 20])
def test_a_thing_that_is_elsewhere_in_other_frames_has_changed_and_nothing_else_has(brighter: int) -> None:
    others = [prepared(key, swings(key), brighter) for key in OTHERS]
    changed = prepared(KEY, swings(KEY)).changed((X, Y), others, AT_WALL, FlowConfig())
    truth = disc(KEY, swings(KEY))
    assert (changed[truth] > 1.2).mean() > 0.9
    away = ~cv2.dilate(truth.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    assert np.quantile(changed[away], 0.99) < 0.7


def test_a_thing_that_stands_where_its_matches_meet_has_not_changed_though_the_model_lacks_it() -> None:
    at = (0.55, 0.1)
    inverse = np.where(disc(KEY, at), np.float32(1.0 / NEAR), AT_WALL)
    others = [prepared(key, at) for key in OTHERS]
    changed = prepared(KEY, at).changed((X, Y), others, inverse, FlowConfig())
    inner = cv2.erode(disc(KEY, at).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert changed[inner].max() < 0.9
    assert prepared(KEY, at).changed((X, Y), others, AT_WALL, FlowConfig())[inner].min() > 1.2


def test_where_the_static_model_is_blurred_in_all_frames_nothing_has_changed() -> None:
    """Not even if matches led the depth astray."""
    others = [prepared(key, None, blur=3.0) for key in OTHERS]
    changed = prepared(KEY, None, blur=3.0).changed((X, Y), others, AT_WALL * 1.7, FlowConfig())
    assert np.quantile(changed, 0.95) < 0.7


def test_what_no_other_frame_sees_is_not_known_to_have_changed() -> None:
    frame = prepared(KEY, swings(KEY))
    assert not frame.changed((X, Y), [], AT_WALL, FlowConfig()).any()
    far = Appearance(Sight(frame.sight.colors, viewmat(400), K), StaticView(frame.sight.colors, frame.depth))
    assert not frame.changed((X, Y), [far], AT_WALL, FlowConfig()).any()
