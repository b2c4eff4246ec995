"""Display encodings of tensors equal those of files, far above white and below black."""

import numpy as np
import pytest
import torch

from torch_backend.footage.display import PLAIN, ROLLED
from torch_backend.freeze.composite.transfer import to_display, to_linear

VALUES = np.concatenate([np.linspace(-0.2, 1.2, 2801), np.geomspace(1.2, 60.0, 400), [0.0, 0.04045, 0.0031308]])


@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_both_ways_are_those_of_files(display):
    for value in (VALUES, -VALUES):
        x = value.astype(np.float32)
        shown = display.from_light(x)
        np.testing.assert_allclose(to_linear(torch.from_numpy(shown), display), display.to_light(shown), rtol=4e-6)
        np.testing.assert_allclose(to_display(torch.from_numpy(x), display), shown, rtol=2e-6, atol=1e-7)


def test_the_curve_is_that_of_the_standard():
    straight = np.abs(VALUES) <= 0.04045
    want = np.sign(VALUES) * np.where(straight, np.abs(VALUES) / 12.92, ((np.abs(VALUES) + 0.055) / 1.055) ** 2.4)
    found = to_linear(torch.from_numpy(VALUES).float(), PLAIN)
    np.testing.assert_allclose(found, want, rtol=2e-6, atol=1e-8)
    np.testing.assert_allclose(to_display(found, PLAIN), VALUES, rtol=3e-6, atol=1e-7)
    assert to_linear(torch.tensor([0.0, 1.0]), PLAIN).tolist() == [0.0, 1.0]
