// Belongs inside the loop of `rows.cpp`; opens no block. Forward, without the parts for depth and top contributor.
#include "alpha.cpp"

                for (int c = 0; c < NCH; c++) C[c][row] = fma(w, (F)channel[c], C[c][row]);
                total += w; peak = vmax(peak, w);
