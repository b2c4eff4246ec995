"""The GPU's SSIM kernel, alone and in the loss, against float64: on Warp's cpu device everywhere, on a GPU if there is
one."""

import pytest
import torch

from torch_backend.native import initialised_warp
from torch_backend.raster import ssim as ssim_cpu
from torch_backend.raster import ssim_cuda
from torch_backend.train import adam, losses

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


def pair(height, width, channels):
    g = torch.Generator().manual_seed(height * 1000 + width * 10 + channels)
    coarse = torch.rand(1, channels, 3, 4, generator=g)
    target = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=True)
    target = target[0].permute(1, 2, 0).contiguous()
    return target + 0.1 * torch.randn(target.shape, generator=g), target


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("height", "width", "channels"), [(11, 11, 1), (17, 23, 3), (13, 200, 3), (90, 12, 2)])
def test_value_and_gradient_match_float64(device, height, width, channels):
    image, target = pair(height, width, channels)
    x, x64 = image.to(device).requires_grad_(), image.double().requires_grad_()
    value, expected = ssim_cuda.ssim(x, target.to(device)), losses.ssim(x64, target.double())
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (got,) = torch.autograd.grad(3.0 * value, x)
    (want,) = torch.autograd.grad(3.0 * expected, x64)
    assert float((got.cpu() - want).norm() / want.norm()) <= 1e-5


def test_value_without_gradient_is_that_of_the_cpu_body():
    image, target = pair(40, 31, 3)
    assert float(ssim_cuda.ssim(image, target)) == pytest.approx(float(ssim_cpu.ssim(image, target)), rel=1e-6)


def test_strided_images_are_taken():
    image, target = pair(20, 30, 3)
    wide = torch.zeros(20, 60, 3)
    wide[:, ::2] = image
    assert float(ssim_cuda.ssim(wide[:, ::2], target)) == float(ssim_cuda.ssim(image, target))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("hides", [False, True])
def test_the_loss_and_its_gradient_match_float64(device, hides):
    image, target = pair(37, 23, 3)
    image[3, 4] = target[3, 4]  # the slope of |x - y| is 0 there
    ignored = torch.rand(37, 23, generator=torch.Generator().manual_seed(6)) > 0.8 if hides else None
    x, x64 = image.to(device, copy=True).requires_grad_(), image.double().requires_grad_()
    given = None if ignored is None else ignored.to(device)
    value = ssim_cuda.photometric(x, target.to(device), 0.2, given)
    expected = losses.photometric(x64, target.double(), 0.2, ignored)
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (3.0 * value).backward()
    (3.0 * expected).backward()
    assert float((x.grad.cpu() - x64.grad).norm() / x64.grad.norm()) <= 1e-5
    if ignored is not None:
        assert not x.grad.cpu()[ignored].any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_losses_choose_it_for_cuda_images():
    image, target = (t.cuda() for t in pair(30, 40, 3))
    assert float(losses.ssim(image, target)) == float(ssim_cuda.ssim(image, target))
    assert float(losses.photometric(image, target, 0.2)) == float(ssim_cuda.photometric(image, target, 0.2))


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="11"):
        ssim_cuda.ssim(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3))
    with pytest.raises(ValueError, match="float64"):
        ssim_cuda.ssim(torch.zeros(20, 20, 3, dtype=torch.float64), torch.zeros(20, 20, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="without gradient"):
        ssim_cuda.ssim(torch.zeros(20, 20, 3), torch.zeros(20, 20, 3, requires_grad=True))
    for ignored in (torch.zeros(20, 21, dtype=torch.bool), torch.zeros(20, 20)):
        with pytest.raises(ValueError, match="ignored should be bool"):
            ssim_cuda.photometric(torch.zeros(20, 20, 3), torch.zeros(20, 20, 3), 0.2, ignored)


@pytest.mark.parametrize("arch", [75, 90, 120])
def test_kernels_compile_for_gpus_that_are_not_here(tmp_path, arch):
    """NVRTC comes with Warp: a GPU's code is made without one. Adam's kernel too."""
    wp = initialised_warp()
    for kernel in (ssim_cuda.kernel(), adam._kernel()):
        folder = tmp_path / kernel.key
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder), use_ptx=True)
        assert any(path.stat().st_size > 1000 for path in folder.rglob("*.ptx"))
