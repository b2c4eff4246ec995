// Belongs inside the loop of `rows.cpp`; opens no block. Alpha, weight, and the transmittance behind the hit.

                F e = LANE + shifts[l][row], before = T[row];
                F p = fma(A * e, e, (F)levels[l][row]);
                F raw = exp2v(p), al = vmin(raw, (F)ALPHA_MAX);
                al = ((p >= PMIN) & (before > T_STOP)) ? al : (F)0.f;
                F w = al * before;
                T[row] = fma(-al, before, before);
