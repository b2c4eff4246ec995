// Stage 1 (one worker): computes the first hit of every slot, and sorts slots with hits by depth (stable radix sort).

long long total = 0, n = 0;
for (long long c = 0; c < P.chunks; c++)
    for (long long s = c * @CHUNK@, e = s + P.chunk_count[c]; s < e; s++) {
        P.hit_start[s] = (int)total;
        if (P.hit_count[s] == 0) continue;
        total += P.hit_count[s];
        P.order[n] = (int)s; P.key[n] = __builtin_bit_cast(int, P.aux[s * 4 + 3]); n++;
    }
P.visible = n; P.hits = total;
int *ka = P.key, *kb = P.key2, *oa = P.order, *ob = P.order2;
for (int shift = 0; shift < 33; shift += 11) {
    int bins[2048] = {};
    for (long long i = 0; i < n; i++) bins[((unsigned)ka[i] >> shift) & 2047]++;
    int at = 0;
    for (int b = 0; b < 2048; b++) { int c = bins[b]; bins[b] = at; at += c; }
    for (long long i = 0; i < n; i++) {
        int place = bins[((unsigned)ka[i] >> shift) & 2047]++;
        kb[place] = ka[i]; ob[place] = oa[i];
    }
    int* t = ka; ka = kb; kb = t; t = oa; oa = ob; ob = t;
}
