// One row pair of the warp; `end` is the row after the last.

        UNROLL for (int s = 0; s < SLOTS; s++) {
            if (end <= warp * 4 + 2 * s || top > warp * 4 + 2 * s + 1) continue;
            const float dy = row + 2 * s + 0.5f - my, e = column - mx - kk * dy;
            const float p = fmaf(A * e, e, lop + R * dy * dy);
            if (!(p >= PMIN && T[s] > T_STOP)) continue;
            touched = true;
            const float raw = exp2s(p), al = smin(raw, ALPHA_MAX), w = al * T[s];
