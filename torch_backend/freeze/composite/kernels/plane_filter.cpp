// Joint bilateral filter of planes of inverse depth: one unit of work is a row of the picture.

// maps: [small_height + 2 border][small_width + 2 border][5 + channels], per window: value of its plane in the middle of
// the picture, slopes along and down, fit, variance, colour; rough: [height][width]; picture: [height][width][channels];
// inverse, deviation: [height][width]; settings: noise, outlier, 1 / colour sigma, least inverse depth.
using I = int __attribute__((ext_vector_type(16)));
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
#include "../../../kernels/exp2.cpp"
const long long W = P.width, H = P.height, w = P.small_width, h = P.small_height, C = P.channels, B = P.border;
const long long stride = w + 2 * B, size = 5 + C;
const float noise = P.settings[0], outlier = P.settings[1], per_color = P.settings[2], least = P.settings[3];
const float HALF_LOG2E = 0.72134752f;
// exp(-x / 2), at least 2^-126
auto falloff = FN(F x) -> F { x *= -HALF_LOG2E; return exp2v(x > -126.f ? x : (F)-126.f); };
for (long long row; (row = take()) < H;) {
    float down = (row + 0.5f) * ((float)h / H), y = down - 0.5f - 0.5f * h;
    long long line = (long long)down < h ? (long long)down : h - 1;
    for (long long first = 0; first < W; first += 16) {
        long long lanes = W - first < 16 ? W - first : 16, column[16];
        float x[16] = {}, rough[16] = {}, near[16] = {};
        for (long long l = 0; l < lanes; l++) {
            float along = (first + l + 0.5f) * ((float)w / W), r = P.rough[row * W + first + l];
            column[l] = (long long)along < w ? (long long)along : w - 1;
            x[l] = along - 0.5f - 0.5f * w; rough[l] = r; near[l] = 1.f / (noise * (r > least ? r : least));
        }
        F total = 1e-20f, mean = 0.f, square = 0.f, spread = 0.f;
        for (long long v = -B; v <= B; v += B) for (long long u = -B; u <= B; u += B) {
            float guess[16] = {}, color[16] = {}, fit[16] = {}, variance[16] = {};
            for (long long l = 0; l < lanes; l++) {
                const float* m = P.maps + ((line + B + v) * stride + column[l] + B + u) * size;
                const float* p = P.picture + (row * W + first + l) * C;
                guess[l] = m[0] + m[1] * x[l] + m[2] * y - rough[l]; fit[l] = m[3]; variance[l] = m[4];
                for (long long c = 0; c < C; c++) {
                    float off = (m[5 + c] - p[c]) * per_color;
                    color[l] += off * off;
                }
            }
            F g = load(guess), away = g * load(near);
            // Splats choose among windows of one colour. Windows of another colour are rejected, whatever their depth.
            F weight = load(fit) * falloff(load(color)) * (falloff(away * away) + outlier);
            total += weight; mean += weight * g; square += weight * g * g; spread += weight * load(variance);
        }
        F middle = mean / total, varied = square / total - middle * middle;
        varied = (varied > 0.f ? varied : (F)0.f) + spread / total;
        for (long long l = 0; l < lanes; l++) {
            long long at = row * W + first + l;
            bool known = total[l] > 1e-12f;
            P.inverse[at] = known ? rough[l] + middle[l] : rough[l];
            P.deviation[at] = known ? __builtin_sqrtf(varied[l]) : noise * rough[l];
        }
    }
}
