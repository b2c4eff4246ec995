// Belongs inside the loop of `rows.cpp`; opens no block. Backward: `v` is w (G . c) - alpha / (1 - alpha) behind.
#include "alpha.cpp"

                float dy = dys[l][row];
                F along = (F)0.f;
                for (int c = 0; c < NCH; c++) {
                    along = fma(G[c][row], (F)channel[c], along); gc[c] = fma(w, G[c][row], gc[c]); }
                F seen = w * along, behind = left[row] - seen;
                left[row] = behind;
                // d loss / d log alpha; nothing passes the clamp.
                F v = seen - al / (1.f - al) * behind;
                v = raw <= ALPHA_MAX ? v : (F)0.f;
                F ve = v * e;
                s0 += v; s1 += ve; s2 = fma(v, (F)dy, s2);
                s3 = fma(ve, e, s3); s4 = fma(ve, (F)dy, s4); s5 = fma(v, (F)(dy * dy), s5);
                if (want_abs) { ax += vabs(ve); ay += vabs(fma(v, (F)(qc * dy), ve * -(kk * qa))); }
