"""Pixels of plate t* that the scene lacks: detection, depth, and cases that must not be changed."""

import numpy as np
import pytest
import torch

from torch_backend.freeze.frozen import FrozenImage
from torch_backend.freeze.instant.missing import missing_pixels, weighted_median
from torch_backend.freeze.views.source_views import VisibilityConfig

HEIGHT, WIDTH, WALL, ARM = 120, 160, 4.0, 2.0
DARK, SKIN = torch.tensor([0.1, 0.1, 0.12]), torch.tensor([0.8, 0.6, 0.5])
ARM_AT, HAND_AT = np.s_[60:76, 80:160], np.s_[56:80, 50:80]


def seen(*objects):
    """(picture [H, W, 3], the same as a render): a dark wall, and skin-coloured objects in front at (area, depth)."""
    picture, depth = DARK.expand(HEIGHT, WIDTH, 3).clone(), torch.full((HEIGHT, WIDTH), WALL)
    for at, deep in objects:
        picture[at], depth[at] = SKIN, deep
    ones = torch.ones(HEIGHT, WIDTH)
    return picture, FrozenImage(picture.clone(), ones, depth, ones, ones)


def missing_between(plate, scene, matte=1.0):
    matte = torch.full((HEIGHT, WIDTH), matte)
    return missing_pixels(seen(*plate)[0], seen(*scene)[1], seen()[1], matte, 1.0, VisibilityConfig())


def test_a_hand_that_the_scene_lacks_is_as_deep_as_its_arm():
    missing, inverse = missing_between([(ARM_AT, ARM), (HAND_AT, ARM)], [(ARM_AT, ARM)])
    hand = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hand[HAND_AT] = True
    assert float((missing[hand] > 0.5).float().mean()) > 0.9
    assert not bool((missing[~hand] > 0.5).any())
    torch.testing.assert_close(inverse[missing > 0.5], torch.full_like(inverse[missing > 0.5], 1.0 / ARM))


@pytest.mark.parametrize(
    ("plate", "scene", "matte"),
    [
        ([(ARM_AT, ARM), (HAND_AT, ARM)], [(ARM_AT, ARM)], 0.0),
        ([(HAND_AT, ARM)], [], 1.0),
        ([(ARM_AT, ARM)], [(ARM_AT, ARM), (HAND_AT, ARM)], 1.0),
        ([(ARM_AT, ARM), (np.s_[66:69, 76:80], ARM)], [(ARM_AT, ARM)], 1.0),
        ([(np.s_[61:77, 81:160], ARM)], [(ARM_AT, ARM)], 1.0),
    ],
    ids=["it does not move", "it hangs on nothing", "the scene has too much", "a speck", "a pixel off"],
)
def test_nothing_is_added_where(plate, scene, matte):
    assert not bool((missing_between(plate, scene, matte)[0] > 0.5).any())


def test_stray_splat_does_not_change_the_depth_of_a_hand():
    """The depth is the median over the outline, most of which belongs to the arm."""
    scene = [(ARM_AT, ARM), (np.s_[64:68, 44:48], 0.5)]
    missing, inverse = missing_between([(ARM_AT, ARM), (HAND_AT, ARM), (np.s_[64:68, 44:48], ARM)], scene)
    assert bool((inverse[missing > 0.5] - 1.0 / ARM).abs().max() < 1e-6)


def test_the_median_of_weights():
    values, weights = np.array([3.0, 1.0, 2.0], np.float32), np.array([1.0, 1.0, 5.0], np.float32)
    assert weighted_median(values, weights) == 2.0
    assert weighted_median(values, np.array([9.0, 1.0, 5.0], np.float32)) == 3.0
