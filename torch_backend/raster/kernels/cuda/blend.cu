// One block per tile: forward blending.
#include "tile.cu"

float C[SLOTS][NCH], best[SLOTS], median[SLOTS], largest[SLOTS];
int winner[SLOTS];
UNROLL for (int s = 0; s < SLOTS; s++) {
    best[s] = 0.f; largest[s] = 0.f; median[s] = @DEPTH_EMPTY@f; winner[s] = -1;
    UNROLL for (int c = 0; c < NCH; c++) C[s][c] = 0.f; }
#include "batch.cu"

        float sum = 0.f, peak = 0.f;
#include "alpha.cu"

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
    UNROLL for (int c = 0; c < NCH; c++)
        P.image[pixel * NCH + c] = P.background && c < NCH - P.want_depth ? C[s][c] + T[s] * P.background[c] : C[s][c];
}
