"""The freeze as a warp of the artist's own plate, one EXR per frame.

    frozen = matte * plate(ST) + fill        scene-linear, premultiplied

`ST` is an image of coordinates as in `lens/stmap.py` (s to the right, t up, pixel centres at (i + 0.5) / size) over
the undistorted plate. `matte` is the share of a pixel that comes from that plate. `fill` is the rest, from other plates
and splats. Where nothing moves, ST is the identity, matte is 1 and fill is 0. The plate, graded or not, is then
reproduced exactly.

The filter is bilinear, on coordinates rounded to 1/256 of a pixel, so that a pixel's centre gives that pixel bit for
bit. Without the rounding, float32 coordinates of a wide plate are off by about 1e-4 pixels, which is visible next to a
highlight of 50.

Of the filters of Blender's Map UV node, only Nearest exists in all versions from 4.2 to 5.2 and keeps the identity. Its
coordinates must point a quarter of a pixel past the pixel's corner, because in 4.3 the centre gives the next pixel.
Bilinear exists since 5.0 and has the float32 error. Anisotropic blurs the identity in 4.2, 4.3 and 5.2; Bicubic always
does. The add-on's node group therefore blends four Nearest look-ups, and agrees with `sample` to 1e-4 relative.

The channel names are the result of tests with the bpy wheels 4.2.23, 4.5.15, 5.0.1 and 5.2.3: `CHANNELS` become the
sockets Combined (the fill), Alpha, ST and Matte of one Image node. Rejected: `forward.u` and `forward.v` (4.2 and 5.2
read two channels wrongly), and `ST.R` (read as a colour, and converted if the scene's colours are not Rec.709).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ...contract import UserError
from ...footage.color import LIGHTS, in_light, light_matrix
from ...torch_types import from_numpy
from ..exr import linear_spec, read_layers, read_light, set_margin, write_exr
from ..views.reproject import pair

CHANNELS = ("R", "G", "B", "A", "ST.X", "ST.Y", "ST.Z", "Matte.V")
"""Channels of the fill, the frame's alpha, ST (s, t and 1) and the matte."""
WARP_VERSION = 1
"""Version of the `splannequin:` attributes of a warp."""
STEPS = 256
"""Number of coordinate steps per pixel."""
MATTE_STEPS = 1024.0
"""Number of steps of a matte from 0 to 1. Half floats store them exactly, so that matte and fill match in a file."""

_FORMATS = (oiio.HALF,) * 4 + (oiio.FLOAT,) * 3 + (oiio.HALF,)
_ROWS = 256


@dataclass(frozen=True)
class WarpMetadata:
    """Metadata of a warp, stored as EXR attributes."""

    frame: int
    """Frame number in the clip's own numbering."""
    primary: int
    """Frame number of the plate that ST refers to: `frame` on the clip's poses, else the plate nearest in pose."""
    t_star_frame: float
    """Frozen instant, as a (fractional) frame number of the clip."""
    plate_width: int
    """Width in pixels of the plate that ST refers to."""
    plate_height: int
    """Height in pixels of the plate that ST refers to."""
    key: str = ""
    """Key of the frame's inputs, to detect a stale warp."""
    light: str = LIGHTS[0]
    """Primaries of the light in the file, one of `LIGHTS`. `Warp.fill` is always in Rec.709."""
    version: int = WARP_VERSION
    """Version of these attributes."""


@dataclass(frozen=True, eq=False)
class Warp:
    """One warp as read from a file; tensors are float32 on the CPU."""

    st: Tensor
    """[H,W,2] s and t, 0..1 over the plate."""
    matte: Tensor
    """[H,W] in 0..1."""
    fill: Tensor
    """[H,W,3] scene-linear, premultiplied."""
    alpha: Tensor
    """[H,W] in 0..1: how opaque the frozen frame is."""
    metadata: WarpMetadata
    margin: tuple[int, int] = (0, 0)
    """Pixels of overscan (left and right, above and below), included in the tensors."""


def snap(st: Tensor, plate_size: tuple[int, int]) -> Tensor:
    """ST [H,W,2] over a plate of (width, height), rounded to multiples of 1/`STEPS` of a pixel; float32."""
    size = pair(*plate_size, st.new_empty(0, dtype=torch.float64))
    out = torch.empty(st.shape, dtype=torch.float32, device=st.device)
    for top in range(0, st.shape[0], _ROWS):
        rows = st[top : top + _ROWS].double()
        out[top : top + _ROWS] = ((((rows * size - 0.5) * STEPS).round() / STEPS + 0.5) / size).float()
    return out


def sample(plate: Tensor, st: Tensor) -> Tensor:
    """[H,W,C] float32: a plate [h,w,C] sampled bilinearly at ST [H,W,2]; its border pixels are repeated outside."""
    height, width = plate.shape[:2]
    flat = plate.reshape(height * width, -1)
    out = torch.empty((*st.shape[:2], flat.shape[1]), dtype=torch.float32, device=plate.device)
    for top in range(0, st.shape[0], _ROWS):
        rows = st[top : top + _ROWS].double()
        left, right, across = _between(rows[..., 0], width)
        lower, upper, up = _between(rows[..., 1], height)
        above, below = (height - 1 - upper) * width, (height - 1 - lower) * width
        bottom = (1.0 - across) * flat[below + left] + across * flat[below + right]
        out[top : top + _ROWS] = (1.0 - up) * bottom + up * (
            (1.0 - across) * flat[above + left] + across * flat[above + right]
        )
    return out


def _between(share: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Indices [H,W] int64 of two neighbouring pixels on an axis of `size`, and the second one's weight [H,W,1]."""
    at = (((share * size - 0.5) * STEPS).round() / STEPS).clamp(0.0, size - 1.0)
    first = at.floor()
    return first.long(), (first.long() + 1).clamp(max=size - 1), (at - first).float()[..., None]


def apply_warp(plate_linear: Tensor, warp: Warp) -> Tensor:
    """[H,W,3] the frozen frame, scene-linear, premultiplied, of a plate [h,w,3]: matte * plate(ST) + fill.

    ValueError if the plate's size differs from the size that the warp was made for.
    """
    metadata = warp.metadata
    if plate_linear.shape != (metadata.plate_height, metadata.plate_width, 3):
        raise ValueError(
            f"the warp of frame {metadata.frame} is for a plate of {metadata.plate_width} x "
            f"{metadata.plate_height} with 3 channels, got shape {list(plate_linear.shape)}"
        )
    return warp.matte[..., None] * sample(plate_linear.float(), warp.st) + warp.fill


def write_warp(
    path: str | Path,
    st: ArrayLike,  # [H,W,2]
    matte: ArrayLike,  # [H,W]
    fill: ArrayLike,  # [H,W,3]
    alpha: ArrayLike,  # [H,W]
    metadata: WarpMetadata,
    margin: tuple[int, int] = (0, 0),
) -> Path:
    """Writes one warp atomically: float32 ST, the rest half, ZIP. Arrays as in `Warp`, ST from `snap`.

    Half floats store mattes in steps of 1/1024 exactly, and the fill with a relative error of at most 5e-4. The frame's
    error is as small, because the fill only adds light to the plate's share. With a `margin` the arrays are the data
    window, as in `write_frozen_exr`.

    ValueError names the layer whose shape is wrong or that holds NaN or infinity; OSError if the file cannot be
    written (errno ENOSPC when the disk is full).
    """
    layers = {"st": st, "matte": matte, "fill": fill, "alpha": alpha}
    with np.errstate(over="ignore"):
        arrays = {name: np.asarray(layer, dtype=np.float32) for name, layer in layers.items()}
    shape = arrays["matte"].shape
    if len(shape) != 2 or not arrays["matte"].size:
        raise ValueError(f"matte should be [H,W], got shape {list(shape)}")
    for name, beyond in (("st", (2,)), ("fill", (3,)), ("alpha", ())):
        if arrays[name].shape != (*shape, *beyond):
            raise ValueError(f"{name} should be {[*shape, *beyond]} like matte, got shape {list(arrays[name].shape)}")
    spec = linear_spec(shape[1], shape[0], CHANNELS, _FORMATS, metadata.light)
    _describe(spec, metadata)
    set_margin(spec, margin)
    ones = np.broadcast_to(np.float32(1.0), (*shape, 1))
    fill_in_light = in_light(arrays["fill"], light_matrix(metadata.light))
    parts = {"fill": fill_in_light, "alpha": arrays["alpha"], "st": arrays["st"], "one": ones, "matte": arrays["matte"]}
    return write_exr(Path(path), spec, [*parts.values()], [*parts])


def read_warp(path: str | Path) -> Warp:
    """Reads a file of `write_warp`.

    FileNotFoundError if there is no file; ValueError if it cannot be read, is not a warp, or is from a newer version.
    """
    spec, names, metadata, pixels = read_layers(Path(path), CHANNELS, "no warp", _metadata)
    found = from_numpy(pixels)
    fill, alpha, st, matte = (
        found[..., [names.index(name) for name in part]].squeeze(-1)
        for part in (CHANNELS[:3], CHANNELS[3:4], CHANNELS[4:6], CHANNELS[7:])
    )
    forth = light_matrix(metadata.light)
    if forth is not None:
        fill = from_numpy(in_light(fill.numpy(), np.linalg.inv(forth)))
    return Warp(st, matte, fill, alpha, metadata, (spec.full_x - spec.x, spec.full_y - spec.y))


def _describe(spec: oiio.ImageSpec, metadata: WarpMetadata) -> None:
    if not math.isfinite(metadata.t_star_frame):
        raise ValueError(f"metadata.t_star_frame should be finite, got {metadata.t_star_frame}")
    if min(metadata.plate_width, metadata.plate_height) < 1:
        raise ValueError(f"metadata: a plate of {metadata.plate_width} x {metadata.plate_height} has no pixels")
    spec.attribute("splannequin:frame", int(metadata.frame))
    spec.attribute("splannequin:leading", int(metadata.primary))
    spec.attribute("splannequin:tStarFrame", float(metadata.t_star_frame))
    spec.attribute("splannequin:plateWidth", int(metadata.plate_width))
    spec.attribute("splannequin:plateHeight", int(metadata.plate_height))
    spec.attribute("splannequin:version", int(metadata.version))
    if metadata.key:
        spec.attribute("splannequin:key", metadata.key)


def _metadata(spec: oiio.ImageSpec, path: Path) -> WarpMetadata:
    names = ("frame", "leading", "tStarFrame", "plateWidth", "plateHeight", "version")
    values = {name: spec.getattribute(f"splannequin:{name}") for name in names}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise UserError(f"{path}: no warp, it has no attribute splannequin:{missing[0]}")
    if values["version"] > WARP_VERSION:
        raise UserError(f"{path}: written by a newer version ({values['version']}, this one reads {WARP_VERSION})")
    return WarpMetadata(
        frame=int(values["frame"]),
        primary=int(values["leading"]),
        t_star_frame=float(values["tStarFrame"]),
        plate_width=int(values["plateWidth"]),
        plate_height=int(values["plateHeight"]),
        key=str(spec.getattribute("splannequin:key") or ""),
        light=read_light(spec),
        version=int(values["version"]),
    )
