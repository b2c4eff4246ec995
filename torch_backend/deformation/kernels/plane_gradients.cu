// Gradient of the planes on a GPU, with recomputed samples. One thread per channel, level and point.

// A point's channels are neighbours, so that what a warp adds at a node is one piece of memory.
#if defined(__CUDA_ARCH__)
#define ADD(p, v) atomicAdd(p, v)
#else
#define ADD(p, v) (*(p) += (v))
#endif
#include "plane_corners.cu"
const int c = tid % C, level = tid / C % levels;
const long long point = tid / C / levels;
Corners at[6];
float s[6], after[6];
_Pragma("unroll") for (int k = 0; k < 6; k++) {
    at[k] = corners(6 * level + k, k, (const float*)wheres + 4 * point);
    const float* from = (const float*)table[4 * (6 * level + k)] + c;
    s[k] = at[k].weight[0] * from[at[k].at[0]] + at[k].weight[1] * from[at[k].at[1]]
         + at[k].weight[2] * from[at[k].at[2]] + at[k].weight[3] * from[at[k].at[3]];
}
after[5] = 1.f;
_Pragma("unroll") for (int k = 4; k >= 0; k--) after[k] = after[k + 1] * s[k + 1];
float before = ((const float*)pulls)[tid];
_Pragma("unroll") for (int k = 0; k < 6; k++) {
    float* to = (float*)results + table[4 * (6 * level + k) + 3] + c;
    const float pull = before * after[k];
    _Pragma("unroll") for (int q = 0; q < 4; q++) ADD(to + at[k].at[q], at[k].weight[q] * pull);
    before *= s[k];
}
