// Blend stage 0: forward. Parallel over tiles.
#include "tile.cpp"

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
#include "batch.cpp"

        // Rows in which some pixel's transmittance has not crossed a half yet, where its median depth is.
        unsigned undecided = 0;
        if (want_depth) for (int i = 0; i < 16; i++) undecided |= (unsigned)any(T[i] > 0.5f) << i;
        F totals[16], peaks[16];
        for (int l = m; l < 16; l++) { totals[l] = (F)0.f; peaks[l] = (F)0.f; }
        for (int l = 0; l < m; l++) {
#include "hit.cpp"

            F total = (F)0.f, peak = (F)0.f;
            float depth = 0.f; int id = 0;
            if (want_depth) depth = P.aux[4 * (long long)slots[l] + 3];
            if (want_top) id = P.index[slots[l]];
#include "rows.cpp"
#include "forward_row.cpp"

                if (undecided >> row & 1) {
                    I crossed = (before > 0.5f) & (T[row] <= 0.5f);
                    if (any(crossed)) median[row] = crossed ? (F)depth : median[row];
                }
                if (want_top) {
                    I larger = w > best[row];
                    if (any(larger)) {
                        top[row] = larger ? (I)id : top[row];
                        best[row] = vmax(best[row], w);
                    }
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
#include "uncrossed.cpp"

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
