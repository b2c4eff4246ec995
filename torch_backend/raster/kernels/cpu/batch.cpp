// Belongs inside the loop over hits `b`, which it leaves once no pixel of the tile is unfinished. Opens no block.
// Sixteen hits at a time: for each, the rows that it touches, as bits, and its ellipse on each of the 16 rows. `r` is a
// record of `cpu_source.py`: r[0], r[1] mean x, y; r[2] A; r[3] k; r[4] R; r[5] log2 opacity.

        unsigned live = 0;
        for (int i = 0; i < 16; i++) live |= (unsigned)any(T[i] > T_STOP) << i;
        if (!live) break;
        int slots[16], m = stop - b < 16 ? (int)(stop - b) : 16;
        unsigned masks[16];
        alignas(64) float dys[16][16], shifts[16][16], levels[16][16];
        for (int l = 0; l < m; l++) {
            slots[l] = P.hit_slot[b + l];
            // The next batch's record, and where this hit's result goes.
            __builtin_prefetch(P.record + P.hit_slot[b + 16 + l < stop ? b + 16 + l : stop - 1] * RS);
            prefetch_result(P.hit_place[b + l]);
            const float* r = P.record + slots[l] * RS;
            // Exponent of alpha on a row: level + A e^2, e = column + shift.
            F dy = LANE + 0.5f - (r[1] - y0), shift = (0.5f - (r[0] - x0)) - r[3] * dy;
            F level = fma(r[4] * dy, dy, (F)r[5]);
            store(dys[l], dy); store(shifts[l], shift); store(levels[l], level);
            // The row's pixel nearest to the ellipse's middle is lit, or none is; a hair of slack against rounding.
            F e = shift + vround(vmin(vmax(-shift, (F)0.f), (F)15.f));
            masks[l] = bits(fma(r[2] * e, e, level) >= PMIN - 1e-3f) & live;
        }
