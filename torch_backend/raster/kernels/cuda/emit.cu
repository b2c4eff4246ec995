// One thread per rank: writes the hits in depth order. The whole block writes the hits of a large Gaussian.
#include "spans.cu"

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
