// Precedes every stage of the CUDA backend: names that differ between GPUs and Warp's CPU fibers, elementary functions.
// `cuda_source.py` documents names and units, and replaces the names between @ signs.

#if defined(__CUDA_ARCH__)
#define SHARED __shared__
#define UNIFORM(x) (x)
#define WARP_ANY(x) __any_sync(0xffffffffu, x)
#define QUOTIENT(a, b) __fdividef(a, b)
#define ADD(p, v) atomicAdd(p, v)
#define RAISE(p, v) atomicMax((int*)(p), __float_as_int(v))
#define UNROLL _Pragma("unroll")
auto exp2s = [](float x) -> float { float y; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); return y; };
auto bits = [](float x) -> int { return __float_as_int(x); };
auto as_float = [](int x) -> float { return __int_as_float(x); };
#else
#define SHARED static
#define UNIFORM(x) ((x) || true)
#define WARP_ANY(x) ((x) || true)
#define QUOTIENT(a, b) ((a) / (b))
#define ADD(p, v) (*(p) += (v))
#define RAISE(p, v) (*(p) = *(p) > (v) ? *(p) : (v))
#define UNROLL
auto exp2s = [](float x) -> float { return exp2f(x); };
auto bits = [](float x) -> int { return __builtin_bit_cast(int, x); };
auto as_float = [](int x) -> float { return __builtin_bit_cast(float, x); };
#endif
const float LOG2E = 1.44269504088896f, LN2 = 0.693147180559945f, PMIN = @LOG2_ALPHA_MIN@f;
const float ALPHA_MAX = @ALPHA_MAX@f, T_STOP = @T_STOP@f, LOW_PASS = @LOW_PASS@f;
auto smin = [](float a, float b) -> float { return a < b ? a : b; };
auto smax = [](float a, float b) -> float { return a > b ? a : b; };
auto finite = [&](float v) -> bool { return (bits(v) & 0x7f800000) != 0x7f800000; };
const int tid = WP_TILE_THREAD_IDX, lane = tid & 31, warp = tid >> 5;
