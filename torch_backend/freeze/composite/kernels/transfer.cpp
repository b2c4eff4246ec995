// Values of a display to light, or back: one unit of work is 48 @BLOCKS@ values.

// values: [count]; alpha: [count / 3] or null; out: [count], with alpha [count / 3][4]; back, bends: 0 or 1; shoulder: see
// curves.cpp; largest: largest colour with alpha.
#include "curves.cpp"
const long long N = P.count, UNIT = 48 * @BLOCKS@;
for (long long first; (first = take() * UNIT) < N;) for (long long at = first; at < first + UNIT && at < N; at += 48) {
    long long lanes = N - at < 48 ? N - at : 48;
    float x[48] = {}, a[48] = {};
    __builtin_memcpy(x, P.values + at, lanes * 4);
    if (P.alpha) for (long long l = 0; l < lanes; l++) a[l] = P.alpha[at / 3 + l / 3];
    for (int part = 0; part < 48; part += 16) {
        F value = load(x + part);
        if (P.alpha) {
            F covered = load(a + part), weight = covered > 0.f ? covered : (F)1.f, top = covered * P.shoulder[2];
            value = value > top ? top : value < 0.f ? (F)0.f : value;
            value = to_light(value / weight) * weight;
        } else value = P.back ? to_display(value) : to_light(value);
        store(x + part, value);
    }
    if (!P.alpha) { __builtin_memcpy(P.out + at, x, lanes * 4); continue; }
    for (long long l = 0; l < lanes; l += 3) {
        float* pixel = P.out + (at + l) / 3 * 4;
        for (int c = 0; c < 3; c++) pixel[c] = x[l + c];
        pixel[3] = a[l];
    }
}
