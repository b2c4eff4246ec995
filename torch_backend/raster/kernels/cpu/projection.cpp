// Projection of 16 Gaussians, from world mean X, Y, Z, quaternion q* (wxyz) and clamped log-scales l*.

F pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
F px = V[0] * X + V[1] * Y + V[2] * Z + V[3], py = V[4] * X + V[5] * Y + V[6] * Z + V[7];
F iz = 1.f / pz, xn = px * iz, yn = py * iz;
F u = vmin(vmax(xn, (F)P.x_low), (F)P.x_high), v = vmin(vmax(yn, (F)P.y_low), (F)P.y_high);
F mx = P.fx * xn + P.cx, my = P.fy * yn + P.cy;
// Largest component first, so that the squares neither vanish nor overflow.
F qmax = vmax(vmax(vabs(qw), vabs(qx)), vmax(vabs(qy), vabs(qz))), iq = 1.f / qmax;
F w = qw * iq, x = qx * iq, y = qy * iq, z = qz * iq, unit = 1.f / vsqrt(w * w + x * x + y * y + z * z);
w *= unit; x *= unit; y *= unit; z *= unit; iq *= unit;
F Q[9] = {1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y),
          2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x),
          2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)};
F s[3] = {expv(l0), expv(l1), expv(l2)};
F ja = P.fx * iz, jb = P.fy * iz, jc = -ja * u, jd = -jb * v;
F T0[3], T1[3], B0[3], B1[3];
for (int i = 0; i < 3; i++) { T0[i] = ja * V[i] + jc * V[8 + i]; T1[i] = jb * V[4 + i] + jd * V[8 + i]; }
for (int j = 0; j < 3; j++) {
    B0[j] = (T0[0] * Q[j] + T0[1] * Q[3 + j] + T0[2] * Q[6 + j]) * s[j];
    B1[j] = (T1[0] * Q[j] + T1[1] * Q[3 + j] + T1[2] * Q[6 + j]) * s[j]; }
F n0 = B0[1] * B1[2] - B0[2] * B1[1], n1 = B0[2] * B1[0] - B0[0] * B1[2], n2 = B0[0] * B1[1] - B0[1] * B1[0];
F rxx = B0[0] * B0[0] + B0[1] * B0[1] + B0[2] * B0[2], ryy = B1[0] * B1[0] + B1[1] * B1[1] + B1[2] * B1[2];
F xy = B0[0] * B1[0] + B0[1] * B1[1] + B0[2] * B1[2], xx = rxx + LOW_PASS, yy = ryy + LOW_PASS;
F dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;
