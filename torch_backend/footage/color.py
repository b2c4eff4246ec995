"""Conversion between display-referred sRGB and scene-linear light. All other modules use these functions.

Working frames and the trained model are display-referred, because splats blend in that space; `display` compresses the
highlights of footage brighter than white. Output such as EXR is scene-linear with the Rec.709 / sRGB primaries.
Transfer function: IEC 61966-2-1, exact piecewise form. It is odd-extended below 0 and its power segment continues above
1, so that ringing and highlights survive a round trip.

`InputSpace` converts footage in other encodings to display-referred sRGB or to light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import linear_solution
from ..contract import PROBE

SRGB_KNEE = np.float32(0.04045)
"""Encoded value at the end of the linear segment."""
# Derived from `SRGB_KNEE`, not the rounded 0.0031308 of the standard, so that both branches agree.
LINEAR_KNEE = np.float32(0.04045 / 12.92)
"""The same point in linear light."""


def srgb_to_linear(x: ArrayLike) -> NDArray[np.float32]:
    """Converts display-referred sRGB of any shape to scene-linear float32; 0..1 maps to 0..1.

    Values beyond about 1.2e16 overflow to infinity (their linear value does not fit float32).
    """
    x = np.asarray(x, dtype=np.float32)
    magnitude = np.abs(x)
    line = np.minimum(magnitude, SRGB_KNEE) / np.float32(12.92)
    with np.errstate(over="ignore"):
        curve = np.power((np.maximum(magnitude, SRGB_KNEE) + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.copysign(np.where(magnitude <= SRGB_KNEE, line, curve), x)


def linear_to_srgb(x: ArrayLike) -> NDArray[np.float32]:
    """Converts scene-linear values of any shape to display-referred sRGB float32; the inverse of `srgb_to_linear`.

    A round trip has a relative error of 1e-6 below 16 and 1e-5 up to 1e38.
    """
    x = np.asarray(x, dtype=np.float32)
    magnitude = np.abs(x)
    line = np.minimum(magnitude, LINEAR_KNEE) * np.float32(12.92)
    root = np.power(np.maximum(magnitude, LINEAR_KNEE), np.float32(1.0 / 2.4))
    curve = root * np.float32(1.055) - np.float32(0.055)
    return np.copysign(np.where(magnitude <= LINEAR_KNEE, line, curve), x)


def linear_to_srgb8(x: ArrayLike) -> NDArray[np.uint8]:
    """Converts scene-linear values of any shape to 8-bit sRGB, clipped to 0..1 and rounded. NaN becomes 0."""
    encoded = np.nan_to_num(linear_to_srgb(x), nan=0.0)
    return (np.clip(encoded, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)


def on_straight_colour(rgba: ArrayLike, curve: Callable[[ArrayLike], NDArray[np.float32]]) -> NDArray[np.float32]:
    """Applies a curve to colour premultiplied by alpha, [..., 4]. Raises ValueError for another shape.

    The curve acts on the unpremultiplied colour; if alpha is 0 (pure emission), on the stored colour.
    """
    rgba = np.asarray(rgba, dtype=np.float32)
    if rgba.ndim < 1 or rgba.shape[-1] != 4:
        raise ValueError(f"rgba should be [..., 4], got shape {list(rgba.shape)}")
    alpha = rgba[..., 3:4]
    weight = np.where(alpha > 0.0, alpha, np.float32(1.0))
    # A half-covered white pixel of sRGB becomes light (0.5, 0.5, 0.5, 0.5). The curve on 0.5 itself would give 0.21.
    return np.concatenate([curve(rgba[..., :3] / weight) * weight, alpha], axis=-1)


# ------------------------------------------------------------------------------------------------- input colour spaces

Chromaticities = tuple[float, float, float, float, float, float, float, float]
"""CIE 1931 x and y of red, green, blue and white."""

_D65 = (0.3127, 0.3290)
_ACES_WHITE = (0.32168, 0.33767)
REC709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
PRIMARIES: dict[str, tuple[str, Chromaticities]] = {
    "rec709": ("Rec.709", REC709),
    "rec2020": ("BT.2020", (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65)),
    "p3d65": ("P3-D65", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65)),
    "p3dci": ("DCI-P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)),
    "adobergb": ("Adobe RGB", (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65)),
    "ap1": ("ACEScg (AP1)", (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE)),
    "ap0": ("ACES2065-1 (AP0)", (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES_WHITE)),
    "ciexyzd65": ("CIE XYZ", (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, *_D65)),
}
"""Short name as in colour interop ids -> (name for messages, chromaticities)."""

DIFFUSE_WHITE_NITS = 203.0
"""Luminance of white in HDR footage, mapped to 1 (ITU-R BT.2408)."""
_HLG_PEAK_NITS, _HLG_GAMMA = 1000.0, 1.2
_HALF_MAX = 65504.0
_REC2020_LUMA = np.array([0.2627, 0.6780, 0.0593], np.float32)


Curve = Callable[[ArrayLike], NDArray[np.float32]]
"""Elementwise function of arrays of any shape."""


def rgb_to_xyz(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """Matrix [3, 3] from linear RGB of these primaries to CIE XYZ, white at Y = 1. ValueError if they span no gamut."""
    x, y = np.array(chromaticities, np.float64).reshape(4, 2).T
    if not np.isfinite([*x, *y]).all() or abs(y[3]) < 1e-6:
        raise ValueError(f"these are not valid chromaticities: {chromaticities}")
    columns = np.stack([x[:3], y[:3], 1.0 - x[:3] - y[:3]])
    if abs(np.linalg.det(columns)) < 1e-6:
        raise ValueError(f"these primaries lie on one line: {chromaticities}")
    white = np.array([x[3] / y[3], 1.0, (1.0 - x[3] - y[3]) / y[3]])
    return columns * np.linalg.solve(columns, white)


def to_rec709(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """Matrix [3, 3] from linear RGB of these primaries to linear Rec.709, adapting their white to D65 (Bradford)."""
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    target, source = rgb_to_xyz(REC709), rgb_to_xyz(chromaticities)
    cones = (bradford @ target.sum(axis=1)) / (bradford @ source.sum(axis=1))
    adapted = linear_solution(bradford, cones[:, None] * (bradford @ source))
    return linear_solution(target, adapted)


LIGHTS = ("rec709", "rec2020", "p3d65", "ap1", "ap0")
"""Keys of `PRIMARIES` available for the linear light of frozen frames. The first is the internal space."""


def light_matrix(light: str) -> NDArray[np.float32] | None:
    """Matrix [3, 3] for row vectors, from linear Rec.709 to linear light of one of `LIGHTS`; None for Rec.709 itself.

    Raises ValueError for other primaries.
    """
    if light not in LIGHTS:
        raise ValueError(f"the output light should be one of {', '.join(LIGHTS)}, not {light!r}")
    if light == LIGHTS[0]:
        return None
    return np.linalg.inv(to_rec709(PRIMARIES[light][1])).T.astype(np.float32)


def in_light(pixels: NDArray[Any], matrix: NDArray[np.float32] | None) -> NDArray[Any]:
    """Applies a matrix of `light_matrix` to the first three channels of pixels [..., 3 or more]."""
    if matrix is None:
        return pixels
    return np.concatenate([np.asarray(pixels[..., :3], np.float32) @ matrix, pixels[..., 3:]], axis=-1)


def light_of_chromaticities(values: Sequence[float] | None) -> str:
    """The member of `LIGHTS` with a file's chromaticities; the first member if none matches."""
    known = (x for x in LIGHTS if values is not None and np.allclose(values, PRIMARIES[x][1], atol=2e-3))
    return next(known, LIGHTS[0])


def cineon_to_linear(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Converts Cineon log (printing density, 10 bits as 0..1) to scene-linear: code 95 (black) to 0, 685 (white) to 1.

    Kodak's conversion: 0.002 density per code, negative gamma 0.6.
    """
    black = 10.0 ** ((95.0 - 685.0) * 0.002 / 0.6)
    light = np.power(np.float32(10.0), (x * np.float32(1023.0) - np.float32(685.0)) * np.float32(0.002 / 0.6))
    return (light - np.float32(black)) / np.float32(1.0 - black)


def pq_to_linear(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Converts SMPTE ST 2084 to linear light, 1 at `DIFFUSE_WHITE_NITS`."""
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    root = np.power(np.clip(x, 0.0, 1.0).astype(np.float64), 1.0 / m2)
    nits = 10000.0 * np.power(np.maximum(root - c1, 0.0) / (c2 - c3 * root), 1.0 / m1)
    return (nits / DIFFUSE_WHITE_NITS).astype(np.float32)


def hlg_to_linear(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Converts BT.2100 HLG [..., 3] to the linear light of a display of 1000 cd/m2, 1 at `DIFFUSE_WHITE_NITS`."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    x = np.clip(x, 0.0, 1.0)
    upper = np.exp((np.maximum(x, np.float32(0.5)) - np.float32(c)) / np.float32(a)) + np.float32(b)
    scene = np.where(x <= 0.5, x * x / 3.0, upper / np.float32(12.0)).astype(np.float32)
    luminance = np.maximum((scene @ _REC2020_LUMA)[..., None], np.float32(1e-9))
    return scene * np.power(luminance, np.float32(_HLG_GAMMA - 1.0)) * np.float32(_HLG_PEAK_NITS / DIFFUSE_WHITE_NITS)


def _power(exponent: float) -> Callable[[ArrayLike], NDArray[np.float32]]:
    def curve(x: ArrayLike) -> NDArray[np.float32]:
        x = np.asarray(x, np.float32)
        return np.copysign(np.power(np.abs(x), np.float32(exponent)), x)

    return curve


# Transfer function of pictures made for a display -> (curve to light, curve back). Except for gamma 1.8, the encoded
# values are used as sRGB without conversion, as in players and Blender. Only their primaries are converted, in light.
_DISPLAY = {
    "srgb": (srgb_to_linear, linear_to_srgb),
    "g18": (_power(1.8), linear_to_srgb),
    "g22": (_power(2.2), _power(1.0 / 2.2)),
    "g24": (_power(2.4), _power(1.0 / 2.4)),
    "g26": (_power(2.6), _power(1.0 / 2.6)),
}
# Transfer function of pictures that hold light -> curve to light.
_SCENE: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "lin": lambda x: x,
    "cineon": cineon_to_linear,
    "pq": pq_to_linear,
    "hlg": hlg_to_linear,
}
TRANSFERS = {
    "srgb": "sRGB", "g18": "gamma 1.8", "g22": "gamma 2.2", "g24": "video", "g26": "gamma 2.6", "lin": "linear",
    "cineon": "Cineon log", "pq": "PQ", "hlg": "HLG",
}  # fmt: skip
"""Transfer function -> name for messages."""


@dataclass(frozen=True)
class InputSpace:
    """Colour space of the values in a picture."""

    transfer: str
    """One of `TRANSFERS`."""
    primaries: str = "rec709"
    """One of `PRIMARIES`, or "" for `chromaticities`."""
    chromaticities: Chromaticities = REC709
    """Chromaticities of primaries without a name."""
    declared: bool = True
    """True if the footage declares the colour space, False if it was assumed."""

    @property
    def name(self) -> str:
        """Name for messages."""
        gamut = PRIMARIES[self.primaries][0] if self.primaries else "custom primaries"
        return f"{TRANSFERS[self.transfer]}, {gamut}"

    @property
    def is_light(self) -> bool:
        """True if the values encode light (linear, log, HDR) instead of a picture for a display."""
        return self.transfer in _SCENE

    @property
    def is_passthrough(self) -> bool:
        """True if the values are used as sRGB without conversion."""
        return self.transfer in _DISPLAY and self.transfer != "g18" and self._wide is None

    @property
    def origin(self) -> dict[str, str]:
        """Source of the colour space for the import's record, such as a look or an OCIO configuration; else empty."""
        return {}

    @property
    def light(self) -> str:
        """Member of `LIGHTS` for output frames: the footage's primaries if it is linear, otherwise Rec.709."""
        return self.primaries if self.transfer == "lin" and self.primaries in LIGHTS else LIGHTS[0]

    @property
    def probe(self) -> tuple[float, ...]:
        """Linear Rec.709 light of the value `contract.PROBE` in this space."""
        return tuple(float(value) for value in self.to_linear(np.array([[PROBE]], np.float32))[0, 0])

    @property
    def rows(self) -> int:
        """Number of rows to convert at a time: float32 takes four times the memory of codes."""
        return 64

    @property
    def _wide(self) -> Chromaticities | None:
        found = PRIMARIES[self.primaries][1] if self.primaries else self.chromaticities
        return None if found == REC709 else found

    def to_srgb(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Converts a picture [H, W, 3] made for a display to display-referred sRGB in [0, 1]. NaN becomes 0.

        Raises ValueError if the space holds light, which needs `to_linear` and a `display.Display`.
        """
        if self.is_light:
            raise ValueError(f"{self.name} is scene-linear light, which sRGB would clip")
        pixels = np.nan_to_num(pixels, nan=0.0, posinf=65504.0, neginf=0.0)
        if self.is_passthrough:
            return np.clip(pixels, 0.0, 1.0)
        light, encode = self._light(pixels)
        return encode(np.clip(light, 0.0, 1.0))

    def to_linear(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Converts a picture [H, W, 3] to scene-linear Rec.709, keeping values below 0 and above 1.

        NaN becomes 0. Values are clipped to the range of a half float.
        """
        pixels = np.nan_to_num(pixels, nan=0.0, posinf=_HALF_MAX, neginf=-_HALF_MAX)
        if self.is_passthrough:
            light = srgb_to_linear(pixels)
        else:
            light, encode = self._light(pixels)
            # After the conversion of primaries, the encoded values of a display picture count as sRGB, not its light.
            light = light if self.is_light else srgb_to_linear(encode(light))
        return np.clip(np.nan_to_num(light, nan=0.0), -_HALF_MAX, _HALF_MAX)

    def _light(self, pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], Curve]:
        """(light with Rec.709 primaries, curve that encodes it again)."""
        decode, encode = _DISPLAY.get(self.transfer) or (_SCENE[self.transfer], linear_to_srgb)
        light = decode(pixels)
        if self._wide is not None:
            light = light @ to_rec709(self._wide).T.astype(np.float32)
        return light, encode


def named_space(name: str) -> InputSpace | None:
    """The colour space of a name in a file: a colour interop id (lin_ap1_scene) or an older name; None if unknown."""
    short = _ALIASES.get(name.lower(), name.lower())
    transfer, _, after_transfer = short.partition("_")
    primaries = after_transfer.partition("_")[0]
    if transfer in TRANSFERS and primaries in PRIMARIES:
        return InputSpace(transfer, primaries)
    return None


def space_of_chromaticities(values: Chromaticities) -> InputSpace:
    """The linear space with these primaries, named if they are in `PRIMARIES`. ValueError if they span no gamut."""
    for short, (_, known) in PRIMARIES.items():
        if np.allclose(values, known, atol=2e-3):
            return InputSpace("lin", short)
    to_rec709(values)
    return InputSpace("lin", "", values)


_ALIASES = {
    "srgb": "srgb_rec709", "rec709": "g24_rec709", "linear": "lin_rec709", "scene_linear": "lin_rec709",
    "lin_srgb": "lin_rec709", "acescg": "lin_ap1", "aces2065-1": "lin_ap0", "kodaklog": "cineon_rec709",
    "cineon": "cineon_rec709", "adobergb": "g22_adobergb", "display p3": "srgb_p3d65",
}  # fmt: skip
