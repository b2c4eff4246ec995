// Rows of an EXR as OpenEXR stores them: all values of a channel, then those of the next. One unit of work is a row.

// channels: [count][6] integers: address of the first float, floats to the next pixel and to the next row, first byte in
// `out`, what is stored (0 float, 1 half, 2 grain, 3 splat, 4 plate; see exr_rows.py), and a place in `infinite`, which
// becomes 1 for a value that is not finite; out: [height][bytes].
using I = int __attribute__((ext_vector_type(16)));
auto bits = FN(F x) -> I { return __builtin_bit_cast(I, x); };
auto value = FN(I x) -> F { return __builtin_bit_cast(F, x); };
auto clamped = FN(F x) -> F { x = x < -65504.f ? (F)-65504.f : x; return x > 65504.f ? (F)65504.f : x; };
auto half = FN(F x) -> I {  // rounded to nearest even; denormal halves are multiples of the last bit of 0.5
    I b = bits(x) & 0x7fffffff, normal = (b + 0xfff + ((b >> 13) & 1) - (112 << 23)) >> 13;
    normal = b > 0x7f800000 ? 0x7e00 : normal;  // NaN
    return (b < (113 << 23) ? bits(value(b) + 0.5f) - 0x3f000000 : normal) | ((bits(x) >> 16) & 0x8000); };
const long long W = P.width;
for (long long row; (row = take()) < P.height;) for (long long c = 0; c < P.count; c++) {
    const long long* channel = (const long long*)P.channels + 6 * c;
    const float* from = (const float*)channel[0] + row * channel[2];
    char* to = (char*)P.out + row * P.bytes + channel[3];
    const long long step = channel[1], kind = channel[4];
    I odd = 0;
    for (long long first = 0; first < W; first += 16) {
        long long lanes = W - first < 16 ? W - first : 16;
        float x[16] = {};
        for (long long l = 0; l < lanes; l++) x[l] = from[(first + l) * step];
        F v = load(x);
        odd |= (bits(v) & 0x7fffffff) >= 0x7f800000;
        if (!kind) { __builtin_memcpy(to + 4 * first, x, 4 * lanes); continue; }
        if (kind == 3) v = value((bits(clamped(v)) + 0x4000) & ~0x7fff);
        if (kind == 4) v = (v * 256.f + 12582912.f - 12582912.f) / 256.f;
        I h = half(clamped(v));
        if (kind == 2) {
            h = (h + 0x80) & 0xff00;
            h = (h & 0x7fff) < 0x7c00 ? h : (h & 0x8000) | 0x7bff;
        }
        short out[16];
        for (int l = 0; l < 16; l++) out[l] = (short)h[l];
        __builtin_memcpy(to + 2 * first, out, 2 * lanes);
    }
    for (int l = 0; l < 16; l++) if (odd[l]) P.infinite[channel[5]] = 1.f;
}
