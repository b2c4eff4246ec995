// Exchange of values between the threads of a warp.

#if defined(__CUDA_ARCH__)
auto shuffle = [](float v, int mask) -> float { return __shfl_xor_sync(0xffffffffu, v, mask); };
#else
static float exchange[@BLOCK@];
auto shuffle = [&](float v, int mask) -> float {
    exchange[tid] = v; WP_TILE_SYNC(); float r = exchange[tid ^ mask]; WP_TILE_SYNC(); return r; };
#endif
// Sixteen sums over a warp in sixteen shuffles: lane l ends with the sum of v[l & 15].
#define FOLD(h) UNROLL for (int i = 0; i < h; i++) { \
    const bool upper = (lane & h) != 0; \
    const float keep = upper ? v[i + h] : v[i], give = upper ? v[i] : v[i + h]; \
    v[i] = keep + shuffle(give, h); }
auto fold = [&](float* v) -> float { FOLD(8) FOLD(4) FOLD(2) FOLD(1) return v[0] + shuffle(v[0], 16); };
