// Visibility of world points in a plate: projection, surface look-up and comparison of depths in one pass.

// points: [count][3]; camera: rows 0 to 2 of the view matrix, fx, fy, cx, cy; surface: [height][width][3], median depth,
// motion, explained; ignored: [height][width] or null; pixels: [count][2]; depth, visible, moving, explained: [count].
using I = int __attribute__((ext_vector_type(16)));
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
#include "../../../kernels/exp2.cpp"
const long long N = P.count, W = P.width, H = P.height;
const float* V = P.camera;
const float fx = V[12], fy = V[13], cx = V[14], cy = V[15], wide = (float)W, high = (float)H;
const float tolerance = P.settings[0], soft = 1.f / P.settings[1];
// Clamps x to 0..most; NaN becomes 0.
auto within = FN(float x, float most) -> float { return !(x > 0.f) ? 0.f : x < most ? x : most; };
for (long long first; (first = take() * @POINTS@) < N;) {
    long long last = first + @POINTS@ < N ? first + @POINTS@ : N;
    for (long long block = first; block < last; block += 16) {
        long long lanes = last - block < 16 ? last - block : 16;
        float off[16] = {}, free[16] = {};
        for (long long l = 0; l < lanes; l++) {
            const float* p = P.points + 3 * (block + l);
            float x = V[0] * p[0] + V[1] * p[1] + V[2] * p[2] + V[3], y = V[4] * p[0] + V[5] * p[1] + V[6] * p[2] + V[7];
            float z = V[8] * p[0] + V[9] * p[1] + V[10] * p[2] + V[11], u = -1e6f, v = -1e6f;
            if (z > 1e-6f) { u = x / z * fx + cx; v = y / z * fy + cy; }
            P.pixels[2 * (block + l)] = u; P.pixels[2 * (block + l) + 1] = v; P.depth[block + l] = z;
            float a = within(u - 0.5f, wide - 1.f), b = within(v - 0.5f, high - 1.f);
            long long left = (long long)a, top = (long long)b;
            long long right = left + 1 < W ? left + 1 : left, bottom = top + 1 < H ? top + 1 : top;
            a -= (float)left; b -= (float)top;
            long long corner[4] = {top * W + left, top * W + right, bottom * W + left, bottom * W + right};
            float share[4] = {(1.f - a) * (1.f - b), a * (1.f - b), (1.f - a) * b, a * b}, shown[3] = {}, covered = 0.f;
            for (int k = 0; k < 4; k++) {
                const float* s = P.surface + 3 * corner[k];
                for (int c = 0; c < 3; c++) shown[c] += share[k] * s[c];
                if (P.ignored) covered += share[k] * P.ignored[corner[k]];
            }
            float nearest = u < wide - u ? u : wide - u, other = v < high - v ? v : high - v;
            free[l] = within((nearest < other ? nearest : other) * soft, 1.f) * (1.f - covered);
            off[l] = (z - shown[0]) / (tolerance * (z > 1e-6f ? z : 1e-6f));
            P.moving[block + l] = shown[1]; P.explained[block + l] = shown[2];
        }
        F power = load(off); power *= power * -1.44269504f;
        power = power > -126.f ? power : (F)-126.f;
        float same[16]; store(same, exp2v(power));
        for (long long l = 0; l < lanes; l++) P.visible[block + l] = same[l] * free[l];
    }
}
