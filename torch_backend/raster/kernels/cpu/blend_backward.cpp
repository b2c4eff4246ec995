// Blend stage 1: backward, front to back, parallel over tiles. `left` is what the Gaussians behind still contribute to
// sum_c G_c C_c - g_alpha T_final: C is the image with its background, G and g_alpha are gradients of image and alpha.
// After a Gaussian of colour c, that is `behind`: d loss / d log alpha = w (G . c) - alpha / (1 - alpha) behind.
#include "tile.cpp"

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
#include "batch.cpp"

        for (int l = 0; l < m; l++) {
#include "hit.cpp"

            F out[(@MOMENTS@ + NCH + 15) / 16 * 16];
#include "backward_sums.cpp"
#include "rows.cpp"
#include "backward_row.cpp"

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
