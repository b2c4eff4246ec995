// Smoothness penalty of feature planes and its gradient.

// rows: [rows] of (plane, row); a unit is one row of one plane.
const long long C = @CHANNELS@;
const float* const* planes = (const float* const*)P.planes;
float* const* grads = (float* const*)P.grads;
const long long* sizes = (const long long*)P.sizes;
const long long* rows = (const long long*)P.rows;
const float* weights = P.weights;  // of each plane: second differences down, along, |1 - p|, each over its count
for (long long unit; (unit = take()) < P.count;) {
    long long plane = rows[2 * unit], h = rows[2 * unit + 1], H = sizes[2 * plane], W = sizes[2 * plane + 1], S = W * C;
    const float* p = planes[plane];
    float down = weights[3 * plane], along = weights[3 * plane + 1], still = weights[3 * plane + 2];
    double total = 0;
    for (long long w = 0; w < W; w++) for (long long c = 0; c < C; c += 16) {
        const float* at = p + h * S + w * C + c;
        auto bend = FN(long long i, long long count, long long step, long long shift) -> F {
            if (i < 1 || i > count - 2) return (F)0.f;
            const float* z = at + shift * step;
            return load(z - step) - 2.f * load(z) + load(z + step); };
        F pull = (F)0.f, sum = (F)0.f;
        if (down != 0.f) {
            F here = bend(h, H, S, 0);
            pull += 2.f * down * (bend(h - 1, H, S, -1) - 2.f * here + bend(h + 1, H, S, 1));
            sum += down * here * here; }
        if (along != 0.f) {
            F here = bend(w, W, C, 0);
            pull += 2.f * along * (bend(w - 1, W, C, -1) - 2.f * here + bend(w + 1, W, C, 1));
            sum += along * here * here; }
        if (still != 0.f) {
            F gap = load(at) - 1.f;
            sum += still * __builtin_elementwise_abs(gap);
            pull += gap > 0.f ? (F)still : (gap < 0.f ? (F)-still : (F)0.f); }
        if (grads) store(grads[plane] + h * S + w * C + c, pull);
        float lanes[16]; store(lanes, sum);
        float line = 0.f; for (int l = 0; l < 16; l++) line += lanes[l];
        total += line;
    }
    P.partial[unit] = (float)total;
}
