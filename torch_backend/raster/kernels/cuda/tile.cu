// Common beginning of both blending stages: the pixels of a tile.
#include "shuffle.cu"

enum { NCH = @NCH@, SLOTS = 2, STRIDE = (@HEAD@ + NCH + 3) / 4 * 4 };
SHARED __attribute__((aligned(16))) float batch[@BLOCK@ * STRIDE];
SHARED int live, flags[@BLOCK@];
const int per_camera = P.tiles_x * P.tiles_y, tile = (int)(task / @BLOCK@), camera = tile / per_camera;
const int tx = (tile - camera * per_camera) % P.tiles_x, ty = (tile - camera * per_camera) / P.tiles_x;
const long long total = (long long)P.n * P.cameras;
const bool listed = total == 0 || P.ends[total - 1] <= P.capacity;
long long at = listed ? P.tile_start[tile] : 0;
const long long stop = listed ? P.tile_end[tile] : total;
const float x0 = tx * 16.f, y0 = ty * 16.f, column = (lane & 15) + 0.5f;
const int row = warp * 4 + (lane >> 4);
const long long corner = ((long long)camera * P.height + ty * 16 + row) * P.width + tx * 16 + (lane & 15);
float T[SLOTS];
bool inside[SLOTS];
// Pixels outside the image start without transmittance: they are finished from the beginning.
UNROLL for (int s = 0; s < SLOTS; s++) {
    inside[s] = tx * 16 + (lane & 15) < P.width && ty * 16 + row + 2 * s < P.height;
    T[s] = inside[s] ? 1.f : 0.f; }
