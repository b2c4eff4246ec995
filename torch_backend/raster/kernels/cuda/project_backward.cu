// One thread per Gaussian, camera after camera: gradients of the projection from the gradients of the moments.
#include "shuffle.cu"
#include "twelve.cu"

const long long g = task < P.n ? task : 0;
const bool mine = task < P.n;
#include "gaussian.cu"

bool seen = false;
float aX[3] = {0.f, 0.f, 0.f}, aq[4] = {0.f, 0.f, 0.f, 0.f}, as[3] = {0.f, 0.f, 0.f}, al = 0.f;
float* sh_to = P.grad_sh + g * P.sh_stride; float* color_to = P.grad_colors + g * P.n_colors;
for (int camera = 0; camera < P.cameras; camera++) {
    const long long slot = (long long)camera * P.n + g;
    const bool use = mine && P.hit_count[slot] > 0;
    float gV[16] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
    if (mine && !use) { P.grad_norm[slot] = 0.f; P.grad_abs[slot] = 0.f; }
    if (use) {
#include "camera.cu"

        const float pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
#include "projection.cu"

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
#include "direction.cu"

            // A floored channel passes only what would raise it; the record holds the floored colour.
            const float* shown = P.record + slot * P.record_stride + @HEAD@;
            const float* from = P.sh + g * P.sh_stride;
            const float h0 = shown[0] > 0.f || gc[0] < 0.f ? gc[0] : 0.f;
            const float h1 = shown[1] > 0.f || gc[1] < 0.f ? gc[1] : 0.f;
            const float h2 = shown[2] > 0.f || gc[2] < 0.f ? gc[2] : 0.f;
            float gdx = 0.f, gdy = 0.f, gdz = 0.f;
            float f[12], o[12];
@HARMONICS_BACKWARD@
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
