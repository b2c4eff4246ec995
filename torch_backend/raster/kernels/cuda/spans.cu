// Tile spans of one slot: its ellipse's extent, its tile rows, and its pixel columns in one of them.

auto first_at = [&](float v, float limit) -> int {
    v = smin(smax(v, 0.f), limit); int t = (int)v; return t + ((float)t < v); };
auto last_at = [&](float v, float limit) -> int { return v < 0.f ? -1 : (int)smin(v, limit); };
struct Extent { float mx, my, A, kk, R, lop, y0, y1, hx, dyr; };
auto extent = [&](long long slot) -> Extent {
    const float4* r = (const float4*)(P.record + slot * P.record_stride);
    const float4 a = r[0], b = r[1];
    return Extent{a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, P.aux[2 * slot], P.aux[2 * slot + 1]}; };
auto first_row = [&](const Extent& e) -> int { return first_at(e.y0 - 0.5f, (float)P.height) >> 4; };
auto last_row = [&](const Extent& e) -> int {
    int y0 = first_at(e.y0 - 0.5f, (float)P.height), y1 = last_at(e.y1 - 0.5f, (float)P.height - 1.f);
    return y0 > y1 ? -1 : y1 >> 4; };
// First and last pixel column in tile row ty.
auto columns_of = [&](const Extent& e, int ty, int& c0, int& c1) -> void {
    float lo = smax(e.y0, ty * 16 + 0.5f) - e.my, hi = smin(e.y1, ty * 16 + 15.5f) - e.my;
    auto half = [&](float d) -> float { return sqrtf(smax((e.lop + e.R * d * d - PMIN) / -e.A, 0.f)); };
    float right = e.dyr < lo ? e.kk * lo + half(lo) : e.dyr > hi ? e.kk * hi + half(hi) : e.hx;
    float left = -e.dyr < lo ? e.kk * lo - half(lo) : -e.dyr > hi ? e.kk * hi - half(hi) : -e.hx;
    c0 = first_at(e.mx + left - 0.5f, (float)P.width); c1 = last_at(e.mx + right - 0.5f, (float)P.width - 1.f); };
