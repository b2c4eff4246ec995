// One block per tile: backward, front to back. `left` is the part of d loss / d image . image that the Gaussians behind
// still contribute.
#include "tile.cu"

enum { GROUPS = (@MOMENTS@ + NCH + 15) / 16, GROUP = 16 };
float left[SLOTS], G[SLOTS][NCH];
UNROLL for (int s = 0; s < SLOTS; s++) {
    const long long pixel = corner + 2 * s * P.width;
    left[s] = 0.f;
    UNROLL for (int c = 0; c < NCH; c++) G[s][c] = 0.f;
    if (!inside[s]) continue;
    if (P.grad_alpha) left[s] = -P.grad_alpha[pixel] * (1.f - P.alpha[pixel]);
    UNROLL for (int c = 0; c < NCH; c++) {
        G[s][c] = P.grad_image[pixel * NCH + c]; left[s] = fmaf(G[s][c], P.image[pixel * NCH + c], left[s]); }
}
#include "batch.cu"

        float out[GROUPS * GROUP];
        UNROLL for (int i = 0; i < GROUPS * GROUP; i++) out[i] = 0.f;
        const float qa = -2.f * LN2 * A, qc = -2.f * LN2 * R;
#include "alpha.cu"

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
