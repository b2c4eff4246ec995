// Stage 5: sum and maximum of the weights of every visible Gaussian over its tiles. Parallel over chunks.

for (long long chunk; (chunk = take()) < P.chunks;)
    for (long long s = chunk * @CHUNK@, e = s + P.chunk_count[chunk]; s < e; s++) {
        float total = 0.f, largest = 0.f;
        const float* h = P.hit_weight + 2 * (long long)P.hit_start[s];
        for (int j = 0; j < P.hit_count[s]; j++) { total += h[2 * j]; largest = smax(largest, h[2 * j + 1]); }
        P.weight_sum[P.index[s]] = total; P.weight_max[P.index[s]] = largest;
    }
