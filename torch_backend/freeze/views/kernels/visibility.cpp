// Visibility of world points in a plate, in one pass: one unit of work is @POINTS@ points.

// points: [count][3]; camera, surface, ignored: see seen.cpp; pixels: [count][2]; depth, visible, moving, explained: [count].
using I = int __attribute__((ext_vector_type(16)));
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
#include "../../../kernels/exp2.cpp"
#include "seen.cpp"
const long long N = P.count;
const Plate plate = {P.camera, P.surface, P.ignored, P.width, P.height, P.settings[0], 1.f / P.settings[1]};
for (long long first; (first = take() * @POINTS@) < N;) {
    long long last = first + @POINTS@ < N ? first + @POINTS@ : N;
    for (long long at = first; at < last; at += 16)
        seen(plate, P.points + 3 * at, last - at < 16 ? last - at : 16, P.pixels + 2 * at, P.depth + at, P.visible + at,
             P.moving + at, P.explained + at);
}
