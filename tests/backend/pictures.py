"""Pictures of any format that OpenImageIO writes."""

import numpy as np
import OpenImageIO as oiio

KINDS = {"float16": "half", "float32": "float", "float64": "float"}


def spec_of(pixels, names=None, window=None, full=None, **attributes):
    """Specification of pixels [H, W, C], in their own type. `a__b` in `attributes` is `a:b`; a value may have a type
    of its own, as (type, value)."""
    spec = oiio.ImageSpec(*pixels.shape[1::-1], pixels.shape[2], KINDS.get(str(pixels.dtype), str(pixels.dtype)))
    if names:
        spec.channelnames = names
    if full:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = full
    if window:
        spec.x, spec.y = window
    for name, value in attributes.items():
        name = name.replace("__", ":")
        if isinstance(value, tuple) and isinstance(value[0], oiio.TypeDesc):
            spec.attribute(name, *value)
        elif isinstance(value, tuple):
            spec.attribute(name, f"float[{len(value)}]", value)
        else:
            spec.attribute(name, value)
    return spec


def write(path, pixels, names=None, window=None, full=None, **attributes):
    spec = spec_of(pixels, names, window, full, **attributes)
    out = oiio.ImageOutput.create(str(path))
    assert out and out.open(str(path), spec), oiio.geterror()
    assert out.write_image(np.ascontiguousarray(pixels)) and out.close(), out.geterror()
