// Stage 0: project, cull, compact into slots, colour, count tile hits. Parallel over chunks.
#include "gather.cpp"
#include "spans.cpp"

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
#include "projection.cpp"

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
