"""C++ of the CUDA body, as text for `warp.func_native`: NVRTC compiles it for the GPU, Clang for Warp's CPU fibers.

The rules are those of `constants.py`, the formulas those of `cpu_source.py` (a record holds A, k, R: the conic by
completed squares; gradients go by way of xc, yy and k). One thread works on one Gaussian, a block of BLOCK threads on
one tile. In a tile, a warp owns four rows, two at a time: `SLOTS` pixels a thread, one in each pair of rows.

Names: a *slot* is camera * N + Gaussian, a *rank* its place in depth order over all cameras, a *hit* one pair of a slot
and a tile. A tile reads its hits from a list of fixed capacity. When the hits of a call outnumber the list, every tile
instead walks through all ranks and tests which of them meet it: slower, but nothing is lost and the host is not asked.

The same text runs on fibers with these substitutes: a shuffle goes through memory and a barrier, so every thread of
the block has to take part in it and the shortcuts of a single warp (`UNIFORM`, `WARP_ANY`) are not taken; atomics are
plain, since fibers share one thread.
"""

import re

from . import constants as k

BLOCK = 128
"""Threads of a block: four warps of four pixel rows each."""
HEAD = 8
"""Floats of a record before its channels: mean x, y; A; k; R; log2 opacity; first and last y of the ellipse."""
MOMENTS = 8
"""Floats of a slot's gradient before its channels, as in `cpu_source.MOMENTS`."""
WEIGHT_SCALE = 2.0**36
"""Weights are summed as integers of this many parts, so that the sum does not depend on the order."""
WIDE_FROM = 2**15 - 1
"""From this many tiles on, tile numbers take 32 bits to sort instead of 16."""

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
    "near": "float32",
}
"""Fields of the parameter structure and their Warp types; pointers travel as integers."""
_POINTER = {name: kind for kind, names in POINTERS.items() for name in names}

_COMMON = r"""
#if defined(__CUDA_ARCH__)
#define SHARED __shared__
#define UNIFORM(x) (x)
#define WARP_ANY(x) __any_sync(0xffffffffu, x)
#define QUOTIENT(a, b) __fdividef(a, b)
#define ADD(p, v) atomicAdd(p, v)
#define RAISE(p, v) atomicMax((int*)(p), __float_as_int(v))
#define UNROLL _Pragma("unroll")
auto exp2s = [](float x) -> float { float y; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); return y; };
auto bits = [](float x) -> int { return __float_as_int(x); };
auto as_float = [](int x) -> float { return __int_as_float(x); };
#else
#define SHARED static
#define UNIFORM(x) ((x) || true)
#define WARP_ANY(x) ((x) || true)
#define QUOTIENT(a, b) ((a) / (b))
#define ADD(p, v) (*(p) += (v))
#define RAISE(p, v) (*(p) = *(p) > (v) ? *(p) : (v))
#define UNROLL
auto exp2s = [](float x) -> float { return exp2f(x); };
auto bits = [](float x) -> int { return __builtin_bit_cast(int, x); };
auto as_float = [](int x) -> float { return __builtin_bit_cast(float, x); };
#endif
const float LOG2E = 1.44269504088896f, LN2 = 0.693147180559945f, PMIN = @LOG2_ALPHA_MIN@f;
const float ALPHA_MAX = @ALPHA_MAX@f, T_STOP = @T_STOP@f, LOW_PASS = @LOW_PASS@f;
auto smin = [](float a, float b) -> float { return a < b ? a : b; };
auto smax = [](float a, float b) -> float { return a > b ? a : b; };
auto finite = [&](float v) -> bool { return (bits(v) & 0x7f800000) != 0x7f800000; };
const int tid = WP_TILE_THREAD_IDX, lane = tid & 31, warp = tid >> 5;
"""

_SHUFFLE = r"""
#if defined(__CUDA_ARCH__)
auto shuffle = [](float v, int mask) -> float { return __shfl_xor_sync(0xffffffffu, v, mask); };
#else
static float exchange[@BLOCK@];
auto shuffle = [&](float v, int mask) -> float {
    exchange[tid] = v; WP_TILE_SYNC(); float r = exchange[tid ^ mask]; WP_TILE_SYNC(); return r; };
#endif
// Sixteen sums over a warp in sixteen shuffles: lane l ends with the sum of v[l & 15].
#define FOLD(h) UNROLL for (int i = 0; i < h; i++) { \
    const bool upper = (lane & h) != 0; \
    const float keep = upper ? v[i + h] : v[i], give = upper ? v[i] : v[i + h]; \
    v[i] = keep + shuffle(give, h); }
auto fold = [&](float* v) -> float { FOLD(8) FOLD(4) FOLD(2) FOLD(1) return v[0] + shuffle(v[0], 16); };
"""

# The camera of a slot and everything of the projection, for world mean X, Y, Z, quaternion q*, clamped log-scales l*.
_CAMERA = r"""
const float* V = P.viewmats + 16 * camera; const float* K = P.Ks + 9 * camera;
const float fx = K[0], fy = K[4], cx = K[2], cy = K[5];
const float W = (float)P.width, H = (float)P.height;
const float wide_x = @FRUSTUM_MARGIN@f * 0.5f * W, wide_y = @FRUSTUM_MARGIN@f * 0.5f * H;
const float x_low = (-cx - wide_x) / fx, x_high = (W - cx + wide_x) / fx;
const float y_low = (-cy - wide_y) / fy, y_high = (H - cy + wide_y) / fy;
"""
_PROJECT = r"""
float px = V[0] * X + V[1] * Y + V[2] * Z + V[3], py = V[4] * X + V[5] * Y + V[6] * Z + V[7];
float iz = 1.f / pz, xn = px * iz, yn = py * iz;
float u = smin(smax(xn, x_low), x_high), v = smin(smax(yn, y_low), y_high);
float mx = fx * xn + cx, my = fy * yn + cy;
// Largest component first, so that the squares neither vanish nor overflow.
float iq = 1.f / qmax, w = qw * iq, x = qx * iq, y = qy * iq, z = qz * iq;
float unit = 1.f / sqrtf(w * w + x * x + y * y + z * z);
w *= unit; x *= unit; y *= unit; z *= unit; iq *= unit;
float Q[9] = {1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y),
              2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x),
              2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)};
float s[3] = {expf(smax(r0, @LOG_SCALE_MIN@f)), expf(smax(r1, @LOG_SCALE_MIN@f)), expf(smax(r2, @LOG_SCALE_MIN@f))};
float ja = fx * iz, jb = fy * iz, jc = -ja * u, jd = -jb * v;
float T0[3], T1[3], B0[3], B1[3];
UNROLL for (int i = 0; i < 3; i++) { T0[i] = ja * V[i] + jc * V[8 + i]; T1[i] = jb * V[4 + i] + jd * V[8 + i]; }
UNROLL for (int j = 0; j < 3; j++) {
    B0[j] = (T0[0] * Q[j] + T0[1] * Q[3 + j] + T0[2] * Q[6 + j]) * s[j];
    B1[j] = (T1[0] * Q[j] + T1[1] * Q[3 + j] + T1[2] * Q[6 + j]) * s[j]; }
float n0 = B0[1] * B1[2] - B0[2] * B1[1], n1 = B0[2] * B1[0] - B0[0] * B1[2], n2 = B0[0] * B1[1] - B0[1] * B1[0];
float rxx = B0[0] * B0[0] + B0[1] * B0[1] + B0[2] * B0[2], ryy = B1[0] * B1[0] + B1[1] * B1[1] + B1[2] * B1[2];
float xy = B0[0] * B1[0] + B0[1] * B1[1] + B0[2] * B1[2], xx = rxx + LOW_PASS, yy = ryy + LOW_PASS;
float dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;
"""
_GAUSSIAN = r"""
const float X = P.means[3 * g], Y = P.means[3 * g + 1], Z = P.means[3 * g + 2];
const float qw = P.quats[4 * g], qx = P.quats[4 * g + 1], qy = P.quats[4 * g + 2], qz = P.quats[4 * g + 3];
const float r0 = P.log_scales[3 * g], r1 = P.log_scales[3 * g + 1], r2 = P.log_scales[3 * g + 2];
const float logit = P.logits[g];
const float qmax = smax(smax(fabsf(qw), fabsf(qx)), smax(fabsf(qy), fabsf(qz)));
"""
_DIRECTION = r"""
const float camx = -(V[0] * V[3] + V[4] * V[7] + V[8] * V[11]), camy = -(V[1] * V[3] + V[5] * V[7] + V[9] * V[11]);
const float camz = -(V[2] * V[3] + V[6] * V[7] + V[10] * V[11]);
float dx = X - camx, dy = Y - camy, dz = Z - camz, inv = 1.f / sqrtf(dx * dx + dy * dy + dz * dz);
dx *= inv; dy *= inv; dz *= inv;
const float sxx = dx * dx, syy = dy * dy, szz = dz * dz;
"""

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
"""Harmonic and its derivatives by the unit direction dx, dy, dz, where they are not 0."""


# Twelve coefficients (four harmonics) at a time, as three 16-byte words where the array allows it.
_TWELVE = r"""
auto load12 = [&](const float* p, int limit, float* f) -> void {
    if (P.sh_aligned) {
        UNROLL for (int i = 0; i < 3; i++) {
            const float4 word = ((const float4*)p)[i];
            f[4 * i] = word.x; f[4 * i + 1] = word.y; f[4 * i + 2] = word.z; f[4 * i + 3] = word.w; }
    } else { UNROLL for (int i = 0; i < 12; i++) f[i] = i < limit ? p[i] : 0.f; } };
auto store12 = [&](float* p, int limit, const float* f) -> void {
    if (P.sh_aligned) {
        UNROLL for (int i = 0; i < 3; i++)
            ((float4*)p)[i] = float4{f[4 * i], f[4 * i + 1], f[4 * i + 2], f[4 * i + 3]};
    } else { UNROLL for (int i = 0; i < 12; i++) if (i < limit) p[i] = f[i]; } };
"""


def _harmonics(before: str, per_band: str, after: str) -> str:
    """`per_band` for every harmonic there is, with @Y@ and what its derivatives @dY@ add put in, a degree at a time.

    Four at a time stand between `before` and `after`, whose @q@ is where their coefficients begin; @i@ counts in those.
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


# Tile spans of one slot: calls visit(tile row, first tile column, last tile column).
_SPANS = r"""
auto first_at = [&](float v, float limit) -> int {
    v = smin(smax(v, 0.f), limit); int t = (int)v; return t + ((float)t < v); };
auto last_at = [&](float v, float limit) -> int { return v < 0.f ? -1 : (int)smin(v, limit); };
struct Extent { float mx, my, A, kk, R, lop, y0, y1, hx, dyr; };
auto extent = [&](long long slot) -> Extent {
    const float4* r = (const float4*)(P.record + slot * P.record_stride);
    const float4 a = r[0], b = r[1];
    return Extent{a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, P.aux[2 * slot], P.aux[2 * slot + 1]}; };
auto first_row = [&](const Extent& e) -> int { return first_at(e.y0 - 0.5f, (float)P.height) >> 4; };
auto last_row = [&](const Extent& e) -> int {
    int y0 = first_at(e.y0 - 0.5f, (float)P.height), y1 = last_at(e.y1 - 0.5f, (float)P.height - 1.f);
    return y0 > y1 ? -1 : y1 >> 4; };
// First and last pixel column in tile row ty.
auto columns_of = [&](const Extent& e, int ty, int& c0, int& c1) -> void {
    float lo = smax(e.y0, ty * 16 + 0.5f) - e.my, hi = smin(e.y1, ty * 16 + 15.5f) - e.my;
    auto half = [&](float d) -> float { return sqrtf(smax((e.lop + e.R * d * d - PMIN) / -e.A, 0.f)); };
    float right = e.dyr < lo ? e.kk * lo + half(lo) : e.dyr > hi ? e.kk * hi + half(hi) : e.hx;
    float left = -e.dyr < lo ? e.kk * lo - half(lo) : -e.dyr > hi ? e.kk * hi - half(hi) : -e.hx;
    c0 = first_at(e.mx + left - 0.5f, (float)P.width); c1 = last_at(e.mx + right - 0.5f, (float)P.width - 1.f); };
"""

# A thread per slot: project, cull, colour, count tile hits.
_STAGE_PROJECT = (
    _SPANS
    + _TWELVE
    + r"""
const long long slot = task;
if (slot >= (long long)P.n * P.cameras) return;
const int camera = task / P.n;
const long long g = slot - (long long)camera * P.n;
P.radii[slot] = 0; P.means2d[2 * slot] = 0.f; P.means2d[2 * slot + 1] = 0.f;
P.hit_count[slot] = 0; P.depth_key[slot] = 0x7fffffff;
"""
    + _CAMERA
    + _GAUSSIAN
    + r"""
bool ok = finite(X) && finite(Y) && finite(Z) && finite(qw) && finite(qx) && finite(qy) && finite(qz);
ok = ok && r0 <= @LOG_SCALE_MAX@f && r1 <= @LOG_SCALE_MAX@f && r2 <= @LOG_SCALE_MAX@f && logit == logit;
ok = ok && qmax > @QUAT_MIN@f && fx > 0.f && fy > 0.f && finite(fx) && finite(fy) && finite(cx) && finite(cy);
const float pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
if (!(ok && pz > P.near && finite(pz))) return;
"""
    + _PROJECT
    + r"""
float lop = -log2f(1.f + expf(-smin(smax(logit, -80.f), 80.f)));
if (P.antialiased) lop += 0.5f * log2f(smax(dr / det, @COMPENSATION2_MIN@f));
float level = smax(lop - PMIN, 0.f) * (2.f * LN2), hx = sqrtf(level * xx), hy = sqrtf(level * yy);
ok = level > 0.f && xx + yy < @VARIANCE_MAX@f && mx + hx >= 0.5f && mx - hx <= W - 0.5f;
if (!(ok && my + hy >= 0.5f && my - hy <= H - 0.5f)) return;
float* channel = P.record + slot * P.record_stride + @HEAD@;
if (P.n_sh) {
"""
    + _DIRECTION
    + r"""
    float c0 = 0.5f, c1 = 0.5f, c2 = 0.5f, f[12];
    const float* from = P.sh + g * P.sh_stride;
"""
    + _harmonics(
        "load12(from + @q@, 3 * P.bands - @q@, f);\n",
        "{ const float b = @Y@; c0 += b * f[@i@]; c1 += b * f[@i@ + 1]; c2 += b * f[@i@ + 2]; }",
        "",
    )
    + r"""
    if (!(finite(c0) && finite(c1) && finite(c2))) return;
    *(float4*)channel = float4{smax(c0, 0.f), smax(c1, 0.f), smax(c2, 0.f), pz};
    channel += 3;
}
for (int c = 0; c < P.n_colors; c++) {
    float value = P.colors[g * P.n_colors + c];
    ok = ok && finite(value); channel[c] = value; }
if (!ok) return;
if (P.want_depth) channel[P.n_colors] = pz;
const Extent e = {mx, my, -0.5f * LOG2E * yy / det, xy / yy, -0.5f * LOG2E / yy, lop, my - hy, my + hy, hx,
                  xy / xx * hx};
float4* head = (float4*)(P.record + slot * P.record_stride);
head[0] = float4{e.mx, e.my, e.A, e.kk}; head[1] = float4{e.R, e.lop, e.y0, e.y1};
P.aux[2 * slot] = e.hx; P.aux[2 * slot + 1] = e.dyr;
int hits = 0;
for (int ty = first_row(e), end = last_row(e); ty <= end; ty++) {
    int c0, c1; columns_of(e, ty, c0, c1);
    if (c0 <= c1) hits += (c1 >> 4) - (c0 >> 4) + 1; }
float half = 0.5f * (xx + yy), diff = 0.5f * (xx - yy);
float radius = smin(sqrtf((half + sqrtf(diff * diff + xy * xy)) * level), 1.07e9f);
int whole = (int)radius;
P.radii[slot] = whole + ((float)whole < radius);
P.means2d[2 * slot] = mx; P.means2d[2 * slot + 1] = my;
P.hit_count[slot] = hits;
if (hits) P.depth_key[slot] = bits(pz);
"""
)

# A thread per rank: write the hits, those of a large Gaussian by the whole block. Hits come in depth order.
_STAGE_EMIT = (
    _SPANS
    + r"""
SHARED int many, large[@BLOCK@], first[@BLOCK@], width[@BLOCK@];
const long long rank = task, total = (long long)P.n * P.cameras, tiles = (long long)P.tiles_x * P.tiles_y;
auto put = [&](long long at, long long tile, long long slot) -> void {
    if (at >= P.capacity) return;
    if (P.wide) ((int*)P.hit_key)[at] = (int)tile; else ((short*)P.hit_key)[at] = (short)tile;
    P.hit_slot[at] = (int)slot; };
if (tid == 0) many = 0;
WP_TILE_SYNC();
const long long slot = rank < total ? P.order[rank] : 0;
const int count = rank < total ? P.hit_count[slot] : 0;
large[tid] = count > 32;
if (count > 32) many = 1;
if (count > 0 && count <= 32) {
    const Extent e = extent(slot);
    long long at = P.ends[rank] - count;
    for (int ty = first_row(e), end = last_row(e); ty <= end; ty++) {
        int c0, c1; columns_of(e, ty, c0, c1);
        const long long row = (int)slot / P.n * tiles + (long long)ty * P.tiles_x;
        if (c0 <= c1) for (int c = c0 >> 4; c <= c1 >> 4; c++) put(at++, row + c, slot);
    }
}
WP_TILE_SYNC();
if (!many) return;
for (int j = 0; j < @BLOCK@; j++) {
    if (!large[j]) continue;
    const long long its = P.order[rank - tid + j];
    const Extent e = extent(its);
    long long at = P.ends[rank - tid + j] - P.hit_count[its];
    const int end = last_row(e);
    for (int base = first_row(e); base <= end; base += @BLOCK@) {
        int c0 = 0, c1 = -1;
        if (base + tid <= end) columns_of(e, base + tid, c0, c1);
        first[tid] = c0 >> 4; width[tid] = c0 <= c1 ? (c1 >> 4) - (c0 >> 4) + 1 : 0;
        WP_TILE_SYNC();
        const int rows = end - base + 1 < @BLOCK@ ? end - base + 1 : @BLOCK@;
        for (int i = 0; i < rows; i++) {
            const long long row = (int)its / P.n * tiles + (long long)(base + i) * P.tiles_x + first[i];
            if ((i & 3) == warp) for (int c = lane; c < width[i]; c += 32) put(at + c, row + c, its);
            at += width[i];
        }
        WP_TILE_SYNC();
    }
}
"""
)

# A thread per place of the sorted list: where the tiles begin and end in it.
_STAGE_RANGES = r"""
const long long at = task, tiles = (long long)P.tiles_x * P.tiles_y * P.cameras;
if (at == 0) {
    const long long wanted = P.ends[(long long)P.n * P.cameras - 1];
    P.hits[0] = wanted; P.hits[1] = P.capacity;
    if (wanted > P.demand[0]) P.demand[0] = wanted;
}
if (at >= P.capacity) return;
auto key = [&](long long i) -> int { return P.wide ? ((int*)P.sorted_key)[i] : (int)((short*)P.sorted_key)[i]; };
const int tile = key(at);
if (tile >= tiles) return;
P.sorted_slot[at] = P.hit_slot[P.permutation[at]];
if (at == 0 || key(at - 1) != tile) P.tile_start[tile] = (int)at;
if (at == P.capacity - 1 || key(at + 1) != tile) P.tile_end[tile] = (int)at + 1;
"""

_TILE = (
    _SHUFFLE
    + r"""
enum { NCH = @NCH@, SLOTS = 2, STRIDE = (@HEAD@ + NCH + 3) / 4 * 4 };
SHARED __attribute__((aligned(16))) float batch[@BLOCK@ * STRIDE];
SHARED int live, flags[@BLOCK@];
const int per_camera = P.tiles_x * P.tiles_y, tile = (int)(task / @BLOCK@), camera = tile / per_camera;
const int tx = (tile - camera * per_camera) % P.tiles_x, ty = (tile - camera * per_camera) / P.tiles_x;
const long long total = (long long)P.n * P.cameras;
const bool listed = total == 0 || P.ends[total - 1] <= P.capacity;
long long at = listed ? P.tile_start[tile] : 0;
const long long stop = listed ? P.tile_end[tile] : total;
const float x0 = tx * 16.f, y0 = ty * 16.f, column = (lane & 15) + 0.5f;
const int row = warp * 4 + (lane >> 4);
const long long corner = ((long long)camera * P.height + ty * 16 + row) * P.width + tx * 16 + (lane & 15);
float T[SLOTS];
bool inside[SLOTS];
// Pixels outside the image start without transmittance: they are finished from the beginning.
UNROLL for (int s = 0; s < SLOTS; s++) {
    inside[s] = tx * 16 + (lane & 15) < P.width && ty * 16 + row + 2 * s < P.height;
    T[s] = inside[s] ? 1.f : 0.f; }
"""
)
# Next hits of the tile into shared memory: record, rows in which the ellipse meets the tile's columns, and slot.
_BATCH = (
    _SPANS
    + r"""
while (at < stop) {
    if (tid == 0) live = 0;
    WP_TILE_SYNC();
    if (T[0] > T_STOP || T[1] > T_STOP) live = 1;
    WP_TILE_SYNC();
    if (!live) break;
    int slot = -1, place = tid, m = (int)(stop - at < @BLOCK@ ? stop - at : @BLOCK@);
    if (listed) { if (tid < m) slot = P.sorted_slot[at + tid]; }
    else {
        if (P.hit_count[P.order[at]] == 0) break;
        if (tid < m) {
            const long long its = P.order[at + tid];
            if (P.hit_count[its] > 0 && (int)its / P.n == camera) {
                const Extent e = extent(its);
                int c0 = 0, c1 = -1;
                if (ty >= first_row(e) && ty <= last_row(e)) columns_of(e, ty, c0, c1);
                if (c0 <= c1 && tx >= c0 >> 4 && tx <= c1 >> 4) slot = (int)its;
            }
        }
        flags[tid] = slot >= 0;
        WP_TILE_SYNC();
        place = m = 0;
        for (int j = 0; j < @BLOCK@; j++) { place += j < tid ? flags[j] : 0; m += flags[j]; }
    }
    at += @BLOCK@;
    if (slot >= 0) {
        const float4* r = (const float4*)(P.record + (long long)slot * P.record_stride);
        float4* to = (float4*)(batch + place * STRIDE);
        const float4 a = r[0], b = r[1];
        const float mx = a.x - x0, my = a.y - y0, A = -a.z, kk = a.w, R = -b.x, L = b.y - PMIN;
        const float q = A * kk * kk + R, tip = kk * sqrtf(L / R);
        const float xu = smin(smax(tip, 0.5f - mx), 15.5f - mx), xd = smin(smax(-tip, 0.5f - mx), 15.5f - mx);
        const float hi = A * kk * xu + sqrtf(smax(L * q - A * R * xu * xu, 0.f));
        const float lo = A * kk * xd - sqrtf(smax(L * q - A * R * xd * xd, 0.f));
        // A hair of slack against rounding: rows too many cost time, rows too few cost pixels.
        const float from = smin(smax(my - 0.502f + lo / q, 0.f), 16.f);
        const float till = smin(smax(my + 0.502f + hi / q, 0.f), 16.f);
        int top = (int)from; top += (float)top < from;
        to[0] = float4{mx, my, a.z, kk};
        to[1] = float4{b.x, b.y, as_float(top | ((int)till << 8)), as_float(slot)};
        UNROLL for (int c = 2; c < STRIDE / 4; c++) to[c] = r[c];
    }
    WP_TILE_SYNC();
    for (int j = 0; j < m; j++) {
        if ((j & 15) == 15 && !WARP_ANY(T[0] > T_STOP || T[1] > T_STOP)) break;
        const float* h = batch + j * STRIDE;
        const int range = bits(h[6]), top = range & 255, end = range >> 8;
        if (!UNIFORM(end > warp * 4 && top < warp * 4 + 4)) continue;
        const float mx = h[0], my = h[1], A = h[2], kk = h[3], R = h[4], lop = h[5];
        const int slot = bits(h[7]);
        const float* channel = h + @HEAD@;
        bool touched = false;
"""
)
# One row pair of the warp; `end` is the row after the last.
_ALPHA = r"""
        UNROLL for (int s = 0; s < SLOTS; s++) {
            if (end <= warp * 4 + 2 * s || top > warp * 4 + 2 * s + 1) continue;
            const float dy = row + 2 * s + 0.5f - my, e = column - mx - kk * dy;
            const float p = fmaf(A * e, e, lop + R * dy * dy);
            if (!(p >= PMIN && T[s] > T_STOP)) continue;
            touched = true;
            const float raw = exp2s(p), al = smin(raw, ALPHA_MAX), w = al * T[s];
"""

# A block per tile: forward.
_STAGE_BLEND = (
    _TILE
    + r"""
float C[SLOTS][NCH], best[SLOTS], median[SLOTS], largest[SLOTS];
int winner[SLOTS];
UNROLL for (int s = 0; s < SLOTS; s++) {
    best[s] = 0.f; largest[s] = 0.f; median[s] = @DEPTH_EMPTY@f; winner[s] = -1;
    UNROLL for (int c = 0; c < NCH; c++) C[s][c] = 0.f; }
"""
    + _BATCH
    + r"""
        float sum = 0.f, peak = 0.f;
"""
    + _ALPHA
    + r"""
            T[s] = fmaf(-al, T[s], T[s]);
            UNROLL for (int c = 0; c < NCH; c++) C[s][c] = fmaf(w, channel[c], C[s][c]);
            sum += w; peak = smax(peak, w);
            if (P.want_depth) {
                // T before > 0.5 and T after <= 0.5: crossed here. Until then, the largest so far.
                if (T[s] + w > 0.5f && (T[s] <= 0.5f || w > best[s])) median[s] = channel[NCH - 1];
                best[s] = smax(best[s], w);
            }
            if (P.want_top && w > largest[s]) { largest[s] = w; winner[s] = slot; }
        }
        if (P.want_weights && WARP_ANY(touched)) {
            UNROLL for (int h = 16; h > 0; h >>= 1) { sum += shuffle(sum, h); peak = smax(peak, shuffle(peak, h)); }
            if (lane == 0 && peak > 0.f) {
                ADD((unsigned long long*)P.weight_sum + slot, (unsigned long long)(sum * @WEIGHT_SCALE@f));
                RAISE(P.weight_max + slot, peak); }
        }
    }
    WP_TILE_SYNC();
}
UNROLL for (int s = 0; s < SLOTS; s++) if (inside[s]) {
    const long long pixel = corner + 2 * s * P.width;
    P.alpha[pixel] = 1.f - T[s];
    if (P.want_depth) P.median[pixel] = median[s];
    if (P.want_top) {
        P.top_weight[pixel] = largest[s]; P.top_id[pixel] = winner[s] < 0 ? -1 : winner[s] - camera * P.n; }
    UNROLL for (int c = 0; c < NCH; c++) P.image[pixel * NCH + c] = C[s][c] + T[s] * P.background[c];
}
"""
)

# A block per tile: backward, front to back. `left` is what the Gaussians behind still add to d loss / d image . image.
_STAGE_BLEND_BACKWARD = (
    _TILE
    + r"""
enum { GROUPS = (@MOMENTS@ + NCH + 15) / 16, GROUP = 16 };
float left[SLOTS], G[SLOTS][NCH];
UNROLL for (int s = 0; s < SLOTS; s++) {
    const long long pixel = corner + 2 * s * P.width;
    left[s] = 0.f;
    UNROLL for (int c = 0; c < NCH; c++) G[s][c] = 0.f;
    if (!inside[s]) continue;
    left[s] = -P.grad_alpha[pixel] * (1.f - P.alpha[pixel]);
    UNROLL for (int c = 0; c < NCH; c++) {
        G[s][c] = P.grad_image[pixel * NCH + c]; left[s] = fmaf(G[s][c], P.image[pixel * NCH + c], left[s]); }
}
"""
    + _BATCH
    + r"""
        float out[GROUPS * GROUP];
        UNROLL for (int i = 0; i < GROUPS * GROUP; i++) out[i] = 0.f;
        const float qa = -2.f * LN2 * A, qc = -2.f * LN2 * R;
"""
    + _ALPHA
    + r"""
            float along = 0.f;
            UNROLL for (int c = 0; c < NCH; c++) {
                along = fmaf(G[s][c], channel[c], along);
                out[@MOMENTS@ + c] = fmaf(w, G[s][c], out[@MOMENTS@ + c]); }
            const float seen = w * along, behind = left[s] - seen;
            left[s] = behind;
            T[s] = fmaf(-al, T[s], T[s]);
            // d loss / d log alpha; nothing passes the clamp.
            const float v = raw <= ALPHA_MAX ? seen - QUOTIENT(al, 1.f - al) * behind : 0.f, ve = v * e;
            out[0] += v; out[1] += ve; out[2] = fmaf(v, dy, out[2]);
            out[3] = fmaf(ve, e, out[3]); out[4] = fmaf(ve, dy, out[4]); out[5] = fmaf(v * dy, dy, out[5]);
            if (P.want_abs) { out[6] += fabsf(qa * ve); out[7] += fabsf(qc * dy * v - kk * qa * ve); }
        }
        if (!WARP_ANY(touched)) continue;
        float* to = P.grad + (long long)slot * P.grad_stride;
        UNROLL for (int i = 0; i < GROUPS; i++) {
            const float value = fold(out + GROUP * i);
            if (lane < GROUP && GROUP * i + lane < @MOMENTS@ + NCH) ADD(to + GROUP * i + lane, value); }
    }
    WP_TILE_SYNC();
}
"""
)

# A thread per Gaussian, camera after camera: gradients of the projection from those of the moments.
_STAGE_PROJECT_BACKWARD = (
    _SHUFFLE
    + _TWELVE
    + r"""
const long long g = task < P.n ? task : 0;
const bool mine = task < P.n;
"""
    + _GAUSSIAN
    + r"""
bool seen = false;
float aX[3] = {0.f, 0.f, 0.f}, aq[4] = {0.f, 0.f, 0.f, 0.f}, as[3] = {0.f, 0.f, 0.f}, al = 0.f;
float* sh_to = P.grad_sh + g * P.sh_stride; float* color_to = P.grad_colors + g * P.n_colors;
for (int camera = 0; camera < P.cameras; camera++) {
    const long long slot = (long long)camera * P.n + g;
    const bool use = mine && P.hit_count[slot] > 0;
    float gV[16] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
    if (mine && !use) { P.grad_norm[slot] = 0.f; P.grad_abs[slot] = 0.f; }
    if (use) {
"""
    + _CAMERA
    + r"""
        const float pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
"""
    + _PROJECT
    + r"""
        const float4 ma = ((const float4*)(P.grad + slot * P.grad_stride))[0];
        const float4 mb = ((const float4*)(P.grad + slot * P.grad_stride))[1];
        const float* gc = P.grad + slot * P.grad_stride + @MOMENTS@;
        const float m0 = ma.x;
        // log alpha = log opacity - (e^2 / xc + dy^2 / yy) / 2 with e = dx - k dy, k = xy / yy, xc = det / yy.
        // Gradients by way of xc, yy and k lose no digits on long thin Gaussians; by way of the conic they do.
        float kk = xy / yy, ic = yy / det, iy = 1.f / yy;
        float gmx = ma.y * ic, gmy = ma.z * iy - kk * gmx;
        float g2c = ma.w * ic * ic, gk = mb.x * ic * iy, g2y = mb.y * iy * iy;
        float ga0[3] = {0.f, 0.f, 0.f}, ga1[3] = {0.f, 0.f, 0.f};
        if (P.antialiased) {
            const bool free = dr > @COMPENSATION2_MIN@f * det;
            float h = free ? m0 : 0.f, over = free ? h / dr : 0.f;
            g2c -= h * ic; g2y -= h * iy;
            float e0 = over * n0, e1 = over * n1, e2 = over * n2;
            ga0[0] = B1[1] * e2 - B1[2] * e1; ga0[1] = B1[2] * e0 - B1[0] * e2; ga0[2] = B1[0] * e1 - B1[1] * e0;
            ga1[0] = e1 * B0[2] - e2 * B0[1]; ga1[1] = e2 * B0[0] - e0 * B0[2]; ga1[2] = e0 * B0[1] - e1 * B0[0];
        }
        float gT0[3] = {0.f, 0.f, 0.f}, gT1[3] = {0.f, 0.f, 0.f}, gQ[9], gs[3];
        UNROLL for (int j = 0; j < 3; j++) {
            float across = B0[j] - kk * B1[j], gB0 = g2c * across + gk * B1[j];
            float gB1 = g2y * B1[j] + gk * across - kk * gB0;
            gB0 += ga0[j]; gB1 += ga1[j];
            float along = 0.f;
            UNROLL for (int i = 0; i < 3; i++) {
                float gM = T0[i] * gB0 + T1[i] * gB1, M = Q[3 * i + j] * s[j];
                gT0[i] += gB0 * M; gT1[i] += gB1 * M;
                gQ[3 * i + j] = gM * s[j]; along += gM * M;
            }
            gs[j] = along;
        }
        as[0] += r0 >= @LOG_SCALE_MIN@f ? gs[0] : 0.f; as[1] += r1 >= @LOG_SCALE_MIN@f ? gs[1] : 0.f;
        as[2] += r2 >= @LOG_SCALE_MIN@f ? gs[2] : 0.f;
        float gw = 2.f * (z * (gQ[3] - gQ[1]) + y * (gQ[2] - gQ[6]) + x * (gQ[7] - gQ[5]));
        float gx = 2.f * (y * (gQ[1] + gQ[3]) + z * (gQ[2] + gQ[6]) + w * (gQ[7] - gQ[5]) - 2.f * x * (gQ[4] + gQ[8]));
        float gy = 2.f * (x * (gQ[1] + gQ[3]) + z * (gQ[5] + gQ[7]) + w * (gQ[2] - gQ[6]) - 2.f * y * (gQ[0] + gQ[8]));
        float gz = 2.f * (x * (gQ[2] + gQ[6]) + y * (gQ[5] + gQ[7]) + w * (gQ[3] - gQ[1]) - 2.f * z * (gQ[0] + gQ[4]));
        float turn = w * gw + x * gx + y * gy + z * gz;
        aq[0] += (gw - w * turn) * iq; aq[1] += (gx - x * turn) * iq;
        aq[2] += (gy - y * turn) * iq; aq[3] += (gz - z * turn) * iq;
        float gja = gT0[0] * V[0] + gT0[1] * V[1] + gT0[2] * V[2], gjc = gT0[0] * V[8] + gT0[1] * V[9] + gT0[2] * V[10];
        float gjb = gT1[0] * V[4] + gT1[1] * V[5] + gT1[2] * V[6], gjd = gT1[0] * V[8] + gT1[1] * V[9] + gT1[2] * V[10];
        float gu = xn >= x_low && xn <= x_high ? -ja * gjc : 0.f, gv = yn >= y_low && yn <= y_high ? -jb * gjd : 0.f;
        float gxn = gu + fx * gmx, gyn = gv + fy * gmy, gpx = gxn * iz, gpy = gyn * iz;
        float gpz = -iz * (gja * ja + gjb * jb + gjc * jc + gjd * jd + gxn * xn + gyn * yn);
        if (P.want_depth) gpz += gc[P.channels - 1];
        aX[0] += V[0] * gpx + V[4] * gpy + V[8] * gpz; aX[1] += V[1] * gpx + V[5] * gpy + V[9] * gpz;
        aX[2] += V[2] * gpx + V[6] * gpy + V[10] * gpz;
        float gcx = 0.f, gcy = 0.f, gcz = 0.f;
        if (P.n_sh) {
"""
    + _DIRECTION
    + r"""
            // A floored channel passes only what would raise it; the record holds the floored colour.
            const float* shown = P.record + slot * P.record_stride + @HEAD@;
            const float* from = P.sh + g * P.sh_stride;
            const float h0 = shown[0] > 0.f || gc[0] < 0.f ? gc[0] : 0.f;
            const float h1 = shown[1] > 0.f || gc[1] < 0.f ? gc[1] : 0.f;
            const float h2 = shown[2] > 0.f || gc[2] < 0.f ? gc[2] : 0.f;
            float gdx = 0.f, gdy = 0.f, gdz = 0.f;
            float f[12], o[12];
"""
    + _harmonics(
        "load12(from + @q@, 3 * P.bands - @q@, f); UNROLL for (int i = 0; i < 12; i++) o[i] = 0.f;\n"
        "if (seen) load12(sh_to + @q@, 3 * P.bands - @q@, o);\n",
        "{ const float b = @Y@; "
        "[[maybe_unused]] const float through = h0 * f[@i@] + h1 * f[@i@ + 1] + h2 * f[@i@ + 2]; @dY@ "
        "o[@i@] += b * h0; o[@i@ + 1] += b * h1; o[@i@ + 2] += b * h2; }",
        "store12(sh_to + @q@, 3 * P.bands - @q@, o);",
    )
    + r"""
            const float radial = dx * gdx + dy * gdy + dz * gdz;
            gcx = -(gdx - dx * radial) * inv; gcy = -(gdy - dy * radial) * inv; gcz = -(gdz - dz * radial) * inv;
            aX[0] -= gcx; aX[1] -= gcy; aX[2] -= gcz;
        }
        for (int c = 0; c < P.n_colors; c++) {
            const float value = gc[P.n_sh + c];
            color_to[c] = seen ? color_to[c] + value : value; }
        seen = true;
        float op = expf(-fabsf(smin(smax(logit, -80.f), 80.f)));
        al += m0 * ((logit > 0.f ? op : 1.f) / (1.f + op));
        P.grad_norm[slot] = sqrtf(gmx * gmx + gmy * gmy); P.grad_abs[slot] = sqrtf(mb.z * mb.z + mb.w * mb.w);
        const float gp[3] = {gpx, gpy, gpz}, world[3] = {X, Y, Z}, gCam[3] = {gcx, gcy, gcz};
        UNROLL for (int r = 0; r < 3; r++) {
            UNROLL for (int c = 0; c < 3; c++) {
                float value = gp[r] * world[c] - gCam[c] * V[4 * r + 3];
                if (r == 0) value += ja * gT0[c];
                if (r == 1) value += jb * gT1[c];
                if (r == 2) value += jc * gT0[c] + jd * gT1[c];
                gV[4 * r + c] = value;
            }
            gV[4 * r + 3] = gp[r] - (gcx * V[4 * r] + gcy * V[4 * r + 1] + gcz * V[4 * r + 2]);
        }
    }
    if (P.want_view && WARP_ANY(use)) {
        const float value = fold(gV);
        if (lane < 12) ADD(P.grad_view + 16 * camera + lane, value);
    }
}
if (!mine) return;
UNROLL for (int c = 0; c < 3; c++) { P.grad_means[3 * g + c] = aX[c]; P.grad_log_scales[3 * g + c] = as[c]; }
UNROLL for (int c = 0; c < 4; c++) P.grad_quats[4 * g + c] = aq[c];
P.grad_logits[g] = al;
// What no camera saw, and the bands that were not used.
if (P.n_sh && P.sh_aligned) for (int i = seen ? (P.bands + 3) / 4 * 12 : 0; i < P.sh_stride; i += 4)
    *(float4*)(sh_to + i) = float4{0.f, 0.f, 0.f, 0.f};
if (P.n_sh && !P.sh_aligned) for (int i = seen ? 3 * P.bands : 0; i < P.sh_stride; i++) sh_to[i] = 0.f;
if (!seen) for (int c = 0; c < P.n_colors; c++) color_to[c] = 0.f;
"""
)


def _field(match: re.Match) -> str:
    name = match.group(1)
    return f"(({_POINTER[name]})args.{name})" if name in _POINTER else f"args.{name}"


def _assemble(stage: str, **extra: object) -> str:
    """The snippet of one stage, with the constants of `constants.py` put in. Arguments: args, task (thread number)."""
    values = {name: getattr(k, name) for name in dir(k) if name.isupper() and not name.startswith("SH_")}
    values |= {"BLOCK": BLOCK, "HEAD": HEAD, "MOMENTS": MOMENTS, "WEIGHT_SCALE": WEIGHT_SCALE} | extra
    text = _COMMON + stage
    for name, value in values.items():
        text = text.replace(f"@{name}@", repr(value) if isinstance(value, float) else str(value))
    return re.sub(r"\bP\.(\w+)", _field, text)


def stages() -> dict[str, str]:
    """Snippets of the stages that know no channels, by kernel name."""
    return {
        "raster_project": _assemble(_STAGE_PROJECT),
        "raster_emit": _assemble(_STAGE_EMIT),
        "raster_ranges": _assemble(_STAGE_RANGES),
        "raster_project_backward": _assemble(_STAGE_PROJECT_BACKWARD),
    }


def blending(channels: int) -> dict[str, str]:
    """Snippets of blending for images of `channels` channels (depth included), by kernel name."""
    return {
        "raster_blend": _assemble(_STAGE_BLEND, NCH=channels),
        "raster_blend_backward": _assemble(_STAGE_BLEND_BACKWARD, NCH=channels),
    }
