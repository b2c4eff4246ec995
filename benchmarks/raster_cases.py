"""Hard cases of the rasteriser: scenes, and the bounds asserted by tests/backend/raster/test_hard_cases.py."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from benchmarks.raster_errors import Scene, camera, cloud, single, stack
from torch_backend.raster import RasterSettings


@dataclass(frozen=True)
class Case:
    """One hard case: a scene, and the allowed errors of a float32 backend against the reference."""

    build: Callable[[bool], Scene]
    """Builds the scene; with True, a small one for slow CPU fibers."""
    psnr: float = 100.0
    """Least PSNR in dB at pixels without flips, relative to a peak of 1 or the brightest channel if greater."""
    gradient: float | None = 5e-4
    """Largest relative L2 gradient error of any input at pixels without flips; None requires finite values only."""
    flips: float = 0.02
    """Largest share of pixels with flips."""
    note: str = ""
    """Reason for a wider bound."""
    plain: float | None = None
    """Wider bound on gradients for plain torch in float32 (body reference32), or None."""


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
    """Gaussians behind the camera, behind, on and just beyond the near plane, and some that extend through it."""
    scene = cloud(30, 24, 18, seed=11, settings=RasterSettings(threads=2, near=0.25))
    scene.tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    z = torch.tensor([-5, -0.25, -1e-8, 0, 1e-38, 1e-8, 0.2499, 0.25, 0.25 + 2**-20, 0.2501, 0.26, 0.3])
    scene.tensors["means"][: len(z), :2] *= 0.1
    scene.tensors["means"][: len(z), 2] = z.double()
    scene.tensors["log_scales"][10:20] = torch.linspace(-2, 1, 10)[:, None].double()
    return scene


def _frustum_edge(small: bool) -> Scene:
    """Long Gaussians near the camera and far to the side, whose footprint explodes without the clamp."""
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
    """Discs seen edge-on, points and lines, whose projected covariance is singular before the blur."""
    scene = cloud(24, 24, 18, seed=9)
    scene.tensors["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene.tensors["quats"] = torch.tensor([1.0, 0, 0, 0]).double().repeat(24, 1)
    kinds = torch.tensor([[-1.5, -40, -1.5], [-40, -40, -1.5], [-40, -40, -40], [-1.5, -40, -40]]).double()
    scene.tensors["log_scales"] = kinds.repeat(6, 1)
    scene.tensors["means"][:8, :2] = 0
    return scene


def _quaternions(small: bool) -> Scene:
    """Quaternions of length zero, shorter than the cut, and up to the greatest lengths of float32."""
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
    """One Gaussian that covers all pixels, and two inside it."""
    size = (40, 36) if small else (300, 200)
    scene = stack(single(*size, focal=float(size[0]), scale=4.0), 3)
    scene.tensors["log_scales"] += torch.tensor([0.3, 0.0, -0.3])
    scene.tensors["log_scales"][1:] -= 3.0
    scene.tensors["quats"][:, 1:] = torch.tensor([0.2, 0.1, 0.4])
    scene.tensors["means"][1] = torch.tensor([0.3, 0.1, 1.8])
    return scene


def _image(width: int, height: int) -> Callable[[bool], Scene]:
    return lambda small: cloud(60, width, height, with_depth=True)


def _behind_the_camera(small: bool) -> Scene:
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
    """Builder of a scene with world, near plane and camera positions scaled by `factor`."""

    def build(small: bool) -> Scene:
        scene = cloud(60, 32, 24, seed=14, settings=RasterSettings(threads=2, near=0.01 * factor))
        scene.tensors["means"] *= factor
        scene.tensors["log_scales"] += math.log(factor)
        scene.tensors["viewmats"][:, :3, 3] *= factor
        return scene

    return build


def _far_from_the_origin(small: bool) -> Scene:
    """World and camera 1400 units from the origin, where float32 resolves positions to 3e-5 units, or 4e-4 px."""
    scene = cloud(60, 32, 24, seed=15)
    offset = torch.tensor([1000.0, -500.0, 800.0]).double()
    scene.tensors["means"] += offset
    view = scene.tensors["viewmats"][0]
    view[:3, 3] -= view[:3, :3] @ offset
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
        note="gradients of sheets nearly uniform across the picture are small differences of large numbers",
    ),
    "scales of e^-20, e^-50, 0": Case(_scales(-20.0, -50.0, -math.inf)),
    "the same, antialiased": Case(_scales(-20.0, -50.0, -math.inf, antialiased=True)),
    "behind, on, just beyond, through the near plane": Case(_near_plane, gradient=5e-3),
    "elongated at and beyond the frustum's edge": Case(_frustum_edge),
    # Expanding the conic in float32, or computing det = xx yy - xy^2, would lose three digits.
    "needles 1 : 1000": Case(_needles(False), gradient=2e-3),
    "needles 1 : 1000, antialiased": Case(_needles(True), gradient=5e-3),
    "points, lines, discs from the side": Case(_edge_on),
    "quaternions of length 0, 1e-38 ... 1e37": Case(_quaternions),
    "opacity 1 (logits 15, 100, inf)": Case(
        _opacities(15.0, 100.0, math.inf),
        plain=0.5,
        note="torch's float32 sigmoid is 1 beyond 17, so its gradients of 3e-7 vanish",
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
    "nothing in view": Case(_behind_the_camera),
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
        note="positions are exact float32 numbers; their transform to the camera subtracts 1400 from 1400",
    ),
    "equal depths": Case(_equal_depths),
}


def size(case: str, body: str) -> Scene:
    """The scene of a case, small for the body `cuda`."""
    return CASES[case].build(body == "cuda")
