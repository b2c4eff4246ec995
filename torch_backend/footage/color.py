"""The one place where display-referred sRGB and scene-linear light are converted into each other.

Working frames and the trained model are display-referred (what splatting blends in); everything that leaves, EXR
first of all, is scene-linear with the Rec.709 / sRGB primaries. Transfer function: IEC 61966-2-1, exact piecewise
form. It is odd-extended below 0 and its power segment continues above 1, so that ringing and highlights survive the
way there and back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SRGB_KNEE = np.float32(0.04045)
"""Encoded value where the linear segment ends."""
LINEAR_KNEE = np.float32(0.04045 / 12.92)
"""The same point in linear light; derived from `SRGB_KNEE`, not the rounded 0.0031308, so that both branches agree."""


def srgb_to_linear(x: ArrayLike) -> NDArray[np.float32]:
    """Display-referred sRGB to scene-linear, any shape, float32 out; 0..1 maps to 0..1.

    Values beyond about 1.2e16 overflow to infinity (their linear value does not fit float32).
    """
    x = np.asarray(x, dtype=np.float32)
    magnitude = np.abs(x)
    line = np.minimum(magnitude, SRGB_KNEE) / np.float32(12.92)
    with np.errstate(over="ignore"):
        curve = np.power((np.maximum(magnitude, SRGB_KNEE) + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.copysign(np.where(magnitude <= SRGB_KNEE, line, curve), x)


def linear_to_srgb(x: ArrayLike) -> NDArray[np.float32]:
    """Scene-linear to display-referred sRGB, any shape, float32 out; the inverse of `srgb_to_linear`.

    There and back is exact to a relative 1e-6 below 16 and 1e-5 up to 1e38.
    """
    x = np.asarray(x, dtype=np.float32)
    magnitude = np.abs(x)
    line = np.minimum(magnitude, LINEAR_KNEE) * np.float32(12.92)
    root = np.power(np.maximum(magnitude, LINEAR_KNEE), np.float32(1.0 / 2.4))
    curve = root * np.float32(1.055) - np.float32(0.055)
    return np.copysign(np.where(magnitude <= LINEAR_KNEE, line, curve), x)


def premultiplied_srgb_to_linear(rgba: ArrayLike) -> NDArray[np.float32]:
    """[..., 4] sRGB colour premultiplied by alpha (as splats blend) to scene-linear colour premultiplied by alpha.

    The transfer function acts on the unpremultiplied colour, so a half-covered white pixel becomes (0.5, 0.5, 0.5,
    0.5), not darker. Where alpha is 0, colour (pure emission) is converted as it stands.
    """
    return _on_straight_colour(rgba, srgb_to_linear)


def premultiplied_linear_to_srgb(rgba: ArrayLike) -> NDArray[np.float32]:
    """[..., 4] scene-linear premultiplied to sRGB premultiplied; the inverse of `premultiplied_srgb_to_linear`."""
    return _on_straight_colour(rgba, linear_to_srgb)


def linear_to_srgb8(x: ArrayLike) -> NDArray[np.uint8]:
    """Scene-linear to 8-bit sRGB, clipped to 0..1 and rounded, any shape. NaN becomes 0."""
    encoded = np.nan_to_num(linear_to_srgb(x), nan=0.0)
    return (np.clip(encoded, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)


def _on_straight_colour(rgba: ArrayLike, curve) -> NDArray[np.float32]:
    rgba = np.asarray(rgba, dtype=np.float32)
    if rgba.ndim < 1 or rgba.shape[-1] != 4:
        raise ValueError(f"rgba should be [..., 4], got shape {list(rgba.shape)}")
    alpha = rgba[..., 3:4]
    weight = np.where(alpha > 0.0, alpha, np.float32(1.0))
    return np.concatenate([curve(rgba[..., :3] / weight) * weight, alpha], axis=-1)
