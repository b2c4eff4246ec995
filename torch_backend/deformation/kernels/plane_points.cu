// Gradient of the points on a GPU, with recomputed samples. One thread per point, so that no atomics are needed.

#include "plane_corners.cu"
const float* pull = (const float*)pulls + (long long)tid * levels * C;
float along[4] = {0.f, 0.f, 0.f, 0.f};
for (int level = 0; level < levels; level++) {
    Corners at[6];
    const float* from[6];
    _Pragma("unroll") for (int k = 0; k < 6; k++) {
        at[k] = corners(6 * level + k, k, (const float*)wheres + 4 * (long long)tid);
        from[k] = (const float*)table[4 * (6 * level + k)]; }
    for (int c = 0; c < C; c++) {
        float s[6], sx[6], sy[6], after[6];
        _Pragma("unroll") for (int k = 0; k < 6; k++) {
            const float a = from[k][at[k].at[0] + c], b = from[k][at[k].at[1] + c];
            const float d = from[k][at[k].at[2] + c], e = from[k][at[k].at[3] + c];
            s[k] = at[k].weight[0] * a + at[k].weight[1] * b + at[k].weight[2] * d + at[k].weight[3] * e;
            sx[k] = at[k].dx * ((1 - at[k].fy) * (b - a) + at[k].fy * (e - d));
            sy[k] = at[k].dy * ((1 - at[k].fx) * (d - a) + at[k].fx * (e - b)); }
        after[5] = 1.f;
        _Pragma("unroll") for (int k = 4; k >= 0; k--) after[k] = after[k + 1] * s[k + 1];
        float before = pull[level * C + c];
        _Pragma("unroll") for (int k = 0; k < 6; k++) {
            along[AXES[k][0]] += before * after[k] * sx[k];
            along[AXES[k][1]] += before * after[k] * sy[k];
            before *= s[k]; }
    }
}
for (int axis = 0; axis < 4; axis++) ((float*)results)[4 * (long long)tid + axis] = along[axis];
