// One thread per slot: project, cull, compute the colour, count tile hits.
#include "spans.cu"
#include "twelve.cu"

const long long slot = task;
if (slot >= (long long)P.n * P.cameras) return;
const int camera = task / P.n;
const long long g = slot - (long long)camera * P.n;
P.radii[slot] = 0; P.means2d[2 * slot] = 0.f; P.means2d[2 * slot + 1] = 0.f;
P.hit_count[slot] = 0; P.depth_key[slot] = 0x7fffffff;
#include "camera.cu"
#include "gaussian.cu"

bool ok = finite(X) && finite(Y) && finite(Z) && finite(qw) && finite(qx) && finite(qy) && finite(qz);
ok = ok && r0 <= @LOG_SCALE_MAX@f && r1 <= @LOG_SCALE_MAX@f && r2 <= @LOG_SCALE_MAX@f && logit == logit;
ok = ok && qmax > @QUAT_MIN@f && fx > 0.f && fy > 0.f && finite(fx) && finite(fy) && finite(cx) && finite(cy);
const float pz = V[8] * X + V[9] * Y + V[10] * Z + V[11];
if (!(ok && pz > P.near && finite(pz))) return;
#include "projection.cu"

float lop = -log2f(1.f + expf(-smin(smax(logit, -80.f), 80.f)));
if (P.antialiased) lop += 0.5f * log2f(smax(dr / det, @COMPENSATION2_MIN@f));
float level = smax(lop - PMIN, 0.f) * (2.f * LN2), hx = sqrtf(level * xx), hy = sqrtf(level * yy);
ok = level > 0.f && xx + yy < @VARIANCE_MAX@f && mx + hx >= 0.5f && mx - hx <= W - 0.5f;
if (!(ok && my + hy >= 0.5f && my - hy <= H - 0.5f)) return;
float* channel = P.record + slot * P.record_stride + @HEAD@;
if (P.n_sh) {
#include "direction.cu"

    float c0 = 0.5f, c1 = 0.5f, c2 = 0.5f, f[12];
    const float* from = P.sh + g * P.sh_stride;
@HARMONICS@
    if (!(finite(c0) && finite(c1) && finite(c2))) return;
    *(float4*)channel = float4{smax(c0, 0.f), smax(c1, 0.f), smax(c2, 0.f), pz};
    channel += 3;
}
for (int c = 0; c < P.n_colors; c++) {
    float value = P.colors[g * P.n_colors + c];
    ok = ok && finite(value); channel[c] = value; }
if (!ok) return;
if (P.want_depth) channel[P.n_colors] = pz;
// Tiles read records by four floats.
for (int c = P.n_sh + P.n_colors + P.want_depth; c & 3; c++) channel[c - P.n_sh] = 0.f;
const Extent e = {mx, my, -0.5f * LOG2E * yy / det, xy / yy, -0.5f * LOG2E / yy, lop, my - hy, my + hy, hx,
                  xy / xx * hx};
float4* head = (float4*)(P.record + slot * P.record_stride);
head[0] = float4{e.mx, e.my, e.A, e.kk}; head[1] = float4{e.R, e.lop, e.y0, e.y1};
P.aux[2 * slot] = e.hx; P.aux[2 * slot + 1] = e.dyr;
int hits = 0;
for (int ty = first_row(e), end = last_row(e); ty <= end; ty++) {
    int c0, c1; columns_of(e, ty, c0, c1);
    if (c0 <= c1) hits += (c1 >> 4) - (c0 >> 4) + 1; }
float half = 0.5f * (xx + yy), diff = 0.5f * (xx - yy);
float radius = smin(sqrtf((half + sqrtf(diff * diff + xy * xy)) * level), 1.07e9f);
int whole = (int)radius;
P.radii[slot] = whole + ((float)whole < radius);
P.means2d[2 * slot] = mx; P.means2d[2 * slot + 1] = my;
P.hit_count[slot] = hits;
if (hits) P.depth_key[slot] = bits(pz);
