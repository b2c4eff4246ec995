import math
from dataclasses import dataclass, field

import pytest
import torch

from benchmarks.raster import WORKLOADS, room
from torch_backend.raster import RasterOutput, RasterSettings, rasterize

INPUTS = ("means", "quats", "log_scales", "opacity_logits", "colors", "sh", "viewmats", "background")


@dataclass
class Scene:
    """Arguments of one `rasterize` call as float64 tensors, and how to run them."""

    tensors: dict[str, torch.Tensor]
    Ks: torch.Tensor
    width: int
    height: int
    options: dict = field(default_factory=dict)

    def leaves(self, dtype=torch.float32) -> dict[str, torch.Tensor]:
        return {name: value.to(dtype).clone().requires_grad_() for name, value in self.tensors.items()}

    def run(self, backend: str, leaves=None, **options) -> RasterOutput:
        if leaves is None:
            leaves = self.leaves(torch.float64 if backend == "reference" else torch.float32)
        options = {"settings": RasterSettings(threads=2)} | self.options | options
        return rasterize(**leaves, Ks=self.Ks, width=self.width, height=self.height, backend=backend, **options)

    def gradients(self, backend: str, where=1.0, **options) -> tuple[RasterOutput, dict[str, torch.Tensor]]:
        """Output, and the gradients of a fixed random cotangent of all differentiable images, at pixels `where`."""
        leaves = self.leaves(torch.float64 if backend == "reference" else torch.float32)
        out = self.run(backend, leaves, **options)
        generator = torch.Generator().manual_seed(5)
        where = torch.as_tensor(where, dtype=out.colors.dtype)
        loss = (out.colors * torch.randn(out.colors.shape, generator=generator) * where[..., None]).sum()
        loss = loss + (out.alphas * torch.randn(out.alphas.shape, generator=generator) * where).sum()
        if out.depth_expected is not None:
            # Where alpha is near 0 the ratio is ill-conditioned and its cut-off flips: not a place to compare.
            depth = torch.where(out.alphas > 0.2, out.depth_expected, torch.zeros_like(out.alphas))
            loss = loss + (depth * torch.randn(depth.shape, generator=generator) * where).sum()
        loss.backward()
        return out, {name: leaf.grad for name, leaf in leaves.items()}


def relative(value: torch.Tensor, truth: torch.Tensor) -> float:
    """|value - truth| / |truth|, L2."""
    return float((value.double() - truth.double()).norm() / truth.double().norm().clamp_min(1e-300))


def psnr(value: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10 * torch.log10((value.detach().double() - truth.detach().double()).square().mean()))


def camera(width: int, height: int, focal: float, cx: float | None = None, cy: float | None = None) -> torch.Tensor:
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return torch.tensor([[[focal, 0, cx], [0, focal, cy], [0, 0, 1]]], dtype=torch.float64)


def cloud(n: int, width: int, height: int, seed=0, channels=3, degree: int | None = None, **options) -> Scene:
    """Random Gaussians before a camera that is turned a little; harmonics instead of colours if degree is given."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3) * torch.tensor([0.9, 0.6, 0.8]) + torch.tensor([0.0, 0.0, 3.0])
    viewmat = torch.eye(4, dtype=torch.float64)
    a = 0.1
    viewmat[:3, :3] = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    viewmat[:3, 3] = torch.tensor([0.05, -0.02, 0.1])
    tensors = {"means": means, "quats": normal(n, 4), "log_scales": normal(n, 3) * 0.5 - 2.3,
               "opacity_logits": normal(n) * 1.5, "viewmats": viewmat[None],
               "background": torch.linspace(0.1, 0.9, channels, dtype=torch.float64)}
    if degree is None:
        tensors["colors"] = normal(n, channels)
    else:
        tensors["sh"] = 0.5 * normal(n, (degree + 1) ** 2, 3)
        if channels > 3:
            tensors["colors"] = normal(n, channels - 3)
    return Scene(tensors, camera(width, height, 0.9 * max(width, height)), width, height, options)


def single(width=16, height=16, focal=16.0, mean=(0.0, 0.0, 2.0), quat=(1.0, 0.0, 0.0, 0.0), scale=0.2,
           logit=2.0) -> Scene:
    """One grey-red Gaussian before a camera at the origin."""
    tensors = {"means": [mean], "quats": [quat], "log_scales": [(math.log(scale),) * 3], "opacity_logits": [logit],
               "colors": [(0.8, 0.4, 0.2)], "background": (0.0, 0.0, 0.0)}
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in tensors.items()}
    tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    return Scene(tensors, camera(width, height, focal), width, height)


@pytest.fixture(scope="session")
def small_room() -> Scene:
    """The benchmark's workload W0: 400 Gaussians, 64 x 48."""
    _, width, height = WORKLOADS["W0"]
    work = room(*WORKLOADS["W0"])
    opacity = torch.tensor(work.opacities).double()
    tensors = {"means": work.means, "quats": work.quats, "colors": work.colors, "viewmats": work.viewmat[None]}
    tensors = {name: torch.tensor(value).double() for name, value in tensors.items()}
    tensors |= {"log_scales": torch.tensor(work.scales).double().log(), "opacity_logits": torch.logit(opacity),
                "background": torch.tensor([0.1, 0.2, 0.3]).double()}
    return Scene(tensors, torch.tensor(work.K)[None].double(), width, height)


@pytest.fixture(scope="session")
def tools():
    """Helpers, since tests cannot import this file."""

    class Tools:
        pass

    for function in (cloud, single, relative, psnr, camera, Scene):
        setattr(Tools, function.__name__, staticmethod(function))
    return Tools
