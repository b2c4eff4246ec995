"""Gaussians of a part that is given: a disc of the plate before a wall, an outline that is half the wall's."""

import numpy as np
import pytest

from torch_backend.freeze.frozen import render_frozen
from torch_backend.freeze.instant_bench import InstantBench, InstantConfig
from torch_backend.freeze.layer_gaussians import Part, gaussians_of

from .test_missing_layer import ARM, T_STAR, WALL, H, W, frozen_of, together, wall, world

SKIN = np.float32([0.9, 0.55, 0.4])
ROWS, COLUMNS = np.mgrid[:H, :W].astype(np.float32)
DISC = np.clip(20.5 - np.hypot(COLUMNS - 96, ROWS - 72), 0.0, 1.0)
"""How much of each pixel the disc covers: its outline is a mixture."""


def before_the_wall(folder, cover, exposed=(0.0, 0.0)):
    """(bench, world): plate t* shows a disc before the wall that is all that the model has."""

    def drawn(picture, n):
        own = SKIN * np.exp(exposed[0]) + exposed[1]
        return picture + cover[..., None] * (own - picture)

    made = world(folder, wall(), lambda n: wall(), drawn, exposed)
    return InstantBench(made.run, made.scene, T_STAR - 1, InstantConfig(), None), made


def drawn_by(bench, made, parts):
    return gaussians_of(bench, made.frozen, bench.render(made.frozen), parts)


@pytest.mark.parametrize("exposed", [(0.0, 0.0), (-0.25, 0.05)])
def test_a_part_stands_at_its_depth_and_looks_as_the_plate_does_however_that_was_exposed(tmp_path, exposed):
    bench, made = before_the_wall(tmp_path, DISC, exposed)
    state, cover = drawn_by(bench, made, [Part(DISC, np.full_like(DISC, 1.0 / ARM), None)])
    local = state["means"] @ made.scene.viewmats[T_STAR - 1][:3, :3].T + made.scene.viewmats[T_STAR - 1][:3, 3]
    assert (local[:, 2] - ARM).abs().max() < 1e-4
    assert abs(float(cover.sum()) / DISC.sum() - 1.0) < 0.02
    image = bench.render(frozen_of(together(made.frozen.state, state)))
    inside = DISC > 0.99
    assert np.abs(image.color.numpy() - bench.view.picture)[inside].mean() < 0.02
    assert np.abs(image.depth.numpy()[inside] - ARM).max() < 0.05 * ARM
    assert np.abs(image.depth.numpy()[DISC == 0.0] - WALL).mean() < 0.1 * WALL


def test_of_an_outline_that_is_taken_for_whole_the_walls_share_is_left_to_the_wall(tmp_path):
    bench, made = before_the_wall(tmp_path, DISC)
    state, cover = drawn_by(bench, made, [Part((DISC > 0.1).astype(np.float32), np.full_like(DISC, 1.0 / ARM), None)])
    rim = (DISC > 0.15) & (DISC < 0.85)
    assert np.abs(cover - DISC)[rim].mean() < 0.12
    alone = render_frozen(frozen_of(state), made.scene.viewmats[T_STAR - 1], made.scene.Ks[0], W, H)
    seen = rim & (alone.alpha.numpy() > 0.3)
    own = alone.color.numpy()[seen] / alone.alpha.numpy()[seen][:, None]
    assert np.abs(own - SKIN).mean() < 0.06, "its colour is its own, and none of the wall's"


def test_where_two_parts_meet_the_one_that_covers_more_has_the_pixel(tmp_path):
    bench, made = before_the_wall(tmp_path, DISC)
    left, right = DISC * np.where(COLUMNS < 96, 1.0, 0.4), DISC * np.where(COLUMNS < 96, 0.4, 1.0)
    parts = [
        Part(side.astype(np.float32), np.full_like(DISC, 1.0 / z), None) for side, z in ((left, 3.0), (right, 4.0))
    ]
    state, _ = drawn_by(bench, made, parts)
    middle = W / 2
    depth = bench.render(frozen_of(together(made.frozen.state, state))).depth.numpy()
    inside = DISC > 0.99
    assert np.abs(depth[inside & (middle - 2 > COLUMNS)] - 3.0).max() < 0.15
    assert np.abs(depth[inside & (middle + 2 < COLUMNS)] - 4.0).max() < 0.2
