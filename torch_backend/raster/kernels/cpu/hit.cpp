// What one hit needs beside its rows.

            const float* channel = P.record + slots[l] * RS + @HEAD@;
            float A = P.record[slots[l] * RS + 2], kk = P.record[slots[l] * RS + 3], R = P.record[slots[l] * RS + 4];
