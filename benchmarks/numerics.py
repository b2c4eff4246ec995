"""Writes docs/numerics.md: errors of every rasteriser body against the float64 oracle, case by case.

    python benchmarks/numerics.py [--out docs/numerics.md] [--cases CASE ...] [--bodies BODY ...]

The cases are those of tests/backend/raster/test_hard_cases.py, which asserts the bounds stated here. Inputs are rounded
to float32 before the oracle sees them, so that an error is a body's own. A Gaussian whose alpha at a pixel lies within
rounding of 1/255 is drawn by one body and skipped by another ("flip"); images and gradients are compared at the pixels
where no such thing happened, and the share of the others is stated and bounded.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import datetime
import importlib.util
import math
import os
import pathlib
import platform
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import torch
from torch import Tensor

from benchmarks.raster import WORKLOADS, room
from torch_backend.raster import RasterOutput, RasterSettings, rasterize

ROOT = pathlib.Path(__file__).resolve().parents[1]
INPUTS = ("means", "quats", "log_scales", "opacity_logits", "colors", "sh", "viewmats", "background")
PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "colors", "sh")
SAME_SIDE = 3e-4
"""Pixels whose alphas differ by less are on the same side of the alpha cut: a flip moves alpha by T / 255."""

BODIES: dict[str, tuple[str, torch.dtype, str]] = {
    "cpu": ("cpu", torch.float32, "cpu"),
    "reference": ("reference", torch.float64, "cpu"),
    "reference32": ("reference", torch.float32, "cpu"),
}
"""Body: backend, float type, device. `reference` in float64 is the oracle; `cuda` runs the CUDA kernels on CPU fibers,
`gpu` the same on a GPU."""
if importlib.util.find_spec("torch_backend.raster.cuda"):
    BODIES["cuda"] = ("cuda", torch.float32, "cpu")
    if torch.cuda.is_available():
        BODIES["gpu"] = ("cuda", torch.float32, "cuda")


@dataclass
class Scene:
    """Arguments of one `rasterize` call as float64 tensors, and how to run them."""

    tensors: dict[str, Tensor]
    Ks: Tensor
    width: int
    height: int
    options: dict[str, Any] = field(default_factory=dict)

    def leaves(self, dtype: torch.dtype = torch.float32, device: str = "cpu") -> dict[str, Tensor]:
        return {name: value.to(device, dtype).clone().requires_grad_() for name, value in self.tensors.items()}

    def rounded(self) -> Scene:
        """The same with every input a float32 number."""
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
        """Output, and the gradients of a fixed random cotangent of all differentiable images, at pixels `where`."""
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
        # Where alpha is near 0 the ratio is ill-conditioned and its cut-off flips: not a place to compare.
        depth = torch.where(out.alphas > 0.2, out.depth_expected, torch.zeros_like(out.alphas))
        loss = loss + (depth * weights(depth) * where).sum()
    return loss


def relative(value: Tensor, truth: Tensor) -> float:
    """|value - truth| / |truth|, L2."""
    value, truth = value.detach().cpu().double(), truth.detach().cpu().double()
    return float((value - truth).norm() / truth.norm().clamp_min(1e-300))


def _decibels(error: Tensor) -> float:
    """PSNR of errors at a peak of 1; infinite where there are none."""
    return float(-10 * torch.log10(error.square().mean())) if error.numel() else math.inf


def psnr(value: Tensor, truth: Tensor) -> float:
    """dB for a peak of 1; infinite where equal."""
    return _decibels(value.detach().cpu().double() - truth.detach().cpu().double())


@dataclass
class Errors:
    """One body against the oracle on one scene."""

    flips: float
    """Share of pixels on different sides of the alpha cut."""
    image: float
    """Largest |colour error| at the others, in units of the brightest channel of the oracle's image (1 at least)."""
    psnr: float
    """dB at the same pixels, for a peak of that unit."""
    psnr_all: float
    """The same over all pixels, flips included."""
    gradients: dict[str, float]
    """Relative L2 error per input of the gradients at pixels without flips; 0 where both are 0. For the background:
    relative to 1 % at least of its gradient in an empty scene, since 1 - alpha is all that float32 knows of T."""
    out: RasterOutput
    grads: dict[str, Tensor]
    oracle: RasterOutput
    oracle_grads: dict[str, Tensor]

    @property
    def gradient(self) -> float:
        """The largest of `gradients`."""
        return max(self.gradients.values(), default=0.0)


def compare(scene: Scene, body: str, **options: Any) -> Errors:
    """Run `scene`, its inputs rounded to float32, on a body and on the oracle."""
    scene = scene.rounded()
    options = {"with_contributions": True} | options
    ran: list[tuple[RasterOutput, dict[str, Tensor]]] = []
    for name in (body, "reference"):
        _, dtype, device = BODIES[name]
        leaves = scene.leaves(dtype, device)
        ran.append((scene.run(name, leaves, **options), leaves))
    (out, leaves), (oracle, truth) = ran
    gap = (out.alphas.detach().cpu().double() - oracle.alphas.detach()).abs()
    same = gap < SAME_SIDE
    for images in (out, oracle):
        scalar(images, same.to(images.alphas.device)).backward()
    grads, oracle_grads = (
        {n: leaf.grad for n, leaf in tensors.items() if leaf.grad is not None} for tensors in (leaves, truth)
    )
    brightest = max(1.0, float(oracle.colors.detach().abs().amax())) if oracle.colors.numel() else 1.0
    error = (out.colors.detach().cpu().double() - oracle.colors.detach()).abs() / brightest
    clean = error[same]
    gradients = {}
    for name, value in oracle_grads.items():
        floor = 1e-6  # what the oracle has as rounding of zero has no relative error
        if name == "background":
            empty = torch.zeros_like(oracle.colors).requires_grad_()
            blank = dataclasses.replace(oracle, colors=empty, alphas=oracle.alphas.detach(), depth_expected=None)
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
        oracle=oracle,
        oracle_grads=oracle_grads,
    )


def camera(width: int, height: int, focal: float, cx: float | None = None, cy: float | None = None) -> Tensor:
    """K [1, 3, 3]; the principal point is the centre unless given."""
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return torch.tensor([[[focal, 0, cx], [0, focal, cy], [0, 0, 1]]], dtype=torch.float64)


def cloud(
    n: int, width: int, height: int, seed: int = 0, channels: int = 3, degree: int | None = None, **options: Any
) -> Scene:
    """Random Gaussians before a camera that is turned a little; harmonics instead of colours if degree is given."""
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
    """One grey-red Gaussian before a camera at the origin."""
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
    """One of the benchmark's rooms."""
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


@dataclass(frozen=True)
class Case:
    """One hard case: a scene, and how far a float32 body may be from the oracle on it."""

    build: Callable[[bool], Scene]
    """Makes the scene; True asks for a small one (CPU fibers are slow)."""
    psnr: float = 100.0
    """Least PSNR in dB at pixels without flips, at a peak of 1 or the brightest channel."""
    gradient: float | None = 5e-4
    """Largest relative L2 gradient error of any input at pixels without flips; None: ill-posed, only finite."""
    flips: float = 0.02
    """Largest share of pixels with flips."""
    note: str = ""
    """Why a bound is wider than the others."""
    plain: float | None = None
    """The bound on gradients for plain torch in float32 (body reference32), where it is wider."""


def stack(scene: Scene, n: int) -> Scene:
    """`n` copies of a scene's one Gaussian."""
    for name in PER_GAUSSIAN:
        if name in scene.tensors:
            value = scene.tensors[name]
            scene.tensors[name] = value.repeat(n, *[1] * (value.dim() - 1))
    return scene


def _poisoned(small: bool) -> Scene:
    scene = cloud(40, 24, 18, degree=1, channels=4)
    for i, name in enumerate(("means", "quats", "log_scales", "opacity_logits", "colors", "sh")):
        for j, bad in enumerate((math.nan, math.inf, -math.inf)):
            if name in ("means", "quats", "colors", "sh") or math.isnan(bad):
                scene.tensors[name].view(40, -1)[3 * i + j, -1] = bad
    return scene


def _scales(
    *log_scales: float,
    axes: tuple[tuple[int, ...], ...] = ((0,), (0, 1), (0, 1, 2)),
    near: float = 0.01,
    antialiased: bool = False,
) -> Callable[[bool], Scene]:
    """A cloud in which some Gaussians have the given log-scales on one, two or three axes."""

    def build(small: bool) -> Scene:
        scene = cloud(40, 24, 18, seed=3, settings=RasterSettings(threads=2, near=near, antialiased=antialiased))
        scene.tensors["opacity_logits"] += 1.0
        at = 0
        for log_scale in log_scales:
            for which in axes:
                scene.tensors["log_scales"][at, list(which)] = log_scale
                at += 1
        return scene

    return build


def _near_plane(small: bool) -> Scene:
    """Behind the camera, behind the plane, on it, just beyond, and Gaussians that reach through it."""
    scene = cloud(30, 24, 18, seed=11, settings=RasterSettings(threads=2, near=0.25))
    scene.tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    z = torch.tensor([-5, -0.25, -1e-8, 0, 1e-38, 1e-8, 0.2499, 0.25, 0.25 + 2**-20, 0.2501, 0.26, 0.3])
    scene.tensors["means"][: len(z), :2] *= 0.1
    scene.tensors["means"][: len(z), 2] = z.double()
    scene.tensors["log_scales"][10:20] = torch.linspace(-2, 1, 10)[:, None].double()
    return scene


def _frustum_edge(small: bool) -> Scene:
    """Long Gaussians far off to the side and near: without the clamp their footprint explodes."""
    scene = cloud(60 if small else 200, 32, 24, seed=6)
    scene.Ks = camera(32, 24, 24.0, 9.0, 14.0)
    scene.tensors["means"] *= torch.tensor([4.0, 4.0, 0.4])
    scene.tensors["means"][:, 2] -= 0.8
    scene.tensors["log_scales"] += 0.8
    scene.tensors["log_scales"][:, 0] += 1.0
    return scene


def _needles(antialiased: bool) -> Callable[[bool], Scene]:
    def build(small: bool) -> Scene:
        n, width, height = (24, 24, 18) if small else (100, 64, 48)
        scene = cloud(n, width, height, seed=8, settings=RasterSettings(threads=2, antialiased=antialiased))
        scene.tensors["log_scales"] = torch.tensor([0.5, -6.5, -6.5]).double().expand(n, 3).clone()
        scene.tensors["opacity_logits"] += 2.0
        return scene

    return build


def _edge_on(small: bool) -> Scene:
    """Discs seen exactly from the side, points and lines: the projected covariance is singular before the blur."""
    scene = cloud(24, 24, 18, seed=9)
    scene.tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene.tensors["quats"] = torch.tensor([1.0, 0, 0, 0]).double().repeat(24, 1)
    kinds = torch.tensor([[-1.5, -40, -1.5], [-40, -40, -1.5], [-40, -40, -40], [-1.5, -40, -40]]).double()
    scene.tensors["log_scales"] = kinds.repeat(6, 1)
    scene.tensors["means"][:8, :2] = 0
    return scene


def _quaternions(small: bool) -> Scene:
    """Zero, shorter than the cut, and of any length that float32 holds."""
    scene = cloud(30, 24, 18, seed=12)
    lengths = torch.tensor([0, 1e-38, 1e-7, 1e-5, 1e-3, 1e8, 1e15, 1e25, 1e37]).double()
    unit = scene.tensors["quats"][:9] / scene.tensors["quats"][:9].norm(dim=-1, keepdim=True)
    scene.tensors["quats"][:9] = unit * lengths[:, None]
    scene.tensors["log_scales"][:9, 0] = -0.5
    return scene


def _opacities(*logits: float, scale: float = 0.0) -> Callable[[bool], Scene]:
    def build(small: bool) -> Scene:
        scene = cloud(40, 24, 18, seed=13)
        for i, logit in enumerate(logits):
            scene.tensors["opacity_logits"][i :: len(logits)] = logit
        scene.tensors["log_scales"] += scale
        return scene

    return build


def _opaque_stack(small: bool) -> Scene:
    scene = stack(single(4, 4, logit=4.2, scale=5.0), 40)
    scene.tensors["means"][:, 2] = torch.linspace(2, 3, 40)
    scene.tensors["colors"] = torch.linspace(0, 1, 120).reshape(40, 3).double()
    return scene


def _crowd(small: bool) -> Scene:
    """Ten thousand Gaussians in one pixel (300 on fibers)."""
    n = 300 if small else 10_000
    scene = cloud(n, 7, 5, seed=1)
    scene.tensors["means"] = torch.tensor([0.0, 0.0, 3.0]) + 0.01 * scene.tensors["means"]
    scene.tensors["log_scales"] = torch.full((n, 3), -5.0).double()
    scene.tensors["opacity_logits"] = torch.full((n,), -4.5).double()
    return scene


def _giant(small: bool) -> Scene:
    """One Gaussian over all pixels, two more inside it."""
    size = (40, 36) if small else (300, 200)
    scene = stack(single(*size, focal=float(size[0]), scale=4.0), 3)
    scene.tensors["log_scales"] += torch.tensor([0.3, 0.0, -0.3])
    scene.tensors["log_scales"][1:] -= 3.0
    scene.tensors["quats"][:, 1:] = torch.tensor([0.2, 0.1, 0.4])
    scene.tensors["means"][1] = torch.tensor([0.3, 0.1, 1.8])
    return scene


def _image(width: int, height: int) -> Callable[[bool], Scene]:
    return lambda small: cloud(60, width, height, with_depth=True)


def _nowhere(small: bool) -> Scene:
    scene = cloud(50, 20, 12, with_depth=True)
    scene.tensors["means"][:, 2] = -3.0
    return scene


def _principal_point(cx: float, cy: float) -> Callable[[bool], Scene]:
    def build(small: bool) -> Scene:
        scene = cloud(60 if small else 200, 32, 24, seed=2)
        scene.Ks = camera(32, 24, 30.0, cx, cy)
        return scene

    return build


def _black_harmonics(small: bool) -> Scene:
    scene = cloud(40, 24, 18, degree=2)
    scene.tensors["sh"][:, 0] -= 1.2
    return scene


def scaled_world(factor: float) -> Callable[[bool], Scene]:
    """World, near plane and camera positions times `factor`."""

    def build(small: bool) -> Scene:
        scene = cloud(60, 32, 24, seed=14, settings=RasterSettings(threads=2, near=0.01 * factor))
        scene.tensors["means"] *= factor
        scene.tensors["log_scales"] += math.log(factor)
        scene.tensors["viewmats"][:, :3, 3] *= factor
        return scene

    return build


def _far_from_the_origin(small: bool) -> Scene:
    """World and camera 1000 units off: float32 holds positions there to 3e-5 of a unit, 4e-4 px."""
    scene = cloud(60, 32, 24, seed=15)
    away = torch.tensor([1000.0, -500.0, 800.0]).double()
    scene.tensors["means"] += away
    view = scene.tensors["viewmats"][0]
    view[:3, 3] -= view[:3, :3] @ away
    return scene


def _cameras(count: int) -> Callable[[bool], Scene]:
    def build(small: bool) -> Scene:
        scene = cloud(40, 24, 18, seed=4)
        views = scene.tensors["viewmats"].repeat(count, 1, 1)
        views[:, 0, 3] += 0.2 * torch.arange(count)
        scene.tensors["viewmats"], scene.Ks = views, scene.Ks.repeat(count, 1, 1)
        return scene

    return build


def _equal_depths(small: bool) -> Scene:
    scene = stack(single(9, 9, logit=0.0, scale=2.0), 3)
    scene.tensors["colors"] = torch.eye(3).double()
    return scene


def _antialiased(small: bool) -> Scene:
    return cloud(
        60 if small else 200,
        40,
        30,
        seed=16,
        degree=2,
        with_depth=True,
        settings=RasterSettings(threads=2, antialiased=True),
    )


CASES: dict[str, Case] = {
    "well-behaved cloud, depth, pose": Case(lambda small: cloud(60 if small else 300, 40, 30, with_depth=True)),
    "antialiased, harmonics of degree 2": Case(_antialiased),
    "NaN and infinities in every input": Case(_poisoned),
    "log-scales inf, 40, 30, 29, 20": Case(
        _scales(math.inf, 40.0, 30.0, 29.0, 20.0),
        gradient=None,
        note="what float32 cannot invert is culled in all bodies; the cut itself is subject to rounding",
    ),
    "scales up to e^6 units": Case(
        _scales(1.0, 3.0, 6.0),
        gradient=5e-3,
        note="gradients of sheets that look flat from edge to edge are small differences of large numbers",
    ),
    "scales of e^-20, e^-50, 0": Case(_scales(-20.0, -50.0, -math.inf)),
    "the same, antialiased": Case(_scales(-20.0, -50.0, -math.inf, antialiased=True)),
    "behind, on, just beyond, through the near plane": Case(_near_plane, gradient=5e-3),
    "elongated at and beyond the frustum's edge": Case(_frustum_edge),
    "needles 1 : 1000": Case(_needles(False), gradient=2e-3),
    "needles 1 : 1000, antialiased": Case(_needles(True), gradient=5e-3),
    "points, lines, discs from the side": Case(_edge_on),
    "quaternions of length 0, 1e-38 ... 1e37": Case(_quaternions),
    "opacity 1 (logits 15, 100, inf)": Case(
        _opacities(15.0, 100.0, math.inf),
        plain=0.5,
        note="torch's float32 sigmoid is 1 beyond 17: its gradients, of 3e-7, are gone",
    ),
    "opacity 0 (logits -100, -inf), some not": Case(_opacities(-100.0, -math.inf, 0.0)),
    "opacity 0.01 everywhere": Case(_opacities(-4.6), flips=0.05),
    "forty opaque layers": Case(_opaque_stack),
    "10,000 Gaussians in one pixel": Case(
        _crowd, psnr=80, gradient=5e-3, flips=0.2, note="ten thousand alphas at the cut; 35 pixels"
    ),
    "one Gaussian over all pixels": Case(_giant),
    "image of 1 x 1": Case(_image(1, 1)),
    "image of 7 x 5": Case(_image(7, 5)),
    "image of 17 x 1": Case(_image(17, 1)),
    "image of 1 x 40": Case(_image(1, 40)),
    "no Gaussians": Case(lambda small: cloud(0, 20, 12, with_depth=True)),
    "nothing in view": Case(_nowhere),
    "no cameras": Case(_cameras(0)),
    "three cameras": Case(_cameras(3)),
    "principal point at a corner": Case(_principal_point(3.0, 20.0)),
    "principal point outside, left": Case(_principal_point(-15.0, 9.0)),
    "principal point outside, right": Case(_principal_point(40.0, 30.0)),
    "black harmonics": Case(_black_harmonics),
    "world scaled by 17462": Case(scaled_world(17462.0)),
    "world scaled by 1e-4": Case(scaled_world(1e-4)),
    "world 1400 units from the origin": Case(
        _far_from_the_origin,
        psnr=55,
        gradient=5e-2,
        flips=0.1,
        note="positions themselves are exact float32 numbers; their transform to the camera cancels 1400 against 1400",
    ),
    "equal depths": Case(_equal_depths),
}


def size(case: str, body: str) -> Scene:
    """The scene of a case, at the size for a body."""
    return CASES[case].build(body == "cuda")


_H, _P = "test_hard_cases.py::", "test_properties.py::"
ROWS: list[tuple[str, list[str], str]] = [
    (
        "NaN loss, everything dies in 1 to 2 steps",
        [
            _H + "test_non_finite_gaussian_is_culled_and_the_others_stay",
            _H + "test_non_finite_harmonics_are_culled",
            _P + "test_any_numbers_give_sane_images_and_gradients",
        ],
        "skipping a step whose loss is not finite is the trainer's",
    ),
    (
        "NaN hidden by culling; ratio of determinants underflows",
        [
            _H + "test_poisoned_gaussians_show_in_their_radii_though_not_in_the_image",
            _H + "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased",
        ],
        "",
    ),
    ("NaN spreads in squares", [_H + "test_ssim_sees_no_nan_of_a_poisoned_scene"], ""),
    (
        "Inf scale, NaN radius, uninitialised keys",
        [
            _H + "test_infinite_and_enormous_scales_are_culled",
            _H + "test_extreme_scales",
            _H + "test_what_overflows_and_is_culled_gets_zero_gradients",
            _H + "test_a_tall_image_needs_more_tile_spans_than_are_kept",
        ],
        "same predicate when counting and emitting",
    ),
    (
        "Near plane",
        [
            _H + "test_near_plane",
            _H + "test_gaussian_on_the_near_plane_is_culled",
            _H + "test_scale_of_the_world_does_not_matter",
        ],
        "which near plane suits a scene is the trainer's",
    ),
    (
        "Frustum-edge Jacobian blow-up",
        [
            _H + "test_frustum_edge_jacobian_is_clamped_about_the_principal_point",
            _H + "test_footprint_beyond_the_frustum_is_bounded_by_the_clamp",
            _H + "test_no_gradient_passes_the_frustum_clamp",
            _H + "test_principal_point_off_centre_and_outside",
            _H + "test_a_crop_with_the_principal_point_aside_is_the_crop_of_the_image",
            _P + "test_footprints_at_the_frustum_edge_are_bounded",
        ],
        "the clamp still turns long splats beyond the edge; their size is bounded",
    ),
    (
        "Degenerate 2D covariance",
        [
            _H + "test_a_point_is_as_wide_as_the_low_pass",
            _H + "test_degenerate_covariances",
            _H + "test_long_thin_gaussians_keep_their_precision",
            _H + "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased",
        ],
        "",
    ),
    (
        "Zero or non-unit quaternion",
        [_H + "test_zero_quaternion_is_culled", _H + "test_length_of_a_quaternion_does_not_matter"],
        "",
    ),
    (
        "Zero scale, log-scale explosion",
        [
            _H + "test_extreme_scales",
            _H + "test_infinite_and_enormous_scales_are_culled",
            _H + "test_a_point_is_as_wide_as_the_low_pass",
        ],
        "pruning by size is the trainer's",
    ),
    (
        "Alpha clamp and saturated opacity",
        [
            _H + "test_opacity_at_its_ends",
            _H + "test_no_gradient_passes_the_alpha_clamp",
            _H + "test_pixel_stops_once_it_is_opaque",
        ],
        "",
    ),
    (
        "Opacity reset kills Gaussians",
        [_H + "test_faint_gaussians_lose_their_gradient_where_they_can_be_counted"],
        "the rasteriser's part: such Gaussians have no radius and no weight, so they can be counted",
    ),
    (
        "Hard 1/255 cut-off breaks gradcheck",
        ["test_reference.py::test_gradients_are_those_of_finite_differences"],
        "a scene kept clear of the cut-offs",
    ),
    (
        "SH clamp at 0 traps black Gaussians",
        [_H + "test_black_harmonics_can_become_brighter_but_not_darker", _H + "test_colours_have_no_ceiling"],
        "",
    ),
    (
        "Huge screen radius",
        [
            _H + "test_opaque_gaussians_reach_beyond_three_sigma",
            _H + "test_one_gaussian_over_all_pixels",
            _H + "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel",
            _H + "test_ten_thousand_gaussians_in_one_pixel",
            _H + "test_ten_thousand_gaussians_in_one_pixel_take_memory_by_the_gaussian",
        ],
        "",
    ),
    (
        "Tile-key overflow",
        [
            _H + "test_more_hits_than_an_index_holds_are_refused_before_memory_is_taken",
            _H + "test_images_wider_than_a_tile_column_can_say_are_refused",
        ],
        "",
    ),
    (
        "Empty frustum, zero Gaussians",
        [_H + "test_no_gaussians", _H + "test_nothing_in_view", _H + "test_no_cameras"],
        "",
    ),
    (
        "More than 2^24 samples",
        [_H + "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel"],
        "the rasteriser's part: sums over more pixels than float32 can count",
    ),
    (
        "SSIM",
        [
            _H + "test_images_smaller_than_the_window_of_ssim_are_compared_by_l1_alone",
            _H + "test_ssim_takes_one_as_the_range_of_the_data",
            "test_ssim.py::test_refuses_what_it_cannot_do",
        ],
        "",
    ),
    (
        "Wrong poses or scene scale",
        [_H + "test_scale_of_the_world_does_not_matter", _P + "test_scaling_the_world_scales_the_depth"],
        "the rasteriser's part: a world of any scale renders the same",
    ),
]
"""Rows of the list of known failures that concern rendering: (row, tests, remark)."""
_S, _D, _T = "train/test_stability.py::", "deformation/", "train/"
TRAINING: list[tuple[str, list[str], str]] = [
    (
        "NaN loss, everything dies in 1 to 2 steps",
        [
            _S + "test_one_bad_number_is_named_and_the_run_goes_on",
            _S + "test_a_gradient_of_its_own_costs_a_gaussian_and_no_more",
            _S + "test_too_much_to_repair_ends_in_words",
            _T + "test_adam.py::test_a_step_that_is_not_finite_changes_nothing",
            _T + "test_train.py::test_a_run_that_keeps_failing_ends_in_words",
        ],
        "the step is left out, the offender dropped or mended and named; no restart",
    ),
    (
        "NaN hidden by culling",
        [
            _S + "test_one_bad_number_is_named_and_the_run_goes_on",
            _S + "test_what_was_in_order_stays_as_it_was_row_by_row",
            "gaussians/test_model.py::test_budget_is_never_exceeded_and_nan_is_pruned",
        ],
        "parameters and moments are looked over every 10 steps, whatever the loss says",
    ),
    (
        "NaN spreads in squares",
        [
            _S + "test_a_frame_with_bad_pixels_is_left_out_from_then_on",
            _S + "test_a_bad_frame_does_not_keep_the_gate_shut",
        ],
        "from an image",
    ),
    (
        "Zero scale, log-scale explosion",
        [_T + "test_adam.py::test_range_is_kept", _S + "test_a_gaussian_too_large_for_its_place_is_dropped"],
        "",
    ),
    ("Opacity reset kills Gaussians", [], "opacities are never reset"),
    ("More than 2^24 samples", [], "nothing is drawn by `torch.multinomial`"),
    (
        "Wrong poses or scene scale",
        [
            "test_scene.py::test_normalisation_keeps_every_pixel_and_leads_back",
            "test_scene.py::test_a_camera_that_stands_still_is_refused",
            "solve/test_solving.py::test_points_are_filtered",
            "solve/test_solving.py::test_models_that_nothing_could_be_trained_on_are_refused",
        ],
        "",
    ),
    (
        "Divergence without NaN",
        [
            _S + "test_a_field_that_throws_gaussians_out_of_the_scene_is_put_back",
            _S + "test_a_hasty_step_of_one_attribute_is_trained_away",
            _S + "test_whole_runs_of_every_host_stay_finite_and_alike",
        ],
        'docs/benchmarks.md, "Stability"',
    ),
    ("Floaters in front of the camera", [], "no remedy of its own and no test; held-out views are shown"),
    ("Exposure drift", [_T + "test_exposure.py::test_finds_a_drift"], "fitted from the first step, before the gate"),
    ("Rolling shutter", [], "neither detected nor tested; there is a synthetic scene to measure it on"),
    ("Moving shadows, light", [], "no test; there is a synthetic scene to measure them on"),
    ("Time-plane half range", [_D + "test_hexplane.py::test_ends_of_time_hit_the_end_nodes"], ""),
    (
        "HexPlane out of bounds",
        [
            _D + "test_planes.py::test_the_published_lookup_pulls_points_as_float64_does",
            _D + "test_planes.py::test_a_gaussian_at_nan_stays_inside_the_planes",
        ],
        "the rim's feature holds, and pulls nobody; the box is that of the Gaussians that open, and a margin",
    ),
    (
        "Single or duplicate timestamps",
        [
            _D + "test_planes.py::test_planes_of_two_nodes_do_not_bend",
            "supervision/test_supervision.py::test_paper_needs_a_well_supervised_reference_and_two_times",
        ],
        "with one pose the camera stands still: refused (`test_scene.py`)",
    ),
    (
        "ARAP SVD",
        [
            _D + "test_geometry.py::test_collapsed_flat_and_bad_edges",
            _D + "test_control_points.py::test_penalties_are_finite_at_collapsed_nodes",
            _S + "test_control_points_on_one_spot_stay_finite",
        ],
        "",
    ),
    (
        "6-DoF rotation of angle 0",
        [
            _D + "test_geometry.py::test_screw_has_gradients_at_angle_zero",
            _D + "test_mlp.py::test_six_dof_is_still_at_the_start_and_has_gradients_there",
        ],
        "",
    ),
]
"""Rows that concern training: (row, tests in tests/backend, remark)."""


def _known(rows: list[tuple[str, list[str], str]]) -> list[str]:
    """The table of known failures."""
    lines = ["| known failure | tests | remark |", "|---|---|---|"]
    return lines + [f"| {row} | {'<br>'.join(f'`{t}`' for t in tests)} | {remark} |" for row, tests, remark in rows]


def test_names() -> set[str]:
    """`file::function` of all tests of the rasteriser."""
    names = set()
    for path in (ROOT / "tests" / "backend" / "raster").glob("test_*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names |= {f"{path.name}::{node.name}" for node in tree.body if isinstance(node, ast.FunctionDef)}
    return names


BARS = {"W0": (0.0, 1e-4), "W1": (100.0, 4e-4)}
"""Workload: least PSNR in dB over all pixels, largest relative L2 gradient error of any input."""
_TITLES = {
    "cpu": "cpu: compiled, float32",
    "reference32": "reference32: the torch reference in float32",
    "cuda": "cuda: the CUDA kernels, here on CPU fibers (smaller scenes)",
    "gpu": "gpu: the CUDA kernels on a GPU",
}
_NOTES = """\
- **Flips.** Alpha below 1/255 is dropped, so a pixel within rounding of the cut moves by up to 4e-3 with the last bit
  of an input. No body is wrong there and no two need agree: such pixels are left out of errors and gradients, and
  their share is bounded (2 % unless said otherwise). Pixels count as the same side when their alphas differ by less
  than 3e-4. A pixel that is opaque in the end hides a flip from its alpha, and that flip stays in the errors: on W1,
  measured once by hand, two of 57,600 pixels of the body cpu were off by more than 1e-5 (by 7e-4 at most); without
  those two, its gradients were within 8e-6 of the oracle for every input, not 3e-4.
- **Background.** Float32 keeps 1 - alpha to 6e-8 at best. Where everything is opaque the background's gradient is of
  that size and has no digits; its error is therefore given relative to 1 % at least of the gradient in an empty
  scene.
- **Saturated opacity.** torch's float32 sigmoid of 17 is 1, its gradient 0: the plain reference loses gradients of
  3e-7 that the other bodies keep, because they form exp(-|x|).
- **Far from the origin.** World to camera is done in float32. At 1400 units from the origin it cancels to 1e-4 of a
  unit: normalise scenes, as `scene.py` does.
- **Enormous Gaussians.** Beyond 1e12 px^2 of projected variance a Gaussian is culled in all bodies, since float32
  could not invert its covariance. On that cut bodies may round to different sides; nothing else is promised of them
  there.
- **Enormous colours.** Images are right for any finite colour. Gradients of positions are proportional to colours,
  and overflow to infinity when those pass 1e30 or so; the generated cases ask for finite ones up to 1e6.
- **Beyond the frustum.** The Jacobian's clamp bounds how large a splat may get off screen, and leaves its shape wrong
  there (turned, not only stretched), in every body alike. Views far from the training views show more of that.
"""


def _cell(value: float) -> str:
    return "0" if value == 0 else f"{value:.0e}".replace("e-0", "e-")


def _table(rows: list[tuple[str, Errors]]) -> list[str]:
    """Markdown of errors, one line per scene."""
    head = ["", "flips", "max", "dB", *INPUTS]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, e in rows:
        gradients = [_cell(e.gradients[i]) if i in e.gradients else "" for i in INPUTS]
        decibels = "exact" if math.isinf(e.psnr) else f"{e.psnr:.0f}"
        lines.append(f"| {name} | {100 * e.flips:.2g} % | {_cell(e.image)} | {decibels} | {' | '.join(gradients)} |")
    return lines


def _generated(asked: int) -> str:
    """Run the property tests; their count of generated cases, and pytest's verdict."""
    command = [sys.executable, "-P", "-m", "pytest", "-q", "tests/backend/raster/test_properties.py"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **({"SPLANNEQUIN_CASES": str(asked)} if asked else {})}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    counts = [line for line in run.stdout.splitlines() if line.startswith("rasteriser:")]
    if not counts:
        raise SystemExit(f"the property tests did not run:\n{run.stdout[-2000:]}{run.stderr[-1000:]}")
    total, _, parts = counts[0].removeprefix("rasteriser: ").partition(" generated cases ")
    verdict = run.stdout.splitlines()[-1].strip("= ")
    lines = [
        f"{int(total):,} cases, {verdict} (one test per property and body):",
        "",
        "| property | cases |",
        "|---|---|",
    ]
    for part in parts.strip("()").split(", "):
        name, count = part.rsplit(" ", 1)
        lines.append(f"| {name.removeprefix('test_').replace('_', ' ')} | {count} |")
    return "\n".join(lines)


def _machine() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ", no GPU"
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("torch", "warp-lang", "numpy"))
    return f"{model}, {os.cpu_count()} cores{gpu}; {platform.system()}, Python {platform.python_version()}, {versions}"


def _workloads(bodies: list[str]) -> list[str]:
    """The rooms of benchmarks/raster.py: errors over all pixels and per input, against the bars."""
    lines = [
        "| workload, body | flips | dB, all pixels | dB | " + " | ".join(i for i in INPUTS if i != "sh") + " | bars |",
        "|---" * (len(INPUTS) + 4) + "|",
    ]
    for name, (least, most) in BARS.items():
        scene = workload(name)
        for body in bodies:
            if body == "cuda" and name != "W0":
                continue  # on fibers it would take minutes
            e = compare(scene, body)
            held = e.psnr_all >= least and e.gradient <= most
            asked = (f">= {least:.0f} dB, " if least else "") + f"<= {_cell(most)}"
            cells = " | ".join(f"{e.gradients[i]:.1e}" for i in INPUTS if i in e.gradients)
            lines.append(
                f"| {name}, {body} | {100 * e.flips:.2g} % | {e.psnr_all:.1f} | {e.psnr:.1f} | {cells} | "
                f"{asked}: {'held' if held else 'MISSED'} |"
            )
    return lines


def report(bodies: list[str], names: list[str], asked: int) -> str:
    """The whole of docs/numerics.md."""
    text = [
        "# Numerics of the rasteriser",
        "",
        "Written by `python benchmarks/numerics.py`; do not edit. Errors of each body against the float64 oracle "
        "(torch, autograd) on inputs rounded to float32.",
        "",
        f"{datetime.date.today().isoformat()}; {_machine()}.",
        "",
        "`max` is the largest colour error, `dB` the PSNR, both at pixels without flips and for a peak of 1 (or the "
        "brightest channel); `flips` is the share of the other pixels; the columns after that are relative L2 errors "
        "of gradients. Empty: no such input.",
        "",
        "## Two rooms",
        "",
        "W0: 400 Gaussians, 64 x 48. W1: 20,000 Gaussians, 320 x 180. Gradients are of a random weighting of colours "
        "and alphas, at pixels without flips.",
        "",
        *_workloads(bodies),
        "",
        "## Notes on conditioning",
        "",
        _NOTES.rstrip(),
    ]
    notes = {name: CASES[name].note for name in names if CASES[name].note}
    text += [f"- **{name}.** {note[0].upper()}{note[1:]}." for name, note in notes.items()]
    text += [
        "",
        "## Generated cases",
        "",
        "Properties that hold for every input (`tests/backend/raster/test_properties.py`): " + _generated(asked),
        "",
        "`SPLANNEQUIN_CASES=20000 python -m pytest tests/backend/raster/test_properties.py` tries that many of each.",
        "",
        "## Known failures, and the tests that stand for them",
        "",
        "`tests/backend/raster/remedies.py` takes the remedies out, one at a time, and checks that these tests fail.",
        "",
        *_known(ROWS),
        "",
        "## The same, of training",
        "",
        "Tests in `tests/backend`.",
        "",
        *_known(TRAINING),
        "",
        "## Hard cases, body by body",
        "",
    ]
    for body in bodies:
        rows = [(name, compare(size(name, body), body)) for name in names]
        text += [f"### {_TITLES[body]}", "", *_table(rows), ""]
        for name, e in rows:
            if not all(bool(torch.isfinite(g).all()) for g in e.grads.values()):
                text.append(f"Gradients of '{name}' are NOT finite.")
    text += ["Bounds that the tests assert:", "", "| case | dB | gradient | flips |", "|---|---|---|---|"]
    for name in names:
        case = CASES[name]
        gradient = "finite" if case.gradient is None else _cell(case.gradient)
        plain = f" (reference32: {_cell(case.plain)})" if case.plain else ""
        text.append(f"| {name} | {case.psnr:.0f} | {gradient}{plain} | {100 * case.flips:.0f} % |")
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    others = [body for body in BODIES if body != "reference"]
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "numerics.md", metavar="FILE")
    parser.add_argument("--bodies", nargs="+", choices=others, default=others)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE")
    parser.add_argument("--generate", type=int, default=0, metavar="N", help="cases per property, not the tests' usual")
    arguments = parser.parse_args()
    text = report(arguments.bodies, arguments.cases, arguments.generate)
    partial = arguments.out.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(arguments.out)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
