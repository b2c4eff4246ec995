"""Visibility of world points in a plate: on the processor a C++ kernel compiled by Warp, on a card torch's operators.

The kernel fuses `project`, `inside` and `look_up` of `reproject.py` with a comparison of depths. A frozen frame needs
it for about 30 plates. As 40 tensor operators it took a third of the time per frame.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ...kernel_text import kernel_text
from ...native import INTEGER, POINTER, Snippet
from .reproject import inside, look_up, project

_POINTS = 2048
"""Number of points per unit of work."""
_KERNEL = Path(__file__).with_name("kernels") / "visibility.cpp"


@dataclass
class Visibility:
    """Visibility of points in one plate; leading dimensions are those of the points."""

    pixels: Tensor
    """[..., 2] in pixels at decision resolution; (-1e6, -1e6) for points behind the camera."""
    depth: Tensor
    """[...] depth along the camera's axis."""
    visible: Tensor
    """[...] in 0..1: the point is inside the picture and not occluded."""
    moving: Tensor
    """[...] in 0..1: the plate's motion matte at the pixel."""
    explained: Tensor
    """[...] in 0..1: agreement of model and plate at the pixel, as in `PlateView.surface`."""


@functools.cache
def _snippet() -> Snippet:
    pointers = (
        "points", "camera", "surface", "ignored", "settings", "pixels", "depth", "visible", "moving", "explained",
    )  # fmt: skip
    fields = {**dict.fromkeys(pointers, POINTER), **dict.fromkeys(("count", "width", "height"), INTEGER)}
    return Snippet("visibility", fields, kernel_text(_KERNEL).replace("@POINTS@", str(_POINTS)))


def warm_up() -> None:
    """Compiles the kernel, or loads it from the cache. Call this from the main thread."""
    _snippet().warm_up()


def visible_pixels(
    points: Tensor, viewmat: Tensor, K: Tensor, surface: Tensor, ignored: Tensor | None, tolerance: float,
    soft: float,
) -> Visibility:  # fmt: skip
    """Visibility of world points [..., 3] in a plate. Not differentiable.

    Args:
        viewmat: [4, 4] world-to-camera.
        K: [3, 3] in pixels of `surface`.
        surface: [h, w, 3] median depth, motion matte and agreement, as in `PlateView`.
        ignored: [h, w, 1] in 0..1, ignored pixels; None: no pixel is ignored.
        tolerance: relative depth difference up to which a point belongs to the surface.
        soft: width in pixels of the ramp at the border over which visibility falls to 0.

    Raises:
        ValueError: a tensor is not float32, or on another device than `surface`.
    """
    tensors = [value for value in (points, viewmat, K, surface, ignored) if value is not None]
    if any(value.dtype != torch.float32 or value.device != surface.device for value in tensors):
        raise ValueError("points, cameras, surface and ignored must be float32 and on one device")
    if surface.device.type != "cpu":
        return visible_by_operators(points, viewmat, K, surface, ignored, tolerance, soft)
    shape, height, width = points.shape[:-1], *surface.shape[:2]
    points, surface = points.contiguous(), surface.contiguous()
    ignored = None if ignored is None else ignored.contiguous()
    camera = torch.cat([viewmat[:3].flatten(), torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])]).contiguous()
    settings = torch.tensor([tolerance, soft], device="cpu")
    pixels = torch.empty(*shape, 2, device="cpu")
    depth, visible, moving, explained = (torch.empty(shape, device="cpu") for _ in range(4))
    count = depth.numel()
    _snippet().run(
        1 if count <= 4 * _POINTS else None, points=points.data_ptr(), camera=camera.data_ptr(),
        surface=surface.data_ptr(), ignored=0 if ignored is None else ignored.data_ptr(), settings=settings.data_ptr(),
        pixels=pixels.data_ptr(), depth=depth.data_ptr(), visible=visible.data_ptr(), moving=moving.data_ptr(),
        explained=explained.data_ptr(), count=count, width=width, height=height,
    )  # fmt: skip
    return Visibility(pixels, depth, visible, moving, explained)


def visible_by_operators(
    points: Tensor, viewmat: Tensor, K: Tensor, surface: Tensor, ignored: Tensor | None, tolerance: float, soft: float
) -> Visibility:
    """`visible_pixels` by torch's operators, on any device; the kernel's results up to rounding."""
    pixels, depth = project(points, viewmat, K)
    near, moving, explained = look_up(surface, pixels).unbind(-1)
    free = inside(pixels, surface.shape[1], surface.shape[0], soft)
    if ignored is not None:
        free = free * (1.0 - look_up(ignored, pixels)[..., 0])
    off = (depth - near) / (tolerance * depth.clamp_min(1e-6))
    visible = (torch.exp(-off.square()) * free).nan_to_num(0.0)  # non-finite points are invisible
    return Visibility(pixels, depth, visible, moving, explained)
