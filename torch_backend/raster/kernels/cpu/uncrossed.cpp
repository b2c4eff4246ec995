// Median depth of the pixels whose transmittance stays above 0.5: depth of the Gaussian with the largest weight. Such
// pixels are few, so their rows are blended again. Tracking this depth for all pixels would double the blending time.

    unsigned uncrossed = 0;
    if (want_depth) for (int i = 0; i < rows; i++) uncrossed |= (unsigned)any(T[i] > 0.5f) << i;
    if (uncrossed) {
        F most[16], final[16];
        for (int i = 0; i < 16; i++) {
            most[i] = (F)0.f; final[i] = T[i];
            T[i] = LANE < (F)(uncrossed >> i & 1 ? (float)columns : 0.f) ? (F)1.f : (F)0.f; }
        for (long long b = start; b < stop; b += 16) {
#include "batch.cpp"

            for (int l = 0; l < m; l++) {
#include "hit.cpp"

                float depth = P.aux[4 * (long long)slots[l] + 3];
#include "rows.cpp"
#include "alpha.cpp"

                    I larger = (w > most[row]) & (final[row] > 0.5f);
                    if (any(larger)) {
                        median[row] = larger ? (F)depth : median[row];
                        most[row] = vmax(most[row], w);
                    }
                }
            }
        }
        for (int i = 0; i < 16; i++) T[i] = final[i];
    }
