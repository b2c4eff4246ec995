// Grain of some rows of a picture: one unit of work is a row.

// color: [height][width][3], premultiplied, light or sRGB; alpha, share: [height][width]; noise: [noise_height][noise_width]
// [3], at most as large as the picture of `whole` rows, whose row `top` is the first; curve: [3][BINS] deviations; out:
// [height][width][3] light; is_light, bends: 0 or 1; shoulder: see curves.cpp.
#include "curves.cpp"
const long long W = P.width, w = P.noise_width, h = P.noise_height;
auto unit = FN(F x) -> F { return x < 0.f ? (F)0.f : x > 1.f ? (F)1.f : x; };
// Place between two of `most + 1` values, for interpolation. NaN is 0.
auto between = FN(double at, long long most, float& part) -> long long {
    at = at > 0. ? at < most ? at : most : 0.;
    long long first = (long long)at < most ? (long long)at : most > 0 ? most - 1 : 0;
    part = (float)(at - first);
    return first; };
for (long long row; (row = take()) < P.height;) {
    float down, along[16], a[16], share[16];
    long long above = between((P.top + row + 0.5) * h / P.whole - 0.5, h - 1, down);
    const float* upper = P.noise + above * w * 3, *lower = above + 1 < h ? upper + w * 3 : upper;
    for (long long first = 0; first < W; first += 16) {
        long long lanes = W - first < 16 ? W - first : 16, left[16];
        const float* color = P.color + (row * W + first) * 3;
        float* out = P.out + (row * W + first) * 3;
        bool any = false;
        for (long long l = 0; l < 16; l++) {
            a[l] = l < lanes ? P.alpha[row * W + first + l] : 0.f;
            share[l] = l < lanes ? P.share[row * W + first + l] : 0.f;
            any |= a[l] != 0.f && share[l] != 0.f;
        }
        if (!any) { __builtin_memset(out, 0, 12 * lanes); continue; }
        for (long long l = 0; l < lanes; l++) left[l] = 3 * between((first + l + 0.5) * w / W - 0.5, w - 1, along[l]);
        F covered = load(a), weight = (covered > 0.f ? covered : (F)1.f), strength = covered * load(share);
        for (int c = 0; c < 3; c++) {
            float x[16] = {}, deviation[16] = {}, noise[16] = {};
            for (long long l = 0; l < lanes; l++) x[l] = color[3 * l + c];
            F value = unit((P.is_light ? to_display(load(x)) : load(x)) / weight);
            store(x, value);
            for (long long l = 0; l < lanes; l++) {
                float part;
                const float* curve = P.curve + c * @BINS@ + between(x[l] * @BINS@ - 0.5f, @BINS@ - 1, part);
                deviation[l] = curve[0] + part * (curve[1] - curve[0]);
                long long p = left[l] + c, q = left[l] / 3 + 1 < w ? p + 3 : p;
                float from = upper[p] + down * (lower[p] - upper[p]), to = upper[q] + down * (lower[q] - upper[q]);
                noise[l] = from + along[l] * (to - from);
            }
            F grainy = unit(value + load(deviation) * load(noise));
            store(x, (to_light(grainy) - to_light(value)) * strength + 0.f);  // + 0: no negative zeros, which do not compress
            for (long long l = 0; l < lanes; l++) out[3 * l + c] = x[l];
        }
    }
}
