"""Exposure: interpolation in time, premultiplied colour, and recovery of a drift."""

import pytest
import torch

from torch_backend.train.exposure import Exposure, ExposureConfig


def test_interpolates_and_holds_at_the_ends():
    exposure = Exposure(torch.tensor([0.0, 0.5, 1.0]), ExposureConfig())
    with torch.no_grad():
        exposure.values[:, 1] = torch.tensor([0.0, 0.2, 0.4])[:, None]
    for time, offset in ((0.0, 0.0), (0.25, 0.1), (0.5, 0.2), (0.9, 0.36), (1.0, 0.4), (2.0, 0.4)):
        gain, got = exposure.at(time)
        assert got.tolist() == pytest.approx([offset] * 3, abs=1e-6)
        assert gain.tolist() == [1.0] * 3


def test_premultiplied_colour_gets_its_share_of_the_offset():
    exposure = Exposure(torch.tensor([0.0, 1.0]), ExposureConfig())
    with torch.no_grad():
        exposure.values[:, 1] = 0.1
    out = exposure.apply(torch.full((1, 2, 3), 0.2), 0.0, torch.tensor([[0.5, 0.0]]))
    assert out[0, :, 0].tolist() == pytest.approx([0.25, 0.2])


def test_finds_a_drift():
    times = torch.linspace(0, 1, 9)
    exposure = Exposure(times, ExposureConfig())
    optimizer = torch.optim.Adam([exposure.values], lr=0.005)
    image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    truth = 1.0 + 0.1 * times
    for step in range(900):
        n = step % 9
        optimizer.zero_grad()
        loss = (exposure.apply(image, float(times[n])) - truth[n] * image).square().mean()
        (loss + 1e-3 * exposure.regularisation()).backward()
        optimizer.step()
    for n in (1, 4, 8):
        error = exposure.apply(image, float(times[n])).detach() - truth[n] * image
        assert float(error.abs().mean()) < 0.01


def test_exposure_by_place_equals_exposure_by_time():
    exposure, image = Exposure(torch.tensor([0.0, 0.3, 0.55, 1.0]), ExposureConfig()), torch.rand(4, 5, 3)
    with torch.no_grad():
        exposure.values.copy_(0.1 * torch.randn(exposure.values.shape))
    for time in (-0.1, 0.0, 0.21, 0.3, 0.4321, 0.9, 1.2):
        found = []
        for is_named in (False, True):
            exposure.values.grad = None
            left, right, share = exposure.place(time)
            places = torch.tensor([left, right]), torch.tensor([1.0 - share, share])
            shown = exposure.apply_at(image, *places) if is_named else exposure.apply(image, time)
            shown.square().sum().backward()
            found.append((shown.detach(), exposure.values.grad))
        assert all(torch.equal(a, b) for a, b in zip(*found, strict=True)), time
    disabled = Exposure(torch.tensor([0.0, 1.0]), ExposureConfig(on=False))
    assert disabled.apply_at(image, torch.tensor([0, 1]), torch.tensor([0.5, 0.5])) is image
