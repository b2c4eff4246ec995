// Powers of two of vectors, after F, I and fma: what the rasteriser and the field's network share.
auto exp2v = FN(F p) -> F {
    F z = p + 12582912.f, f = p - (z - 12582912.f), f2 = f * f;
    F q = fma(fma(f, (F)1.33389978e-3f, (F)9.61833261e-3f), f2, fma(f, (F)5.55044435e-2f, (F)2.40226522e-1f));
    q = fma(q, f2, fma(f, (F)6.93147182e-1f, (F)1.f));
    return __builtin_bit_cast(F, __builtin_bit_cast(I, q) + (__builtin_bit_cast(I, z) << 23)); };
