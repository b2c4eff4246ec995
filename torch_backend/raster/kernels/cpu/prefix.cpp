// Stage 3 (one worker): computes where the hits of each worker and tile begin.

int at = 0; long long tiles = P.tiles_x * P.tiles_y;
for (long long t = 0; t < tiles; t++) {
    P.tile_start[t] = at;
    for (long long w = 0; w < P.workers; w++) {
        int c = P.histogram[w * tiles + t]; P.histogram[w * tiles + t] = at; at += c; }
}
P.tile_start[tiles] = at;
