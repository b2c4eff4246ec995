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
    """[24, 120, 320, 3] frames of a clip at 10 frames per second, where its camera sways fastest."""
    frames = open_source(str(ROOT / "examples" / "sitting.mp4")).frames(43, 66)
    return [cv2.resize(f.pixels, (320, 240), interpolation=cv2.INTER_AREA)[60:180] for f in frames]


@pytest.fixture(scope="module")
def second_clip():
    """Frames of a pan over another scene, with blobs of all sizes."""
    noise = sum(cv2.resize(RNG.random((n, 4 * n, 3)), (640, 120), interpolation=cv2.INTER_CUBIC) for n in (6, 15, 30))
    strip = np.clip((noise - 0.6) * 280, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(strip[:, 3 * i : 3 * i + 320]) for i in range(12)]


def mix(a, b, share):
    return np.clip(a * (1.0 - share) + b * share, 0, 255).astype(np.uint8)


def found(frames):
    grey = [small_grey(f) for f in frames]
    light = [float(np.log2(max((f / 255.0).mean() ** 2.2, 1e-6) / 0.18)) for f in frames]
    shown = [n for n, g in enumerate(grey) if g.std() > 1.5]
    transitions = find_transitions(Frames([quick_features(g) for g in grey], light, grey.__getitem__), shown)
    return [(one.kind, one.before, one.after) for one in transitions]


def test_hard_cuts_dark_mirrored_negative_and_near_an_end(clip, second_clip):
    dark = [mix(f, f * 0, 0.94) for f in clip[:8] + second_clip[:8]]
    assert found(dark) == [("hard cut", 7, 8)]
    mirrored = [np.ascontiguousarray(f[:, ::-1]) for f in clip[:8]]
    negative = [255 - f for f in clip[16:]]
    assert found(mirrored + clip[8:16] + negative) == [("hard cut", 7, 8), ("hard cut", 15, 16)]
    assert found(clip[:2] + second_clip[:8] + clip[16:]) == [("hard cut", 1, 2), ("hard cut", 9, 10)]


def test_a_dissolve_a_wipe_and_a_fade_are_named_with_frames_of_one_take_on_both_sides(clip, second_clip):
    before, after = clip[:12], second_clip
    sides = list(zip(before[-5:], after[:5], strict=True))  # frames 7 to 11 mix both takes
    dissolved = [mix(a, b, (i + 1) / 6) for i, (a, b) in enumerate(sides)]
    edge = np.arange(320)[None, :, None]
    wiped = [np.where(edge < 53 * (i + 1), b, a) for i, (a, b) in enumerate(sides)]
    faded = [mix(a, a * 0, (i + 1) / 5) for i, (a, _) in enumerate(sides)]
    faded += [mix(b * 0, b, i / 4) for i, (_, b) in enumerate(sides)]
    for kind, middle in (("dissolve", dissolved), ("wipe or", wiped), ("fade", faded)):
        ((name, first, last),) = found(before[:-5] + middle + after[5:])
        assert kind in name and first <= 8 and last >= 5 + len(middle) and last - first <= 12, (kind, first, last)


@pytest.mark.parametrize("case", ["dark", "noisy", "flicker", "blur", "flash", "black", "gap", "passer-by"])
def test_one_take_has_no_transition(clip, second_clip, case):
    frames = clip[:14]
    if case == "dark":
        frames = [mix(f, f * 0, 0.95) for f in frames]
    elif case == "noisy":
        frames = [np.clip(f * 0.3 + RNG.normal(0, 14, f.shape), 0, 255).astype(np.uint8) for f in frames]
    elif case == "flicker":
        frames = [np.clip(f * RNG.uniform(0.4, 1.3), 0, 255).astype(np.uint8) for f in frames]
    elif case == "blur":
        frames = [cv2.blur(f, (25, 1)) for f in frames]
    elif case == "flash":
        frames[6:8] = [mix(f, np.full_like(f, 255), 0.97) for f in frames[6:8]]
    elif case == "black":
        frames[6:9] = [f * 0 for f in frames[6:9]]
    elif case == "gap":
        del frames[5:8]
    elif case == "passer-by":
        edge = np.arange(320)[None, :, None]
        frames = [np.where(abs(edge - 30 * n + 60) < 50, second_clip[5], f) for n, f in enumerate(frames)]
    assert found(frames) == []
