// The worker's stretch of the depth order. Stages 2 to 4 are a stable counting sort of the hits into tiles.

long long tiles = P.tiles_x * P.tiles_y;
long long from = P.visible * worker / P.workers, to = P.visible * (worker + 1) / P.workers;
int* mine = P.histogram + worker * tiles;
