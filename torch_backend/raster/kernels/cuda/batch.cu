// Loads the tile's next hits into shared memory: record, slot, and rows in which the ellipse meets the tile's columns.
#include "spans.cu"

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
