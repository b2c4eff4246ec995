"""The transfer on tensors is that of files, far beyond white and below black."""

import numpy as np
import torch

from torch_backend.footage.color import linear_to_srgb, srgb_to_linear
from torch_backend.freeze.transfer import to_display, to_linear

VALUES = np.concatenate([np.linspace(-0.2, 1.2, 2801), np.geomspace(1.2, 60.0, 400), [0.0, 0.04045, 0.0031308]])


def test_both_ways_are_those_of_files():
    for value in (VALUES, -VALUES):
        x = value.astype(np.float32)
        np.testing.assert_allclose(to_linear(torch.from_numpy(x)), srgb_to_linear(x), rtol=2e-6, atol=1e-9)
        np.testing.assert_allclose(to_display(torch.from_numpy(x)), linear_to_srgb(x), rtol=2e-6, atol=1e-7)


def test_the_curve_is_that_of_the_standard():
    straight = np.abs(VALUES) <= 0.04045
    want = np.sign(VALUES) * np.where(straight, np.abs(VALUES) / 12.92, ((np.abs(VALUES) + 0.055) / 1.055) ** 2.4)
    found = to_linear(torch.from_numpy(VALUES).float())
    np.testing.assert_allclose(found, want, rtol=2e-6, atol=1e-8)
    np.testing.assert_allclose(to_display(found), VALUES, rtol=3e-6, atol=1e-7)
    assert to_linear(torch.tensor([0.0, 1.0])).tolist() == [0.0, 1.0]
