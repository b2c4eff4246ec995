// Sums of one hit over its rows.

            F s0 = (F)0.f, s1 = s0, s2 = s0, s3 = s0, s4 = s0, s5 = s0, ax = s0, ay = s0, gc[NCH];
            for (int c = 0; c < NCH; c++) gc[c] = (F)0.f;
            float qa = -2.f * LN2 * A, qc = -2.f * LN2 * R;
