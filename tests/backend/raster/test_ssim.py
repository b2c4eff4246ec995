"""The compiled SSIM implementations, compared with the same formulas in float64 torch and autograd."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torch_backend.raster import ssim as cpu
from torch_backend.raster import ssim_cuda
from torch_backend.raster.ssim import ssim
from torch_backend.train import losses


def reference(x, y):
    """Mean SSIM of float64 [H, W, C] by convolution; windows are cut at the border and renormalised."""
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
    """A smooth target and a noisy image that partly leaves [0, 1], as renders do."""
    g = torch.Generator().manual_seed(height * 1000 + width * 10 + channels)
    coarse = torch.rand(1, channels, 3, 4, generator=g)
    target = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=True)
    target = target[0].permute(1, 2, 0).contiguous()
    return target + noise * torch.randn(target.shape, generator=g), target


BODIES = {
    "cpu": (cpu.ssim, cpu.photometric, "cpu"),
    "torch": (losses.ssim, losses.photometric, "cpu"),
    "fibers": (ssim_cuda.ssim, ssim_cuda.photometric, "cpu"),
    "gpu": (ssim_cuda.ssim, ssim_cuda.photometric, "cuda"),
}
"""Map from implementation to (SSIM, loss, device). `fibers` runs the CUDA kernel on Warp's cpu device."""
on_every_body = pytest.mark.parametrize(
    "body",
    [
        "cpu",
        "torch",
        "fibers",
        pytest.param("gpu", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
    ],
)


@on_every_body
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("height", "width"), [(11, 11), (17, 23), (13, 640), (640, 13)])
def test_value_and_gradient_match_float64(body, height, width, channels):
    image, target = pair(height, width, channels)
    score, _, device = BODIES[body]
    x, x64 = image.to(device, copy=True).requires_grad_(), image.double().requires_grad_()
    value, expected = score(x, target.to(device)), reference(x64, target.double())
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (got,) = torch.autograd.grad(3.0 * value, x)
    (want,) = torch.autograd.grad(3.0 * expected, x64)
    assert float((got.cpu() - want).norm() / want.norm()) <= 1e-5


@on_every_body
@pytest.mark.parametrize("hides", [False, True])
@pytest.mark.parametrize(("height", "width"), [(11, 11), (13, 640), (640, 13)])
def test_the_loss_and_its_gradient_match_float64(body, height, width, hides):
    image, target = pair(height, width, 3)
    image[3, 4] = target[3, 4]  # here the slope of |x - y| is 0
    generator = torch.Generator().manual_seed(6)
    ignored = torch.rand(height, width, generator=generator) > 0.8 if hides else None
    _, loss, device = BODIES[body]
    x, x64 = image.to(device, copy=True).requires_grad_(), image.double().requires_grad_()
    value = loss(x, target.to(device), 0.2, None if ignored is None else ignored.to(device))
    expected = losses.photometric(x64, target.double(), 0.2, ignored)
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (got,) = torch.autograd.grad(3.0 * value, x)
    (want,) = torch.autograd.grad(3.0 * expected, x64)
    assert float((got.cpu() - want).norm() / want.norm()) <= 1e-5
    assert ignored is None or not got.cpu()[ignored].any()


def test_torch_in_float64_is_the_reference():
    image, target = (one.double() for one in pair(17, 23, 3))
    image.requires_grad_()
    value, expected = losses.ssim(image, target), reference(image, target)
    assert abs(float((value - expected).detach())) < 1e-12
    (got,), (want,) = torch.autograd.grad(value, image), torch.autograd.grad(expected, image)
    assert float((got - want).norm() / want.norm()) < 1e-10


def test_torch_path_stays_on_the_images_device():
    image = torch.zeros(12, 13, 3, device="meta", requires_grad=True)
    value = losses.ssim(image, torch.zeros(12, 13, 3, device="meta"))
    value.backward()
    assert value.device.type == image.grad.device.type == "meta"


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
        again, second = run(threads)
        assert torch.equal(value, again)
        assert torch.equal(gradient, second)


def test_callers_in_several_threads_do_not_mix():
    pairs = [pair(40 + 3 * i, 50, 3) for i in range(4)]
    single = [ssim(x, y, 2) for x, y in pairs]
    with ThreadPoolExecutor(len(pairs)) as pool:
        together = list(pool.map(lambda pair: [ssim(*pair, 2) for _ in range(5)], pairs))
    assert all(torch.equal(a, b) for a, several in zip(single, together) for b in several)


def test_sizes_may_alternate():
    """Scratch memory is reused between calls; data of an earlier size must not affect the next."""
    first, second = pair(48, 64, 3), pair(21, 30, 1)
    before = ssim(*first), ssim(*second)
    assert torch.equal(ssim(*first), before[0])
    assert torch.equal(ssim(*second), before[1])


def test_strided_images():
    image, target = pair(24, 31, 3)
    strided = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided.is_contiguous()
    assert torch.equal(ssim(strided, target), ssim(image, target))


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
