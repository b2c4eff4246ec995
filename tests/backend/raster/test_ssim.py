"""The compiled SSIM against the same formulas in float64 torch, differentiated by autograd."""

import threading

import pytest
import torch

from torch_backend.raster.ssim import photometric, ssim
from torch_backend.train import losses


def reference(x, y):
    """Mean SSIM of float64 [H, W, C]: windows cut at the border and renormalised, by convolution and autograd."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    kernel = (window[:, None] * window[None])[None, None]
    inside = torch.nn.functional.conv2d(torch.ones(1, 1, *x.shape[:2], dtype=torch.float64), kernel, padding=5)

    def blur(z):
        return (torch.nn.functional.conv2d(z.permute(2, 0, 1)[:, None], kernel, padding=5) / inside)[:, 0]

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return ((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()


def pair(height, width, channels, noise=0.1):
    """A smooth target and a noisy image that leaves [0, 1] here and there, as renders do."""
    g = torch.Generator().manual_seed(height * 1000 + width * 10 + channels)
    coarse = torch.rand(1, channels, 3, 4, generator=g)
    target = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=True)
    target = target[0].permute(1, 2, 0).contiguous()
    return target + noise * torch.randn(target.shape, generator=g), target


SIZES = [(11, 11), (17, 23), (13, 640), (640, 13), (48, 64)]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient_match_float64(height, width, channels):
    image, target = pair(height, width, channels)
    x, x64 = image.clone().requires_grad_(), image.double().requires_grad_()
    value, expected = ssim(x, target), reference(x64, target.double())
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (got,) = torch.autograd.grad(3.0 * value, x)
    (want,) = torch.autograd.grad(3.0 * expected, x64)
    assert float((got - want).norm() / want.norm()) <= 1e-5


@pytest.mark.parametrize("hides", [False, True])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_the_loss_and_its_gradient_match_float64(height, width, hides):
    image, target = pair(height, width, 3)
    image[3, 4] = target[3, 4]  # the slope of |x - y| is 0 there
    generator = torch.Generator().manual_seed(6)
    ignored = torch.rand(height, width, generator=generator) > 0.8 if hides else None
    x, x64 = image.clone().requires_grad_(), image.double().requires_grad_()
    value, expected = photometric(x, target, 0.2, ignored), losses.photometric(x64, target.double(), 0.2, ignored)
    assert float(losses.photometric(image, target, 0.2, ignored)) == float(value.detach())
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (got,) = torch.autograd.grad(3.0 * value, x)
    (want,) = torch.autograd.grad(3.0 * expected, x64)
    assert float((got - want).norm() / want.norm()) <= 1e-5
    assert ignored is None or not got[ignored].any()


def test_torch_path_agrees():
    """`losses.ssim` runs float32 compiled and float64 in torch: one function."""
    image, target = pair(37, 53, 3)
    x, x64 = image.clone().requires_grad_(), image.double().requires_grad_()
    value, value64 = losses.ssim(x, target), losses.ssim(x64, target.double())
    assert float(value.detach()) == pytest.approx(float(value64.detach()), rel=1e-6)
    value.backward()
    value64.backward()
    assert float((x.grad - x64.grad).norm() / x64.grad.norm()) <= 1e-5


def test_torch_path_stays_on_the_images_device():
    image = torch.zeros(12, 13, 3, device="meta", requires_grad=True)
    value = losses.ssim(image, torch.zeros(12, 13, 3, device="meta"))
    value.backward()
    assert value.device.type == image.grad.device.type == "meta"


def test_torch_path_passes_gradcheck():
    image, target = pair(12, 13, 1)
    x = image.double().requires_grad_()
    assert torch.autograd.gradcheck(losses.ssim, (x, target.double()))


@pytest.mark.parametrize(("height", "width"), [(17, 23), (75, 101)])
def test_any_number_of_threads_gives_the_same_bits(height, width):
    image, target = pair(height, width, 3)

    def run(threads):
        x = image.clone().requires_grad_()
        value = ssim(x, target, threads)
        value.backward()
        return value.detach(), x.grad

    value, gradient = run(1)
    for threads in (2, 3, 8):
        again, other = run(threads)
        assert torch.equal(value, again)
        assert torch.equal(gradient, other)


def test_callers_in_several_threads_do_not_mix():
    pairs = [pair(40 + 3 * i, 50, 3) for i in range(4)]
    alone = [ssim(x, y, 2) for x, y in pairs]
    together: list[torch.Tensor | None] = [None] * len(pairs)

    def work(i):
        for _ in range(5):
            together[i] = ssim(*pairs[i], 2)

    workers = [threading.Thread(target=work, args=(i,)) for i in range(len(pairs))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert all(torch.equal(a, b) for a, b in zip(alone, together))


def test_sizes_may_alternate():
    """Scratch is reused between calls; what an earlier size left must not leak into the next."""
    first, second = pair(48, 64, 3), pair(21, 30, 1)
    before = ssim(*first), ssim(*second)
    assert torch.equal(ssim(*first), before[0])
    assert torch.equal(ssim(*second), before[1])


def test_strided_images():
    image, target = pair(24, 31, 3)
    apart = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not apart.is_contiguous()
    assert torch.equal(ssim(apart, target), ssim(image, target))


def test_equal_images_score_one_with_no_gradient():
    _, target = pair(20, 40, 3)
    x = target.clone().requires_grad_()
    value = ssim(x, target)
    value.backward()
    assert float(value.detach()) == pytest.approx(1.0, abs=1e-6)
    assert float(x.grad.abs().max()) < 1e-7


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="11"):
        ssim(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3))
    with pytest.raises(ValueError, match="11"):
        ssim(torch.zeros(30, 10, 3), torch.zeros(30, 10, 3))
    with pytest.raises(ValueError, match="one shape"):
        ssim(torch.zeros(30, 20, 3), torch.zeros(20, 30, 3))
    with pytest.raises(ValueError, match="float64"):
        ssim(torch.zeros(20, 20, 3, dtype=torch.float64), torch.zeros(20, 20, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="threads"):
        ssim(torch.zeros(20, 20, 3), torch.zeros(20, 20, 3), 0)
