// Precedes every stage of the CPU backend: vectors of 16 floats, elementary functions and sums over lanes.
// `cpu_source.py` documents names and units, and replaces the names between @ signs.

typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
const float LOG2E = 1.44269504088896f, LN2 = 0.693147180559945f, PMIN = @LOG2_ALPHA_MIN@f;
const float ALPHA_MAX = @ALPHA_MAX@f, T_STOP = @T_STOP@f, LOW_PASS = @LOW_PASS@f;
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
// The second operand where the first is NaN, as in one vminps or vmaxps.
auto vmin = FN(F a, F b) -> F { return a < b ? a : b; };
auto vmax = FN(F a, F b) -> F { return a > b ? a : b; };
auto vabs = FN(F a) -> F { return __builtin_elementwise_abs(a); };
auto vsqrt = FN(F a) -> F { return __builtin_elementwise_sqrt(a); };
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
auto vround = FN(F a) -> F { return __builtin_elementwise_roundeven(a); };
typedef bool Bits __attribute__((ext_vector_type(16)));
auto bits = FN(I m) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, Bits)); };
auto any = FN(I m) -> bool { return __builtin_reduce_or(m) != 0; };
auto smin = FN(float a, float b) -> float { return a < b ? a : b; };
auto smax = FN(float a, float b) -> float { return a > b ? a : b; };
auto ssqrt = FN(float a) -> float { return __builtin_elementwise_sqrt(a); };
// Pixel rows or columns whose centres lie at or beyond v: first index >= v, last index <= v, for v in any range.
auto first_at = FN(float v, float limit) -> int {
    v = smin(smax(v, 0.f), limit); int t = (int)v; return t + ((float)t < v); };
auto last_at = FN(float v, float limit) -> int { return v < 0.f ? -1 : (int)smin(v, limit); };
// 2^p: nearest integer by the rounding of a large addend, degree-5 polynomial for the rest (relative error 2e-7).
#include "../../../kernels/exp2.cpp"
auto expv = FN(F x) -> F { return exp2v(vmin(vmax(x * LOG2E, (F)-125.f), (F)125.f)); };
auto log2v = FN(F x) -> F {
    I bits = __builtin_bit_cast(I, x), e = (bits - 0x3f3504f3) >> 23;
    F m = __builtin_bit_cast(F, bits - (e << 23)), t = (m - 1.f) / (m + 1.f), t2 = t * t;
    F q = fma(t2, (F)(1.f / 9), (F)(1.f / 7)); q = fma(q, t2, (F)(1.f / 5)); q = fma(q, t2, (F)(1.f / 3));
    q = fma(q, t2, (F)1.f);
    return fma(t * q, (F)2.88539008177793f, __builtin_convertvector(e, F)); };
const F LANE = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
// Sixteen vectors to one: lane i of the result is v[i] folded over its lanes. Every step is one cheap shuffle a side.
#define FOLD(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
// Halves are joined first: that takes no shuffle where a vector of 16 is two registers or four.
typedef float Half __attribute__((ext_vector_type(8)));
auto fold16 = FN(const F* v, auto&& join) -> F {
    Half h[16];
    for (int i = 0; i < 16; i++)
        h[i] = join(FOLD(v[i], v[i], 0,1,2,3,4,5,6,7), FOLD(v[i], v[i], 8,9,10,11,12,13,14,15));
    for (int i = 0; i < 8; i++)
        h[i] = join(FOLD(h[i], h[i + 8], 0,1,2,3,8,9,10,11), FOLD(h[i], h[i + 8], 4,5,6,7,12,13,14,15));
    for (int i = 0; i < 4; i++)
        h[i] = join(FOLD(h[i], h[i + 4], 0,1,8,9,4,5,12,13), FOLD(h[i], h[i + 4], 2,3,10,11,6,7,14,15));
    for (int i = 0; i < 2; i++)
        h[i] = join(FOLD(h[i], h[i + 2], 0,2,8,10,4,6,12,14), FOLD(h[i], h[i + 2], 1,3,9,11,5,7,13,15));
    return FOLD(h[0], h[1], 0,8,2,10,1,9,3,11,4,12,6,14,5,13,7,15);
};
auto add = FN(auto a, auto b) { return a + b; };
auto larger = FN(auto a, auto b) { return a > b ? a : b; };
auto sum = FN(F v) -> float {
    float a[16]; store(a, v);
    float b0 = (a[0] + a[8]) + (a[4] + a[12]), b1 = (a[1] + a[9]) + (a[5] + a[13]);
    float b2 = (a[2] + a[10]) + (a[6] + a[14]), b3 = (a[3] + a[11]) + (a[7] + a[15]);
    return (b0 + b2) + (b1 + b3); };
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED); };
