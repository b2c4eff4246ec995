"""Small things followed through a clip, and where in space they were."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from torch_backend.freeze.instant_depth import View
from torch_backend.freeze.instant_track import Track, TrackConfig, swing, tracks

WIDTH, HEIGHT, COUNT, T_STAR = 320, 180, 48, 20
K = np.array([[270.0, 0.0, 160.0], [0.0, 270.0, 90.0], [0.0, 0.0, 1.0]])
LENGTH, SPEED = 1.75, 0.296
"""Of the thread in metres, and radians of the swing per frame of 1/8 s."""


def camera(index: int, still: bool = False) -> View:
    """Goes forward and to the side, and is held by hand."""
    viewmat = np.eye(4)
    wobble = 0.01 * np.sin(np.array([0.7, 1.1]) * index)
    viewmat[:3, 3] = (0, 0, 0) if still else (-0.02 * index + wobble[0], wobble[1], -0.035 * index)
    return View(index, np.zeros((0, 0, 3), np.float32), viewmat, K)


def hangs(index: int) -> np.ndarray:
    """An apple on a thread, 3 m ahead."""
    side, deep = 0.25 * np.sin(SPEED * index + 0.5), 0.05 * np.sin(SPEED * index + 2.0)
    return np.array([0.3 + side, 0.1 - (side**2 + deep**2) / (2 * LENGTH), 3.0 + deep])


def shown(view: View, point: np.ndarray) -> np.ndarray:
    local = view.K @ (view.viewmat[:3, :3] @ point + view.viewmat[:3, 3])
    return local[:2] / local[2]


def track_of(still: bool = False, noise: float = 0.15) -> Track:
    rng = np.random.default_rng(1)
    at = {i: shown(camera(i, still), hangs(i)) + rng.normal(0, noise, 2) for i in range(COUNT) if i % 5 != 3}
    at[7] = at[7] + 60.0  # another red thing
    return Track(np.ones((3, 3), bool), np.array([0.8, 0.1, 0.1], np.float32), at)


@pytest.mark.parametrize(("noise", "off"), [(0.0, 1e-6), (0.15, 0.05)])
def test_the_swing_tells_how_deep_an_apple_on_a_thread_is(noise: float, off: float) -> None:
    told = swing(track_of(noise=noise), T_STAR, camera, TrackConfig(), 1.0)
    assert told is not None
    true = float((camera(T_STAR).viewmat @ np.append(hangs(T_STAR), 1.0))[2])
    assert told.depth == pytest.approx(true, rel=off)
    assert abs(told.depth / true - 1.0) < 3.0 * told.deviation and told.deviation < 0.05
    assert told.residual < 0.3


def test_a_camera_that_stands_still_tells_no_depth() -> None:
    assert swing(track_of(still=True), T_STAR, lambda i: camera(i, still=True), TrackConfig(), 1.0) is None


def test_what_does_not_swing_tells_no_depth() -> None:
    track, rng = track_of(), np.random.default_rng(2)
    walk = np.cumsum(rng.normal(0, 3.0, (COUNT, 2)), axis=0)
    track.at = {i: place + walk[i] for i, place in track.at.items()}
    assert swing(track, T_STAR, camera, TrackConfig(), 1.0) is None


def test_part_of_a_swing_tells_no_depth() -> None:
    track = track_of()
    track.at = {i: place for i, place in track.at.items() if abs(i - T_STAR) <= 8}
    assert swing(track, T_STAR, camera, TrackConfig(least=8), 1.0) is None


def frame(index: int) -> tuple[View, np.ndarray] | None:
    """A red and a blue disc on grey; in every sixth frame the matte has missed the red one."""
    if not 0 <= index < COUNT:
        return None
    view, moving = camera(index), np.zeros((HEIGHT, WIDTH), np.uint8)
    view.picture = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    red, blue = shown(view, hangs(index)), (60.0 + 3 * index, 90.0)
    for at, color, seen in ((red, (0.8, 0.1, 0.1), index % 6 != 1), (blue, (0.1, 0.1, 0.8), True)):
        middle = int(at[0]), int(at[1])
        cv2.circle(view.picture, middle, 3, color, -1)
        if seen:
            cv2.circle(moving, middle, 4, 1, -1)
    return view, moving > 0


def test_a_thing_is_followed_past_frames_without_and_past_another_thing() -> None:
    empty = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    found = tracks(frame, T_STAR, empty, TrackConfig(), 1.0)
    red = [track for track in found if track.color[0] > 0.6]
    assert len(found) == 2 and len(red) == 1
    assert len(red[0].at) >= 35
    off = [np.linalg.norm(place - shown(camera(i), hangs(i))) for i, place in red[0].at.items()]
    assert max(off) < 1.5


def test_a_thing_that_the_render_shows_is_not_missing() -> None:
    start = frame(T_STAR)
    assert start is not None
    assert tracks(frame, T_STAR, start[0].picture, TrackConfig(), 1.0) == []
