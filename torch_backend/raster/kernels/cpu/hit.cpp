// Values of hit `l` that do not depend on the row; it opens no block. `A`, `kk` (k) and `R`: see the record in
// `cpu_source.py`.

            const float* channel = P.record + slots[l] * RS + @HEAD@;
            float A = P.record[slots[l] * RS + 2], kk = P.record[slots[l] * RS + 3], R = P.record[slots[l] * RS + 4];
