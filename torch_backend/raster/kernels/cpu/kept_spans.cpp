// Tile spans of one slot as in `spans.cpp`, from stored pairs if any: (tile row, first column | last column << 16).
#include "spans.cpp"

auto kept_spans = FN(int slot, auto&& visit) -> void {
    if (P.span_start[slot] < 0) { spans(slot, visit); return; }
    const int* s = P.span + 2 * (long long)P.span_start[slot];
    for (int i = 0; i < P.span_count[slot]; i++) visit(s[2 * i], s[2 * i + 1] & 0xffff, s[2 * i + 1] >> 16);
};
