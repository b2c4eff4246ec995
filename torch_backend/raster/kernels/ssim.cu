// SSIM with or without L1, and its gradient, on a GPU, in the four passes that `ssim_cuda.py` describes. Each thread
// computes one value.

const int HALF = @HALF@;
const float TAP[2 * HALF + 1] = {@TAPS@}, C1 = 1e-4f, C2 = 9e-4f, MID = 0.5f;
const float* image = (const float*)images; const float* target = (const float*)targets;
float* blurred = (float*)blurreds; float* back = (float*)backs;
const int length = width * channels, count = height * length;
// Where a pixel is ignored the image stands in the place of the target.
const unsigned char* ignored = (const unsigned char*)ignoreds;
auto aim = [&](int i) -> float { return (ignored && ignored[i / channels] ? image : target)[i]; };
const int h = tid / length, w = tid % length / channels;
// The loops have constant bounds, so that the taps become constants of the code.
#define TAPS_DOWN _Pragma("unroll") for (int k = -HALF; k <= HALF; k++) if (h + k >= 0 && h + k < height)
#define TAPS_ALONG _Pragma("unroll") for (int k = -HALF; k <= HALF; k++) if (w + k >= 0 && w + k < width)
float m[4] = {0.f, 0.f, 0.f, 0.f}, weight = 0.f;
if (stage == 0) {
    TAPS_DOWN {
        float tap = TAP[k + HALF], x = image[tid + k * length] - MID, y = aim(tid + k * length) - MID;
        weight += tap; m[0] += tap * x; m[1] += tap * y; m[2] += tap * (x * x + y * y); m[3] += tap * x * y; }
    for (int q = 0; q < 4; q++) blurred[q * count + tid] = m[q] / weight;
} else if (stage == 1) {
    TAPS_ALONG {
        float tap = TAP[k + HALF];
        weight += tap;
        for (int q = 0; q < 4; q++) m[q] += tap * blurred[q * count + tid + k * channels]; }
    float rx = 1.f / weight, u = m[0] * rx, v = m[1] * rx, square = m[2] * rx, both = m[3] * rx;
    float mx = u + MID, my = v + MID;
    float a1 = 2.f * mx * my + C1, a2 = 2.f * (both - u * v) + C2;
    float b1 = mx * mx + my * my + C1, b2 = square - (u * u + v * v) + C2;
    float inverse = 1.f / (b1 * b2), score = a1 * a2 * inverse;
    const float gap = image[tid] - aim(tid);
    ((float*)scores)[tid] = base + share * score + (plain != 0.f ? plain * (gap < 0.f ? -gap : gap) : 0.f);
    if (!back) return;
    float down = 0.f;
    TAPS_DOWN down += TAP[k + HALF];
    float part = share * rx / down, d1 = score * inverse * b2, d2 = score * inverse * b1;
    // By the mean of x (inside the luminance, then inside the variances), by x^2, by x y.
    back[tid] = part * (2.f * (my * (a2 * inverse) - mx * d1) + 2.f * (u * d2 - v * (a1 * inverse)));
    back[count + tid] = part * -d2;
    back[2 * count + tid] = part * (2.f * a1 * inverse);
} else if (stage == 2) {
    TAPS_DOWN
        for (int q = 0; q < 3; q++) m[q] += TAP[k + HALF] * back[q * count + tid + k * length];
    for (int q = 0; q < 3; q++) blurred[q * count + tid] = m[q];
} else {
    TAPS_ALONG
        for (int q = 0; q < 3; q++) m[q] += TAP[k + HALF] * blurred[q * count + tid + k * channels];
    const float gap = image[tid] - aim(tid), sign = gap > 0.f ? plain : (gap < 0.f ? -plain : 0.f);
    const float pull = m[0] + 2.f * (image[tid] - MID) * m[1] + (aim(tid) - MID) * m[2] + sign;
    back[tid] = ignored && ignored[tid / channels] ? 0.f : pull / (float)count;
}
