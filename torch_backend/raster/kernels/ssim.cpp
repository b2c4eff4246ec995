// Mean of share * SSIM + plain * |x - y| and its gradient on the CPU, in two passes over rows. `ssim.py` documents the
// mathematics and the fields of P.

typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
#define UNROLL _Pragma("clang loop unroll(full)")
const int R = @ROWS@, HALF = @HALF@;
const float TAP[2 * HALF + 1] = {@TAPS@}, C1 = 1e-4f, C2 = 9e-4f, MID = 0.5f;
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
const long long H = P.height, L = P.length, C = P.channels, S = P.padded, Q = P.pitch;
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED) * R; };
// Symmetric blur along a row with zeros around it.
auto across = FN(const float* z) -> F {
    F total = TAP[HALF] * load(z);
    UNROLL for (int k = 1; k <= HALF; k++) total = fma((F)TAP[HALF + k], load(z - k * C) + load(z + k * C), total);
    return total; };
float edge[2][R + 2 * HALF][16];

if (stage == 0) {
float* rows = P.scratch + worker * P.scratch_stride + P.margin;
float* back = rows + 4 * R * Q;
for (long long first; (first = take()) < H;) {
    int count = (int)(H - first < R ? H - first : R);
    // Down the columns, R rows at a time: x, y, x^2 + y^2, x y.
    for (long long at = 0; at < S; at += 16) {
        const float* px = P.image + (first - HALF) * L + at; const float* py = P.target + (first - HALF) * L + at;
        long long step = L;
        if (at + 16 > L) {
            for (int j = 0; j < R + 2 * HALF; j++) for (int l = 0; l < 16; l++) {
                bool in = first + j >= HALF && first + j < H + HALF && at + l < L;
                edge[0][j][l] = in ? px[j * L + l] : MID; edge[1][j][l] = in ? py[j * L + l] : MID; }
            px = edge[0][0]; py = edge[1][0]; step = 16;
        }
        F m[R][4] = {};
        UNROLL for (int j = 0; j < R + 2 * HALF; j++) {
            if (first + j < HALF || first + j >= H + HALF) continue;
            F x = load(px + j * step) - MID, y = load(py + j * step) - MID, square = fma(x, x, y * y), both = x * y;
            UNROLL for (int i = 0; i < R; i++) if (j >= i && j - i <= 2 * HALF) {
                F w = (F)TAP[j - i];
                m[i][0] = fma(w, x, m[i][0]); m[i][1] = fma(w, y, m[i][1]);
                m[i][2] = fma(w, square, m[i][2]); m[i][3] = fma(w, both, m[i][3]); }
        }
        UNROLL for (int i = 0; i < R; i++) {
            F inverse = (F)P.inverse_y[first + i];
            UNROLL for (int q = 0; q < 4; q++) store(rows + (4 * i + q) * Q + at, m[i][q] * inverse); }
    }
    for (int i = 0; i < count; i++) {
        const float* z = rows + 4 * i * Q;
        F sum = (F)0.f;
        for (long long at = 0; at < S; at += 16) {
            F rx = load(P.inverse_x + at);
            F u = rx * across(z + at), v = rx * across(z + Q + at);
            F square = rx * across(z + 2 * Q + at), both = rx * across(z + 3 * Q + at);
            F mx = u + MID, my = v + MID;
            F a1 = 2.f * mx * my + C1, a2 = 2.f * (both - u * v) + C2;
            F b1 = mx * mx + my * my + C1, b2 = square - (u * u + v * v) + C2;
            F inverse = 1.f / (b1 * b2), score = a1 * a2 * inverse;
            sum += rx > 0.f ? score : (F)0.f;
            if (!P.want_gradient) continue;
            // By the mean of x (inside the luminance, then inside the variances), by x^2, by x y.
            F weight = rx * P.inverse_y[first + i], d1 = score * inverse * b2, d2 = score * inverse * b1;
            F mean = 2.f * (my * (a2 * inverse) - mx * d1) + 2.f * (u * d2 - v * (a1 * inverse));
            store(back + at, weight * mean);
            store(back + Q + at, weight * -d2);
            store(back + 2 * Q + at, weight * (2.f * a1 * inverse));
        }
        double total = 0;
        for (int l = 0; l < 16; l++) total += sum[l];
        double apart = 0;
        if (P.plain != 0.f) {
            const float* px = P.image + (first + i) * L; const float* py = P.target + (first + i) * L;
            F sum = (F)0.f;
            long long at = 0;
            for (; at + 16 <= L; at += 16) sum += __builtin_elementwise_abs(load(px + at) - load(py + at));
            for (int l = 0; l < 16; l++) apart += sum[l];
            for (; at < L; at++) apart += __builtin_fabsf(px[at] - py[at]);
        }
        P.row_score[first + i] = (float)(P.share * total + P.plain * apart);
        if (!P.want_gradient) continue;
        float* to = P.blurred + (first + i) * S;
        for (long long at = 0; at < S; at += 16)
            UNROLL for (int q = 0; q < 3; q++) store(to + q * H * S + at, across(back + q * Q + at));
    }
}
}

if (stage == 1) {
const float each = 1.f / ((float)H * (float)L), scale = P.share * each, plain = P.plain * each;
for (long long first; (first = take()) < H;) {
    int count = (int)(H - first < R ? H - first : R);
    for (long long at = 0; at < S; at += 16) {
        const float* z = P.blurred + (first - HALF) * S + at;
        F d[R][3] = {};
        UNROLL for (int j = 0; j < R + 2 * HALF; j++) {
            if (first + j < HALF || first + j >= H + HALF) continue;
            F d0 = load(z + j * S), d1 = load(z + (H + j) * S), d2 = load(z + (2 * H + j) * S);
            UNROLL for (int i = 0; i < R; i++) if (j >= i && j - i <= 2 * HALF) {
                F w = (F)TAP[j - i];
                d[i][0] = fma(w, d0, d[i][0]); d[i][1] = fma(w, d1, d[i][1]); d[i][2] = fma(w, d2, d[i][2]); }
        }
        UNROLL for (int i = 0; i < R; i++) if (i < count) {
            long long from = (first + i) * L + at;
            const float* px = P.image + from; const float* py = P.target + from;
            bool part = at + 16 > L;
            if (part) {
                for (int l = 0; l < L - at; l++) { edge[0][0][l] = px[l]; edge[1][0][l] = py[l]; }
                px = edge[0][0]; py = edge[1][0]; }
            F x = load(px) - MID, y = load(py) - MID, apart = load(px) - load(py);
            F value = scale * (d[i][0] + 2.f * x * d[i][1] + y * d[i][2]);
            value += apart > 0.f ? (F)plain : (apart < 0.f ? (F)-plain : (F)0.f);
            if (!part) { store(P.gradient + from, value); continue; }
            store(edge[0][0], value);
            for (int l = 0; l < L - at; l++) P.gradient[from + l] = edge[0][0][l];
        }
    }
}
}
