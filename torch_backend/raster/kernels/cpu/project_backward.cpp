// Stage 6: gradients of the projection from the summed gradients of the hits. Parallel over chunks. For the first
// camera, the uninitialised rows of a chunk are zeroed just before gradients are added, which keeps them in the cache.
#include "gather.cpp"

const long long GS = P.grad_stride;
const int D = (int)P.channels;
auto clear = FN(float* rows, long long first, long long count, long long width) -> void {
    if (rows) for (long long i = first * width; i < (first + count) * width; i++) rows[i] = 0.f; };
for (long long chunk; (chunk = take()) < P.chunks;) {
    long long base = chunk * @CHUNK@; int count = P.chunk_count[chunk];
    if (P.clear) {
        long long own = P.n - base < @CHUNK@ ? P.n - base : @CHUNK@;
        clear(P.grad_means, base, own, 3); clear(P.grad_quats, base, own, 4);
        clear(P.grad_log_scales, base, own, 3); clear(P.grad_logits, base, own, 1);
        clear(P.grad_colors, base, own, P.n_colors); clear(P.grad_sh, base, own, P.sh_stride);
        if (P.clear > 1) clear(P.grad_sh_rest, base, own, P.rest_stride);
    }
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
#include "projection.cpp"

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
            float* first = P.grad_sh + i * P.sh_stride;
            float* rest = P.grad_sh_rest + i * P.rest_stride;
            if (P.n_sh) for (int c = 0; c < 3; c++) first[c] += shv[c][l];
            if (P.n_sh) for (int c = 3; c < bands * 3; c++) rest[c - 3] += shv[c][l];
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
