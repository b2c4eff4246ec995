"""Plate t*'s own pixels for what moves: where they stand in place of the splats, and where not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.backend.freeze.composite.test_compositor import H, W, build, off, widened
from torch_backend.freeze.composite.compositor import DetailConfig, Detailer
from torch_backend.freeze.composite.reference_pixels import InstantPixels
from torch_backend.freeze.composite.reference_view import bridged, continued, smooth_depth
from torch_backend.freeze.frozen import freeze_at, render_frozen
from torch_backend.freeze.views.reproject import pixel_centres

SHARP = DetailConfig(depth_error=0.01)
"""Surfaces of these worlds are where they are."""
NEVER = replace(SHARP, beside=(0.0, 0.0))
"""Plate t* is believed from its own side alone."""


@pytest.fixture(scope="module")
def world(tmp_path_factory, quiet):
    return build(tmp_path_factory.mktemp("board"), quiet())


def delivered(world, config, spoilt, pose=3, t_star=8, rough=None):
    """(frame, truth [H, W, 3], where the board is): splats of the board are as `spoilt` leaves them, seen from here,
    and as deep as `rough` does."""
    output = world.output(pose, t_star)
    truth, on = world.truth(output)
    frozen = freeze_at(world.run.model, world.scene.time_of_frame(t_star), 1.0)
    image = render_frozen(frozen, output.viewmat, output.K, W, H)
    where = torch.from_numpy(on)
    image.color[where] = spoilt(image.color)[where]
    if rough is not None:
        image.depth[where] = rough(image.depth)[where]
    made = Detailer(world.run, world.scene, world.plates(), config).frame(output, frozen, image, W, H)
    return made, truth, on


def test_splats_that_fall_apart_seen_from_elsewhere_give_way_to_the_plate_of_the_instant(world):
    """A face lets the wall through from a metre aside; where it is its depth still tells."""
    (whole, truth, on), (torn, _, _) = (delivered(world, c, lambda color: color * 0.5) for c in (SHARP, NEVER))
    inner = ~widened(~on, 8)
    assert off(torn.color, truth, inner) > 0.15, "what is missed in other plates does not know of it"
    assert off(whole.color, truth, inner) < 0.2 * off(torn.color, truth, inner)
    assert (whole.source.numpy()[inner] == 8).all() and whole.plate.numpy()[inner].min() > 0.99
    good, _, _ = delivered(world, SHARP, lambda color: color)
    assert off(good.color, truth, ~widened(on, 12)) == off(whole.color, truth, ~widened(on, 12))


def test_a_plate_that_shows_it_much_smaller_does_not_stand_for_it(world):
    """This frame sees the board no larger than plate t* does: by less than that it would be believed no more."""
    (usual, truth, on), (never, _, _) = (
        delivered(world, config, lambda color: color * 0.5) for config in (SHARP, replace(SHARP, coarser=(0.2, 0.4)))
    )
    inner = ~widened(~on, 8)
    assert off(usual.color, truth, inner) < 0.2 * off(never.color, truth, inner)


def test_a_second_nose_that_no_low_pass_sees_gives_way_as_well(world):
    """Splats of a face are double from aside: no more than that, so no region of them has fallen apart."""

    def double(color):
        return color + 0.06 * torch.sin(torch.arange(W) * 2.0)[None, :, None]

    (whole, truth, on), (residual, _, _) = (delivered(world, c, double) for c in (SHARP, NEVER))
    inner = ~widened(~on, 8)
    assert off(residual.color, truth, inner) > 0.03
    assert off(whole.color, truth, inner) < 0.5 * off(residual.color, truth, inner)
    assert (whole.source.numpy()[inner] == 8).all()


def test_a_depth_that_is_rough_holds_as_far_as_it_fetches_pixels_from_their_places(world):
    """An arm that comes towards the camera: by depth alone nearly none of it would be what plate t* shows."""

    def rough(depth):
        return depth * (1.0 + 0.07 * torch.sin(torch.arange(H) * 0.2)[:, None])

    def dark(color):
        return color * 0.5

    asked = {pixels: delivered(world, replace(SHARP, returns=pixels), dark, rough=rough) for pixels in (1e-3, 2.0)}
    (strict, truth, on), (whole, _, _) = asked.values()
    inner = ~widened(~on, 8)
    assert off(whole.color, truth, inner) < 0.5 * off(strict.color, truth, inner)
    assert (whole.source.numpy()[inner] == 8).mean() > 0.95

    def deep(depth):  # the wall behind the board
        return depth * 1.5

    far = [delivered(world, replace(SHARP, returns=pixels), dark, rough=deep)[0].color for pixels in (1e-3, 2.0)]
    assert torch.equal(*far), "what lies so far behind is another thing"


def test_along_outlines_and_from_far_aside_splats_stay(world):
    """Depth is a pixel off there, and plate t* shows what is behind."""

    def double(color):
        return color + 0.06 * torch.sin(torch.arange(W) * 2.0)[None, :, None]

    (whole, _, on), (residual, _, _) = (delivered(world, c, double) for c in (SHARP, NEVER))
    changed = np.abs(whole.color.numpy() - residual.color.numpy()).mean(-1)
    assert changed[on & widened(~on, 1)].mean() < 0.6 * changed[~widened(~on, 8)].mean()
    aside, _, _ = delivered(world, replace(SHARP, beside=(1.0, 2.0)), double)
    assert torch.equal(aside.color, residual.color), "from three degrees aside it is not asked"


def test_between_two_sides_it_is_believed_in_part(world):
    """The board of frame 3 is seen 3.6 degrees from where plate 8 saw it."""

    def dark(color):
        return color * 0.5

    shares = []
    for beside in ((0.0, 1.0), (3.0, 4.5), (4.5, 6.0)):
        made, truth, on = delivered(world, replace(SHARP, beside=beside), dark)
        shares.append(off(made.color, truth, ~widened(~on, 8)))
    assert shares[0] > 1.2 * shares[1] > 1.2 * shares[2]


def test_single_depths_are_smoothed_away_and_an_apple_of_a_small_picture_is_not():
    y, x = np.mgrid[:40, :60]
    apple = torch.from_numpy((y - 20) ** 2 + (x - 30) ** 2 < 6)  # five pixels across
    depth = torch.where(apple, 2.0, 6.0)
    depth[8, 8] = depth[20, 30] = 1.0
    small, large = (smooth_depth(SHARP, depth, unit) for unit in (0.375, 1.0))
    assert small[8, 8] == large[8, 8] == 6.0
    assert (small[19:22, 29:32] == 2.0).all() and (large == 6.0).all(), "of a large one it is a speck"


def test_a_gap_is_shown_as_around_it_unless_two_surfaces_meet_there():
    """Where depth is rough it would fetch a pixel from anywhere."""
    here, seen = pixel_centres(40, 30), torch.ones(30, 40, dtype=torch.bool)
    seen[12:16, 10:14] = seen[:, 25:28] = False
    places = here + torch.tensor([5.0, -2.0])
    places[:, 26:, 0] += 6.0
    rough = places.clone()
    rough[~seen] += 30.0 * torch.randn(int((~seen).sum()), 2, generator=torch.Generator().manual_seed(0))
    found, steady = bridged(rough, seen, 4.0, 1.5)
    assert torch.equal(found[seen], rough[seen]) and bool(steady[seen].all())
    assert bool(steady[12:16, 10:14].all()) and (found - places)[12:16, 10:14].abs().max() < 0.2
    assert not bool(steady[:, 25:28].any()), "a hand and the wall behind it"
    nothing, told = bridged(rough, torch.zeros_like(seen), 4.0, 1.5)
    assert bool(nothing.isfinite().all()) and not bool(told.any())


def test_a_soft_border_goes_on_as_the_nearest_pixel_that_is_taken():
    """A hand and a sleeve, displaced to different sides, and between them a wall that plate t* shows elsewhere."""
    here, taken = pixel_centres(40, 30), torch.zeros(30, 40, dtype=torch.bool)
    taken[5:25, 5:15] = taken[5:25, 20:35] = True
    ways = torch.tensor([[3.0, 1.0], [-4.0, 2.0], [25.0, 0.0]])
    places = here + ways[2]
    places[:, 5:15], places[:, 20:35] = here[:, 5:15] + ways[0], here[:, 20:35] + ways[1]
    places[~taken] = (here + ways[2])[~taken]
    moved = continued(places, taken, 4) - here
    torch.testing.assert_close(moved[10, 1:17], ways[0].expand(16, 2))
    torch.testing.assert_close(moved[10, 18:39], ways[1].expand(21, 2))
    torch.testing.assert_close(moved[10, 0], ways[2])
    nothing = torch.zeros_like(taken)
    assert continued(places, nothing, 4) is places


def test_between_two_surfaces_a_plate_larger_than_decisions_is_read_at_either_and_not_between():
    """Left half comes from the red end of plate t*, right half from the blue end; green lies between the two."""
    plate = torch.zeros(80, 160, 3)
    plate[:, :50, 0] = plate[:, 50:110, 1] = plate[:, 110:, 2] = 1.0
    here = pixel_centres(40, 20)
    places = here.clone()
    places[:, :20, 0], places[:, 20:, 0] = 0.4 * here[:, :20, 0], 40.0 - 0.4 * (40.0 - here[:, 20:, 0])
    none = torch.zeros(20, 40)
    made = InstantPixels(none, none, places, plate.half(), torch.ones(3), torch.zeros(3), None, 1.5)
    fine = pixel_centres(160, 80).reshape(-1, 2) / 4.0
    row = made.at(fine, torch.tensor([4.0, 4.0])).reshape(80, 160, 3)[40]
    assert row[:78, 0].min() > 0.9 and row[82:, 2].min() > 0.9
    assert row[:, 1].max() < 0.1
