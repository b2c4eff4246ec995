"""A head that turned between two frames, which no matte says: each plate shows it one way or the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from torch_backend.freeze.frozen import ALWAYS, Turned, freeze_at, render_frozen
from torch_backend.freeze.turned import turned
from torch_backend.gaussians.model import SH_C0

from . import test_detail as plates
from .test_missing_layer import ARM, FRAMES, T_STAR, H, W, sheet, stops_when_asked, together, wall, where, world

FACE, HAIR = (0.9, 0.6, 0.5), (0.25, 0.15, 0.12)


def head(share):
    """A head of which so much is face."""
    colour = torch.tensor(FACE) * share + torch.tensor(HAIR) * (1.0 - share)
    return sheet((-0.2, 0.2), (-0.25, 0.25), ARM, 0.02, lambda x, y: colour.expand(len(x), 3))


def clip(folder, share):
    """A wall and a head, `share(n)` of which is face in frame n; the model has its mean."""
    mean = float(np.mean([share(n) for n in range(1, FRAMES + 1)]))
    return world(folder, together(wall(), head(mean)), lambda n: together(wall(), head(share(n))))


def still(n):
    return np.zeros((H, W), np.uint8)


def found(made, mattes=still, **options):
    return turned(made.run, made.scene, made.frozen, T_STAR, mattes, **options)


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    return clip(tmp_path_factory.mktemp("before"), lambda n: float(n < 5))


def test_it_is_known_from_when_on_plates_show_what_plate_t_star_shows(before):
    made = found(before)
    assert made is not None
    truth = where(before, head(0.0))
    first = made.first.numpy()
    assert (first[truth] == 5).mean() > 0.7 and set(np.unique(first)) <= {0, 5, 6}, "at its rim a frame later"
    assert (first[~binary_dilation(truth, np.ones((5, 5)))] == 0).all()
    assert (made.last == ALWAYS).all()
    assert made.otherwise(4).any() and not made.otherwise(6).any() and not made.otherwise(FRAMES).any()


def test_and_until_when_though_it_turns_back_later(tmp_path, before):
    made = found(clip(tmp_path, lambda n: float(n < 5 or n > 9)))
    assert made is not None
    at = torch.from_numpy(binary_erosion(where(before, head(0.0)), np.ones((5, 5))))
    assert float(made.first[at].float().median()) == 5 and float(made.last[at].double().median()) == 9


@pytest.mark.parametrize(
    "share",
    [lambda n: 0.0, lambda n: (n - 1) / (FRAMES - 1), lambda n: float(n == 3), lambda n: float(n == T_STAR)],
    ids=["never", "by and by", "in one plate", "in plate t* alone"],
)
def test_nothing_else_is_taken_for_it(tmp_path, share):
    assert found(clip(tmp_path, share)) is None


def test_what_mattes_call_moving_is_left_to_them(before):
    once = lambda n: (255 * where(before, head(0.0), n) * (n == 4)).astype(np.uint8)  # noqa: E731
    assert found(before, once) is None
    assert found(before, lambda n: None) is None, "without mattes nobody knows"


def test_it_can_be_cancelled_between_plates(before):
    assert stops_when_asked(lambda check: found(before, check=check))


# -------------------------------------------------------------------------------------------------- in frozen frames

PATCH = 0.5
"""Half the side of a patch on the wall, scene units, that is darker in the first frames."""
DARKER = 0.3


def on_patch(viewmat):
    """[H, W] where a camera sees the patch."""
    y, x = np.mgrid[: plates.H, : plates.W] + 0.5
    at = -np.asarray(viewmat, np.float64)[:3, 3]
    across, down = (
        c + (pixel - size / 2) / plates.FOCAL * (plates.WALL - at[2])
        for c, pixel, size in zip(at[:2], (x, y), (plates.W, plates.H), strict=True)
    )
    return (abs(across) < PATCH) & (abs(down) < PATCH)


@pytest.fixture(scope="module")
def patched(tmp_path_factory, quiet):
    """A still wall with a patch that is darker in frames 1 to 4: the model has the mean of both."""
    viewmats = plates.path()

    def drawn(picture, n):
        return np.where((on_patch(viewmats[n - 1]) & (n < 5))[..., None], picture - DARKER, picture)

    made = plates.build(tmp_path_factory.mktemp("patch"), quiet(), still=True, drawn=drawn)
    params = made.run.model.gaussians.params
    on = (params["means"][:, :2].abs() < PATCH).all(1)
    params["sh0"].data[on] -= 0.5 * DARKER / SH_C0
    return made


def made_of(world, output, known):
    """The frame; `known`: it is known what was otherwise."""
    frozen = freeze_at(world.run.model, world.scene.time_of_frame(output.t_star), 1.0)
    if known:
        at = torch.from_numpy(on_patch(world.scene.viewmats[int(output.t_star) - 1])[::2, ::2])
        frozen = replace(
            frozen, turned=Turned(torch.where(at, 5, 0).int(), torch.full(at.shape, ALWAYS, dtype=torch.int32))
        )
    at = world.scene.time_of_frame(output.exposed_like)
    image = render_frozen(frozen, output.viewmat, output.K, plates.W, plates.H, world.run.model.exposure, at)
    return world.detailer().frame(output, frozen, image, plates.W, plates.H)


def test_a_frame_shows_it_as_plate_t_star_does(patched):
    output = patched.output(2, 8)
    without, shown = (made_of(patched, output, known) for known in (False, True))
    truth, _ = patched.truth(output)
    inner = ~binary_dilation(~on_patch(output.viewmat), np.ones((9, 9)))
    assert inner.sum() > 1000
    assert plates.off(without.color, truth, inner) > 0.9 * DARKER, "its own plate stays where nothing says otherwise"
    assert plates.off(shown.color, truth, inner) < 0.1 * DARKER
    assert (shown.source.numpy()[inner] > 4).all() and (shown.motion.numpy()[inner] > 0.9).all()
    away = ~binary_dilation(on_patch(output.viewmat), np.ones((41, 41)))
    assert torch.equal(shown.linear[away], without.linear[away])


def test_so_does_a_frame_of_a_path_whose_nearest_plate_shows_it_otherwise(patched):
    output = plates.replace_pose(patched.output(2, 8), [0.0, 0.02, 0.0])
    shown = made_of(patched, output, True)
    assert shown.leading in (1, 2, 3)
    truth, _ = plates.seen(output.viewmat, 99.0)
    inner = ~binary_dilation(~on_patch(output.viewmat), np.ones((9, 9)))
    assert plates.off(shown.color, truth, inner) < 0.2 * DARKER


def test_plates_of_the_same_spell_stay_whole(patched):
    output = patched.output(6, 8)
    without, shown = (made_of(patched, output, known) for known in (False, True))
    assert torch.equal(shown.linear, without.linear)
