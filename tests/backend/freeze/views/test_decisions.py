"""Decisions that do not hang on the last bit: no pixel of a frozen frame jumps by 1, wherever a threshold lies."""

from dataclasses import replace

import pytest
import torch

from torch_backend.footage.plates import Plates
from torch_backend.freeze.composite.compositor import DetailConfig, Detailer
from torch_backend.freeze.frozen import OutputFrame, freeze_at, render_frozen, span_of
from torch_backend.freeze.views.decisions import LEVELS, above, by_levels, first_best, first_least
from torch_backend.freeze.views.regions import closed, enclosed, grown, larger
from torch_backend.scene import load_scene
from torch_backend.train import load_run

JUMP = 1.0 / LEVELS + 0.02
"""A region that comes or goes at one level of a mask, and a rounding."""


def test_a_threshold_is_a_ramp_around_it():
    value = torch.tensor([0.0, 0.44, 0.475, 0.5, 0.525, 0.56, 9.0])
    torch.testing.assert_close(above(value, 0.5), torch.tensor([0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0]))
    torch.testing.assert_close(above(value, torch.full((7,), 0.5)), above(value, 0.5))
    assert float(above(0.0, 0.0)) == 0.5, "no threshold, and no division by it"


def test_a_mask_of_which_every_region_stays_is_unchanged():
    mask = torch.rand(20, 30, generator=torch.Generator().manual_seed(0))
    mask[:4], mask[4:8] = 0.0, 1.0
    torch.testing.assert_close(by_levels(mask, lambda within: within.float()), mask)
    assert torch.equal(by_levels(mask, lambda within: within.float())[:8], mask[:8])
    assert not by_levels(mask, lambda within: torch.zeros(20, 30)).any()


@pytest.mark.parametrize(
    "operator",
    [
        lambda mask: larger(mask, 60.0),
        lambda mask: closed(mask, 3),
        lambda mask: grown(all_but(mask, 12), mask, 20, 1),
        lambda mask: enclosed(mask, torch.ones_like(mask), 2, 0.9, 20.0),
    ],
)
def test_a_pixel_that_changes_a_little_changes_regions_a_little(operator):
    """Two squares and a bridge of one pixel, as soft as it may be: at 0.5 a bool mask would break there."""
    for level in (0.05, 0.25, 0.5, 0.75, 0.95):
        masks = torch.zeros(2, 24, 40)
        masks[:, 8:16, 4:18] = masks[:, 8:16, 20:34] = 1.0
        masks[0, 10:14, 18:20], masks[1, 10:14, 18:20] = level - 1e-6, level + 1e-6
        before, after = (operator(mask) for mask in masks)
        assert float((before - after).abs().max()) <= JUMP


def all_but(mask, column):
    seeds = mask.clone()
    seeds[:, column:] = 0.0
    return seeds


def test_of_choices_that_are_equally_good_the_first_is_taken():
    values = torch.tensor([[1.0, 0.2], [1.0 + 1e-6, 0.5], [0.9, 0.5 - 1e-6]])
    assert first_best(values).tolist() == [0, 1]
    assert first_least([3.0, 1.0 + 1e-6, 1.0], 0.0) == 1 and first_least([1e-7, 0.0], 1e-5) == 0


@pytest.fixture(scope="module")
def frame(trained):
    """frame(settings, by): [H, W, 5] colour, support and motion at a pose aside, with other numbers of the detail, and
    Gaussians off by a share `by`."""
    world, _ = trained
    run, scene, plates = load_run(world.shot, "main", torch.device("cpu")), load_scene(world.shot), Plates(world.shot)
    detailer, (pose, t_star) = Detailer(run, scene, plates), (113, 106)
    size, i = (plates.width, plates.height), scene.frames.index(pose)
    output = OutputFrame(pose, scene.viewmats[i], scene.camera_at(*size)[i], float(t_star), float(pose))

    def made(settings, by=0.0):
        detailer.config = replace(DetailConfig(), **settings)
        frozen = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run))
        noise = torch.Generator().manual_seed(3)
        for name, value in frozen.state.items():
            frozen.state[name] = value * (1.0 + by * (2.0 * torch.rand(value.shape, generator=noise) - 1.0))
        exposed_at = scene.time_of_frame(pose)
        image = render_frozen(frozen, output.viewmat, output.K, *size, run.model.exposure, exposed_at)
        out = detailer.frame(output, frozen, image, *size)
        return torch.cat([out.linear, out.support[..., None], out.motion[..., None]], dim=-1)

    return made


@pytest.mark.parametrize("name", ["borne_out", "travel", "carried", "torn"])
def test_wherever_a_threshold_lies_no_pixel_jumps_for_a_rounding(frame, name):
    """Looks for the threshold at which a frame changes most: between two that differ by a millionth it is little."""
    usual = getattr(DetailConfig(), name)
    low, high = 0.5 * usual, 2.0 * usual
    below, over = frame({name: low}), frame({name: high})
    assert name == "torn" or float((below - over).abs().max()) > 2.0 * JUMP, "else there is nothing to find"
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        between = frame({name: middle})
        if (below - between).abs().max() >= (between - over).abs().max():
            high, over = middle, between
        else:
            low, below = middle, between
    assert float((below - over).abs().max()) < JUMP


def test_rounding_errors_of_the_scene_stay_rounding_errors(frame):
    assert float((frame({}) - frame({}, 1e-6)).abs().max()) < 0.02
