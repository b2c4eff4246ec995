"""C++ of the CUDA backend (`kernels/cuda/*.cu`) for `warp.func_native`. NVRTC compiles it for GPUs, Clang for fibers.

It follows the rules of `constants.py` and the formulas of `kernels/cpu`: a record holds A, k, R (the conic with
completed squares), and gradients are computed via xc, yy and k. One thread works on one Gaussian, a block of BLOCK
threads on one tile. In a tile, a warp covers four rows, two at a time: each thread has `SLOTS` pixels, one in each pair
of rows.

Terms: a *slot* is camera * N + Gaussian, a *rank* its place in depth order over all cameras, a *hit* one pair of a slot
and a tile. A tile reads its hits from a list of fixed capacity. If a call has more hits than the list holds, every tile
instead walks through all ranks and tests which of them meet it. That is slower, but exact and without synchronisation.

Fibers run the same text with these substitutes. A shuffle goes through memory and a barrier, so every thread of the
block takes part and the shortcuts of a single warp (`UNIFORM`, `WARP_ANY`) are not taken. Atomics are plain operations,
because fibers share one thread.
"""

import re
from pathlib import Path

from ..kernel_text import kernel_text
from . import constants as k

BLOCK = 128
"""Threads of a block: four warps of four pixel rows each."""
HEAD = 8
"""Floats of a record before its channels: mean x, y; A; k; R; log2 opacity; first and last y of the ellipse."""
MOMENTS = 8
"""Floats of a slot's gradient before its channels, as in `cpu_source.MOMENTS`."""
WEIGHT_SCALE = 2.0**36
"""Weights are summed as integers in units of 1 / WEIGHT_SCALE, so that the sum does not depend on the order."""
WIDE_FROM = 2**15 - 1
"""From this many tiles on, tile numbers are sorted as 32-bit integers instead of 16-bit ones."""

POINTERS = {
    "const float*": (
        "means",
        "quats",
        "log_scales",
        "logits",
        "colors",
        "sh",
        "viewmats",
        "Ks",
        "background",
        "grad_image",
        "grad_alpha",
    ),
    "float*": (
        "record",
        "aux",
        "image",
        "alpha",
        "median",
        "top_weight",
        "means2d",
        "weight_max",
        "grad",
        "grad_means",
        "grad_quats",
        "grad_log_scales",
        "grad_logits",
        "grad_colors",
        "grad_sh",
        "grad_view",
        "grad_norm",
        "grad_abs",
    ),
    "int*": ("radii", "hit_count", "depth_key", "hit_slot", "sorted_slot", "tile_start", "tile_end", "top_id"),
    "long long*": ("order", "ends", "permutation", "hits", "demand", "weight_sum"),
    "void*": ("hit_key", "sorted_key"),
}
SIZES = (
    "n",
    "cameras",
    "width",
    "height",
    "tiles_x",
    "tiles_y",
    "capacity",
    "n_colors",
    "n_sh",
    "bands",
    "sh_stride",
    "channels",
    "record_stride",
    "grad_stride",
    "antialiased",
    "want_depth",
    "want_weights",
    "want_top",
    "want_abs",
    "want_view",
    "wide",
    "sh_aligned",
)
FIELDS = {
    **{name: "uint64" for names in POINTERS.values() for name in names},
    **dict.fromkeys(SIZES, "int32"),
    **dict.fromkeys(("near", "overscan_x", "overscan_y"), "float32"),
}
"""Fields of the parameter structure and their Warp types; pointers are passed as integers."""
_POINTER = {name: kind for kind, names in POINTERS.items() for name in names}

_KERNELS = Path(__file__).with_name("kernels") / "cuda"
"""Folder with one file per kernel; each is compiled after `common.cu`."""

_A, _C2, _C3 = k.SH_C1, k.SH_C2, k.SH_C3
_HARMONICS = [
    (f"{k.SH_C0}f", "", "", ""),
    (f"{-_A}f * dy", "", f"{-_A}f", ""),
    (f"{_A}f * dz", "", "", f"{_A}f"),
    (f"{-_A}f * dx", f"{-_A}f", "", ""),
    (f"{_C2[0]}f * dx * dy", f"{_C2[0]}f * dy", f"{_C2[0]}f * dx", ""),
    (f"{_C2[1]}f * dy * dz", "", f"{_C2[1]}f * dz", f"{_C2[1]}f * dy"),
    (f"{_C2[2]}f * (2.f * szz - sxx - syy)", f"{-2 * _C2[2]}f * dx", f"{-2 * _C2[2]}f * dy", f"{4 * _C2[2]}f * dz"),
    (f"{_C2[3]}f * dx * dz", f"{_C2[3]}f * dz", "", f"{_C2[3]}f * dx"),
    (f"{_C2[4]}f * (sxx - syy)", f"{2 * _C2[4]}f * dx", f"{-2 * _C2[4]}f * dy", ""),
    (f"{_C3[0]}f * dy * (3.f * sxx - syy)", f"{6 * _C3[0]}f * dx * dy", f"{3 * _C3[0]}f * (sxx - syy)", ""),
    (f"{_C3[1]}f * dx * dy * dz", f"{_C3[1]}f * dy * dz", f"{_C3[1]}f * dx * dz", f"{_C3[1]}f * dx * dy"),
    (
        f"{_C3[2]}f * dy * (4.f * szz - sxx - syy)",
        f"{-2 * _C3[2]}f * dx * dy",
        f"{_C3[2]}f * (4.f * szz - sxx - 3.f * syy)",
        f"{8 * _C3[2]}f * dy * dz",
    ),
    (
        f"{_C3[3]}f * dz * (2.f * szz - 3.f * sxx - 3.f * syy)",
        f"{-6 * _C3[3]}f * dx * dz",
        f"{-6 * _C3[3]}f * dy * dz",
        f"{_C3[3]}f * (6.f * szz - 3.f * sxx - 3.f * syy)",
    ),
    (
        f"{_C3[4]}f * dx * (4.f * szz - sxx - syy)",
        f"{_C3[4]}f * (4.f * szz - 3.f * sxx - syy)",
        f"{-2 * _C3[4]}f * dx * dy",
        f"{8 * _C3[4]}f * dx * dz",
    ),
    (
        f"{_C3[5]}f * dz * (sxx - syy)",
        f"{2 * _C3[5]}f * dx * dz",
        f"{-2 * _C3[5]}f * dy * dz",
        f"{_C3[5]}f * (sxx - syy)",
    ),
    (f"{_C3[6]}f * dx * (sxx - 3.f * syy)", f"{3 * _C3[6]}f * (sxx - syy)", f"{-6 * _C3[6]}f * dx * dy", ""),
]
"""Each harmonic and its derivatives with respect to the unit direction dx, dy, dz; empty if a derivative is 0."""


def _harmonics(before: str, per_band: str, after: str) -> str:
    """`per_band` for every harmonic, with @Y@ (its value) and @dY@ (terms of its derivatives) substituted.

    Each group of four harmonics is enclosed by `before` and `after`. @q@ is the offset of the group's coefficients, @i@
    the offset of a coefficient within the group.
    """
    text = ""
    for four in range(0, 16, 4):
        text += f"if (P.bands > {four}) {{\n" + before.replace("@q@", str(3 * four))
        for i in range(four, four + 4):
            value, *slope = _HARMONICS[i]
            along = "".join(f"gd{axis} += through * ({part});" for axis, part in zip("xyz", slope, strict=True) if part)
            text += f"if (P.bands > {i}) {{\n" if i in (1, 9) else ""
            text += per_band.replace("@i@", str(3 * (i - four))).replace("@Y@", value).replace("@dY@", along) + "\n"
            text += "}\n" if i in (3, 11) else ""
        text += after.replace("@q@", str(3 * four)) + "}\n"
    return text


_LOAD = "load12(from + @q@, 3 * P.bands - @q@, f);"


def _harmonics_text() -> str:
    """`@HARMONICS@` of `project.cu`: the colour c0, c1, c2 from the coefficients `from`."""
    return _harmonics(
        _LOAD + "\n",
        "{ const float b = @Y@; c0 += b * f[@i@]; c1 += b * f[@i@ + 1]; c2 += b * f[@i@ + 2]; }",
        "",
    )


def _backward_harmonics() -> str:
    """`@HARMONICS_BACKWARD@` of `project_backward.cu`: gradients of the coefficients, and gdx, gdy, gdz."""
    return _harmonics(
        _LOAD + " UNROLL for (int i = 0; i < 12; i++) o[i] = 0.f;\n"
        "if (seen) load12(sh_to + @q@, 3 * P.bands - @q@, o);\n",
        "{ const float b = @Y@; "
        "[[maybe_unused]] const float through = h0 * f[@i@] + h1 * f[@i@ + 1] + h2 * f[@i@ + 2]; @dY@ "
        "o[@i@] += b * h0; o[@i@ + 1] += b * h1; o[@i@ + 2] += b * h2; }",
        "store12(sh_to + @q@, 3 * P.bands - @q@, o);",
    )


def _field(match: re.Match[str]) -> str:
    name = match.group(1)
    return f"(({_POINTER[name]})args.{name})" if name in _POINTER else f"args.{name}"


def _assemble(stage: str, **extra: object) -> str:
    """The snippet of file `stage` with constants substituted. Its arguments are args and task, the thread number."""
    values = {name: getattr(k, name) for name in dir(k) if name.isupper() and not name.startswith("SH_")}
    values |= {"BLOCK": BLOCK, "HEAD": HEAD, "MOMENTS": MOMENTS, "WEIGHT_SCALE": WEIGHT_SCALE} | extra
    text = kernel_text(_KERNELS / "common.cu") + kernel_text(_KERNELS / stage)
    text = text.replace("@HARMONICS@", _harmonics_text()).replace("@HARMONICS_BACKWARD@", _backward_harmonics())
    for name, value in values.items():
        text = text.replace(f"@{name}@", repr(value) if isinstance(value, float) else str(value))
    return re.sub(r"\bP\.(\w+)", _field, text)


def stages() -> dict[str, str]:
    """Snippets of the stages that do not depend on the number of channels, by kernel name."""
    return {f"raster_{name}": _assemble(f"{name}.cu") for name in ("project", "emit", "ranges", "project_backward")}


def blending(channels: int) -> dict[str, str]:
    """Snippets of blending for images of `channels` channels (depth included), by kernel name."""
    return {f"raster_{name}": _assemble(f"{name}.cu", NCH=channels) for name in ("blend", "blend_backward")}
