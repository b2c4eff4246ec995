// Twelve coefficients (four harmonics) at a time, as three 16-byte words where the array allows it.

auto load12 = [&](const float* p, int limit, float* f) -> void {
    if (P.sh_aligned) {
        UNROLL for (int i = 0; i < 3; i++) {
            const float4 word = ((const float4*)p)[i];
            f[4 * i] = word.x; f[4 * i + 1] = word.y; f[4 * i + 2] = word.z; f[4 * i + 3] = word.w; }
    } else { UNROLL for (int i = 0; i < 12; i++) f[i] = i < limit ? p[i] : 0.f; } };
auto store12 = [&](float* p, int limit, const float* f) -> void {
    if (P.sh_aligned) {
        UNROLL for (int i = 0; i < 3; i++)
            ((float4*)p)[i] = float4{f[4 * i], f[4 * i + 1], f[4 * i + 2], f[4 * i + 3]};
    } else { UNROLL for (int i = 0; i < 12; i++) if (i < limit) p[i] = f[i]; } };
