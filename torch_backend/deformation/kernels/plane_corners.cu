// Corners and weights of a point on a plane; included by the GPU kernels that sample (`planes_cuda.py`).

const int C = @CHANNELS@;
const int AXES[6][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};
const long long* table = (const long long*)tables;
struct Corners { int at[4]; float weight[4]; float fx, fy, dx, dy; };
// Border padding, corners aligned; a NaN goes to the rim.
auto corners = [&](int plane, int k, const float* where) -> Corners {
    const int H = (int)table[4 * plane + 1], W = (int)table[4 * plane + 2];
    float x = 0.5f * (where[AXES[k][0]] + 1.f) * (W - 1), y = 0.5f * (where[AXES[k][1]] + 1.f) * (H - 1);
    const float dx = x > 0.f && x < W - 1 ? 0.5f * (W - 1) : 0.f, dy = y > 0.f && y < H - 1 ? 0.5f * (H - 1) : 0.f;
    x = x > 0.f ? (x < W - 1 ? x : W - 1) : 0.f; y = y > 0.f ? (y < H - 1 ? y : H - 1) : 0.f;
    const int x0 = (int)x, y0 = (int)y, x1 = x0 + 1 < W ? x0 + 1 : x0, y1 = y0 + 1 < H ? y0 + 1 : y0;
    const float fx = x - x0, fy = y - y0;
    return {{(y0 * W + x0) * C, (y0 * W + x1) * C, (y1 * W + x0) * C, (y1 * W + x1) * C},
            {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy}, fx, fy, dx, dy}; };
