// Products of feature plane samples, and gradients of planes and points.

// planes: [levels * 6] addresses of [H][W][C]; sizes: H, W of each; where: [M][4] in [-1, 1];
// samples: [levels * 6][M][C]; pulls: [M][4], the gradient in `where`.
const long long C = @CHANNELS@, V = C / 16, POINTS = @POINTS@;
const int AXES[6][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};
const float* const* planes = (const float* const*)P.planes;
float* const* grads = (float* const*)P.grads;
const long long* sizes = (const long long*)P.sizes;
struct Corners { long long at[4]; float weight[4]; float fx, fy, dx, dy; };
// Border padding, corners aligned; a NaN goes to the rim.
auto corners = FN(long long plane, const float* where) -> Corners {
    long long H = sizes[2 * plane], W = sizes[2 * plane + 1];
    float x = 0.5f * (where[AXES[plane % 6][0]] + 1.f) * (W - 1);
    float y = 0.5f * (where[AXES[plane % 6][1]] + 1.f) * (H - 1);
    float dx = x > 0.f && x < W - 1 ? 0.5f * (W - 1) : 0.f, dy = y > 0.f && y < H - 1 ? 0.5f * (H - 1) : 0.f;
    x = x > 0.f ? (x < W - 1 ? x : W - 1) : 0.f; y = y > 0.f ? (y < H - 1 ? y : H - 1) : 0.f;
    long long x0 = (long long)x, y0 = (long long)y, x1 = x0 + 1 < W ? x0 + 1 : x0, y1 = y0 + 1 < H ? y0 + 1 : y0;
    float fx = x - x0, fy = y - y0;
    return {{(y0 * W + x0) * C, (y0 * W + x1) * C, (y1 * W + x0) * C, (y1 * W + x1) * C},
            {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy}, fx, fy, dx, dy}; };
const long long M = P.count, L = P.levels;

if (stage == 0) for (long long first; (first = take() * POINTS) < M;) {
    long long last = first + POINTS < M ? first + POINTS : M;
    for (long long m = first; m < last; m++) for (long long level = 0; level < L; level++) {
        F product[V];
        for (int k = 0; k < 6; k++) {
            long long plane = 6 * level + k;
            Corners c = corners(plane, P.where + 4 * m);
            for (int v = 0; v < V; v++) {
                const float* from = planes[plane] + 16 * v;
                F s = c.weight[0] * load(from + c.at[0]) + c.weight[1] * load(from + c.at[1])
                    + c.weight[2] * load(from + c.at[2]) + c.weight[3] * load(from + c.at[3]);
                if (P.samples) store(P.samples + (plane * M + m) * C + 16 * v, s);
                product[v] = k ? product[v] * s : s;
            }
        }
        for (int v = 0; v < V; v++) store(P.features + (m * L + level) * C + 16 * v, product[v]);
    }
}
if (stage == 1) for (long long plane; (plane = take()) < 6 * L;) {
    long long level = plane / 6;
    __builtin_memset(grads[plane], 0, 4 * sizes[2 * plane] * sizes[2 * plane + 1] * C);
    for (long long m = 0; m < M; m++) {
        Corners c = corners(plane, P.where + 4 * m);
        for (int v = 0; v < V; v++) {
            F pull = load(P.features + (m * L + level) * C + 16 * v);
            for (int k = 0; k < 6; k++) if (6 * level + k != plane)
                pull *= load(P.samples + ((6 * level + k) * M + m) * C + 16 * v);
            for (int q = 0; q < 4; q++) {
                float* to = grads[plane] + c.at[q] + 16 * v;
                store(to, load(to) + c.weight[q] * pull);
            }
        }
    }
}
if (stage == 2) for (long long first; (first = take() * POINTS) < M;) {
    long long last = first + POINTS < M ? first + POINTS : M;
    for (long long m = first; m < last; m++) {
        F along[4] = {(F)0.f, (F)0.f, (F)0.f, (F)0.f};
        for (long long plane = 0; plane < 6 * L; plane++) {
            long long level = plane / 6;
            Corners c = corners(plane, P.where + 4 * m);
            for (int v = 0; v < V; v++) {
                F pull = load(P.features + (m * L + level) * C + 16 * v);
                for (int k = 0; k < 6; k++) if (6 * level + k != plane)
                    pull *= load(P.samples + ((6 * level + k) * M + m) * C + 16 * v);
                const float* from = planes[plane] + 16 * v;
                F a = load(from + c.at[0]), b = load(from + c.at[1]);
                F d = load(from + c.at[2]), e = load(from + c.at[3]);
                along[AXES[plane % 6][0]] += c.dx * pull * ((1 - c.fy) * (b - a) + c.fy * (e - d));
                along[AXES[plane % 6][1]] += c.dy * pull * ((1 - c.fx) * (d - a) + c.fx * (e - b));
            }
        }
        for (int axis = 0; axis < 4; axis++) {
            float lanes[16], sum = 0.f; store(lanes, along[axis]);
            for (int l = 0; l < 16; l++) sum += lanes[l];
            P.pulls[4 * m + axis] = sum;
        }
    }
}
