// Adam on a GPU, one thread per element. `adam.py` documents the columns of the two tables.

// stage 0: check one gradient; 1: advance one segment's step count; 2: update one element.
const wp::int64* whole = (const wp::int64*)wholes; float* real = (float*)reals; int* bad = (int*)flag;
if (stage == 1) {
    const wp::int64* w = whole + tid * @WHOLE@; float* r = real + tid * @REAL@; float* t = (float*)w[7];
    if (bad[0] || !t) return;
    t[0] += 1.f;
    r[6] = (float)(r[0] / (1.0 - wp::pow(1.0 - (double)r[1], (double)t[0])));
    r[7] = (float)(1.0 / wp::sqrt(1.0 - wp::pow(1.0 - (double)r[2], (double)t[0])));
    return; }
wp::int64 chunk = tid / @CHUNK@, s = 0, high = segments;
while (high - s > 1) {
    wp::int64 middle = (s + high) / 2;
    if (whole[middle * @WHOLE@ + 6] <= chunk) s = middle; else high = middle; }
const wp::int64* w = whole + s * @WHOLE@; const float* r = real + s * @REAL@;
wp::int64 i = (chunk - w[6]) * @CHUNK@ + tid % @CHUNK@;
if (i >= w[4]) return;
const float* g = (const float*)w[1];
if (stage == 0) { float odd = g[i] - g[i]; if (!(odd == 0.f)) bad[0] = 1; return; }
if (bad[0] || !w[0] || (w[5] > 0 && visible && !((const unsigned char*)visible)[i / w[5]])) return;
float *p = (float*)w[0], *m = (float*)w[2], *v = (float*)w[3];
float M = m[i] + r[1] * (g[i] - m[i]), V = v[i] + r[2] * (g[i] * g[i] - v[i]);
float rate = w[8] ? r[6] * ((const float*)w[8])[i] : r[6];
float X = p[i] - rate * (M / (wp::sqrt(V) * r[7] + r[3]));
m[i] = M; v[i] = V; p[i] = X < r[4] ? r[4] : (X > r[5] ? r[5] : X);
