"""Display encodings of tensors equal those of files, far above white and below black."""

import numpy as np
import pytest
import torch

from torch_backend.footage.display import PLAIN, ROLLED
from torch_backend.freeze.composite.transfer import display_of, light_of, straight_to_linear, to_display, to_linear

VALUES = np.concatenate([np.linspace(-0.2, 1.2, 2801), np.geomspace(1.2, 60.0, 400), [0.0, 0.04045, 0.0031308]])


@pytest.mark.parametrize("ways", [(to_linear, to_display), (light_of, display_of)], ids=["processor", "card"])
@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_both_ways_are_those_of_files(display, ways):
    to_light, to_shown = ways
    for value in (VALUES, -VALUES):
        x = value.astype(np.float32)
        shown = display.from_light(x)
        np.testing.assert_allclose(to_light(torch.from_numpy(shown), display), display.to_light(shown), rtol=4e-6)
        np.testing.assert_allclose(to_shown(torch.from_numpy(x), display), shown, rtol=2e-6, atol=1e-7)


def test_the_curve_is_that_of_the_standard():
    straight = np.abs(VALUES) <= 0.04045
    want = np.sign(VALUES) * np.where(straight, np.abs(VALUES) / 12.92, ((np.abs(VALUES) + 0.055) / 1.055) ** 2.4)
    found = to_linear(torch.from_numpy(VALUES).float(), PLAIN)
    np.testing.assert_allclose(found, want, rtol=2e-6, atol=1e-8)
    np.testing.assert_allclose(to_display(found, PLAIN), VALUES, rtol=3e-6, atol=1e-7)
    assert to_linear(torch.tensor([0.0, 1.0]), PLAIN).tolist() == [0.0, 1.0]


@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_premultiplied_colours_are_converted_by_their_straight_colour(display):
    rng = np.random.default_rng(1)
    alpha = rng.uniform(size=(7, 131)).astype(np.float32)
    alpha[0, :40] = 0.0
    color = (rng.uniform(-0.1, 1.1, (7, 131, 3)) * alpha[..., None]).astype(np.float32)
    found = straight_to_linear(torch.from_numpy(color), torch.from_numpy(alpha), display).numpy()
    straight = np.divide(color, alpha[..., None], where=alpha[..., None] > 0.0, out=np.zeros_like(color))
    light = display.to_light(straight.clip(0.0, display.most)).astype(np.float64) * alpha[..., None]
    np.testing.assert_allclose(found[..., :3], light, rtol=4e-5 if display.bends else 3e-6, atol=1e-9)
    np.testing.assert_array_equal(found[..., 3], alpha)


@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_what_is_not_finite_stays_so(display):
    bad = torch.tensor([torch.nan, torch.inf, -torch.inf])
    assert not to_display(bad, display).isfinite().any() and not to_linear(bad[:2], display).isfinite().any()
