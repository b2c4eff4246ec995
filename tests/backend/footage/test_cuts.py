"""Transitions between takes, built from a real handheld clip; and false candidates: noise, darkness, blur, flashes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from torch_backend.footage.continuity import quick_features, small_grey
from torch_backend.footage.cuts import Frames, find_transitions
from torch_backend.footage.opening import open_source

ROOT = Path(__file__).resolve().parents[3]
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def clip():
    """[74, 240, 320, 3] frames of a clip at 10 frames per second with a fast-swaying camera."""
    frames = open_source(str(ROOT / "examples" / "sitting.mp4")).frames(None, None)
    return [cv2.resize(f.pixels, (320, 240), interpolation=cv2.INTER_AREA) for f in frames]


@pytest.fixture(scope="module")
def second_clip():
    """Frames of a pan over another scene, with blobs of all sizes."""
    noise = sum(cv2.resize(RNG.random((n, 2 * n, 3)), (640, 240), interpolation=cv2.INTER_CUBIC) for n in (12, 30, 60))
    strip = np.clip((noise - 0.6) * 280, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(strip[:, 3 * i : 3 * i + 320]) for i in range(40)]


def mix(a, b, share):
    return np.clip(a * (1.0 - share) + b * share, 0, 255).astype(np.uint8)


def found(frames):
    grey = [small_grey(f) for f in frames]
    light = [float(np.log2(max((f / 255.0).mean() ** 2.2, 1e-6) / 0.18)) for f in frames]
    shown = [n for n, g in enumerate(grey) if g.std() > 1.5]
    transitions = find_transitions(Frames([quick_features(g) for g in grey], light, grey.__getitem__), shown)
    return [(one.kind, one.before, one.after) for one in transitions]


def test_hard_cuts_dark_mirrored_to_another_view_and_near_an_end(clip, second_clip):
    dark = [mix(f, f * 0, 0.94) for f in clip[10:22] + second_clip[:10]]
    assert found(dark) == [("hard cut", 11, 12)]
    mirrored = [np.ascontiguousarray(f[:, ::-1]) for f in clip[22:32]]
    assert found(clip[10:22] + mirrored) == [("hard cut", 11, 12)]
    negative = [255 - f for f in clip[22:32]]
    assert found(clip[10:22] + negative) == [("hard cut", 11, 12)]
    assert found(clip[10:12] + second_clip[:12]) == [("hard cut", 1, 2)]
    assert found(clip[:10] + second_clip[:10] + clip[30:40]) == [("hard cut", 9, 10), ("hard cut", 19, 20)]


def test_a_dissolve_a_wipe_and_a_fade_are_named_with_frames_of_one_take_on_both_sides(clip, second_clip):
    before, after = clip[:24], second_clip[:24]
    sides = list(zip(before[-5:], after[:5], strict=True))  # frames 19 to 23 mix both takes
    dissolved = [mix(a, b, (i + 1) / 6) for i, (a, b) in enumerate(sides)]
    edge = np.arange(320)[None, :, None]
    wiped = [np.where(edge < 53 * (i + 1), b, a) for i, (a, b) in enumerate(sides)]
    faded = [mix(a, a * 0, (i + 1) / 5) for i, (a, _) in enumerate(sides)]
    faded += [mix(b * 0, b, i / 4) for i, (_, b) in enumerate(sides)]
    for kind, middle in (("dissolve", dissolved), ("wipe or", wiped), ("fade", faded)):
        ((name, first, last),) = found(before[:-5] + middle + after[5:])
        assert kind in name and first <= 20 and last >= 17 + len(middle) and last - first <= 24, (kind, first, last)


@pytest.mark.parametrize("case", ["plain", "dark", "noisy", "flicker", "blur", "flash", "black", "gap", "passer-by"])
def test_one_take_has_no_transition(clip, second_clip, case):
    frames = list(clip[42:74])  # part with the fastest sway
    if case == "dark":
        frames = [mix(f, f * 0, 0.95) for f in frames]
    elif case == "noisy":
        frames = [np.clip(f * 0.3 + RNG.normal(0, 14, f.shape), 0, 255).astype(np.uint8) for f in frames]
    elif case == "flicker":
        frames = [np.clip(f * RNG.uniform(0.4, 1.3), 0, 255).astype(np.uint8) for f in frames]
    elif case == "blur":
        frames = [cv2.blur(f, (25, 1)) for f in frames]
    elif case == "flash":
        frames[9:11] = [mix(f, np.full_like(f, 255), 0.97) for f in frames[9:11]]
    elif case == "black":
        frames[9:12] = [f * 0 for f in frames[9:12]]
    elif case == "gap":
        del frames[20:23]
    elif case == "passer-by":
        edge = np.arange(320)[None, :, None]
        frames = [np.where(abs(edge - 20 * n + 80) < 70, second_clip[5], f) for n, f in enumerate(frames)]
    assert found(frames) == []
