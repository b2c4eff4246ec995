"""Black or blurred bars around the picture are located, masked and reported; dark pictures and door frames are not
bars."""

import cv2
import numpy as np
import pytest

from torch_backend.footage.bars import Bars, find_bars
from torch_backend.footage.images import read_png
from torch_backend.footage.importing import FootageConfig, import_footage, load_frames
from torch_backend.shot import Shot

HEIGHT, WIDTH = 120, 200


@pytest.fixture
def world(pan):
    """24 uint8 frames [120, 200, 3] of a camera that pans over a detailed texture."""
    grain = np.random.default_rng(1).normal(0, 12, (HEIGHT, 400, 1))
    frames = pan(24, HEIGHT, WIDTH, speed=3)
    return [np.clip(f + grain[:, 3 * i : 3 * i + WIDTH], 0, 255).astype(np.uint8) for i, f in enumerate(frames)]


def grey(frames):
    return [cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY) for frame in frames]


def barred(frames, top=0, bottom=0, left=0, right=0, colour=0):
    out = []
    for frame in frames:
        framed = np.full_like(frame, colour)
        inner = slice(top, HEIGHT - bottom), slice(left, WIDTH - right)
        framed[inner] = frame[inner]
        out.append(framed)
    return out


def blurred_sides(frames, size):
    """Middle of each frame over a blurred, enlarged copy of the frame's middle."""
    out = []
    for frame in frames:
        middle = np.ascontiguousarray(frame[:, size : WIDTH - size])
        blurred = cv2.GaussianBlur(cv2.resize(middle, (WIDTH, HEIGHT)), (0, 0), 7)
        blurred[:, size : WIDTH - size] = middle
        out.append(blurred)
    return out


@pytest.mark.parametrize(
    ("sides", "colour"),
    [
        ({"top": 15, "bottom": 15}, 0),
        ({"left": 30, "right": 30}, 16),
        ({"bottom": 12}, 0),
        ({"top": 10, "bottom": 10, "left": 40, "right": 40}, 0),
        ({"left": 24, "right": 24}, 235),
    ],
)
def test_bars_of_one_colour_are_found_where_they_are(world, sides, colour):
    assert find_bars(grey(barred(world, **sides, colour=colour))) == Bars(**sides)


@pytest.mark.parametrize("size", [30, 60])
def test_blurred_pillars_are_found_where_they_are(world, size):
    pictures = grey(blurred_sides(world, size))
    assert find_bars(pictures) == Bars(left=size, right=size)
    assert find_bars([np.ascontiguousarray(picture.T) for picture in pictures]) == Bars(top=size, bottom=size)


def test_bars_are_found_despite_subtitles_and_dark_pictures(world):
    frames = barred([(f * np.linspace(1, 0.05, HEIGHT)[:, None, None]).astype(np.uint8) for f in world], 20, 20)
    for frame in frames[:12]:
        frame[6:12, 70:110] = 255
    assert find_bars(grey(frames)) == Bars(top=20, bottom=20)


def darkened(world):
    """Underexposed frames: most of the picture clips to black, the upper third everywhere."""
    fall = np.clip((np.arange(HEIGHT) - 40) / 60, 0, 1)[:, None, None]
    return [np.clip((frame.astype(float) - 90) * fall, 0, 255).astype(np.uint8) for frame in world]


def skyline(world):
    """Roofs against a black sky: their line is not straight, and it moves."""
    out = []
    for i, frame in enumerate(world):
        roofs = 30 + 8 * np.sin((np.arange(WIDTH) + 3 * i) / 9)
        out.append(np.where((np.arange(HEIGHT)[:, None] < roofs)[..., None], 3, frame).astype(np.uint8))
    return out


def door(world):
    """Black door frame at the left side that is nearly still in the picture."""
    out = [frame.copy() for frame in world]
    for i, frame in enumerate(out):
        frame[:, : 24 + round(3 * np.sin(i / 3))] = 9
    return out


def shallow(world):
    """Frames with shallow depth of field: only the middle is sharp."""
    weight = np.clip(np.abs(np.arange(WIDTH) - WIDTH / 2) / 40 - 0.5, 0, 1)[None, :, None]
    return [(f * (1 - weight) + cv2.GaussianBlur(f, (0, 0), 7) * weight).astype(np.uint8) for f in world]


@pytest.mark.parametrize("case", [list, darkened, skyline, door, shallow, lambda world: barred(world[:1] * 24, top=20)])
def test_what_belongs_to_the_scene_is_none(world, case):
    assert find_bars(grey(case(world))) == Bars()


@pytest.mark.parametrize("blurs", [False, True])
def test_an_import_says_what_the_picture_fills_and_masks_the_rest(tmp_path, world, write_video, recorder, blurs):
    frames = blurred_sides(world, 30) if blurs else barred(world, left=30, right=30)
    write_video(tmp_path / "a.mp4", frames)
    shot, report = Shot.create(tmp_path / "shot"), recorder()
    import_footage(shot, str(tmp_path / "a.mp4"), FootageConfig(), report)
    assert [m for m in report.warnings if "fills only 140x120 of the frame's 200x120" in m and "left and right" in m]
    covered = read_png(shot.burnt_in)[..., 0] > 0
    assert covered[:, :30].all() and covered[:, -30:].all() and not covered[:, 34:-34].any()
    assert load_frames(shot)["bars"] == {"top": 0.0, "bottom": 0.0, "left": 0.16, "right": 0.16}
