// Stage 2: each worker counts the hits of every tile in its stretch.
#include "kept_spans.cpp"
#include "stretch.cpp"

for (long long t = 0; t < tiles; t++) mine[t] = 0;
for (long long rank = from; rank < to; rank++)
    kept_spans(P.order2[rank], FN(int ty, int c0, int c1) -> void {
        for (int c = c0; c <= c1; c++) mine[ty * P.tiles_x + c]++; });
