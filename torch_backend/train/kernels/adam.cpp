// Adam on the CPU, in chunks. `adam.py` documents the columns of the two tables.

const long long CHUNK = @CHUNK@;
auto root = FN(F x) -> F { return __builtin_elementwise_sqrt(x); };
const long long* whole = (const long long*)P.whole;
for (long long chunk, s = 0; (chunk = take()) < P.chunks;) {
    while (s + 1 < P.segments && whole[(s + 1) * @WHOLE@ + 6] <= chunk) s++;
    const long long* w = whole + s * @WHOLE@;
    const float* r = P.real + s * @REAL@;
    long long first = (chunk - w[6]) * CHUNK, last = first + CHUNK < w[4] ? first + CHUNK : w[4];
    if (stage == 1 && !w[0]) continue;
    float *p = (float*)w[0], *m = (float*)w[2], *v = (float*)w[3];
    const float *g = (const float*)w[1], *factor = (const float*)w[8];
    if (stage == 0) {
        // A value minus itself is 0 unless it is infinite or no number.
        F odd = (F)0.f; float rest = 0.f; long long i = first;
        for (; i + 16 <= last; i += 16) { F x = load(g + i); odd += x - x; }
        for (; i < last; i++) rest += g[i] - g[i];
        float lanes[16]; store(lanes, odd);
        for (int l = 0; l < 16; l++) rest += lanes[l];
        if (rest != 0.f) __atomic_store_n((int*)P.bad, 1, __ATOMIC_RELAXED);
        continue;
    }
    float w1 = r[1], w2 = r[2], eps = r[3], low = r[4], high = r[5], step = r[6], spread = r[7];
    auto update = FN(F G, F K, F& M, F& V, F& X) -> void {
        M += w1 * (G - M);
        V += w2 * (G * G - V);
        X -= step * K * (M / (root(V) * spread + eps));
        X = X < low ? (F)low : (X > high ? (F)high : X); };
    float edge[5][16] = {};
    auto run = FN(long long i, long long count) -> void {
        if (count == 16) {
            F M = load(m + i), V = load(v + i), X = load(p + i);
            update(load(g + i), factor ? load(factor + i) : (F)1.f, M, V, X);
            store(m + i, M); store(v + i, V); store(p + i, X);
            return; }
        for (long long l = 0; l < count; l++) {
            edge[0][l] = g[i + l]; edge[1][l] = m[i + l]; edge[2][l] = v[i + l]; edge[3][l] = p[i + l];
            edge[4][l] = factor ? factor[i + l] : 1.f; }
        F M = load(edge[1]), V = load(edge[2]), X = load(edge[3]);
        update(load(edge[0]), load(edge[4]), M, V, X);
        store(edge[1], M); store(edge[2], V); store(edge[3], X);
        for (long long l = 0; l < count; l++) {
            m[i + l] = edge[1][l]; v[i + l] = edge[2][l]; p[i + l] = edge[3][l]; } };
    long long width = P.visible ? w[5] : 0;
    const unsigned char* visible = (const unsigned char*)P.visible;
    for (long long i = first; i < last;) {
        // Runs of visible rows; a chunk may begin and end inside a row.
        long long end = last;
        if (width) {
            long long row = i / width;
            bool seen = visible[row];
            while (row * width < last && visible[row] == (seen ? 1 : 0)) row++;
            end = row * width < last ? row * width : last;
            if (!seen) { i = end; continue; }
        }
        for (; i + 16 <= end; i += 16) run(i, 16);
        if (i < end) { run(i, end - i); i = end; }
    }
}
