"""Transfer functions of a `footage.display` for tensors: on the processor a C++ kernel compiled by Warp.

On a card torch's operators are used. `Display` has the same functions for NumPy arrays.
"""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from torch import Tensor

from ...contract import SHOULDER_FROM, SHOULDER_ROLL
from ...footage.color import LINEAR_KNEE, SRGB_KNEE
from ...footage.display import Display
from ...kernel_text import kernel_text
from ...native import INTEGER, POINTER, Snippet

_BLOCKS = 256
_KERNEL = Path(__file__).with_name("kernels") / "transfer.cpp"


@functools.cache
def _snippet() -> Snippet:
    fields = {
        **dict.fromkeys(("values", "alpha", "out", "shoulder"), POINTER),
        **dict.fromkeys(("count", "back", "bends"), INTEGER),
    }
    return Snippet("transfer", fields, kernel_text(_KERNEL).replace("@BLOCKS@", str(_BLOCKS)))


def warm_up() -> None:
    """Compiles the kernel, or loads it from the cache. Call this from the main thread."""
    _snippet().warm_up()


def to_linear(values: Tensor, display: Display) -> Tensor:
    """Scene-linear light from display values of any shape, float32, like `Display.to_light`."""
    return _converted(values, display, back=False) if values.device.type == "cpu" else light_of(values, display)


def to_display(linear: Tensor, display: Display) -> Tensor:
    """Display values from scene-linear light of any shape, float32, like `Display.from_light`."""
    return _converted(linear, display, back=True) if linear.device.type == "cpu" else display_of(linear, display)


def light_of(values: Tensor, display: Display) -> Tensor:
    """`to_linear` by torch's operators, on any device."""
    encoded = values
    if display.bends:
        above = (values - SHOULDER_FROM).clamp_min(0.0)
        encoded = values.clamp_max(SHOULDER_FROM) + SHOULDER_ROLL * torch.expm1(above / SHOULDER_ROLL)
    size = encoded.abs()
    curve = ((size.clamp_min(float(SRGB_KNEE)) + 0.055) / 1.055).pow(2.4)
    return torch.where(size <= float(SRGB_KNEE), encoded / 12.92, torch.copysign(curve, encoded))


def display_of(linear: Tensor, display: Display) -> Tensor:
    """`to_display` by torch's operators, on any device."""
    size = linear.abs()
    curve = size.clamp_min(float(LINEAR_KNEE)).pow(1.0 / 2.4) * 1.055 - 0.055
    encoded = torch.where(size <= float(LINEAR_KNEE), linear * 12.92, torch.copysign(curve, linear))
    if not display.bends:
        return encoded
    above = (encoded - SHOULDER_FROM).clamp_min(0.0)
    return encoded.clamp_max(SHOULDER_FROM) + SHOULDER_ROLL * torch.log1p(above / SHOULDER_ROLL)


def straight_to_linear(color: Tensor, alpha: Tensor, display: Display) -> Tensor:
    """Premultiplied scene-linear RGBA [..., 4], on the CPU, from premultiplied colour [..., 3] and alpha [...].

    Colour is divided by alpha, limited to the range from 0 to `Display.most`, and multiplied again.
    """
    return _converted(color, display, back=False, alpha=alpha)


def _converted(values: Tensor, display: Display, back: bool, alpha: Tensor | None = None) -> Tensor:
    values = values.float().contiguous()
    covered = None if alpha is None else alpha.float().contiguous()
    out = torch.empty(values.shape if covered is None else (*covered.shape, 4), device="cpu")
    shoulder = torch.tensor([SHOULDER_FROM, SHOULDER_ROLL, display.most], device="cpu")
    _snippet().run(
        values=values.data_ptr(), alpha=0 if covered is None else covered.data_ptr(), out=out.data_ptr(),
        shoulder=shoulder.data_ptr(), count=values.numel(), back=back, bends=display.bends,
    )  # fmt: skip
    return out
