// Values of one hit that do not depend on the row.

            const float* channel = P.record + slots[l] * RS + @HEAD@;
            float A = P.record[slots[l] * RS + 2], kk = P.record[slots[l] * RS + 3], R = P.record[slots[l] * RS + 4];
