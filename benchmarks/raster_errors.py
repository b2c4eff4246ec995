"""Scenes for the rasteriser, and errors of a backend against the float64 reference.

Inputs are rounded to float32 before the reference uses them, so that all errors come from the backend. If a Gaussian's
alpha at a pixel is within rounding of 1/255, one backend may draw it and another skip it (a "flip"). Images and
gradients are compared at pixels without flips; the share of the other pixels is reported.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from benchmarks.workload import WORKLOADS, room
from torch_backend.raster import RasterOutput, RasterSettings, rasterize

INPUTS = ("means", "quats", "log_scales", "opacity_logits", "colors", "sh", "viewmats", "background")
PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "colors", "sh")
SAME_SIDE = 3e-4
"""Pixels whose alphas differ by less than this are on the same side of the alpha cut; a flip moves alpha by T / 255."""

BODIES: dict[str, tuple[str, torch.dtype, str]] = {
    "cpu": ("cpu", torch.float32, "cpu"),
    "reference": ("reference", torch.float64, "cpu"),
    "reference32": ("reference", torch.float32, "cpu"),
}
"""Name -> backend, float type, device. `reference` in float64 is the reference; `cuda` runs the CUDA kernels on CPU
fibers, `gpu` the same on a GPU."""
if importlib.util.find_spec("torch_backend.raster.cuda"):
    BODIES["cuda"] = ("cuda", torch.float32, "cpu")
    if torch.cuda.is_available():
        BODIES["gpu"] = ("cuda", torch.float32, "cuda")


@dataclass
class Scene:
    """Arguments of one `rasterize` call as float64 tensors, with its options."""

    tensors: dict[str, Tensor]
    Ks: Tensor
    width: int
    height: int
    options: dict[str, Any] = field(default_factory=dict)

    def leaves(self, dtype: torch.dtype = torch.float32, device: str = "cpu") -> dict[str, Tensor]:
        return {name: value.to(device, dtype).clone().requires_grad_() for name, value in self.tensors.items()}

    def rounded(self) -> Scene:
        """The scene with every input rounded to float32."""
        tensors = {name: value.float().double() for name, value in self.tensors.items()}
        return Scene(tensors, self.Ks.float().double(), self.width, self.height, self.options)

    def run(self, body: str, leaves: dict[str, Tensor] | None = None, **options: Any) -> RasterOutput:
        backend, dtype, device = BODIES.get(body, (body, torch.float32, "cpu"))
        leaves = self.leaves(dtype, device) if leaves is None else leaves
        options = {"settings": RasterSettings(threads=2)} | self.options | options
        return rasterize(
            **leaves,
            Ks=self.Ks,
            width=self.width,
            height=self.height,  # type: ignore[arg-type]
            backend=backend,
            **options,
        )

    def gradients(self, body: str, where: Any = 1.0, **options: Any) -> tuple[RasterOutput, dict[str, Tensor]]:
        """(output, gradients of a fixed random weighting of all differentiable images, at pixels `where`)."""
        _, dtype, device = BODIES[body]
        leaves = self.leaves(dtype, device)
        out = self.run(body, leaves, **options)
        scalar(out, where).backward()
        return out, {name: leaf.grad for name, leaf in leaves.items()}  # type: ignore[misc]


def scalar(out: RasterOutput, where: Any = 1.0) -> Tensor:
    """A fixed random weighting of every differentiable image, at pixels `where` ([C, H, W] mask or a number)."""
    generator = torch.Generator().manual_seed(5)

    def weights(image: Tensor) -> Tensor:
        return torch.randn(image.shape, generator=generator).to(image)

    where = torch.as_tensor(where, dtype=out.colors.dtype, device=out.colors.device)
    loss = (out.colors * weights(out.colors) * where[..., None]).sum()
    loss = loss + (out.alphas * weights(out.alphas) * where).sum()
    if out.depth_expected is not None:
        # Where alpha is near 0 the ratio is ill-conditioned and its cut-off flips, so it is not compared.
        depth = torch.where(out.alphas > 0.2, out.depth_expected, torch.zeros_like(out.alphas))
        loss = loss + (depth * weights(depth) * where).sum()
    return loss


def relative(value: Tensor, truth: Tensor) -> float:
    """|value - truth| / |truth| in the L2 norm."""
    value, truth = value.detach().cpu().double(), truth.detach().cpu().double()
    return float((value - truth).norm() / truth.norm().clamp_min(1e-300))


def assert_gradients(grads: dict[str, Tensor], truth: dict[str, Tensor], bound: float) -> None:
    """AssertionError unless all gradients are finite and within a relative error of `bound`."""
    assert all(torch.isfinite(grad).all() for grad in grads.values())
    errors = {name: relative(grads[name], value) for name, value in truth.items()}
    assert max(errors.values()) <= bound, errors


def on_host(out: RasterOutput) -> RasterOutput:
    """The images copied to the CPU."""
    arrays: dict[str, Any] = {one.name: getattr(out, one.name) for one in dataclasses.fields(out)}
    moved: dict[str, Any] = {name: None if value is None else value.cpu() for name, value in arrays.items()}
    return RasterOutput(**moved)


def _decibels(error: Tensor) -> float:
    """PSNR in dB of errors at a peak of 1; infinite without errors."""
    return float(-10 * torch.log10(error.square().mean())) if error.numel() else math.inf


def psnr(value: Tensor, truth: Tensor) -> float:
    """PSNR in dB at a peak of 1; infinite for equal images."""
    return _decibels(value.detach().cpu().double() - truth.detach().cpu().double())


@dataclass
class Errors:
    """Errors of one backend against the reference on one scene."""

    flips: float
    """Share of pixels on different sides of the alpha cut."""
    image: float
    """Largest |colour error| at pixels without flips, relative to the reference's brightest channel (at least 1)."""
    psnr: float
    """PSNR in dB at pixels without flips, with this brightness as the peak."""
    psnr_all: float
    """The same PSNR over all pixels, including flips."""
    gradients: dict[str, float]
    """Relative L2 error of each input's gradient at pixels without flips; 0 where both are 0. The background's error is
    relative to at least 1 % of its gradient in an empty scene, because float32 knows T only as 1 - alpha."""
    out: RasterOutput
    grads: dict[str, Tensor]
    reference: RasterOutput
    reference_grads: dict[str, Tensor]

    @property
    def gradient(self) -> float:
        """The largest of `gradients`."""
        return max(self.gradients.values(), default=0.0)


def compare(scene: Scene, body: str, **options: Any) -> Errors:
    """Runs `scene`, with inputs rounded to float32, on a backend and on the reference, and compares them."""
    scene = scene.rounded()
    options = {"with_contributions": True} | options
    ran: list[tuple[RasterOutput, dict[str, Tensor]]] = []
    for name in (body, "reference"):
        _, dtype, device = BODIES[name]
        leaves = scene.leaves(dtype, device)
        ran.append((scene.run(name, leaves, **options), leaves))
    (out, leaves), (reference, truth) = ran
    gap = (out.alphas.detach().cpu().double() - reference.alphas.detach()).abs()
    same = gap < SAME_SIDE
    for images in (out, reference):
        scalar(images, same.to(images.alphas.device)).backward()
    grads, reference_grads = (
        {n: leaf.grad for n, leaf in tensors.items() if leaf.grad is not None} for tensors in (leaves, truth)
    )
    brightest = max(1.0, float(reference.colors.detach().abs().amax())) if reference.colors.numel() else 1.0
    error = (out.colors.detach().cpu().double() - reference.colors.detach()).abs() / brightest
    clean = error[same]
    gradients = {}
    for name, value in reference_grads.items():
        floor = 1e-6  # below this the reference's value is only rounding of zero
        if name == "background":
            empty = torch.zeros_like(reference.colors).requires_grad_()
            blank = dataclasses.replace(reference, colors=empty, alphas=reference.alphas.detach(), depth_expected=None)
            scalar(blank, same).backward()
            floor = 0.01 * float(empty.grad.sum((0, 1, 2)).norm())  # type: ignore[union-attr]
        difference = (grads[name].cpu().double() - value).norm()
        gradients[name] = float(difference / value.norm().clamp_min(max(floor, 1e-6)))
    return Errors(
        flips=float((~same).double().mean()) if same.numel() else 0.0,
        image=float(clean.amax()) if clean.numel() else 0.0,
        psnr=_decibels(clean),
        psnr_all=_decibels(error),
        gradients=gradients,
        out=out,
        grads=grads,
        reference=reference,
        reference_grads=reference_grads,
    )


def camera(width: int, height: int, focal: float, cx: float | None = None, cy: float | None = None) -> Tensor:
    """K [1, 3, 3]; the principal point defaults to the centre."""
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return torch.tensor([[[focal, 0, cx], [0, focal, cy], [0, 0, 1]]], dtype=torch.float64)


def cloud(
    n: int, width: int, height: int, seed: int = 0, channels: int = 3, degree: int | None = None, **options: Any
) -> Scene:
    """Random Gaussians before a slightly rotated camera, with harmonics instead of colours if `degree` is given."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3) * torch.tensor([0.9, 0.6, 0.8]) + torch.tensor([0.0, 0.0, 3.0])
    viewmat = torch.eye(4, dtype=torch.float64)
    a = 0.1
    viewmat[:3, :3] = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    viewmat[:3, 3] = torch.tensor([0.05, -0.02, 0.1])
    tensors = {
        "means": means,
        "quats": normal(n, 4),
        "log_scales": normal(n, 3) * 0.5 - 2.3,
        "opacity_logits": normal(n) * 1.5,
        "viewmats": viewmat[None],
        "background": torch.linspace(0.1, 0.9, channels, dtype=torch.float64),
    }
    if degree is None:
        tensors["colors"] = normal(n, channels)
    else:
        tensors["sh"] = 0.5 * normal(n, (degree + 1) ** 2, 3)
        if channels > 3:
            tensors["colors"] = normal(n, channels - 3)
    return Scene(tensors, camera(width, height, 0.9 * max(width, height)), width, height, options)


def single(
    width: int = 16,
    height: int = 16,
    focal: float = 16.0,
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    scale: float = 0.2,
    logit: float = 2.0,
) -> Scene:
    """One reddish Gaussian before a camera at the origin."""
    values = {
        "means": [mean],
        "quats": [quat],
        "log_scales": [(math.log(scale),) * 3],
        "opacity_logits": [logit],
        "colors": [(0.8, 0.4, 0.2)],
        "background": (0.0, 0.0, 0.0),
    }
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    return Scene(tensors, camera(width, height, focal), width, height)


def workload(name: str) -> Scene:
    """The room of a benchmark workload."""
    count, width, height = WORKLOADS[name]
    work = room(count, width, height)
    opacity = torch.tensor(work.opacities).double()
    arrays = {"means": work.means, "quats": work.quats, "colors": work.colors, "viewmats": work.viewmat[None]}
    tensors = {name: torch.tensor(value).double() for name, value in arrays.items()}
    tensors |= {
        "log_scales": torch.tensor(work.scales).double().log(),
        "opacity_logits": torch.logit(opacity),
        "background": torch.tensor([0.1, 0.2, 0.3]).double(),
    }
    return Scene(tensors, torch.tensor(work.K)[None].double(), width, height)


def stack(scene: Scene, n: int) -> Scene:
    """`n` copies of the only Gaussian of a scene."""
    for name in PER_GAUSSIAN:
        if name in scene.tensors:
            value = scene.tensors[name]
            scene.tensors[name] = value.repeat(n, *[1] * (value.dim() - 1))
    return scene
