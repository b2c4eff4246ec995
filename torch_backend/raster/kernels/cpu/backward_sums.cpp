// Sums of one hit over its rows, set to 0; it opens no block. `qa` e and `qc` dy are slopes of the natural exponent of
// alpha: d log alpha / d mean x = qa e, d log alpha / d mean y = qc dy - k qa e (the record is in `cpu_source.py`).

            F s0 = (F)0.f, s1 = s0, s2 = s0, s3 = s0, s4 = s0, s5 = s0, ax = s0, ay = s0, gc[NCH];
            for (int c = 0; c < NCH; c++) gc[c] = (F)0.f;
            float qa = -2.f * LN2 * A, qc = -2.f * LN2 * R;
