// Smoothness penalty of feature planes and its gradient on a GPU. One thread per value of a plane.

const int C = @CHANNELS@;
const long long* table = (const long long*)tables;
int plane = 0;
while (plane + 1 < planes && table[4 * (plane + 1) + 3] <= tid) plane++;
const int H = (int)table[4 * plane + 1], W = (int)table[4 * plane + 2], S = W * C;
const int i = tid - (int)table[4 * plane + 3], h = i / S, w = i % S / C;
const float* at = (const float*)table[4 * plane] + i;
// Of each plane: second differences down, along, |1 - p|, each over its count.
const float* weight = (const float*)weights + 3 * plane;
auto bend = [&](int n, int count, int step, int shift) -> float {
    if (n < 1 || n > count - 2) return 0.f;
    const float* z = at + shift * step;
    return z[-step] - 2.f * z[0] + z[step]; };
float pull = 0.f, sum = 0.f;
if (weight[0] != 0.f) {
    const float here = bend(h, H, S, 0);
    pull += 2.f * weight[0] * (bend(h - 1, H, S, -1) - 2.f * here + bend(h + 1, H, S, 1));
    sum += weight[0] * here * here; }
if (weight[1] != 0.f) {
    const float here = bend(w, W, C, 0);
    pull += 2.f * weight[1] * (bend(w - 1, W, C, -1) - 2.f * here + bend(w + 1, W, C, 1));
    sum += weight[1] * here * here; }
if (weight[2] != 0.f) {
    const float gap = at[0] - 1.f;
    pull += gap > 0.f ? weight[2] : (gap < 0.f ? -weight[2] : 0.f);
    sum += weight[2] * (gap < 0.f ? -gap : gap); }
((float*)terms)[tid] = sum;
if (grads) ((float*)grads)[tid] = pull;
