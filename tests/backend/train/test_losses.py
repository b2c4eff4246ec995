"""SSIM, PSNR and the loss; raster/test_ssim.py compares SSIM with float64."""

import pytest
import torch

from torch_backend.train.losses import photometric, psnr


def test_psnr_value():
    assert psnr(torch.full((4, 4, 3), 0.6), torch.full((4, 4, 3), 0.5)) == pytest.approx(20.0, abs=1e-4)


def test_ignored_pixels_teach_nothing_and_are_not_measured():
    g = torch.Generator().manual_seed(2)
    image = torch.rand(20, 24, 3, generator=g, requires_grad=True)
    target = torch.rand(20, 24, 3, generator=g)
    ignored = torch.zeros(20, 24, dtype=torch.bool)
    ignored[5:12, 4:15] = True
    loss = photometric(image, target, 0.2, ignored)
    loss.backward()
    assert image.grad is not None
    assert (image.grad[ignored] == 0).all() and (image.grad[~ignored] != 0).all()
    altered = torch.where(ignored[..., None], 1.0 - target, target)
    assert photometric(image, altered, 0.2, ignored) == loss != photometric(image, altered, 0.2)
    assert psnr(image, altered, ignored) == psnr(image, target, ignored) != psnr(image, target)
