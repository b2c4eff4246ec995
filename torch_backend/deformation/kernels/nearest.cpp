// Nearest points of each query, nearest first.

// queries: [count][D]; points: [D][padded], the padding far away; index: [count][K].
const long long D = P.dims, K = P.neighbours, Q = P.count, N = P.padded;
for (long long first; (first = take() * 256) < Q;) {
    long long last = first + 256 < Q ? first + 256 : Q;
    for (long long m = first; m < last; m++) {
        const float* query = P.queries + m * D;
        long long* index = (long long*)P.index + m * K;
        float best[@MOST@];
        for (long long k = 0; k < K; k++) { best[k] = __builtin_inff(); index[k] = k; }
        for (long long n = 0; n < N; n += 16) {
            F squared = (F)0.f;
            for (long long d = 0; d < D; d++) { F gap = load(P.points + d * N + n) - query[d]; squared += gap * gap; }
            if (!(__builtin_reduce_min(squared) < best[K - 1])) continue;
            float lanes[16]; store(lanes, squared);
            for (int l = 0; l < 16; l++) if (lanes[l] < best[K - 1]) {
                long long k = K - 1;
                for (; k > 0 && best[k - 1] > lanes[l]; k--) { best[k] = best[k - 1]; index[k] = index[k - 1]; }
                best[k] = lanes[l]; index[k] = n + l;
            }
        }
    }
}
