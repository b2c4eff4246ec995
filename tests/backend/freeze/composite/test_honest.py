"""A moved object is removed completely, although mattes miss parts: no fragment and no outline remains."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from tests.backend.freeze.composite.test_compositor import H, W, board_at, dilate, rms_error
from torch_backend.deformation import Deformation, Deltas
from torch_backend.freeze.composite.compositor import CompositeConfig, Compositor
from torch_backend.freeze.composite.state import StateConfig, StateWeights
from torch_backend.freeze.take.frames import small_share
from torch_backend.freeze.views.source_views import VisibilityConfig

FRAME, T_STAR = 3, 11
"""The board's positions in these two frames do not overlap."""
BLIND = {"state": StateConfig(weights=StateWeights(-5.0, 10.0, 0.0, 0.0, 0.0, 0.0))}
"""`CompositeConfig` options with which only motion mattes decide the state."""


class Stays(Deformation):
    """No motion: the board stays at its position at T_STAR."""

    def forward(self, means, times, host_params=None):
        return Deltas(torch.tensor([board_at(T_STAR), 0.0, 0.0]).expand(len(means), 3))


@pytest.fixture
def board_stays(world, monkeypatch):
    """The model keeps the board at its place at T_STAR."""
    monkeypatch.setattr(world.run, "model", replace(world.run.model, field=Stays()))


def erode(mask, by):
    return ndimage.binary_erosion(mask, np.ones((2 * by + 1,) * 2))


def make(world, mattes, source_views=None, masked=None, **config):
    """Composited frame at T_STAR; `mattes` maps frames to bool [H, W] mattes that replace the correct ones.

    `masked`: bool [H, W], pixels of plate t* to ignore, or None.
    """

    def moving(frame):
        on = mattes.get(frame)
        return torch.from_numpy(world.seen_at(frame)[1] if on is None else on).float()

    settings = CompositeConfig(depth_error=0.01, source_views=source_views or VisibilityConfig(), **config)
    compositor = Compositor(world.run, world.scene, world.plates(), settings, moving)
    if masked is not None:
        at_t = torch.from_numpy(masked).float()
        compositor.source_views.ignored = lambda frame: at_t if frame == T_STAR else None
    return world.make(world.output(FRAME, T_STAR), compositor)


def stale_board_share(world, composited):
    """Fraction of pixels that look like the frame's own board, where its plate shows the board and the truth at t* does
    not."""
    (plate, on), (truth, board_at_t_star) = world.seen_at(FRAME), world.truth(world.output(FRAME, T_STAR))
    gone = on & ~dilate(board_at_t_star, 4)
    assert gone.sum() > 3000
    near = [np.abs(np.asarray(composited.color) - picture).mean(-1) for picture in (plate, truth)]
    return float((near[0] < near[1])[gone].mean())


def test_a_matte_that_ends_short_of_what_moves_leaves_nothing_of_it(world):
    """The flow misses the outer 9 pixels of the board in the frame's own plate and in the filling plates."""
    short = {frame: erode(world.seen_at(frame)[1], 9) for frame in range(1, 14) if frame != T_STAR}
    composited = make(world, short)
    assert stale_board_share(world, composited) < 0.01
    truth, board_at_t_star = world.truth(world.output(FRAME, T_STAR))
    gone = world.seen_at(FRAME)[1] & ~dilate(board_at_t_star, 4)
    error = rms_error(composited.color, truth, gone)
    assert error < min(0.01, 0.2 * rms_error(composited.splat, truth, gone)), "as sharp as its plates"
    assert stale_board_share(world, make(world, short, **BLIND)) > 0.1, "else there is nothing to mend"


def test_object_that_moved_since_t_star_is_not_shown(world):
    """Nobody moves for a second, so mattes are empty; plate t* shows the wall, and so does the frozen frame."""
    still = {frame: np.zeros((H, W), bool) for frame in range(FRAME - 2, FRAME + 3)}
    composited = make(world, still)
    assert stale_board_share(world, composited) < 0.01
    wall = ~dilate(world.seen_at(FRAME)[1] | world.truth(world.output(FRAME, T_STAR))[1], 24)
    assert (composited.matte.numpy()[wall] == 1.0).all(), "and nothing else is let go of"


@pytest.mark.usefixtures("board_stays")
def test_what_the_model_knows_at_no_time_is_not_shown_either(world):
    """As above, but the model keeps the board at its place at t*: only the difference between both plates shows the
    change."""
    still = {frame: np.zeros((H, W), bool) for frame in range(1, 14)}
    assert stale_board_share(world, make(world, still)) < 0.1


def test_what_no_matte_sees_is_let_go_of_where_the_model_knows_of_it(world):
    """At the plate's time the model shows the board where the frozen render shows the static wall."""
    none = {frame: np.zeros((H, W), bool) for frame in range(1, 14)}
    composited, without_evidence = make(world, none), make(world, none, **BLIND)
    gone = erode(world.seen_at(FRAME)[1], 6) & ~dilate(world.truth(world.output(FRAME, T_STAR))[1], 6)
    assert gone.sum() > 1000 and composited.matte.numpy()[gone].max() < 0.01
    assert without_evidence.matte.numpy()[gone].min() > 0.99, "else something else says so"
    assert stale_board_share(world, without_evidence) > 0.9, "else there is nothing to mend, here and above"


def test_plate_is_kept_where_the_model_contradicts_plate_t_star(world):
    """The model has a wrong colour in a spot of the wall at all times, which is not motion."""
    spot = world.run.model.gaussians.params["means"][:, :2]
    wrong = (spot - torch.tensor([-2.2, 1.7])).norm(dim=1) < 0.4
    colors = world.run.model.gaussians.params["sh0"]
    before = colors.detach().clone()
    try:
        with torch.no_grad():
            colors[wrong] += 1.5
        composited = make(world, {})
        shown = np.abs(
            (composited.splat - torch.from_numpy(world.truth(world.output(FRAME, T_STAR))[0]).float()).numpy()
        )
        wrong_pixels = (shown.max(-1) > 0.2) & ~dilate(world.seen_at(FRAME)[1], 24)
        wrong_pixels &= ~dilate(world.truth(world.output(FRAME, T_STAR))[1], 24)
        assert wrong_pixels.sum() > 500
        assert composited.matte.numpy()[wrong_pixels].mean() > 0.75
        error = rms_error(composited.color, world.truth(world.output(FRAME, T_STAR))[0], wrong_pixels)
        assert error < 0.01, "residuals mend the rest"
    finally:
        with torch.no_grad():
            colors.copy_(before)


@pytest.mark.usefixtures("board_stays")
def test_plates_that_fill_show_nothing_of_it_either(world):
    """Flow found the board only in the frame's own plate, and the model keeps the board at its place at t*."""
    mattes = {frame: np.zeros((H, W), bool) for frame in range(1, 14) if frame not in (FRAME, T_STAR)}
    composited = make(world, mattes, None)
    believed = make(world, mattes, VisibilityConfig(unexplained=1e6), state=StateConfig(noise=1e6))
    assert stale_board_share(world, composited) < 0.01
    assert stale_board_share(world, believed) > 0.1, "else there is nothing to mend"


def test_what_moves_and_no_plate_near_t_star_shows_is_a_guess(world):
    """The model renders these Gaussians at every time with full support, so only the plates can reveal the guess."""
    output = world.output(FRAME, T_STAR)
    board = erode(world.truth(output)[1], 6)
    wall = ~dilate(world.seen_at(FRAME)[1] | world.truth(output)[1], 24)
    seen, guessed = world.make(output), world.make(output, withheld=[n for n in range(1, 14) if n != FRAME])
    assert seen.support.numpy()[board].min() > 0.95
    assert guessed.support.numpy()[board].max() < 0.05
    for composited in (seen, guessed):
        assert composited.support.numpy()[wall].min() > 0.99
    shares = [float(small_share(composited.plate, composited.support).mean()) for composited in (seen, guessed)]
    assert shares[0] - shares[1] > 0.8 * float(torch.from_numpy(board).float().mean())
