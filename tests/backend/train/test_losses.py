"""SSIM and PSNR against a float64 convolution and autograd."""

import pytest
import torch

from torch_backend.train.losses import photometric, psnr, ssim


def reference_ssim(x, y):
    """SSIM with the window cut at the border and renormalised, float64, by plain sums."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    kernel = (window[:, None] * window[None])[None, None]

    def blur(z):
        z = z.permute(2, 0, 1)[:, None]
        ones = torch.ones_like(z)
        total = torch.nn.functional.conv2d(z, kernel, padding=5) / torch.nn.functional.conv2d(ones, kernel, padding=5)
        return total[:, 0].permute(1, 2, 0)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean()


def test_ssim_and_gradient_match_autograd_at_float64():
    g = torch.Generator().manual_seed(0)
    x = torch.rand(17, 23, 3, dtype=torch.float64, generator=g, requires_grad=True)
    y = torch.rand(17, 23, 3, dtype=torch.float64, generator=g)
    value = ssim(x, y)
    expected = reference_ssim(x, y)
    assert abs(float(value - expected)) < 1e-12
    (got,) = torch.autograd.grad(value, x)
    (want,) = torch.autograd.grad(expected, x)
    assert float((got - want).norm() / want.norm()) < 1e-10


def test_ssim_range_is_one():
    """The published code ran SSIM with data_range 255 on [0, 1] images, which made it inert."""
    x = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1))
    noisy = (x + 0.1 * torch.randn(32, 32, 3, generator=torch.Generator().manual_seed(2))).clamp(0, 1)
    assert float(1 - ssim(noisy, x)) > 0.03
    assert float(ssim(x, x)) == pytest.approx(1.0, abs=1e-6)


def test_small_images_fall_back_to_l1():
    x, y = torch.zeros(7, 30, 3), torch.full((7, 30, 3), 0.25)
    assert float(photometric(x, y, 0.2)) == pytest.approx(0.25)
    with pytest.raises(ValueError, match="11"):
        ssim(x, y)


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
    other = torch.where(ignored[..., None], 1.0 - target, target)
    assert photometric(image, other, 0.2, ignored) == loss != photometric(image, other, 0.2)
    assert psnr(image, other, ignored) == psnr(image, target, ignored) != psnr(image, target)
