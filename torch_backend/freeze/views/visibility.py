"""Where a plate shows world points, and how; C++ compiled by Warp.

What it does is `project`, `inside`, `look_up` and `same_surface` of `reproject.py`, one after another. A frozen frame
asks it of some 30 plates, and of most points in passing only: as 40 operators on tensors that was a third of a frame's
time.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ...kernel_text import kernel_text
from ...native import INTEGER, POINTER, Snippet

_POINTS = 2048
"""Points of a unit of work."""
_KERNEL = Path(__file__).with_name("kernels") / "visibility.cpp"


@dataclass
class Visibility:
    """Where and how points are seen in one plate; leading dimensions are those of the points."""

    pixels: Tensor
    """[..., 2] in pixels of the size of decisions; far outside for what is behind the camera."""
    depth: Tensor
    """[...] along the camera's axis."""
    visible: Tensor
    """[...] in 0..1: within the picture, and nothing in front."""
    moving: Tensor
    """[...] in 0..1, of the plate there."""
    explained: Tensor
    """[...] in 0..1, of the plate there."""


@functools.cache
def _snippet() -> Snippet:
    pointers = (
        "points", "camera", "surface", "ignored", "settings", "pixels", "depth", "visible", "moving", "explained",
    )  # fmt: skip
    fields = {**dict.fromkeys(pointers, POINTER), **dict.fromkeys(("count", "width", "height"), INTEGER)}
    return Snippet("visibility", fields, kernel_text(_KERNEL).replace("@POINTS@", str(_POINTS)))


def warm_up() -> None:
    """Compile, or load from the cache, from the main thread."""
    _snippet().warm_up()


def visible_pixels(
    points: Tensor, viewmat: Tensor, K: Tensor, surface: Tensor, ignored: Tensor | None, tolerance: float,
    soft: float,
) -> Visibility:  # fmt: skip
    """How a plate shows world points [..., 3]. All on the CPU, float32; no gradient. ValueError for others.

    Args:
        viewmat: [4, 4] world-to-camera; K: [3, 3] in pixels of `surface`.
        surface: [h, w, 3] median depth, and in 0..1 what moves and what is explained.
        ignored: [h, w, 1] in 0..1 of what is no part of the scene; None: nothing.
        tolerance: share of its depth by which a point may lie off the surface and still be it.
        soft: pixels along the border over which points stop being seen.
    """
    shape, height, width = points.shape[:-1], *surface.shape[:2]
    points, surface = points.contiguous(), surface.contiguous()
    ignored = None if ignored is None else ignored.contiguous()
    camera = torch.cat([viewmat[:3].flatten(), torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])]).float().contiguous()
    settings = torch.tensor([tolerance, soft], device="cpu")
    tensors = [value for value in (points, surface, ignored, camera) if value is not None]
    if any(value.dtype != torch.float32 or value.device.type != "cpu" for value in tensors):
        raise ValueError("points, cameras, surface and ignored must be float32 and on the CPU")
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
