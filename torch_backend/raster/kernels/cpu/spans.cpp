// Tile spans of one slot: calls visit(tile row, first tile column, last tile column).

auto spans = FN(long long slot, auto&& visit) -> void {
    const float* r = P.record + slot * P.record_stride; const float* a = P.aux + slot * 4;
    float mx = r[0], my = r[1], A = r[2], kk = r[3], R = r[4], lop = r[5], hx = a[0], dyr = a[2];
    float W = (float)P.width, H = (float)P.height;
    int y0 = first_at(r[6] - 0.5f, H), y1 = last_at(r[7] - 0.5f, H - 1.f);
    if (y0 > y1) return;
    auto half = FN(float dy) -> float { return ssqrt(smax((lop + R * dy * dy - PMIN) / -A, 0.f)); };
    for (int ty = y0 >> 4; ty <= y1 >> 4; ty++) {
        float lo = smax(r[6], ty * 16 + 0.5f) - my, hi = smin(r[7], ty * 16 + 15.5f) - my;
        float right = dyr < lo ? kk * lo + half(lo) : dyr > hi ? kk * hi + half(hi) : hx;
        float left = -dyr < lo ? kk * lo - half(lo) : -dyr > hi ? kk * hi - half(hi) : -hx;
        int c0 = first_at(mx + left - 0.5f, W), c1 = last_at(mx + right - 0.5f, W - 1.f);
        if (c0 <= c1) visit(ty, c0 >> 4, c1 >> 4);
    } };
