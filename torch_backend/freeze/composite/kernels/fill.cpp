// Fills pixels of a frozen frame from several plates: one unit of work is @PIXELS@ pixels.

// at: [count][2] integers, row and column; depth: [height][width] and color: [height][width][3] of these rows, of which the
// first is row `top` of the frame; camera: the frame's, as in seen.cpp; maps: [small_height][small_width][channels], channels a
// multiple of 16: motion, doubt, motion of the splats, then per plate the scene flow (3), visible, agreed; table: [plates][3] addresses of surface, ignored,
// and residual (halves [plate_height][plate_width][3]); at most @PLATES@ plates; views: [plates][17] camera, and parallax in pixels at depth 1;
// out: [count][12] filled colour (3), share, number of the plate, use of plate t* itself, its pixel (2), world point (3), 0.
// settings: decision pixels per pixel, tolerance, 1 / soft, sway_trust, -log2(e) / sway in pixels, doubt, ratio of `first_best`,
// slope of `above` 0.5.
using I = int __attribute__((ext_vector_type(16)));
using H = unsigned short __attribute__((ext_vector_type(16)));
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
#include "../../../kernels/exp2.cpp"
#include "../../views/kernels/seen.cpp"
const long long W = P.width, w = P.small_width, h = P.small_height, N = P.plates, M = P.channels, T = P.instant;
const int MOST = @PLATES@;
const long long *table = (const long long*)P.table, *at = (const long long*)P.at;
const float *V = P.camera, *set = P.settings;
const float across = (float)P.plate_width / P.view_width, down = (float)P.plate_height / P.view_height;
auto larger = FN(float x, float y) -> float { return x > y ? x : y; };
// Weights of the four values around, each thrice, as in torch's grid_sample.
const F BASE = {1, 1, 1, 0, 0, 0, 1, 1, 1, 2, 2, 2}, WAY = {1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, -1};
auto cubic = FN(float t) -> F {
    const float A = -0.75f;
    F x = BASE + WAY * t, outer = ((A * x - 5.f * A) * x + 8.f * A) * x - 4.f * A;
    return x > 1.f ? outer : ((A + 2.f) * x - (A + 3.f)) * x * x + 1.f; };
// A residual at a pixel: the channels of four columns, one after the other, still to be added up.
auto residual_at = FN(const unsigned short* residual, const float* pixel) -> F {
    const long long width = P.plate_width, height = P.plate_height;
    float x = pixel[0] * across - 0.5f, y = pixel[1] * down - 0.5f;
    float left = __builtin_floorf(x), top = __builtin_floorf(y);
    F rows = cubic(y - top), sum = 0.f;
    for (int j = 0; j < 4; j++) {
        long long u = (long long)left - 1, v = (long long)top + j - 1;
        const unsigned short* row = residual + 3 * width * (v < 0 ? 0 : v < height ? v : height - 1);
        H half = 0;
        if (u >= 0 && u + 5 < width) __builtin_memcpy(&half, row + 3 * u, 32);
        else for (int i = 0; i < 12; i++) {
            long long at = u + i / 3;
            half[i] = row[3 * (at < 0 ? 0 : at < width ? at : width - 1) + i % 3];
        }
        I bits = __builtin_convertvector(half, I);
        F value = __builtin_bit_cast(F, (bits & 0x7fff) << 13 | (bits & 0x8000) << 16) * 0x1p112f;  // finite halves
        sum += value * rows[3 * j];
    }
    return sum * cubic(x - left); };
auto plate = FN(long long n) -> Plate {
    const long long* row = table + 3 * n;
    return {P.views + 17 * n, (const float*)row[0], (const float*)row[1], P.view_width, P.view_height, set[1], set[2]}; };
for (long long first; (first = take() * @PIXELS@) < P.count;)
for (long long block = first; block < first + @PIXELS@ && block < P.count; block += 16) {
    long long lanes = P.count - block < 16 ? P.count - block : 16;
    float map[16][(3 + 5 * MOST + 15) / 16 * 16], points[48], moved[48], weight[MOST][16], place[MOST][32], untold[16], same_state[16] = {};
    float depth[16], visible[16], moving[16], explained[16], shown[16] = {};
    for (long long l = 0; l < lanes; l++) {
        long long y = at[2 * (block + l)], x = at[2 * (block + l) + 1];
        float u = x + 0.5f, v = P.top + y + 0.5f, z = P.depth[y * W + x], *p = points + 3 * l;
        float local[3] = {(u - V[14]) / V[12] * z - V[3], (v - V[15]) / V[13] * z - V[7], z - V[11]};
        for (int c = 0; c < 3; c++) p[c] = local[0] * V[c] + local[1] * V[4 + c] + local[2] * V[8 + c];
        float a = within(u * set[0] - 0.5f, w - 1.f), b = within(v * set[0] - 0.5f, h - 1.f);
        long long left = (long long)a, top = (long long)b;
        const float* corner = P.maps + (top * w + left) * M;
        const float *right = left + 1 < w ? corner + M : corner, *under = top + 1 < h ? corner + w * M : corner;
        const float* last = under + (right - corner);
        a -= (float)left; b -= (float)top;
        for (long long m = 0; m < M; m += 16) {
            F upper = (1.f - a) * load(corner + m) + a * load(right + m);
            store(map[l] + m, (1.f - b) * upper + b * ((1.f - a) * load(under + m) + a * load(last + m)));
        }
        untold[l] = 1.f;
    }
    for (long long k = T < 0 ? 1 : 0; k <= N; k++) {  // plate t* first: the better it shows a pixel, the less others count
        long long n = k ? k - 1 : T;
        if (k && n == T) continue;
        const float* view = P.views + 17 * n;
        for (long long l = 0; l < lanes; l++) for (int c = 0; c < 3; c++)
            moved[3 * l + c] = points[3 * l + c] + (n == T ? 0.f : map[l][3 + 5 * n + c]);
        seen(plate(n), moved, lanes, place[n], depth, visible, moving, explained);
        float way[16] = {}, trust[16];
        for (long long l = 0; l < lanes; l++) {
            float u, v;
            project(view, points + 3 * l, u, v);
            u -= place[n][2 * l]; v -= place[n][2 * l + 1];
            way[l] = __builtin_sqrtf(u * u + v * v);
        }
        F power = load(way) * set[4];
        store(trust, exp2v(power > -126.f ? power : (F)-126.f));
        for (long long l = 0; l < lanes; l++) {
            const float motion = map[l][0], doubt = map[l][1], around = map[l][6 + 5 * n], agreed = map[l][7 + 5 * n];
            float far = larger(depth[l], 1e-6f), near = far / (far + view[16]);
            if (n == T) { untold[l] = 1.f - visible[l] * near; shown[l] = visible[l] * around * within((map[l][2] - 0.5f) * set[7] + 0.5f, 1.f); }
            float uneasy = within(larger(motion, doubt), 1.f), unmoved = explained[l] * trust[l] * agreed;
            near *= visible[l] + uneasy * ((visible[l] < around ? visible[l] : around) - visible[l]);
            weight[n][l] = near;
            if (n == T) continue;
            same_state[l] = larger(same_state[l], unmoved * near);
            float still = (1.f - doubt * (1.f - agreed)) * (1.f - motion);
            still *= 1.f - larger(moving[l], doubt * (1.f - explained[l]));
            weight[n][l] = near * (still + (1.f - still) * set[3] * unmoved * untold[l]);
        }
    }
    for (long long l = 0; l < lanes; l++) {
        float total = 0.f, best = 0.f, carried[3] = {}, *out = P.out + 12 * (block + l);
        for (long long n = 0; n < N; n++) { total += weight[n][l]; best = larger(best, weight[n][l]); }
        total = larger(total, 1e-6f);
        long long source = 0;
        while (source < N - 1 && !(weight[source][l] >= set[6] * best)) source++;
        F sum = 0.f;
        for (long long n = 0; n < N; n++) if (weight[n][l] != 0.f)
            sum += residual_at((const unsigned short*)table[3 * n + 2], place[n] + 2 * l) * (weight[n][l] / total);
        for (int i = 0; i < 12; i++) carried[i % 3] += sum[i];
        float share = total / (total + set[5]);
        const float* color = P.color + (at[2 * (block + l)] * W + at[2 * (block + l) + 1]) * 3;
        for (int c = 0; c < 3; c++) { out[c] = color[c] + carried[c] * share; out[8 + c] = points[3 * l + c]; }
        out[3] = share; out[4] = (float)source; out[5] = shown[l] * (1.f - same_state[l]); out[11] = 0.f;
        for (int c = 0; c < 2; c++) out[6 + c] = T < 0 ? 0.f : place[T][2 * l + c] * (c ? down : across);
    }
}
