"""Colour spaces of an OpenColorIO configuration, converted by OpenImageIO's OpenColorIO.

The configuration is that of $OCIO, as in Blender and other studio programs. Without $OCIO, it is OpenColorIO's built-in
ACES studio configuration, which includes camera logs. The role `aces_interchange` defines the conversion to linear
Rec.709 with white at D65, whatever the names of the spaces. A configuration without that role must name linear Rec.709.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from .color import LIGHTS, PRIMARIES, Curve, InputSpace, linear_to_srgb, named_space, to_rec709
from .images import error_of
from .sources import footage_error

BUILT_IN = "ocio://studio-config-latest"
"""Default configuration without $OCIO: the ACES configuration with camera logs, built into OpenColorIO."""
INTERCHANGE = "aces_interchange"
"""Role of ACES2065-1, the common space for conversion between configurations."""
LINEAR = ("lin_rec709_scene", "lin_rec709", "Linear Rec.709", "Utility - Linear - sRGB", "Linear", "linear")
"""Names of linear Rec.709 in configurations without that role."""


@dataclass(frozen=True)
class OcioSpace(InputSpace):
    """A colour space of an OCIO configuration."""

    space: str = ""
    """Name in the configuration."""
    config: str = ""
    """The configuration: a file, or the ocio:// address of a built-in one."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"{self.space} (OCIO)"

    @property
    def is_light(self) -> bool:
        """True: the configuration defines the conversion to light."""
        return True

    @property
    def is_passthrough(self) -> bool:
        """False: `known_space` returns a plain `InputSpace` for sRGB."""
        return False

    @property
    def origin(self) -> dict[str, str]:
        """The configuration, for the import's record."""
        return {"ocio": self.config}

    @property
    def rows(self) -> int:
        """Number of rows to convert at a time: many, because each call reads the configuration again, in 20 ms."""
        return 1024

    def _light(self, pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], Curve]:
        return light_of(pixels, self.space, self.config), linear_to_srgb


@dataclass(frozen=True)
class Colours:
    """Determines the colour space of footage."""

    chosen: str = ""
    """Name of the user's colour space; empty: from the files."""
    config: str = ""
    """Configuration to look up names in. If empty or missing on disk: the active configuration."""

    def space(self) -> InputSpace | None:
        """The user's colour space; None if the user chose none.

        Raises JobError if the name is unknown or means data, or if the configuration cannot be read.
        """
        if not self.chosen:
            return None
        config = self._used()
        found = known_space(self.chosen, config) or named_space(self.chosen)
        if found is not None:
            return found
        names = space_names(config)
        if any(name.lower() == self.chosen.lower() for name in names):
            raise footage_error(
                f"{self.chosen!r} is a colour space for data, not for colour.",
                "Choose the colour space of the footage.",
            )
        near = get_close_matches(self.chosen, names, 4, 0.3) or names[:4]
        raise footage_error(
            f"The OCIO configuration {config} has no colour space {self.chosen!r}.",
            f"It has {len(names)}, among them: {', '.join(near)}.",
        )

    def known(self, name: str) -> InputSpace | None:
        """The space of a name stored in a file; None if the configuration lacks the name."""
        return known_space(name, self._used())

    def by_rules(self, file: Path) -> InputSpace | None:
        """The space from the file rules of $OCIO; None if only the default rule matches."""
        if not (self.config or os.environ.get("OCIO")):
            return None
        config = self._used()
        rules: Any = _configuration(config)
        if rules.filepathOnlyMatchesDefaultRule(str(file)):
            return None
        return known_space(str(rules.getColorSpaceFromFilepath(str(file))), config)

    def _used(self) -> str:
        return self.config if self.config and _exists(self.config) else active_config()


def active_config() -> str:
    """The configuration in $OCIO, else `BUILT_IN`."""
    return os.environ.get("OCIO") or BUILT_IN


def _exists(config: str) -> bool:
    return config.startswith("ocio://") or Path(config).is_file()


@cache
def _configuration(config: str) -> oiio.ColorConfig:
    """Loads a configuration. Raises JobError if that fails, where OpenImageIO would fall back to a default."""
    found = oiio.ColorConfig(config)
    failed = cast(Any, found).geterror()
    if failed:
        raise footage_error(
            f"The OCIO configuration {config} cannot be read: {str(failed).splitlines()[0]}.",
            "Correct the environment variable OCIO, or unset it to use the built-in ACES configuration.",
        )
    return found


def space_names(config: str) -> list[str]:
    """Names of all colour spaces of a configuration. Raises JobError if it cannot be read."""
    return list(_configuration(config).getColorSpaceNames())


def known_space(name: str, config: str) -> InputSpace | None:
    """The colour space with this name, alias or role in a configuration; None if it is missing or means data.

    Raises JobError if the configuration cannot be read, or defines no conversion to linear Rec.709.
    """
    found: Any = _configuration(config)
    space = str(found.resolve(name) or name)
    index = {known.lower(): known for known in found.getColorSpaceNames()}
    if space.lower() not in index or found.isData(index[space.lower()]):
        return None
    space = index[space.lower()]
    if str(found.get_color_interop_id(space) or "") in ("srgb_rec709_display", "srgb_rec709_scene"):
        return InputSpace("srgb")  # unconverted, bit for bit
    primaries = _primaries(space, config)
    return InputSpace("lin", primaries) if primaries else OcioSpace("lin", "", space=space, config=config)


@cache
def _primaries(space: str, config: str) -> str:
    """The member of `LIGHTS` that equals a space, tested by converting a few pixels; empty if none does."""
    pixels = np.concatenate([np.eye(3), 30.0 * np.eye(3), -0.1 * np.ones((1, 3))]).astype(np.float32)
    light = light_of(pixels[None], space, config)[0]
    near = (n for n in LIGHTS if np.allclose(light, pixels @ to_rec709(PRIMARIES[n][1]).T, rtol=1e-4, atol=1e-4))
    return next(near, "")


@cache
def _way_out(config: str) -> tuple[str, Callable[[ArrayLike], NDArray[np.float32]] | None]:
    """(target space, its conversion to linear Rec.709; None if the target is linear Rec.709). JobError if missing."""
    found: Any = _configuration(config)
    if str(found.getColorSpaceNameByRole(INTERCHANGE) or ""):
        matrix = to_rec709(PRIMARIES["ap0"][1]).T.astype(np.float32)
        return INTERCHANGE, lambda light: np.asarray(light, np.float32) @ matrix
    names = {name.lower(): name for name in found.getColorSpaceNames()}
    for name in LINEAR:
        resolved = str(found.resolve(name) or name).lower()
        if resolved in names:
            return names[resolved], None
    raise footage_error(
        f"The OCIO configuration {config} names neither ACES2065-1 (role {INTERCHANGE}) nor linear Rec.709.",
        f"Add the role {INTERCHANGE}, as OCIO 2 configurations have it.",
    )


def light_of(pixels: NDArray[np.float32], space: str, config: str) -> NDArray[np.float32]:
    """Converts [H, W, 3] float32 from a colour space of a configuration to scene-linear Rec.709, unclipped.

    Raises JobError if the configuration cannot convert the space.
    """
    target, finish = _way_out(config)
    source = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
    light = oiio.ImageBufAlgo.colorconvert(source, space, target, False, "", "", config)
    values = None if light.has_error else light.get_pixels(oiio.FLOAT)
    if values is None:
        raise footage_error(
            f"{space!r} cannot be converted to scene-linear light: {error_of(light)}.", "Choose another colour space."
        )
    values = np.asarray(values, np.float32)
    with np.errstate(all="ignore"):  # codes outside of a camera's range may become infinite light
        return values if finish is None else finish(values)
