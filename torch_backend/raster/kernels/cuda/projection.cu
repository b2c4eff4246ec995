// Projection of one Gaussian, from world mean X, Y, Z, quaternion q* (wxyz) and raw log-scales r*.

float px = V[0] * X + V[1] * Y + V[2] * Z + V[3], py = V[4] * X + V[5] * Y + V[6] * Z + V[7];
float iz = 1.f / pz, xn = px * iz, yn = py * iz;
float u = smin(smax(xn, x_low), x_high), v = smin(smax(yn, y_low), y_high);
float mx = fx * xn + cx, my = fy * yn + cy;
// Largest component first, so that the squares neither vanish nor overflow.
float iq = 1.f / qmax, w = qw * iq, x = qx * iq, y = qy * iq, z = qz * iq;
float unit = 1.f / sqrtf(w * w + x * x + y * y + z * z);
w *= unit; x *= unit; y *= unit; z *= unit; iq *= unit;
float Q[9] = {1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y),
              2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x),
              2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)};
float s[3] = {expf(smax(r0, @LOG_SCALE_MIN@f)), expf(smax(r1, @LOG_SCALE_MIN@f)), expf(smax(r2, @LOG_SCALE_MIN@f))};
float ja = fx * iz, jb = fy * iz, jc = -ja * u, jd = -jb * v;
float T0[3], T1[3], B0[3], B1[3];
UNROLL for (int i = 0; i < 3; i++) { T0[i] = ja * V[i] + jc * V[8 + i]; T1[i] = jb * V[4 + i] + jd * V[8 + i]; }
UNROLL for (int j = 0; j < 3; j++) {
    B0[j] = (T0[0] * Q[j] + T0[1] * Q[3 + j] + T0[2] * Q[6 + j]) * s[j];
    B1[j] = (T1[0] * Q[j] + T1[1] * Q[3 + j] + T1[2] * Q[6 + j]) * s[j]; }
float n0 = B0[1] * B1[2] - B0[2] * B1[1], n1 = B0[2] * B1[0] - B0[0] * B1[2], n2 = B0[0] * B1[1] - B0[1] * B1[0];
float rxx = B0[0] * B0[0] + B0[1] * B0[1] + B0[2] * B0[2], ryy = B1[0] * B1[0] + B1[1] * B1[1] + B1[2] * B1[2];
float xy = B0[0] * B1[0] + B0[1] * B1[1] + B0[2] * B1[2], xx = rxx + LOW_PASS, yy = ryy + LOW_PASS;
float dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;
