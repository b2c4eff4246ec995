// Product of the samples of a level's six planes on a GPU. One thread per WIDTH channels, level and point.

#include "plane_corners.cu"
const int WIDTH = @WIDTH@, PARTS = C / WIDTH;
struct alignas(4 * WIDTH) Part { float c[WIDTH]; };
const int first = tid % PARTS * WIDTH, level = tid / PARTS % levels;
const long long point = tid / PARTS / levels;
Part product;
_Pragma("unroll") for (int k = 0; k < 6; k++) {
    const Corners at = corners(6 * level + k, k, (const float*)wheres + 4 * point);
    const float* from = (const float*)table[4 * (6 * level + k)] + first;
    const Part a = *(const Part*)(from + at.at[0]), b = *(const Part*)(from + at.at[1]);
    const Part d = *(const Part*)(from + at.at[2]), e = *(const Part*)(from + at.at[3]);
    _Pragma("unroll") for (int c = 0; c < WIDTH; c++) {
        const float s = at.weight[0] * a.c[c] + at.weight[1] * b.c[c] + at.weight[2] * d.c[c] + at.weight[3] * e.c[c];
        product.c[c] = k ? product.c[c] * s : s; }
}
*(Part*)((float*)results + (point * levels + level) * C + first) = product;
