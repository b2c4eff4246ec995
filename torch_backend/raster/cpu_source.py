"""C++ source of the CPU backend (`kernels/cpu/*.cpp`), assembled as text for `warp.func_native`.

The code works on vectors of 16 floats (`F`), which Clang lowers to AVX-512, AVX2 or NEON. It cannot call libc. One
parameter block `P` (fields below, mirrored by a ctypes structure) carries pointers and sizes, so that a launch passes
one pointer. Stages are functions of (block, worker). Work is split into fixed chunks or tiles, and every sum has a
fixed order, so results do not depend on the number of workers.

Terms: a *slot* is the place of a visible Gaussian (chunk * CHUNK + running number, in index order), a *rank* its place
in depth order, a *hit* one (Gaussian, tile) pair. Hits are listed tile by tile, front to back. Their results are stored
slot by slot, so that the sum over a Gaussian's tiles reads consecutive memory.

A record holds, per slot: mean x, y; A = -log2(e) yy / (2 det); k = xy / yy; R = -log2(e) / (2 yy); log2 opacity; first
and last y of the ellipse alpha >= 1/255; then the channels. The exponent of alpha in base 2 is
  log2 opacity + R dy^2 + A (dx - k dy)^2,
the quadratic form of the conic with completed squares, which avoids cancellation for long thin Gaussians.
"""

import ctypes
from pathlib import Path
from typing import cast

from ..kernel_text import kernel_text
from . import constants as k

CHUNK = 1024
"""Gaussians per unit of work of the projection."""
SPANS = 4 * CHUNK
"""Number of tile spans stored per chunk; further spans are recomputed when needed."""
HEAD = 8
"""Floats of a record before its channels."""
MOMENTS = 8
"""Floats of a hit's gradient before its channels: sums over pixels of v, v e, v dy, v e^2, v e dy, v dy^2, and of
|d loss / d mean x|, |d loss / d mean y|. e = dx - k dy and v = d loss / d log alpha."""

_F, _I, _P = ctypes.c_float, ctypes.c_int64, ctypes.c_uint64
_FIELDS: list[tuple[str, type, str]] = [
    *[
        (n, _P, "const float*")
        for n in (
            "means",
            "quats",
            "log_scales",
            "logits",
            "colors",
            "sh",
            "sh_rest",
            "background",
            "grad_image",
            "grad_alpha",
        )
    ],
    *[
        (n, _P, "float*")
        for n in (
            "record",
            "aux",
            "hit_weight",
            "hit_grad",
            "image",
            "alpha",
            "median",
            "top_weights",
            "means2d",
            "weight_sum",
            "weight_max",
            "grad_means",
            "grad_quats",
            "grad_log_scales",
            "grad_logits",
            "grad_colors",
            "grad_sh",
            "grad_sh_rest",
            "grad_view",
            "grad_norm",
            "grad_abs",
        )
    ],
    *[
        (n, _P, "int*")
        for n in (
            "index",
            "hit_count",
            "hit_start",
            "chunk_count",
            "order",
            "order2",
            "key",
            "key2",
            "histogram",
            "tile_start",
            "tile_end",
            "hit_slot",
            "hit_place",
            "radii",
            "top_ids",
            "span",
            "span_start",
            "span_count",
        )
    ],
    *[
        (n, _I, "long long")
        for n in (
            "n",
            "width",
            "height",
            "tiles_x",
            "tiles_y",
            "chunks",
            "visible",
            "hits",
            "workers",
            "n_colors",
            "n_sh",
            "sh_degree",
            "sh_stride",
            "rest_stride",
            "channels",
            "record_stride",
            "grad_stride",
            "antialiased",
            "want_depth",
            "want_weights",
            "want_top",
            "want_abs",
            "clear",
            "counter",
        )
    ],
    ("view", _F * 12, "float"),
    *[(n, _F, "float") for n in ("fx", "fy", "cx", "cy", "x_low", "x_high", "y_low", "y_high", "near")],
]


class Block(ctypes.Structure):
    """The parameter block: pointers as integers, sizes and flags, one camera."""

    _fields_ = [(name, kind) for name, kind, _ in _FIELDS]


def _block_text() -> str:
    lines = [f"{text} {name}{'[12]' if name == 'view' else ''};" for name, _, text in _FIELDS]
    return "struct Block { " + " ".join(lines) + " };\nBlock& P = *(Block*)block;\n"


_KERNELS = Path(__file__).with_name("kernels") / "cpu"
"""Folder with one file per stage; `blend.cpp` and `blend_backward.cpp` include further small files."""

PROJECT, SORT, COUNT, PREFIX, EMIT, WEIGHTS, PROJECT_BACKWARD = range(7)
BLEND, BLEND_BACKWARD = range(2)


def assemble(stages: list[str], extra: dict[str, object]) -> str:
    """One snippet that switches over `stages`, with the values of `constants.py` and `extra` substituted."""
    values = {name: getattr(k, name) for name in dir(k) if name.isupper() or name.startswith("SH_")}
    values |= {"CHUNK": CHUNK, "SPANS": SPANS, "HEAD": HEAD, "MOMENTS": MOMENTS} | extra
    text = _block_text() + kernel_text(_KERNELS / "common.cpp")
    for number, stage in enumerate(stages):
        text += f"if (stage == {number}) {{\n{stage}\n}}\n"
    for name, value in values.items():
        if isinstance(value, tuple):
            literal = ", ".join(f"{float(v)!r}f" for v in cast(tuple[float, ...], value))
        elif isinstance(value, float):
            literal = repr(value)
        else:
            literal = str(value)
        text = text.replace(f"@{name}@", literal)
    return text


def stages_source() -> str:
    """The stages that do not depend on the number of channels, in the order of PROJECT to PROJECT_BACKWARD."""
    names = ("project", "sort", "count", "prefix", "emit", "weights", "project_backward")
    return assemble([kernel_text(_KERNELS / f"{name}.cpp") for name in names], {"GRAD_MAX": 64})


def blend_source(channels: int) -> str:
    """The stages of blending, forward and backward, for images of `channels` channels (depth included)."""
    names = ("blend", "blend_backward")
    return assemble([kernel_text(_KERNELS / f"{name}.cpp") for name in names], {"NCH": channels})


MAX_CHANNELS = 64 - MOMENTS
"""Largest number of channels per call, depth included."""
