// Curves of a display, after F: to light and back. P.bends: it has a shoulder; P.shoulder: where that starts, and its roll.
// Powers and logarithms to base 2 are series, exact to the last bits of a float: those of exp2.cpp are too coarse here.
using I = int __attribute__((ext_vector_type(16)));
auto least = FN(F x, F y) -> F { return x < y ? x : y; };
auto most = FN(F x, F y) -> F { return x > y ? x : y; };
auto size = FN(F x) -> F { return __builtin_elementwise_abs(x); };
auto signed_as = FN(F x, F sign) -> F { return __builtin_elementwise_copysign(x, sign); };
auto exp2s = FN(F p) -> F {  // at least 2^-126; from 2^128 on infinity
    p = most(least(p, 128.f), -126.f);
    F z = p + 12582912.f, g = (p - (z - 12582912.f)) * 0.69314718f, q = 1.f;
    for (int n = 7; n > 0; n--) q = 1.f + g * (1.f / n) * q;
    return __builtin_bit_cast(F, __builtin_bit_cast(I, q) + (__builtin_bit_cast(I, z) << 23)); };
auto log2s = FN(F x) -> F {  // of positive numbers
    I bits = __builtin_bit_cast(I, x), whole = (bits - 0x3f3504f3) >> 23;
    F m = __builtin_bit_cast(F, bits - (whole << 23)), t = (m - 1.f) / (m + 1.f), q = 1.f / 9.f;  // m: 0.7 to 1.4
    for (int n = 7; n > 0; n -= 2) q = 1.f / n + t * t * q;
    return t * q * 2.88539008f + __builtin_convertvector(whole, F); };
const float start = P.shoulder[0], roll = P.shoulder[1], KNEE = 0.04045f;
auto to_light = FN(F x) -> F {
    F s = x;
    if (P.bends) s = least(x, start) + roll * (exp2s(most(x - start, 0.f) * (1.44269504f / roll)) - 1.f);
    F curve = exp2s(log2s((most(size(s), KNEE) + 0.055f) / 1.055f) * 2.4f);
    F light = size(s) > KNEE ? signed_as(curve, s) : s / 12.92f;
    return x - x == 0.f ? light : x; };  // NaN and infinity stay
auto to_display = FN(F x) -> F {
    F curve = exp2s(log2s(most(size(x), KNEE / 12.92f)) * (1.f / 2.4f)) * 1.055f - 0.055f;
    F s = size(x) > KNEE / 12.92f ? signed_as(curve, x) : x * 12.92f;
    if (P.bends) s = least(s, start) + roll * 0.69314718f * log2s(most(s - start, 0.f) / roll + 1.f);
    return x - x == 0.f ? s : x; };
