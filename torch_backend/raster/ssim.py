"""Mean SSIM of float32 images on the CPU with its gradient, in two passes over rows; C++ compiled by Warp.

The mathematics is that of `train.losses` (Wang et al. 2004; 11 x 11 Gaussian window, sigma 1.5, data_range 1, cut at
the border and renormalised per axis). The renormalised blur of an axis is B = diag(r) S, with S the symmetric blur of
zero-padded rows and r the reciprocal weight sum inside the image; so B^T = S diag(r), and the backward blur is the
plain one of values multiplied by r first.

SSIM sees the variances only through var x + var y, so forward blurs four fields. They are of x - 0.5 and y - 0.5:
variances do not notice, and float32 cancels less. The gradient is linear in the incoming one, so it is computed along
with the value.
"""

import ctypes
import functools
import threading
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..native import Launch, build, default_threads, run_workers

WINDOW, SIGMA = 11, 1.5
_HALF = WINDOW // 2
_LANES = 16
_ROWS = 4
"""Rows per unit of work; blocked so that a row loaded serves all of them."""
_FIELDS_FORWARD, _FIELDS_BACKWARD = 4, 3
_FIELDS: list[tuple[str, type, str]] = [
    *[(n, ctypes.c_uint64, "const float*") for n in ("image", "target", "inverse_x", "inverse_y")],
    *[(n, ctypes.c_uint64, "float*") for n in ("gradient", "row_score", "blurred", "scratch")],
    *[
        (n, ctypes.c_int64, "long long")
        for n in (
            "height",
            "length",
            "channels",
            "padded",
            "margin",
            "pitch",
            "scratch_stride",
            "want_gradient",
            "counter",
        )
    ],
]
"""`length` = width * channels floats of a row, `padded` the same up to full vectors, `pitch` with `margin` zeros either
side; `blurred` [3, height, padded] holds the gradient's fields between the passes, `scratch` a worker's rows."""

_SOURCE = r"""
typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
#define UNROLL _Pragma("clang loop unroll(full)")
const int R = @ROWS@, HALF = @HALF@;
const float TAP[2 * HALF + 1] = {@TAPS@}, C1 = 1e-4f, C2 = 9e-4f, MID = 0.5f;
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
const long long H = P.height, L = P.length, C = P.channels, S = P.padded, Q = P.pitch;
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED) * R; };
// Symmetric blur along a row with zeros around it.
auto across = FN(const float* z) -> F {
    F total = TAP[HALF] * load(z);
    UNROLL for (int k = 1; k <= HALF; k++) total = fma((F)TAP[HALF + k], load(z - k * C) + load(z + k * C), total);
    return total; };
float edge[2][R + 2 * HALF][16];

if (stage == 0) {
float* rows = P.scratch + worker * P.scratch_stride + P.margin;
float* back = rows + 4 * R * Q;
for (long long first; (first = take()) < H;) {
    int count = (int)(H - first < R ? H - first : R);
    // Down the columns, R rows at a time: x, y, x^2 + y^2, x y.
    for (long long at = 0; at < S; at += 16) {
        const float* px = P.image + (first - HALF) * L + at; const float* py = P.target + (first - HALF) * L + at;
        long long step = L;
        if (at + 16 > L) {
            for (int j = 0; j < R + 2 * HALF; j++) for (int l = 0; l < 16; l++) {
                bool in = first + j >= HALF && first + j < H + HALF && at + l < L;
                edge[0][j][l] = in ? px[j * L + l] : MID; edge[1][j][l] = in ? py[j * L + l] : MID; }
            px = edge[0][0]; py = edge[1][0]; step = 16;
        }
        F m[R][4] = {};
        UNROLL for (int j = 0; j < R + 2 * HALF; j++) {
            if (first + j < HALF || first + j >= H + HALF) continue;
            F x = load(px + j * step) - MID, y = load(py + j * step) - MID, square = fma(x, x, y * y), both = x * y;
            UNROLL for (int i = 0; i < R; i++) if (j >= i && j - i <= 2 * HALF) {
                F w = (F)TAP[j - i];
                m[i][0] = fma(w, x, m[i][0]); m[i][1] = fma(w, y, m[i][1]);
                m[i][2] = fma(w, square, m[i][2]); m[i][3] = fma(w, both, m[i][3]); }
        }
        UNROLL for (int i = 0; i < R; i++) {
            F inverse = (F)P.inverse_y[first + i];
            UNROLL for (int q = 0; q < 4; q++) store(rows + (4 * i + q) * Q + at, m[i][q] * inverse); }
    }
    for (int i = 0; i < count; i++) {
        const float* z = rows + 4 * i * Q;
        F sum = (F)0.f;
        for (long long at = 0; at < S; at += 16) {
            F rx = load(P.inverse_x + at);
            F u = rx * across(z + at), v = rx * across(z + Q + at);
            F square = rx * across(z + 2 * Q + at), both = rx * across(z + 3 * Q + at);
            F mx = u + MID, my = v + MID;
            F a1 = 2.f * mx * my + C1, a2 = 2.f * (both - u * v) + C2;
            F b1 = mx * mx + my * my + C1, b2 = square - (u * u + v * v) + C2;
            F inverse = 1.f / (b1 * b2), score = a1 * a2 * inverse;
            sum += rx > 0.f ? score : (F)0.f;
            if (!P.want_gradient) continue;
            // By the mean of x (inside the luminance, then inside the variances), by x^2, by x y.
            F weight = rx * P.inverse_y[first + i], d1 = score * inverse * b2, d2 = score * inverse * b1;
            F mean = 2.f * (my * (a2 * inverse) - mx * d1) + 2.f * (u * d2 - v * (a1 * inverse));
            store(back + at, weight * mean);
            store(back + Q + at, weight * -d2);
            store(back + 2 * Q + at, weight * (2.f * a1 * inverse));
        }
        double total = 0;
        for (int l = 0; l < 16; l++) total += sum[l];
        P.row_score[first + i] = (float)total;
        if (!P.want_gradient) continue;
        float* to = P.blurred + (first + i) * S;
        for (long long at = 0; at < S; at += 16)
            UNROLL for (int q = 0; q < 3; q++) store(to + q * H * S + at, across(back + q * Q + at));
    }
}
}

if (stage == 1) {
float scale = 1.f / ((float)H * (float)L);
for (long long first; (first = take()) < H;) {
    int count = (int)(H - first < R ? H - first : R);
    for (long long at = 0; at < S; at += 16) {
        const float* z = P.blurred + (first - HALF) * S + at;
        F d[R][3] = {};
        UNROLL for (int j = 0; j < R + 2 * HALF; j++) {
            if (first + j < HALF || first + j >= H + HALF) continue;
            F d0 = load(z + j * S), d1 = load(z + (H + j) * S), d2 = load(z + (2 * H + j) * S);
            UNROLL for (int i = 0; i < R; i++) if (j >= i && j - i <= 2 * HALF) {
                F w = (F)TAP[j - i];
                d[i][0] = fma(w, d0, d[i][0]); d[i][1] = fma(w, d1, d[i][1]); d[i][2] = fma(w, d2, d[i][2]); }
        }
        UNROLL for (int i = 0; i < R; i++) if (i < count) {
            long long from = (first + i) * L + at;
            const float* px = P.image + from; const float* py = P.target + from;
            bool part = at + 16 > L;
            if (part) {
                for (int l = 0; l < L - at; l++) { edge[0][0][l] = px[l]; edge[1][0][l] = py[l]; }
                px = edge[0][0]; py = edge[1][0]; }
            F x = load(px) - MID, y = load(py) - MID;
            F value = scale * (d[i][0] + 2.f * x * d[i][1] + y * d[i][2]);
            if (!part) { store(P.gradient + from, value); continue; }
            store(edge[0][0], value);
            for (int l = 0; l < L - at; l++) P.gradient[from + l] = edge[0][0][l];
        }
    }
}
}
"""


class _Block(ctypes.Structure):
    """The parameter block of a launch."""

    _fields_ = [(name, kind) for name, kind, _ in _FIELDS]


def _taps() -> list[float]:
    weights = torch.exp(-0.5 * (torch.arange(-_HALF, _HALF + 1, dtype=torch.float64) / SIGMA).square())
    return (weights / weights.sum()).tolist()


def _source() -> str:
    fields = " ".join(f"{text} {name};" for name, _, text in _FIELDS)
    taps = ", ".join(f"{tap:.9g}f" for tap in _taps())
    body = _SOURCE.replace("@ROWS@", str(_ROWS)).replace("@HALF@", str(_HALF)).replace("@TAPS@", taps)
    return f"struct Block {{ {fields} }};\nBlock& P = *(Block*)block;\n{body}"


_lock = threading.Lock()


@functools.lru_cache(maxsize=1)
def _build() -> Launch:
    return build("ssim_passes", _source())


def _compile() -> Launch:
    """The kernel; threads that ask for it at once wait for one compilation."""
    with _lock:
        return _build()


def warm_up() -> None:
    """Compile, or load from the cache. Call it from the main thread before the first `ssim` of a worker thread."""
    _compile()


@functools.lru_cache(maxsize=16)
def _inverse(size: int, repeat: int, total: int) -> Tensor:
    """[total] reciprocal weight sums of `size` positions, each `repeat` times, then zeros."""
    inside = torch.nn.functional.conv1d(
        torch.ones(1, 1, size, dtype=torch.float64),
        torch.tensor(_taps(), dtype=torch.float64)[None, None],
        padding=_HALF,
    )
    out = torch.zeros(total)
    out[: size * repeat] = (1.0 / inside[0, 0]).repeat_interleave(repeat)
    return out


class _Local(threading.local):
    """Buffers of the calling thread's last size, because fresh pages are slow. Margins of `scratch` stay zero."""

    key: tuple[int, ...] = ()
    scratch: Tensor
    blurred: Tensor


_local = _Local()


def _run(image: Tensor, target: Tensor, want_gradient: bool, threads: int) -> tuple[Tensor, Tensor | None]:
    """Mean SSIM (0-dim) and its gradient by `image`, of contiguous float32 [H, W, C]."""
    launch = _compile()
    height, width, channels = image.shape
    length = width * channels
    padded, margin = -(-length // _LANES) * _LANES, -(-_HALF * channels // _LANES) * _LANES
    pitch = padded + 2 * margin
    stride = (_FIELDS_FORWARD * _ROWS + _FIELDS_BACKWARD) * pitch
    key = (height, width, channels, threads)
    if _local.key != key:
        _local.scratch = torch.zeros(threads * stride)
        _local.blurred = torch.empty(_FIELDS_BACKWARD * height * padded)
        _local.key = key
    inverse_x, inverse_y = _inverse(width, channels, padded), _inverse(height, 1, height + _ROWS)
    gradient, scores = torch.empty_like(image) if want_gradient else None, torch.empty(height)
    block: Any = _Block(
        image=image.data_ptr(),
        target=target.data_ptr(),
        inverse_x=inverse_x.data_ptr(),
        inverse_y=inverse_y.data_ptr(),
        gradient=0 if gradient is None else gradient.data_ptr(),
        row_score=scores.data_ptr(),
        blurred=_local.blurred.data_ptr(),
        scratch=_local.scratch.data_ptr(),
        height=height,
        length=length,
        channels=channels,
        padded=padded,
        margin=margin,
        pitch=pitch,
        scratch_stride=stride,
        want_gradient=int(want_gradient),
    )
    run_workers(launch, block, 0, threads)
    if want_gradient:
        run_workers(launch, block, 1, threads)
    return (scores.double().sum() / (height * length)).float(), gradient


class _Ssim(torch.autograd.Function):
    """Autograd's view; only the first image has a gradient."""

    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, threads: int) -> Tensor:  # type: ignore[override]
        value, gradient = _run(image.contiguous(), target.contiguous(), ctx.needs_input_grad[0], threads)
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None


def supports(image: Tensor, target: Tensor) -> bool:
    """Whether `ssim` takes these tensors: float32, dense, on the CPU, and no gradient asked for the target."""
    return not target.requires_grad and all(
        t.dtype == torch.float32 and t.device.type == "cpu" and t.layout == torch.strided for t in (image, target)
    )


def ssim(image: Tensor, target: Tensor, threads: int | None = None) -> Tensor:
    """Mean structural similarity (0-dim) of two float32 CPU images [H, W, C]; differentiable in the first.

    `threads` workers (default: all cores); the result is bitwise the same for any number. Wang et al. 2004, "Image
    quality assessment", with the window and borders described in this module. ValueError if the shapes differ, a side
    is smaller than the window, or `supports` says no.
    """
    if image.ndim != 3 or image.shape != target.shape or min(image.shape[:2]) < WINDOW or image.shape[2] < 1:
        raise ValueError(
            f"SSIM needs two [H, W, C] images of one shape and at least {WINDOW} px, "
            f"got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if not supports(image, target):
        raise ValueError(
            f"SSIM here takes float32 CPU images and a target without gradient, got {image.dtype} on "
            f"{image.device} and {target.dtype} on {target.device}"
        )
    workers = default_threads() if threads is None else threads
    if workers < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    return _Ssim.apply(image, target, workers)  # type: ignore[no-any-return]
