"""The freeze as a warp: what turns the artist's own plate into the frozen frame, frame by frame, in one EXR each.

    frozen = matte * plate(ST) + fill        scene-linear, premultiplied

`ST` is a picture of coordinates as in `lens/stmap.py` (s to the right, t up, pixel centres at (i + 0.5) / size) over
the undistorted plate, `matte` how much of a pixel that plate gives, `fill` the rest: other plates and splats. Where
nothing moves ST is the identity, matte 1 and fill 0, so the plate leaves as it came, whatever was done to it before.

The filter is bilinear, on coordinates in steps of 1/256 of a pixel: what lies on a pixel's centre is that pixel, bit
for bit, though float32 coordinates of a wide plate are off by some 1e-4 pixels, which beside a highlight of 50 shows.
Of the filters of Blender's Map UV node only Nearest is there from 4.2 to 5.2 and keeps the identity, a quarter into
a pixel (in 4.3 a pixel's centre is the next one's already). Bilinear is there from 5.0 on and has that error;
Anisotropic blurs the identity in 4.2, 4.3 and 5.2, Bicubic wherever it is. So the add-on's group blends four nearest
look-ups by the fraction, and agrees with `sample` to 1e-4 relative.

Channels, by experiment with the bpy wheels 4.2.23, 4.5.15, 5.0.1 and 5.2.3: `CHANNELS` are sockets Combined (the fill),
Alpha, ST and Matte of one Image node. Rejected: `forward.u` and `forward.v` (4.2 and 5.2 read two channels wrongly) and
`ST.R` (taken for a colour, and converted where the scene's colours are not Rec.709).
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
from ..exr import check_finite, linear_spec, read_layers, read_light, set_margin, write_exr

CHANNELS = ("R", "G", "B", "A", "ST.X", "ST.Y", "ST.Z", "Matte.V")
"""Fill and alpha of the whole frame; s, t and 1; matte."""
WARP_VERSION = 1
"""Version of the `splannequin:` attributes of a warp."""
STEPS = 256
"""Coordinates are multiples of one pixel over this."""

_FORMATS = (oiio.HALF,) * 4 + (oiio.FLOAT,) * 3 + (oiio.HALF,)
_ROWS = 256


@dataclass(frozen=True)
class WarpMetadata:
    """What a warp says about itself, stored as EXR attributes."""

    frame: int
    """Frame number in the clip's own numbering."""
    primary: int
    """Number of the plate that ST looks into: `frame` on the clip's poses, else the nearest in pose."""
    t_star_frame: float
    """Instant at which time stands still, as a (fractional) frame number of the clip."""
    plate_width: int
    """Width of the plate in pixels, whose pixels ST counts in."""
    plate_height: int
    """Its height."""
    key: str = ""
    """What it was made from, to tell a stale one: the frame's."""
    light: str = LIGHTS[0]
    """Primaries of the light in the file, one of `LIGHTS`. The fill here is Rec.709's, whatever it is."""
    version: int = WARP_VERSION
    """Version of these attributes."""


@dataclass(frozen=True, eq=False)
class Warp:
    """One warp as read back; tensors float32 on the CPU."""

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
    """Pixels beyond the frame on the left and right, and above and below; the tensors hold them."""


def snap(st: Tensor, plate_size: tuple[int, int]) -> Tensor:
    """ST [H,W,2] over a plate of (width, height), with coordinates on multiples of 1/`STEPS` of a pixel; float32."""
    size = torch.tensor(plate_size, dtype=torch.float64, device=st.device)
    out = torch.empty(st.shape, dtype=torch.float32, device=st.device)
    for top in range(0, st.shape[0], _ROWS):
        rows = st[top : top + _ROWS].double()
        out[top : top + _ROWS] = ((((rows * size - 0.5) * STEPS).round() / STEPS + 0.5) / size).float()
    return out


def sample(plate: Tensor, st: Tensor) -> Tensor:
    """[H,W,C] float32: a plate [h,w,C] seen through ST [H,W,2], bilinear; beyond its border it goes on as it ends."""
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
    """Two neighbouring pixels of a row of `size`, [H,W] int64, and [H,W,1] float32 how far towards the second."""
    at = (((share * size - 0.5) * STEPS).round() / STEPS).clamp(0.0, size - 1.0)
    first = at.floor()
    return first.long(), (first.long() + 1).clamp(max=size - 1), (at - first).float()[..., None]


def apply_warp(plate_linear: Tensor, warp: Warp) -> Tensor:
    """[H,W,3] the frozen frame, scene-linear, premultiplied, of a plate [h,w,3]: matte * plate(ST) + fill.

    ValueError if the plate has not the size that the warp was made for.
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

    Mattes in steps of 1/1024 are exact in half floats, and the fill is off by 5e-4 of itself at most: that is little of
    the frame, too, for a fill that adds light to what the plate gives, instead of taking some away. With a `margin`
    the arrays are the data window, as in `write_frozen_exr`.

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
    for name, layer in arrays.items():
        check_finite(name, layer)
    spec = linear_spec(shape[1], shape[0], CHANNELS, _FORMATS, metadata.light)
    _describe(spec, metadata)
    set_margin(spec, margin)
    ones = np.broadcast_to(np.float32(1.0), (*shape, 1))
    fill_in_light = in_light(arrays["fill"], light_matrix(metadata.light))
    parts = [fill_in_light, arrays["alpha"][..., None], arrays["st"], ones, arrays["matte"][..., None]]
    return write_exr(Path(path), spec, parts)


def read_warp(path: str | Path) -> Warp:
    """Reads a file of `write_warp`.

    FileNotFoundError without a file; ValueError if it cannot be read, is no warp, or is from a newer version.
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
