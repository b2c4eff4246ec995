"""A zooming lens is distinguished from a moving camera by points at different depths."""

import numpy as np
import pytest

from torch_backend.cameras.poses import quat_to_rotation
from torch_backend.lens.zoom import ZOOM, focal_change, zoom_words
from torch_backend.sfm.verdict import quality_words

FOCAL = 500.0


def frame(change: float, seed: int = 0, noise_px: float = 0.3, depths: tuple[float, float] = (2.0, 6.0)):
    """(seen, points, pose) of a frame whose focal length is exp(`change`) times the solve's.

    The pose has small errors and is nearer to the scene, as in a solve that assumes no zoom.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (300, 2)), rng.uniform(*depths, 300)])
    rotation, shift = quat_to_rotation(np.array([1.0, 0.025, -0.05, 0.01])), np.array([0.1, -0.05, 0.2])
    at = points @ rotation.T + shift
    seen = np.exp(change) * at[:, :2] / at[:, 2:] + rng.normal(0.0, noise_px / FOCAL, (300, 2))
    wrong_pose = np.column_stack(
        [quat_to_rotation(np.array([1.0, 0.002, 0.0015, 0.0])) @ rotation, shift - [0.0, 0.0, 2.0 * change]]
    )
    return seen, points, wrong_pose


@pytest.mark.parametrize("change", [0.0, 0.05, 0.3, -0.2])
def test_the_focal_length_of_a_frame_is_found_from_a_pose_that_makes_up_for_it(change):
    assert focal_change(*frame(change), FOCAL) == pytest.approx(change, abs=0.15 * ZOOM)


def test_outliers_do_not_move_it_and_few_points_tell_nothing():
    seen, points, pose = frame(0.1)
    seen[:40] += 0.2
    assert focal_change(seen, points, pose, FOCAL) == pytest.approx(0.1, abs=0.25 * ZOOM)
    assert np.isnan(focal_change(seen[:20], points[:20], pose, FOCAL))


def test_a_wall_seen_head_on_tells_nothing():
    assert np.isnan(focal_change(*frame(0.0, noise_px=1.0, depths=(4.0, 4.0001)), FOCAL))


def test_a_zoom_is_said_with_the_frames_that_do_without_and_a_lens_that_stays_is_not():
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 0.0015, 60)
    still = {1001 + n: float(noise[n]) for n in range(60)}
    assert zoom_words(still) is None
    assert zoom_words({**still, 1030: 0.2}) is None, "one odd frame is no zoom"
    zoomed = {frame: change + 0.01 * max(0, frame - 1031) for frame, change in still.items()}
    words = zoom_words(zoomed)
    assert words is not None and "1001 to 103" in words[1]
    assert zoom_words({1: 0.0, 2: 1.0}) is None, "too few frames to tell"
    assert quality_words(60, 60, 0.3, misled=True).startswith("Poor")
