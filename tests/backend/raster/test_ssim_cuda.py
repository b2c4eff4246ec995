"""The GPU's SSIM kernel; test_ssim.py checks its values and gradients together with the other implementations."""

import pytest
import torch

from torch_backend.native import initialised_warp
from torch_backend.raster import ssim as ssim_cpu
from torch_backend.raster import ssim_cuda
from torch_backend.train import adam, losses


def pair(height, width):
    generator = torch.Generator().manual_seed(3)
    return torch.rand(height, width, 3, generator=generator), torch.rand(height, width, 3, generator=generator)


def test_value_without_gradient_is_that_of_the_cpu_body():
    image, target = pair(40, 31)
    assert float(ssim_cuda.ssim(image, target)) == pytest.approx(float(ssim_cpu.ssim(image, target)), rel=1e-6)


def test_strided_images_are_taken():
    image, target = pair(20, 30)
    wide = torch.zeros(20, 60, 3)
    wide[:, ::2] = image
    assert float(ssim_cuda.ssim(wide[:, ::2], target)) == float(ssim_cuda.ssim(image, target))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_losses_choose_it_for_cuda_images():
    image, target = (t.cuda() for t in pair(30, 40))
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


@pytest.mark.parametrize("arch", [75, 120])
def test_kernels_compile_for_absent_gpus(tmp_path, arch):
    """NVRTC is part of Warp, so GPU code compiles without a GPU; this includes Adam's kernel."""
    wp = initialised_warp()
    for kernel in (ssim_cuda.kernel(), adam._kernel()):
        folder = tmp_path / kernel.key
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder), use_ptx=True)
        assert any(path.stat().st_size > 1000 for path in folder.rglob("*.ptx"))
