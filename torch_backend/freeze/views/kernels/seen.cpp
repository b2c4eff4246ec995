// Visibility of up to 16 points in a plate, after F, I and exp2v: projection, surface look-up and comparison of depths.

// camera: rows 0 to 2 of the view matrix, fx, fy, cx, cy; surface: [height][width][3], median depth, motion, explained;
// ignored: [height][width] or null; tolerance: relative; soft: 1 / width of the border's ramp in pixels.
struct Plate { const float *camera, *surface, *ignored; long long width, height; float tolerance, soft; };
// Clamps x to 0..most; NaN becomes 0.
auto within = FN(float x, float most) -> float { return !(x > 0.f) ? 0.f : x < most ? x : most; };
auto project = FN(const float* V, const float* p, float& u, float& v) -> float {
    float x = V[0] * p[0] + V[1] * p[1] + V[2] * p[2] + V[3], y = V[4] * p[0] + V[5] * p[1] + V[6] * p[2] + V[7];
    float z = V[8] * p[0] + V[9] * p[1] + V[10] * p[2] + V[11];
    u = v = -1e6f;
    if (z > 1e-6f) { u = x / z * V[12] + V[14]; v = y / z * V[13] + V[15]; }
    return z; };
// points: [lanes][3]; pixels: [lanes][2]; the rest: [lanes].
auto seen = FN(const Plate& S, const float* points, long long lanes, float* pixels, float* depth, float* visible,
               float* moving, float* explained) -> void {
    const long long W = S.width, H = S.height;
    const float wide = (float)W, high = (float)H;
    float off[16] = {}, free[16] = {};
    for (long long l = 0; l < lanes; l++) {
        float u, v, z = project(S.camera, points + 3 * l, u, v);
        pixels[2 * l] = u; pixels[2 * l + 1] = v; depth[l] = z;
        float a = within(u - 0.5f, wide - 1.f), b = within(v - 0.5f, high - 1.f);
        long long left = (long long)a, top = (long long)b;
        long long right = left + 1 < W ? left + 1 : left, bottom = top + 1 < H ? top + 1 : top;
        a -= (float)left; b -= (float)top;
        long long corner[4] = {top * W + left, top * W + right, bottom * W + left, bottom * W + right};
        float share[4] = {(1.f - a) * (1.f - b), a * (1.f - b), (1.f - a) * b, a * b}, shown[3] = {}, covered = 0.f;
        for (int k = 0; k < 4; k++) {
            const float* s = S.surface + 3 * corner[k];
            for (int c = 0; c < 3; c++) shown[c] += share[k] * s[c];
            if (S.ignored) covered += share[k] * S.ignored[corner[k]];
        }
        float nearest = u < wide - u ? u : wide - u, other = v < high - v ? v : high - v;
        free[l] = within((nearest < other ? nearest : other) * S.soft, 1.f) * (1.f - covered);
        off[l] = (z - shown[0]) / (S.tolerance * (z > 1e-6f ? z : 1e-6f));
        moving[l] = shown[1]; explained[l] = shown[2];
    }
    F power = load(off); power *= power * -1.44269504f;
    power = power > -126.f ? power : (F)-126.f;
    float same[16]; store(same, exp2v(power));
    for (long long l = 0; l < lanes; l++) visible[l] = same[l] * free[l]; };
