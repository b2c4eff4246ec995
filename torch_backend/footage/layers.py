"""Selects the layer of a picture file that holds the picture itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import OpenImageIO as oiio

from ..contract import regular_file
from .images import check_size, error_of
from .oiio_types import channel_names
from .sources import footage_error

BEAUTY = ("", "rgba", "rgb", "beauty", "combined", "c", "composite", "color", "colour", "final", "main", "master")
"""Common names of the main layer, the most reliable first."""
_COLOURS = (("R", "G", "B", "A"), ("r", "g", "b", "a"), ("red", "green", "blue", "alpha"))
_NO_PICTURE = ("crypto", "depth", "normal", "position", "motion", "vector", "uv", "mist", "index")


@dataclass(frozen=True)
class Layer:
    """Location of a colour layer in its file."""

    name: str
    """Name in the file; empty for the channels R, G, B without a layer."""
    part: int
    """Index of the subimage."""
    channels: tuple[int, int, int]
    """Indices of red, green and blue in that subimage; three times the same for grey."""
    alpha: int | None
    """Index of the alpha channel, if there is one."""


def find_layer(file: Path, layer_name: str = "") -> tuple[Layer, list[str]]:
    """Finds the layer `layer_name`, by default the main layer. Returns it and the names of all layers in the file.

    Raises JobError, which lists the layers, if no layer has that name or no main layer is certain. Raises OSError if
    the file cannot be read.
    """
    found, names = _layers(file)
    if layer_name:
        named = [x for x in found if layer_name.lower() in (x.name.lower(), x.name.rpartition(".")[2].lower())]
        exact = [x for x in named if x.name.lower() == layer_name.lower()]
        if len(exact or named) != 1:
            raise footage_error(
                f"{file.name} has no colour layer {layer_name!r}.",
                f"It has: {_listed([x.name for x in found] or names)}.",
            )
        return (exact or named)[0], names
    pictures = [x for x in found if not any(part in x.name.lower() for part in _NO_PICTURE)]
    ranked = sorted(pictures, key=_rank)
    if not ranked:
        raise footage_error(
            f"{file.name} has no layer with red, green and blue: it has {_listed(names)}.",
            "Choose the picture itself, not one of its passes.",
        )
    if len(ranked) > 1 and (_rank(ranked[0]) == _rank(ranked[1]) or _rank(ranked[0])[0] == len(BEAUTY)):
        raise footage_error(
            f"{file.name} has several layers, and none is recognised as the picture itself: {_listed(names)}.",
            "Choose one by its name (--layer), or write the picture to a separate file.",
        )
    return ranked[0], names


def shown(name: str) -> str:
    """A layer's name for messages."""
    return name or "RGB without a name"


def _listed(names: list[str]) -> str:
    return ", ".join(shown(name) for name in names[:12]) + (" and more" if len(names) > 12 else "")


def _rank(layer: Layer) -> tuple[int, int]:
    words = layer.name.lower().split(".")
    best = min((BEAUTY.index(word) for word in words if word in BEAUTY), default=len(BEAUTY))
    return best, 0 if words[0] in ("", "composite") else 1


def _layers(file: Path) -> tuple[list[Layer], list[str]]:
    """(layers with colour, names of all layers), in the order of the file."""
    image = oiio.ImageInput.open(regular_file(file))
    if image is None:
        raise OSError(f"{file}: {error_of()}")
    found: list[Layer] = []
    names: list[str] = []
    try:
        part = 0
        # Only the parts of an OpenEXR are layers. The parts of a TIFF are pages; those of a PSD make up its first part.
        while image.seek_subimage(part, 0) and (part == 0 or image.format_name() == "openexr"):
            spec = image.spec()
            check_size(file.name, spec)
            if spec.deep:
                raise footage_error(f"{file.name} contains deep data.", "Flatten it before import.")
            several = spec.get_int_attribute("oiio:subimages") > 1
            title = str(spec.getattribute("oiio:subimagename") or "") if several else ""
            for prefix in dict.fromkeys(name.rpartition(".")[0] for name in channel_names(spec)):
                layer = _colour(spec, part, prefix, title, image.format_name() == "openexr")
                names.append(prefix or title or ("" if layer else "/".join(channel_names(spec))))
                found += [layer] if layer else []
            part += 1
    except UnicodeDecodeError as error:
        raise OSError(f"{file}: the name of a layer is damaged") from error
    finally:
        image.close()
    return found, names


def _colour(spec: oiio.ImageSpec, part: int, prefix: str, title: str, is_exr: bool) -> Layer | None:
    names = list(channel_names(spec))
    dot = prefix + "." if prefix else ""
    for colours in _COLOURS:
        red, green, blue, alpha = (names.index(dot + c) if dot + c in names else None for c in colours)
        if red is not None and green is not None and blue is not None:
            return Layer(prefix or title, part, (red, green, blue), alpha)
    if is_exr:
        if dot + "Y" in names and dot + "RY" not in names:
            y = names.index(dot + "Y")
            return Layer(prefix or title, part, (y, y, y), names.index(dot + "A") if dot + "A" in names else None)
        return None
    alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
    return Layer("", part, (0, 1, 2) if spec.nchannels >= 3 else (0, 0, 0), alpha)
