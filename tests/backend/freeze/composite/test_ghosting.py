"""Ghosts: what splats show, on a wall that plate t* sees, of a board that was before it at the frame's own time."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.backend.freeze.composite.test_compositor import H, W, build, off, widened
from torch_backend.footage.images import read_png, write_png
from torch_backend.freeze.composite.compositor import DetailConfig, Detailer
from torch_backend.freeze.frozen import freeze_at, render_frozen

SHARP = DetailConfig(depth_error=0.01)
"""Surfaces of these worlds are where they are."""
BELIEVED = replace(SHARP, ghost=9.0)
"""No ghost is one."""
POSE, T_STAR = 3, 8


@pytest.fixture(scope="module")
def world(tmp_path_factory, quiet):
    return build(tmp_path_factory.mktemp("board"), quiet())


@pytest.fixture(scope="module")
def passed(world):
    """bool [H, W]: wall at t*, with a margin, that the board hides in the frame's own plate."""
    frozen, own = world.truth(world.output(POSE, T_STAR))[1], world.seen_at(POSE)[1]
    return ~widened(frozen | ~own, 8)


def delivered(world, config, share, changed=lambda plates: plates, nearer=None):
    """(frame, truth [H, W, 3]): splats show so much of the board where it was at the frame's own time.

    And they are a quarter nearer where `nearer`, bool [H, W], says so.
    """
    output = world.output(POSE, T_STAR)
    truth, there = world.truth(output)
    own, on = world.seen_at(POSE)
    frozen = freeze_at(world.run.model, world.scene.time_of_frame(T_STAR), 1.0)
    image = render_frozen(frozen, output.viewmat, output.K, W, H)
    where = torch.from_numpy(on & ~there)
    image.color[where] = torch.lerp(image.color, torch.from_numpy(own).float(), share)[where]
    if nearer is not None:
        image.depth[torch.from_numpy(nearer)] *= 0.75
    made = Detailer(world.run, world.scene, changed(world.plates()), config).frame(output, frozen, image, W, H)
    return made, truth


def test_what_the_splats_keep_of_a_board_that_went_by_is_the_wall_of_plate_t_star(world, passed):
    (mended, truth), (haunted, _) = (delivered(world, config, 0.5) for config in (SHARP, BELIEVED))
    assert off(haunted.color, truth, passed) > 0.08, "what is missed in other plates does not know of it"
    assert off(mended.color, truth, passed) < 0.2 * off(haunted.color, truth, passed)
    assert (mended.source.numpy()[passed] == T_STAR).mean() > 0.9
    beyond = ~widened(world.seen_at(POSE)[1] | world.truth(world.output(POSE, T_STAR))[1], 12)
    assert torch.equal(mended.color[torch.from_numpy(beyond)], haunted.color[torch.from_numpy(beyond)])


def test_a_ghost_whose_depth_is_wrong_in_a_bar_is_mended_there_too(world, passed):
    bar = passed.copy()
    bar[[y for y in range(H) if not 90 <= y < 93]] = False
    assert bar.sum() > 100
    made, truth = delivered(world, SHARP, 0.5, nearer=bar)
    haunted, _ = delivered(world, BELIEVED, 0.5, nearer=bar)
    assert off(made.color, truth, bar) < 0.25 * off(haunted.color, truth, bar)
    assert (made.source.numpy()[bar] == T_STAR).mean() > 0.9


def test_a_shine_is_all_that_the_leading_plate_shows_and_stays(world):
    """A highlight moves with the camera: plate t* lacks it, and splats have it as the frame's own plate does."""
    (shining, _), (believed, _) = (delivered(world, config, 1.0) for config in (SHARP, BELIEVED))
    assert torch.equal(shining.color, believed.color)


def test_from_far_aside_splats_stay(world):
    aside = replace(SHARP, beside=(1.0, 2.0))
    (far, _), (believed, _) = (delivered(world, config, 0.5) for config in (aside, replace(aside, ghost=9.0)))
    assert torch.equal(far.color, believed.color), "from three degrees aside plate t* is not asked"


class Darker:
    """Plates of which that of t* is darker, and no exposure knows of it: a cloud, a sheen."""

    def __init__(self, plates, by):
        self._plates, self._by = plates, by

    def __getattr__(self, name):
        return getattr(self._plates, name)

    def display(self, frame):
        picture = self._plates.display(frame)
        return picture - self._by if frame == T_STAR else picture


def test_light_that_falls_otherwise_leaves_no_seam(tmp_path, quiet, passed):
    world = build(tmp_path, quiet())
    working = world.shot.frames / f"{T_STAR:06d}.png"
    picture = read_png(working)
    write_png(working, picture - picture.dtype.type(0.05 * np.iinfo(picture.dtype).max))
    alone = replace(SHARP, instant=False)  # what is darker is nothing that the model lacks
    made, truth = delivered(world, alone, 0.5, lambda plates: Darker(plates, 0.05))
    assert (made.source.numpy()[passed] == T_STAR).mean() > 0.9
    apart = made.color.numpy()[passed].mean(0) - truth[passed].mean(0)
    assert np.abs(apart).max() < 0.01
