// Stage 4: writes the hits to their places in the list.
#include "kept_spans.cpp"
#include "stretch.cpp"

for (long long rank = from; rank < to; rank++) {
    int slot = P.order2[rank], place = P.hit_start[slot];
    kept_spans(slot, FN(int ty, int c0, int c1) -> void {
        for (int c = c0; c <= c1; c++) {
            int at = mine[ty * P.tiles_x + c]++;
            P.hit_slot[at] = slot; P.hit_place[at] = place++;
        } });
}
