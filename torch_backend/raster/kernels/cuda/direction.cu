// The unit direction dx, dy, dz from the camera to the Gaussian.

const float camx = -(V[0] * V[3] + V[4] * V[7] + V[8] * V[11]), camy = -(V[1] * V[3] + V[5] * V[7] + V[9] * V[11]);
const float camz = -(V[2] * V[3] + V[6] * V[7] + V[10] * V[11]);
float dx = X - camx, dy = Y - camy, dz = Z - camz, inv = 1.f / sqrtf(dx * dx + dy * dy + dz * dz);
dx *= inv; dy *= inv; dz *= inv;
const float sxx = dx * dx, syy = dy * dy, szz = dz * dz;
