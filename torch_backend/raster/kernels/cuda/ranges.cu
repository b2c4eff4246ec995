// One thread per entry of the sorted list: finds where each tile begins and ends in the list.

const long long at = task, tiles = (long long)P.tiles_x * P.tiles_y * P.cameras;
if (at == 0) {
    const long long wanted = P.ends[(long long)P.n * P.cameras - 1];
    P.hits[0] = wanted; P.hits[1] = P.capacity;
    if (wanted > P.demand[0]) P.demand[0] = wanted;
}
if (at >= P.capacity) return;
auto key = [&](long long i) -> int { return P.wide ? ((int*)P.sorted_key)[i] : (int)((short*)P.sorted_key)[i]; };
const int tile = key(at);
if (tile >= tiles) return;
P.sorted_slot[at] = P.hit_slot[P.permutation[at]];
if (at == 0 || key(at - 1) != tile) P.tile_start[tile] = (int)at;
if (at == P.capacity - 1 || key(at + 1) != tile) P.tile_end[tile] = (int)at + 1;
