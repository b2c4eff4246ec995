"""C++ of the CPU body, as text for `warp.func_native`.

Everything works on vectors of 16 floats (`F`), which Clang lowers to AVX-512, AVX2 or NEON. There is no libc here.
One parameter block `P` (fields below, mirrored by a ctypes structure) carries pointers and sizes, so that a launch
costs one pointer. Stages are functions of (block, worker); work is dealt out in fixed chunks or tiles, and every sum
has a fixed order, so results do not depend on the number of workers.

Names: a *slot* is the place of a visible Gaussian (chunk * CHUNK + running number, in index order), a *rank* its place
in depth order, a *hit* one (Gaussian, tile) pair. Hits are listed tile by tile, front to back; their per-hit results
are stored slot by slot, so that the sum over a Gaussian's tiles reads consecutive memory.

A record holds, per slot: mean x, y; A = -log2(e) yy / (2 det); k = xy / yy; R = -log2(e) / (2 yy); log2 opacity; first
and last y of the ellipse alpha >= 1/255; then the channels. The exponent of alpha in base 2 is
  log2 opacity + R dy^2 + A (dx - k dy)^2,
the quadratic form of the conic by completed squares: no cancellation for long thin Gaussians.
"""

import ctypes

from . import constants as k

CHUNK = 1024
"""Gaussians per unit of work of the projection."""
SPANS = 4 * CHUNK
"""Tile spans that are remembered per chunk; those beyond are worked out again when needed."""
HEAD = 8
"""Floats of a record before its channels."""
MOMENTS = 8
"""Floats of a hit's gradient before its channels: sums of v, v e, v dy, v e^2, v e dy, v dy^2 with e = dx - k dy and
v = d loss / d log alpha, then of |d loss / d mean x|, |d loss / d mean y|."""

_F, _I, _P = ctypes.c_float, ctypes.c_int64, ctypes.c_uint64
_FIELDS: list[tuple[str, type, str]] = [
    *[
        (n, _P, "const float*")
        for n in ("means", "quats", "log_scales", "logits", "colors", "sh", "background", "grad_image", "grad_alpha")
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
            "channels",
            "record_stride",
            "grad_stride",
            "antialiased",
            "want_depth",
            "want_weights",
            "want_top",
            "want_abs",
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


_COMMON = r"""
typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
const float LOG2E = 1.44269504088896f, LN2 = 0.693147180559945f, PMIN = @LOG2_ALPHA_MIN@f;
const float ALPHA_MAX = @ALPHA_MAX@f, T_STOP = @T_STOP@f, LOW_PASS = @LOW_PASS@f;
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
// The second operand where the first is NaN, as in one vminps or vmaxps.
auto vmin = FN(F a, F b) -> F { return a < b ? a : b; };
auto vmax = FN(F a, F b) -> F { return a > b ? a : b; };
auto vabs = FN(F a) -> F { return __builtin_elementwise_abs(a); };
auto vsqrt = FN(F a) -> F { return __builtin_elementwise_sqrt(a); };
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
auto vround = FN(F a) -> F { return __builtin_elementwise_roundeven(a); };
typedef bool Bits __attribute__((ext_vector_type(16)));
auto bits = FN(I m) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, Bits)); };
auto any = FN(I m) -> bool { return __builtin_reduce_or(m) != 0; };
auto smin = FN(float a, float b) -> float { return a < b ? a : b; };
auto smax = FN(float a, float b) -> float { return a > b ? a : b; };
auto ssqrt = FN(float a) -> float { return __builtin_elementwise_sqrt(a); };
// Pixel rows or columns whose centres lie at or beyond v: first index >= v, last index <= v, for v in any range.
auto first_at = FN(float v, float limit) -> int {
    v = smin(smax(v, 0.f), limit); int t = (int)v; return t + ((float)t < v); };
auto last_at = FN(float v, float limit) -> int { return v < 0.f ? -1 : (int)smin(v, limit); };
// 2^p: nearest integer by the rounding of a large addend, degree-5 polynomial for the rest (relative error 2e-7).
auto exp2v = FN(F p) -> F {
    F z = p + 12582912.f, f = p - (z - 12582912.f), f2 = f * f;
    F q = fma(fma(f, (F)1.33389978e-3f, (F)9.61833261e-3f), f2, fma(f, (F)5.55044435e-2f, (F)2.40226522e-1f));
    q = fma(q, f2, fma(f, (F)6.93147182e-1f, (F)1.f));
    return __builtin_bit_cast(F, __builtin_bit_cast(I, q) + (__builtin_bit_cast(I, z) << 23)); };
auto expv = FN(F x) -> F { return exp2v(vmin(vmax(x * LOG2E, (F)-125.f), (F)125.f)); };
auto log2v = FN(F x) -> F {
    I bits = __builtin_bit_cast(I, x), e = (bits - 0x3f3504f3) >> 23;
    F m = __builtin_bit_cast(F, bits - (e << 23)), t = (m - 1.f) / (m + 1.f), t2 = t * t;
    F q = fma(t2, (F)(1.f / 9), (F)(1.f / 7)); q = fma(q, t2, (F)(1.f / 5)); q = fma(q, t2, (F)(1.f / 3));
    q = fma(q, t2, (F)1.f);
    return fma(t * q, (F)2.88539008177793f, __builtin_convertvector(e, F)); };
const F LANE = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
// Sixteen vectors to one: lane i of the result is v[i] folded over its lanes. Every step is one cheap shuffle a side.
#define FOLD(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
// Halves are joined first: that takes no shuffle where a vector of 16 is two registers or four.
typedef float Half __attribute__((ext_vector_type(8)));
auto fold16 = FN(const F* v, auto&& join) -> F {
    Half h[16];
    for (int i = 0; i < 16; i++)
        h[i] = join(FOLD(v[i], v[i], 0,1,2,3,4,5,6,7), FOLD(v[i], v[i], 8,9,10,11,12,13,14,15));
    for (int i = 0; i < 8; i++)
        h[i] = join(FOLD(h[i], h[i + 8], 0,1,2,3,8,9,10,11), FOLD(h[i], h[i + 8], 4,5,6,7,12,13,14,15));
    for (int i = 0; i < 4; i++)
        h[i] = join(FOLD(h[i], h[i + 4], 0,1,8,9,4,5,12,13), FOLD(h[i], h[i + 4], 2,3,10,11,6,7,14,15));
    for (int i = 0; i < 2; i++)
        h[i] = join(FOLD(h[i], h[i + 2], 0,2,8,10,4,6,12,14), FOLD(h[i], h[i + 2], 1,3,9,11,5,7,13,15));
    return FOLD(h[0], h[1], 0,8,2,10,1,9,3,11,4,12,6,14,5,13,7,15);
};
auto add = FN(auto a, auto b) { return a + b; };
auto larger = FN(auto a, auto b) { return a > b ? a : b; };
auto sum = FN(F v) -> float {
    float a[16]; store(a, v);
    float b0 = (a[0] + a[8]) + (a[4] + a[12]), b1 = (a[1] + a[9]) + (a[5] + a[13]);
    float b2 = (a[2] + a[10]) + (a[6] + a[14]), b3 = (a[3] + a[11]) + (a[7] + a[15]);
    return (b0 + b2) + (b1 + b3); };
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED); };
"""

# From world mean X, Y, Z, quaternion a (wxyz), clamped log-scales l: everything of the projection, on 16 Gaussians.
_PROJECT = r"""
F pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
F px = V[0] * X + V[1] * Y + V[2] * Z + V[3], py = V[4] * X + V[5] * Y + V[6] * Z + V[7];
F iz = 1.f / pz, xn = px * iz, yn = py * iz;
F u = vmin(vmax(xn, (F)P.x_low), (F)P.x_high), v = vmin(vmax(yn, (F)P.y_low), (F)P.y_high);
F mx = P.fx * xn + P.cx, my = P.fy * yn + P.cy;
// Largest component first, so that the squares neither vanish nor overflow.
F qmax = vmax(vmax(vabs(qw), vabs(qx)), vmax(vabs(qy), vabs(qz))), iq = 1.f / qmax;
F w = qw * iq, x = qx * iq, y = qy * iq, z = qz * iq, unit = 1.f / vsqrt(w * w + x * x + y * y + z * z);
w *= unit; x *= unit; y *= unit; z *= unit; iq *= unit;
F Q[9] = {1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y),
          2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x),
          2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)};
F s[3] = {expv(l0), expv(l1), expv(l2)};
F ja = P.fx * iz, jb = P.fy * iz, jc = -ja * u, jd = -jb * v;
F T0[3], T1[3], B0[3], B1[3];
for (int i = 0; i < 3; i++) { T0[i] = ja * V[i] + jc * V[8 + i]; T1[i] = jb * V[4 + i] + jd * V[8 + i]; }
for (int j = 0; j < 3; j++) {
    B0[j] = (T0[0] * Q[j] + T0[1] * Q[3 + j] + T0[2] * Q[6 + j]) * s[j];
    B1[j] = (T1[0] * Q[j] + T1[1] * Q[3 + j] + T1[2] * Q[6 + j]) * s[j]; }
F n0 = B0[1] * B1[2] - B0[2] * B1[1], n1 = B0[2] * B1[0] - B0[0] * B1[2], n2 = B0[0] * B1[1] - B0[1] * B1[0];
F rxx = B0[0] * B0[0] + B0[1] * B0[1] + B0[2] * B0[2], ryy = B1[0] * B1[0] + B1[1] * B1[1] + B1[2] * B1[2];
F xy = B0[0] * B1[0] + B0[1] * B1[1] + B0[2] * B1[2], xx = rxx + LOW_PASS, yy = ryy + LOW_PASS;
F dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;
"""

_GATHER = r"""
const float* V = P.view;
float gather[11][16];
auto fetch = FN(const int* id) -> void {
    for (int l = 0; l < 16; l++) {
        long long i = id[l];
        for (int c = 0; c < 3; c++) gather[c][l] = P.means[3 * i + c];
        for (int c = 0; c < 4; c++) gather[3 + c][l] = P.quats[4 * i + c];
        for (int c = 0; c < 3; c++) gather[7 + c][l] = P.log_scales[3 * i + c];
        gather[10][l] = P.logits[i];
    } };
const float cam[3] = {-(V[0] * V[3] + V[4] * V[7] + V[8] * V[11]), -(V[1] * V[3] + V[5] * V[7] + V[9] * V[11]),
                      -(V[2] * V[3] + V[6] * V[7] + V[10] * V[11])};
const int bands = (int)((P.sh_degree + 1) * (P.sh_degree + 1));
// Harmonics Y[k] at unit directions, and their derivatives if dY is given (rows x, y, z of 16).
auto harmonics = FN(F x, F y, F z, F* Y, F (*dY)[16]) -> void {
    Y[0] = (F)@SH_C0@f;
    if (dY) for (int c = 0; c < 3; c++) for (int i = 0; i < bands; i++) dY[c][i] = (F)0.f;
    if (bands < 4) return;
    Y[1] = -@SH_C1@f * y; Y[2] = @SH_C1@f * z; Y[3] = -@SH_C1@f * x;
    if (dY) { dY[1][1] = (F)-@SH_C1@f; dY[2][2] = (F)@SH_C1@f; dY[0][3] = (F)-@SH_C1@f; }
    if (bands < 9) return;
    F xx = x * x, yy = y * y, zz = z * z;
    const float C2[5] = {@SH_C2@}, C3[7] = {@SH_C3@};
    Y[4] = C2[0] * x * y; Y[5] = C2[1] * y * z; Y[6] = C2[2] * (2.f * zz - xx - yy); Y[7] = C2[3] * x * z;
    Y[8] = C2[4] * (xx - yy);
    if (dY) {
        dY[0][4] = C2[0] * y; dY[1][4] = C2[0] * x; dY[1][5] = C2[1] * z; dY[2][5] = C2[1] * y;
        dY[0][6] = -2.f * C2[2] * x; dY[1][6] = -2.f * C2[2] * y; dY[2][6] = 4.f * C2[2] * z;
        dY[0][7] = C2[3] * z; dY[2][7] = C2[3] * x; dY[0][8] = 2.f * C2[4] * x; dY[1][8] = -2.f * C2[4] * y; }
    if (bands < 16) return;
    Y[9] = C3[0] * y * (3.f * xx - yy); Y[10] = C3[1] * x * y * z; Y[11] = C3[2] * y * (4.f * zz - xx - yy);
    Y[12] = C3[3] * z * (2.f * zz - 3.f * xx - 3.f * yy); Y[13] = C3[4] * x * (4.f * zz - xx - yy);
    Y[14] = C3[5] * z * (xx - yy); Y[15] = C3[6] * x * (xx - 3.f * yy);
    if (dY) {
        dY[0][9] = C3[0] * 6.f * x * y; dY[1][9] = C3[0] * 3.f * (xx - yy);
        dY[0][10] = C3[1] * y * z; dY[1][10] = C3[1] * x * z; dY[2][10] = C3[1] * x * y;
        dY[0][11] = C3[2] * -2.f * x * y; dY[1][11] = C3[2] * (4.f * zz - xx - 3.f * yy);
        dY[2][11] = C3[2] * 8.f * y * z;
        dY[0][12] = C3[3] * -6.f * x * z; dY[1][12] = C3[3] * -6.f * y * z;
        dY[2][12] = C3[3] * (6.f * zz - 3.f * xx - 3.f * yy);
        dY[0][13] = C3[4] * (4.f * zz - 3.f * xx - yy); dY[1][13] = C3[4] * -2.f * x * y;
        dY[2][13] = C3[4] * 8.f * x * z;
        dY[0][14] = C3[5] * 2.f * x * z; dY[1][14] = C3[5] * -2.f * y * z; dY[2][14] = C3[5] * (xx - yy);
        dY[0][15] = C3[6] * 3.f * (xx - yy); dY[1][15] = C3[6] * -6.f * x * y; } };
float shv[48][16];
auto fetch_sh = FN(const int* id) -> void {
    for (int l = 0; l < 16; l++) {
        const float* source = P.sh + (long long)id[l] * P.sh_stride;
        for (int i = 0; i < bands * 3; i++) shv[i][l] = source[i];
    } };
"""

# Tile spans of one slot: calls visit(tile row, first tile column, last tile column).
_SPANS = r"""
auto spans = FN(long long slot, auto&& visit) -> void {
    const float* r = P.record + slot * P.record_stride; const float* a = P.aux + slot * 4;
    float mx = r[0], my = r[1], A = r[2], kk = r[3], R = r[4], lop = r[5], hx = a[0], dyr = a[2];
    float W = (float)P.width, H = (float)P.height;
    int y0 = first_at(r[6] - 0.5f, H), y1 = last_at(r[7] - 0.5f, H - 1.f);
    if (y0 > y1) return;
    auto half = FN(float dy) -> float { return ssqrt(smax((lop + R * dy * dy - PMIN) / -A, 0.f)); };
    for (int ty = y0 >> 4; ty <= y1 >> 4; ty++) {
        float lo = smax(r[6], ty * 16 + 0.5f) - my, hi = smin(r[7], ty * 16 + 15.5f) - my;
        float right = dyr < lo ? kk * lo + half(lo) : dyr > hi ? kk * hi + half(hi) : hx;
        float left = -dyr < lo ? kk * lo - half(lo) : -dyr > hi ? kk * hi - half(hi) : -hx;
        int c0 = first_at(mx + left - 0.5f, W), c1 = last_at(mx + right - 0.5f, W - 1.f);
        if (c0 <= c1) visit(ty, c0 >> 4, c1 >> 4);
    } };
"""

# The same from memory, where it was kept: pairs (tile row, first column | last column << 16).
_KEPT_SPANS = (
    _SPANS
    + r"""
auto kept_spans = FN(int slot, auto&& visit) -> void {
    if (P.span_start[slot] < 0) { spans(slot, visit); return; }
    const int* s = P.span + 2 * (long long)P.span_start[slot];
    for (int i = 0; i < P.span_count[slot]; i++) visit(s[2 * i], s[2 * i + 1] & 0xffff, s[2 * i + 1] >> 16);
};
"""
)

# Stage 0: project, cull, compact into slots, colour, count tile hits. Parallel over chunks.
_STAGE_PROJECT = (
    _GATHER
    + _SPANS
    + r"""
const long long RS = P.record_stride;
const I BIT_INF = (I)0x7f800000;
auto finite = FN(F v) -> I { return (__builtin_bit_cast(I, v) & BIT_INF) != BIT_INF; };
for (long long chunk; (chunk = take()) < P.chunks;) {
    long long base = chunk * @CHUNK@, end = base + @CHUNK@ < P.n ? base + @CHUNK@ : P.n;
    int count = 0;
    for (long long i0 = base; i0 < end; i0 += 16) {
        int id[16];
        for (int l = 0; l < 16; l++) id[l] = (int)(i0 + l < end ? i0 + l : end - 1);
        fetch(id);
        F X = load(gather[0]), Y = load(gather[1]), Z = load(gather[2]);
        F qw = load(gather[3]), qx = load(gather[4]), qy = load(gather[5]), qz = load(gather[6]);
        F r0 = load(gather[7]), r1 = load(gather[8]), r2 = load(gather[9]), logit = load(gather[10]);
        F deep = V[8] * X + V[9] * Y + V[10] * Z + V[11];
        I ok = finite(X) & finite(Y) & finite(Z) & finite(qw) & finite(qx) & finite(qy) & finite(qz);
        ok &= (deep > (F)P.near) & finite(deep) & (logit == logit);
        ok &= (r0 <= (F)@LOG_SCALE_MAX@f) & (r1 <= (F)@LOG_SCALE_MAX@f) & (r2 <= (F)@LOG_SCALE_MAX@f);
        ok &= (LANE < (F)(float)(end - i0));
        if (!any(ok)) continue;
        const F low = (F)@LOG_SCALE_MIN@f;
        F l0 = vmax(r0, low), l1 = vmax(r1, low), l2 = vmax(r2, low);
"""
    + _PROJECT
    + r"""
        F lop = -log2v(1.f + expv(-vmin(vmax(logit, (F)-80.f), (F)80.f)));
        if (P.antialiased) lop += 0.5f * log2v(vmax(dr / det, (F)@COMPENSATION2_MIN@f));
        F level = vmax(lop - PMIN, (F)0.f) * (2.f * LN2);
        F hx = vsqrt(level * xx), hy = vsqrt(level * yy);
        ok &= (qmax > (F)@QUAT_MIN@f) & (level > 0.f) & (xx + yy < @VARIANCE_MAX@f);
        ok &= (mx + hx >= 0.5f) & (mx - hx <= (float)P.width - 0.5f);
        ok &= (my + hy >= 0.5f) & (my - hy <= (float)P.height - 0.5f);
        if (!any(ok)) continue;
        F half = 0.5f * (xx + yy), diff = 0.5f * (xx - yy);
        F radius = vsqrt((half + vsqrt(diff * diff + xy * xy)) * level);
        F out[13] = {mx, my, -0.5f * LOG2E * yy / det, xy / yy, -0.5f * LOG2E / yy, lop, my - hy, my + hy,
                     hx, hy, xy / xx * hx, pz, vmin(radius, (F)1.07e9f)};
        float rows[13][16];
        for (int c = 0; c < 13; c++) store(rows[c], out[c]);
        for (int l = 0; l < 16; l++) if (ok[l]) {
            long long slot = base + count++, i = id[l];
            float* r = P.record + slot * RS; float* a = P.aux + slot * 4;
            for (int c = 0; c < 8; c++) r[c] = rows[c][l];
            for (int c = 0; c < 4; c++) a[c] = rows[8 + c][l];
            P.index[slot] = (int)i;
            int whole = (int)rows[12][l];
            P.radii[i] = whole + ((float)whole < rows[12][l]);
            P.means2d[2 * i] = r[0]; P.means2d[2 * i + 1] = r[1];
        }
    }
    P.chunk_count[chunk] = count;
    long long kept = chunk * @SPANS@, full = kept + @SPANS@;
    for (int b = 0; b < count; b += 16) {
        int id[16], m = count - b < 16 ? count - b : 16;
        for (int l = 0; l < 16; l++) id[l] = P.index[base + b + (l < m ? l : m - 1)];
        I ok = LANE < (F)(float)m;
        float rgb[3][16];
        if (P.n_sh) {
            F Y[16];
            for (int l = 0; l < 16; l++) for (int c = 0; c < 3; c++) gather[c][l] = P.means[3 * (long long)id[l] + c];
            F X = load(gather[0]) - cam[0], Yd = load(gather[1]) - cam[1], Z = load(gather[2]) - cam[2];
            F inv = 1.f / vsqrt(X * X + Yd * Yd + Z * Z);
            harmonics(X * inv, Yd * inv, Z * inv, Y, nullptr);
            fetch_sh(id);
            for (int c = 0; c < 3; c++) {
                F value = (F)0.5f;
                for (int i = 0; i < bands; i++) value = fma(Y[i], load(shv[i * 3 + c]), value);
                ok &= finite(value);
                store(rgb[c], vmax(value, (F)0.f));
            }
        }
        for (int l = 0; l < m; l++) {
            long long slot = base + b + l, i = id[l];
            float* r = P.record + slot * RS + @HEAD@;
            bool good = ok[l];
            for (int c = 0; c < P.n_sh; c++) r[c] = rgb[c][l];
            r += P.n_sh;
            for (int c = 0; c < P.n_colors; c++) {
                float value = P.colors[i * P.n_colors + c];
                good &= (__builtin_bit_cast(int, value) & 0x7f800000) != 0x7f800000;
                r[c] = value;
            }
            if (P.want_depth) r[P.n_colors] = P.aux[slot * 4 + 3];
            int hits = 0, rows = 0;
            if (good) spans(slot, FN(int ty, int c0, int c1) -> void {
                hits += c1 - c0 + 1;
                if (kept + rows < full) { int* to = P.span + 2 * (kept + rows); to[0] = ty; to[1] = c0 | c1 << 16; }
                rows++; });
            else { P.radii[i] = 0; P.means2d[2 * i] = 0; P.means2d[2 * i + 1] = 0; }
            P.hit_count[slot] = hits; P.span_count[slot] = rows;
            bool fits = kept + rows <= full;
            P.span_start[slot] = fits ? (int)kept : -1;
            kept += fits ? rows : 0;
        }
    }
}
"""
)

# Stage 1 (one worker): first hit of every slot; slots that hit a tile in depth order, by a stable radix sort.
_STAGE_SORT = r"""
long long total = 0, n = 0;
for (long long c = 0; c < P.chunks; c++)
    for (long long s = c * @CHUNK@, e = s + P.chunk_count[c]; s < e; s++) {
        P.hit_start[s] = (int)total;
        if (P.hit_count[s] == 0) continue;
        total += P.hit_count[s];
        P.order[n] = (int)s; P.key[n] = __builtin_bit_cast(int, P.aux[s * 4 + 3]); n++;
    }
P.visible = n; P.hits = total;
int *ka = P.key, *kb = P.key2, *oa = P.order, *ob = P.order2;
for (int shift = 0; shift < 33; shift += 11) {
    int bins[2048] = {};
    for (long long i = 0; i < n; i++) bins[((unsigned)ka[i] >> shift) & 2047]++;
    int at = 0;
    for (int b = 0; b < 2048; b++) { int c = bins[b]; bins[b] = at; at += c; }
    for (long long i = 0; i < n; i++) {
        int place = bins[((unsigned)ka[i] >> shift) & 2047]++;
        kb[place] = ka[i]; ob[place] = oa[i];
    }
    int* t = ka; ka = kb; kb = t; t = oa; oa = ob; ob = t;
}
"""

# Stages 2 to 4: stable counting sort of the hits into tiles. Each worker takes one stretch of the depth order.
_STRETCH = r"""
long long tiles = P.tiles_x * P.tiles_y;
long long from = P.visible * worker / P.workers, to = P.visible * (worker + 1) / P.workers;
int* mine = P.histogram + worker * tiles;
"""
_STAGE_COUNT = (
    _KEPT_SPANS
    + _STRETCH
    + r"""
for (long long t = 0; t < tiles; t++) mine[t] = 0;
for (long long rank = from; rank < to; rank++)
    kept_spans(P.order2[rank], FN(int ty, int c0, int c1) -> void {
        for (int c = c0; c <= c1; c++) mine[ty * P.tiles_x + c]++; });
"""
)
_STAGE_PREFIX = r"""
int at = 0; long long tiles = P.tiles_x * P.tiles_y;
for (long long t = 0; t < tiles; t++) {
    P.tile_start[t] = at;
    for (long long w = 0; w < P.workers; w++) {
        int c = P.histogram[w * tiles + t]; P.histogram[w * tiles + t] = at; at += c; }
}
P.tile_start[tiles] = at;
"""
_STAGE_EMIT = (
    _KEPT_SPANS
    + _STRETCH
    + r"""
for (long long rank = from; rank < to; rank++) {
    int slot = P.order2[rank], place = P.hit_start[slot];
    kept_spans(slot, FN(int ty, int c0, int c1) -> void {
        for (int c = c0; c <= c1; c++) {
            int at = mine[ty * P.tiles_x + c]++;
            P.hit_slot[at] = slot; P.hit_place[at] = place++;
        } });
}
"""
)

# Stage 5: sum and largest weight of every visible Gaussian over its tiles. Parallel over chunks.
_STAGE_WEIGHTS = r"""
for (long long chunk; (chunk = take()) < P.chunks;)
    for (long long s = chunk * @CHUNK@, e = s + P.chunk_count[chunk]; s < e; s++) {
        float total = 0.f, largest = 0.f;
        const float* h = P.hit_weight + 2 * (long long)P.hit_start[s];
        for (int j = 0; j < P.hit_count[s]; j++) { total += h[2 * j]; largest = smax(largest, h[2 * j + 1]); }
        P.weight_sum[P.index[s]] = total; P.weight_max[P.index[s]] = largest;
    }
"""

# Stage 6: gradients of the projection from the summed gradients of the hits. Parallel over chunks.
_STAGE_PROJECT_BACKWARD = (
    _GATHER
    + r"""
const long long GS = P.grad_stride;
const int D = (int)P.channels;
for (long long chunk; (chunk = take()) < P.chunks;) {
    long long base = chunk * @CHUNK@; int count = P.chunk_count[chunk];
    F gV[12]; for (int c = 0; c < 12; c++) gV[c] = (F)0.f;
    for (int b = 0; b < count; b += 16) {
        int id[16], hits[16], m = count - b < 16 ? count - b : 16;
        float g[@GRAD_MAX@][16];
        int busy = 0;
        for (int l = 0; l < 16; l++) {
            long long slot = base + b + (l < m ? l : m - 1);
            id[l] = P.index[slot]; hits[l] = l < m ? P.hit_count[slot] : 0; busy |= hits[l];
            for (long long part = 0; part < GS; part += 16) {
                F total = (F)0.f; float flat[16];
                const float* h = P.hit_grad + (long long)P.hit_start[slot] * GS + part;
                for (int j = 0; j < hits[l]; j++) total += load(h + j * GS);
                store(flat, total);
                for (int c = 0; c < 16; c++) g[part + c][l] = flat[c];
            }
        }
        if (!busy) continue;
        fetch(id);
        F X = load(gather[0]), Y = load(gather[1]), Z = load(gather[2]);
        F qw = load(gather[3]), qx = load(gather[4]), qy = load(gather[5]), qz = load(gather[6]);
        F r0 = load(gather[7]), r1 = load(gather[8]), r2 = load(gather[9]), logit = load(gather[10]);
        const F low = (F)@LOG_SCALE_MIN@f;
        F l0 = vmax(r0, low), l1 = vmax(r1, low), l2 = vmax(r2, low);
"""
    + _PROJECT
    + r"""
        F m0 = load(g[0]);
        // log alpha = log opacity - (e^2 / xc + dy^2 / yy) / 2 with e = dx - k dy, k = xy / yy, xc = det / yy.
        // Gradients by way of xc, yy and k lose no digits on long thin Gaussians; by way of the conic they do.
        F kk = xy / yy, ic = yy / det, iy = 1.f / yy;
        F gmx = load(g[1]) * ic, gmy = load(g[2]) * iy - kk * gmx;
        F g2c = load(g[3]) * ic * ic, gk = load(g[4]) * ic * iy, g2y = load(g[5]) * iy * iy;
        F ga0[3] = {}, ga1[3] = {};
        if (P.antialiased) {
            I free = dr > @COMPENSATION2_MIN@f * det;
            F h = free ? m0 : (F)0.f, over = free ? h / dr : (F)0.f;
            g2c -= h * ic; g2y -= h * iy;
            F e0 = over * n0, e1 = over * n1, e2 = over * n2;
            ga0[0] = B1[1] * e2 - B1[2] * e1; ga0[1] = B1[2] * e0 - B1[0] * e2; ga0[2] = B1[0] * e1 - B1[1] * e0;
            ga1[0] = e1 * B0[2] - e2 * B0[1]; ga1[1] = e2 * B0[0] - e0 * B0[2]; ga1[2] = e0 * B0[1] - e1 * B0[0];
        }
        F gT0[3] = {}, gT1[3] = {}, gQ[9], gs[3];
        for (int j = 0; j < 3; j++) {
            F across = B0[j] - kk * B1[j], gB0 = g2c * across + gk * B1[j], gB1 = g2y * B1[j] + gk * across - kk * gB0;
            gB0 += ga0[j]; gB1 += ga1[j];
            F total = (F)0.f;
            for (int i = 0; i < 3; i++) {
                F gM = T0[i] * gB0 + T1[i] * gB1, M = Q[3 * i + j] * s[j];
                gT0[i] += gB0 * M; gT1[i] += gB1 * M;
                gQ[3 * i + j] = gM * s[j]; total += gM * M;
            }
            gs[j] = total;
        }
        gs[0] = r0 >= @LOG_SCALE_MIN@f ? gs[0] : (F)0.f; gs[1] = r1 >= @LOG_SCALE_MIN@f ? gs[1] : (F)0.f;
        gs[2] = r2 >= @LOG_SCALE_MIN@f ? gs[2] : (F)0.f;
        F gw = 2.f * (z * (gQ[3] - gQ[1]) + y * (gQ[2] - gQ[6]) + x * (gQ[7] - gQ[5]));
        F gx = 2.f * (y * (gQ[1] + gQ[3]) + z * (gQ[2] + gQ[6]) + w * (gQ[7] - gQ[5]) - 2.f * x * (gQ[4] + gQ[8]));
        F gy = 2.f * (x * (gQ[1] + gQ[3]) + z * (gQ[5] + gQ[7]) + w * (gQ[2] - gQ[6]) - 2.f * y * (gQ[0] + gQ[8]));
        F gz = 2.f * (x * (gQ[2] + gQ[6]) + y * (gQ[5] + gQ[7]) + w * (gQ[3] - gQ[1]) - 2.f * z * (gQ[0] + gQ[4]));
        F along = w * gw + x * gx + y * gy + z * gz;
        F gq[4] = {(gw - w * along) * iq, (gx - x * along) * iq, (gy - y * along) * iq, (gz - z * along) * iq};
        F gja = gT0[0] * V[0] + gT0[1] * V[1] + gT0[2] * V[2], gjc = gT0[0] * V[8] + gT0[1] * V[9] + gT0[2] * V[10];
        F gjb = gT1[0] * V[4] + gT1[1] * V[5] + gT1[2] * V[6], gjd = gT1[0] * V[8] + gT1[1] * V[9] + gT1[2] * V[10];
        F gu = ((xn >= P.x_low) & (xn <= P.x_high)) ? -ja * gjc : (F)0.f;
        F gv = ((yn >= P.y_low) & (yn <= P.y_high)) ? -jb * gjd : (F)0.f;
        F gxn = gu + P.fx * gmx, gyn = gv + P.fy * gmy;
        F gpx = gxn * iz, gpy = gyn * iz;
        F gpz = -iz * (gja * ja + gjb * jb + gjc * jc + gjd * jd + gxn * xn + gyn * yn);
        if (P.want_depth) gpz += load(g[@MOMENTS@ + D - 1]);
        F gX[3] = {V[0] * gpx + V[4] * gpy + V[8] * gpz, V[1] * gpx + V[5] * gpy + V[9] * gpz,
                   V[2] * gpx + V[6] * gpy + V[10] * gpz};
        F gCam[3] = {};
        if (P.n_sh) {
            F basis[16], slope[3][16];
            F dx = X - cam[0], dy = Y - cam[1], dz = Z - cam[2], inv = 1.f / vsqrt(dx * dx + dy * dy + dz * dz);
            dx *= inv; dy *= inv; dz *= inv;
            harmonics(dx, dy, dz, basis, slope);
            fetch_sh(id);
            F gd[3] = {}, gc[3];
            for (int c = 0; c < 3; c++) {
                F value = (F)0.5f; gc[c] = load(g[@MOMENTS@ + c]);
                for (int i = 0; i < bands; i++) value = fma(basis[i], load(shv[i * 3 + c]), value);
                gc[c] = ((value > 0.f) | (gc[c] < 0.f)) ? gc[c] : (F)0.f;
            }
            for (int i = 0; i < bands; i++) {
                F through = (F)0.f;
                for (int c = 0; c < 3; c++) {
                    through = fma(gc[c], load(shv[i * 3 + c]), through);
                    store(shv[i * 3 + c], gc[c] * basis[i]);
                }
                for (int c = 0; c < 3; c++) gd[c] = fma(through, slope[c][i], gd[c]);
            }
            F radial = dx * gd[0] + dy * gd[1] + dz * gd[2];
            gCam[0] = -(gd[0] - dx * radial) * inv; gCam[1] = -(gd[1] - dy * radial) * inv;
            gCam[2] = -(gd[2] - dz * radial) * inv;
            for (int c = 0; c < 3; c++) gX[c] -= gCam[c];
        }
        F op = expv(-vabs(vmin(vmax(logit, (F)-80.f), (F)80.f)));
        F rest = (logit > 0.f ? op : (F)1.f) / (1.f + op);
        F norm = vsqrt(gmx * gmx + gmy * gmy), ax = load(g[6]), ay = load(g[7]), both = vsqrt(ax * ax + ay * ay);
        F rows[13] = {gX[0], gX[1], gX[2], gq[0], gq[1], gq[2], gq[3], gs[0], gs[1], gs[2], m0 * rest, norm, both};
        float flat[13][16];
        for (int c = 0; c < 13; c++) store(flat[c], rows[c]);
        float live[16];
        for (int l = 0; l < 16; l++) live[l] = hits[l] ? 1.f : 0.f;
        for (int l = 0; l < 16; l++) if (hits[l]) {
            long long i = id[l];
            for (int c = 0; c < 3; c++) P.grad_means[3 * i + c] += flat[c][l];
            for (int c = 0; c < 4; c++) P.grad_quats[4 * i + c] += flat[3 + c][l];
            for (int c = 0; c < 3; c++) P.grad_log_scales[3 * i + c] += flat[7 + c][l];
            P.grad_logits[i] += flat[10][l];
            P.grad_norm[i] = flat[11][l]; P.grad_abs[i] = flat[12][l];
            float* to = P.grad_sh + i * P.sh_stride;
            if (P.n_sh) for (int c = 0; c < bands * 3; c++) to[c] += shv[c][l];
            for (int c = 0; c < P.n_colors; c++) P.grad_colors[i * P.n_colors + c] += g[@MOMENTS@ + P.n_sh + c][l];
        }
        I use = load(live) > 0.f;
        F gp[3] = {gpx, gpy, gpz}, world[3] = {X, Y, Z};
        for (int r = 0; r < 3; r++) {
            F towards = gCam[0] * V[4 * r] + gCam[1] * V[4 * r + 1] + gCam[2] * V[4 * r + 2];
            for (int c = 0; c < 3; c++) {
                F value = gp[r] * world[c] - gCam[c] * V[4 * r + 3];
                if (r == 0) value += ja * gT0[c];
                if (r == 1) value += jb * gT1[c];
                if (r == 2) value += jc * gT0[c] + jd * gT1[c];
                gV[4 * r + c] += use ? value : (F)0.f;
            }
            gV[4 * r + 3] += use ? gp[r] - towards : (F)0.f;
        }
    }
    for (int c = 0; c < 12; c++) P.grad_view[chunk * 12 + c] = sum(gV[c]);
}
"""
)

_TILE = r"""
const int NCH = @NCH@;
// A tile's row of pixels, `each` floats a pixel: memory beyond the image is neither written nor read; zeros are read.
auto write = FN(float* to, const float* from, int columns, const int each) -> void {
    if (columns == 16) __builtin_memcpy(to, from, 64 * each);
    else for (int i = 0; i < columns * each; i++) to[i] = from[i]; };
auto read = FN(float* to, const float* from, int columns, const int each) -> void {
    if (columns == 16) __builtin_memcpy(to, from, 64 * each);
    else for (int i = 0; i < 16 * each; i++) to[i] = i < columns * each ? from[i] : 0.f; };
const long long RS = P.record_stride, W = P.width, H = P.height, tiles = P.tiles_x * P.tiles_y;
"""

# Sixteen hits at a time: the rows that each one touches, as bits, and what its ellipse is on each of the 16 rows.
_BATCH = r"""
        unsigned live = 0;
        for (int i = 0; i < 16; i++) live |= (unsigned)any(T[i] > T_STOP) << i;
        if (!live) break;
        int slots[16], m = stop - b < 16 ? (int)(stop - b) : 16;
        unsigned masks[16];
        alignas(64) float dys[16][16], shifts[16][16], levels[16][16];
        for (int l = 0; l < m; l++) {
            slots[l] = P.hit_slot[b + l];
            // The next batch's record, and where this hit's result goes.
            __builtin_prefetch(P.record + P.hit_slot[b + 16 + l < stop ? b + 16 + l : stop - 1] * RS);
            prefetch_result(P.hit_place[b + l]);
            const float* r = P.record + slots[l] * RS;
            // Exponent of alpha on a row: level + A e^2, e = column + shift.
            F dy = LANE + 0.5f - (r[1] - y0), shift = (0.5f - (r[0] - x0)) - r[3] * dy;
            F level = fma(r[4] * dy, dy, (F)r[5]);
            store(dys[l], dy); store(shifts[l], shift); store(levels[l], level);
            // The row's pixel nearest to the ellipse's middle is lit, or none is; a hair of slack against rounding.
            F e = shift + vround(vmin(vmax(-shift, (F)0.f), (F)15.f));
            masks[l] = bits(fma(r[2] * e, e, level) >= PMIN - 1e-3f) & live;
        }
"""
HIT = r"""
            const float* channel = P.record + slots[l] * RS + @HEAD@;
            float A = P.record[slots[l] * RS + 2], kk = P.record[slots[l] * RS + 3], R = P.record[slots[l] * RS + 4];
"""
"""What one hit needs beside its rows."""
ROWS = r"""
            for (unsigned rest = masks[l]; rest; rest &= rest - 1) {
                int row = __builtin_ctz(rest);
"""
"""The loop over one hit's rows; `benchmarks/hot_loop.py` counts here."""
_ALPHA = r"""
                F e = LANE + shifts[l][row], before = T[row];
                F p = fma(A * e, e, (F)levels[l][row]);
                F raw = exp2v(p), al = vmin(raw, (F)ALPHA_MAX);
                al = ((p >= PMIN) & (before > T_STOP)) ? al : (F)0.f;
                F w = al * before;
                T[row] = fma(-al, before, before);
"""
FORWARD_ROW = (
    _ALPHA
    + r"""
                for (int c = 0; c < NCH; c++) C[c][row] = fma(w, (F)channel[c], C[c][row]);
                total += w; peak = vmax(peak, w);
"""
)
"""One row of one hit, forward, without the parts that depth and top contributor add."""
BACKWARD_SUMS = r"""
            F s0 = (F)0.f, s1 = s0, s2 = s0, s3 = s0, s4 = s0, s5 = s0, ax = s0, ay = s0, gc[NCH];
            for (int c = 0; c < NCH; c++) gc[c] = (F)0.f;
            float qa = -2.f * LN2 * A, qc = -2.f * LN2 * R;"""
"""Sums of one hit over its rows."""
BACKWARD_ROW = (
    _ALPHA
    + r"""
                float dy = dys[l][row];
                F along = (F)0.f;
                for (int c = 0; c < NCH; c++) {
                    along = fma(G[c][row], (F)channel[c], along); gc[c] = fma(w, G[c][row], gc[c]); }
                F seen = w * along, behind = left[row] - seen;
                left[row] = behind;
                // d loss / d log alpha; nothing passes the clamp.
                F v = seen - al / (1.f - al) * behind;
                v = raw <= ALPHA_MAX ? v : (F)0.f;
                F ve = v * e;
                s0 += v; s1 += ve; s2 = fma(v, (F)dy, s2);
                s3 = fma(ve, e, s3); s4 = fma(ve, (F)dy, s4); s5 = fma(v, (F)(dy * dy), s5);
                if (want_abs) { ax += vabs(ve); ay += vabs(fma(v, (F)(qc * dy), ve * -(kk * qa))); }
"""
)
"""One row of one hit, backward."""

# Blend stage 0: forward. Parallel over tiles.
_STAGE_BLEND = (
    _TILE
    + r"""
const bool want_depth = P.want_depth != 0, want_top = P.want_top != 0, want_weights = P.want_weights != 0;
auto prefetch_result = FN(long long place) -> void {
    if (want_weights) __builtin_prefetch(P.hit_weight + 2 * place, 1); };
for (long long tile; (tile = take()) < tiles;) {
    long long tx = tile % P.tiles_x, ty = tile / P.tiles_x, start = P.tile_start[tile], stop = P.tile_start[tile + 1];
    float x0 = tx * 16.f, y0 = ty * 16.f;
    int rows = (int)(H - ty * 16 < 16 ? H - ty * 16 : 16), columns = (int)(W - tx * 16 < 16 ? W - tx * 16 : 16);
    F T[16], C[NCH][16], best[16], median[16];
    I top[16];
    // Lanes outside the image start without transmittance: they are finished from the beginning.
    for (int i = 0; i < 16; i++) {
        T[i] = LANE < (F)(i < rows ? (float)columns : 0.f) ? (F)1.f : (F)0.f;
        best[i] = (F)0.f; median[i] = (F)@DEPTH_EMPTY@f; top[i] = (I)-1;
        for (int c = 0; c < NCH; c++) C[c][i] = (F)0.f; }
    long long b = start;
    for (; b < stop; b += 16) {
"""
    + _BATCH
    + r"""
        F totals[16], peaks[16];
        for (int l = m; l < 16; l++) { totals[l] = (F)0.f; peaks[l] = (F)0.f; }
        for (int l = 0; l < m; l++) {
"""
    + HIT
    + r"""
            F total = (F)0.f, peak = (F)0.f;
            float depth = 0.f; int id = 0;
            if (want_depth) depth = P.aux[4 * (long long)slots[l] + 3];
            if (want_top) id = P.index[slots[l]];
"""
    + ROWS
    + FORWARD_ROW
    + r"""
                if (want_depth | want_top) {
                    I larger = w > best[row];
                    // T before > 0.5 and T after <= 0.5: crossed here. Until then, the largest so far.
                    I pick = (before > 0.5f) & ((T[row] <= 0.5f) | larger) & (w > 0.f);
                    median[row] = pick ? (F)depth : median[row];
                    top[row] = larger ? (I)id : top[row];
                    best[row] = vmax(best[row], w);
                }
            }
            totals[l] = total; peaks[l] = peak;
        }
        if (want_weights) {
            float sums[16], tops[16];
            store(sums, fold16(totals, add)); store(tops, fold16(peaks, larger));
            for (int l = 0; l < m; l++) {
                float* to = P.hit_weight + 2 * (long long)P.hit_place[b + l];
                to[0] = sums[l]; to[1] = tops[l]; }
        }
    }
    b = b < stop ? b : stop;
    P.tile_end[tile] = (int)b;
    if (want_weights) for (; b < stop; b++) {
        float* to = P.hit_weight + 2 * (long long)P.hit_place[b]; to[0] = 0.f; to[1] = 0.f; }
    for (int i = 0; i < rows; i++) {
        long long at = (ty * 16 + i) * W + tx * 16;
        alignas(64) float each[16], pixels[16 * NCH];
        for (int c = 0; c < NCH; c++) {
            store(each, fma(T[i], (F)P.background[c], C[c][i]));
            for (int l = 0; l < 16; l++) pixels[l * NCH + c] = each[l]; }
        write(P.image + at * NCH, pixels, columns, NCH);
        store(each, 1.f - T[i]); write(P.alpha + at, each, columns, 1);
        if (want_depth) { store(each, median[i]); write(P.median + at, each, columns, 1); }
        if (want_top) {
            store(each, best[i]); write(P.top_weights + at, each, columns, 1);
            store(each, __builtin_bit_cast(F, top[i])); write((float*)P.top_ids + at, each, columns, 1); }
    }
}
"""
)

# Blend stage 1: backward, front to back. `left` is what the Gaussians behind still add to d loss / d image . image.
_STAGE_BLEND_BACKWARD = (
    _TILE
    + r"""
const long long GS = P.grad_stride;
const bool want_abs = P.want_abs != 0;
auto prefetch_result = FN(long long place) -> void { __builtin_prefetch(P.hit_grad + place * GS, 1); };
for (long long tile; (tile = take()) < tiles;) {
    long long tx = tile % P.tiles_x, ty = tile / P.tiles_x, start = P.tile_start[tile], stop = P.tile_end[tile];
    float x0 = tx * 16.f, y0 = ty * 16.f;
    int rows = (int)(H - ty * 16 < 16 ? H - ty * 16 : 16), columns = (int)(W - tx * 16 < 16 ? W - tx * 16 : 16);
    F T[16], left[16], G[NCH][16];
    for (int i = 0; i < 16; i++) {
        T[i] = (F)0.f; left[i] = (F)0.f;
        for (int c = 0; c < NCH; c++) G[c][i] = (F)0.f;
        if (i >= rows) continue;
        long long at = (ty * 16 + i) * W + tx * 16;
        alignas(64) float one[16], two[16], grads[16 * NCH], pixels[16 * NCH];
        read(one, P.grad_alpha + at, columns, 1); read(two, P.alpha + at, columns, 1);
        read(grads, P.grad_image + at * NCH, columns, NCH); read(pixels, P.image + at * NCH, columns, NCH);
        T[i] = LANE < (F)(float)columns ? (F)1.f : (F)0.f;
        left[i] = -load(one) * (1.f - load(two));
        for (int c = 0; c < NCH; c++) {
            for (int l = 0; l < 16; l++) { one[l] = grads[l * NCH + c]; two[l] = pixels[l * NCH + c]; }
            G[c][i] = load(one); left[i] = fma(G[c][i], load(two), left[i]); }
    }
    long long b = start;
    for (; b < stop; b += 16) {
"""
    + _BATCH
    + r"""
        for (int l = 0; l < m; l++) {
"""
    + HIT
    + r"""
            F out[(@MOMENTS@ + NCH + 15) / 16 * 16];
"""
    + BACKWARD_SUMS
    + r"""
"""
    + ROWS
    + BACKWARD_ROW
    + r"""
            }
            float* to = P.hit_grad + P.hit_place[b + l] * GS;
            out[0] = s0; out[1] = s1; out[2] = s2; out[3] = s3; out[4] = s4; out[5] = s5; out[6] = qa * ax; out[7] = ay;
            for (int c = 0; c < NCH; c++) out[@MOMENTS@ + c] = gc[c];
            for (int c = @MOMENTS@ + NCH; c < (int)(sizeof(out) / sizeof(F)); c++) out[c] = (F)0.f;
            for (int c = 0; c < (int)(sizeof(out) / sizeof(F)); c += 16) store(to + c, fold16(out + c, add));
        }
    }
    for (long long h = b < stop ? b : stop; h < P.tile_start[tile + 1]; h++)
        for (long long c = 0; c < GS; c += 16) store(P.hit_grad + P.hit_place[h] * GS + c, (F)0.f);
}
"""
)

PROJECT, SORT, COUNT, PREFIX, EMIT, WEIGHTS, PROJECT_BACKWARD = range(7)
BLEND, BLEND_BACKWARD = range(2)


def assemble(stages: list[str], extra: dict[str, object]) -> str:
    """One snippet that switches over `stages`, with the constants of `constants.py` put in."""
    values = {name: getattr(k, name) for name in dir(k) if name.isupper() or name.startswith("SH_")}
    values |= {"CHUNK": CHUNK, "SPANS": SPANS, "HEAD": HEAD, "MOMENTS": MOMENTS} | extra
    text = _block_text() + _COMMON
    for number, stage in enumerate(stages):
        text += f"if (stage == {number}) {{\n{stage}\n}}\n"
    for name, value in values.items():
        if isinstance(value, tuple):
            shown = ", ".join(f"{v!r}f" for v in value)
        elif isinstance(value, float):
            shown = repr(value)
        else:
            shown = str(value)
        text = text.replace(f"@{name}@", shown)
    return text


def stages_source() -> str:
    """The stages that do not depend on the number of channels."""
    return assemble(
        [
            _STAGE_PROJECT,
            _STAGE_SORT,
            _STAGE_COUNT,
            _STAGE_PREFIX,
            _STAGE_EMIT,
            _STAGE_WEIGHTS,
            _STAGE_PROJECT_BACKWARD,
        ],
        {"GRAD_MAX": 64},
    )


def blend_source(channels: int) -> str:
    """Blending, forward and backward, for images of `channels` channels (depth included)."""
    return assemble([_STAGE_BLEND, _STAGE_BLEND_BACKWARD], {"NCH": channels})


MAX_CHANNELS = 64 - MOMENTS
"""Channels, depth included, that one call can carry."""
