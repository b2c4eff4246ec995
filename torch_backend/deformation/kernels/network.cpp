// HexPlane network: a trunk and two-layer heads. Stages: forward (0), backward (1), sums of the gradients (2).

// IN features, WIDTH units. x, dx: [M][IN]. Weights as torch has them, [outputs][inputs], and turned, [inputs][outputs]:
// trunk [WIDTH][IN], trunk_t; a head's layer hidden [HEADS][WIDTH][WIDTH], hidden_t; its last one out
// [HEADS][PAD][WIDTH], out_t [HEADS][WIDTH][PAD], rows beyond its sizes[head] outputs 0. Biases: trunk_b, hidden_b,
// out_b [HEADS][PAD]. results, pulls: [HEADS] addresses of [M][sizes[head]], values and their gradients.
// partial: [units][TOTAL], a unit's share of the gradients: of trunk, trunk_b; then per head of hidden, hidden_b, out_t,
// out_b. sums: [TOTAL].
// A tile's rows beyond M are zeros on the way in, whose pulls are 0, and are never written.
const int IN = @IN@, WIDTH = @WIDTH@, HEADS = @HEADS@, PAD = 16, TILE = @TILE@, WV = WIDTH / 16;
const int HEAD = WIDTH * WIDTH + WIDTH + WIDTH * PAD + PAD, TOTAL = WIDTH * IN + WIDTH + HEADS * HEAD;
typedef int I __attribute__((ext_vector_type(16)));
#define UNROLL _Pragma("clang loop unroll(full)")
auto fma = FN(F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
// 2^p: nearest integer by the rounding of a large addend, degree-5 polynomial for the rest (relative error 2e-7).
#include "../../kernels/exp2.cpp"
// A block of a product is as large as its sums fit the registers: 32 of 16 lanes, or 16 of 8 of which one F takes two.
#ifdef __AVX512F__
const int BLOCK = 4, NARROW = 8;
#else
const int BLOCK = 1, NARROW = 4;
#endif
const long long M = P.count;
const long long* sizes = (const long long*)P.sizes;
float* const* results = (float* const*)P.results;
const float* const* pulls = (const float* const*)P.pulls;
// C [rows][columns] = start + A B, or C + A B without a start: A's element (r, k) at r * by_row + k * by_k, B and C row
// by row, `columns` wide. R rows (the type of `tag`) and V vectors at a time; both must divide what there is.
auto piece = FN(auto* tag, const float* A, long long by_row, long long by_k, const float* B, long long K, float* C,
                long long columns, const float* start) -> void {
    constexpr int R = sizeof(*tag) / sizeof(**tag), V = sizeof(**tag);
    F sum[R][V];
    UNROLL for (int r = 0; r < R; r++) UNROLL for (int v = 0; v < V; v++)
        sum[r][v] = load(start ? start + 16 * v : C + r * columns + 16 * v);
    for (long long k = 0; k < K; k++) {
        F b[V];
        UNROLL for (int v = 0; v < V; v++) b[v] = load(B + k * columns + 16 * v);
        UNROLL for (int r = 0; r < R; r++) {
            F a = (F)A[r * by_row + k * by_k];
            UNROLL for (int v = 0; v < V; v++) sum[r][v] = fma(a, b[v], sum[r][v]); }
    }
    UNROLL for (int r = 0; r < R; r++) UNROLL for (int v = 0; v < V; v++) store(C + r * columns + 16 * v, sum[r][v]); };
auto product = FN(long long rows, const float* A, long long by_row, long long by_k, const float* B, long long K,
                  float* C, long long columns, const float* start) -> void {
    for (long long at = 0; at < columns;) {
        long long wide = columns - at >= 16 * BLOCK ? BLOCK : 1;
        for (long long r = 0; r < rows; r += wide == 1 ? NARROW : 4) {
            const float* from = start ? start + at : start;
            if (wide == 1) piece((char(*)[NARROW][1])0, A + r * by_row, by_row, by_k, B + at, K, C + r * columns + at, columns, from);
            else piece((char(*)[4][BLOCK])0, A + r * by_row, by_row, by_k, B + at, K, C + r * columns + at, columns, from);
        }
        at += 16 * wide;
    } };
// SiLU of g, and its slope.
auto bend = FN(F g, F& slope) -> F {
    F p = g * -1.44269504088896f;
    p = p < 125.f ? p : (F)125.f; p = p > -125.f ? p : (F)-125.f;
    F share = 1.f / (1.f + exp2v(p)), value = g * share;
    slope = fma(share, 1.f - value, value); return value; };
auto columns_added = FN(const float* A, long long columns, float* to) -> void {
    for (long long at = 0; at < columns; at += 16) {
        F sum = load(to + at);
        for (int p = 0; p < TILE; p++) sum += load(A + p * columns + at);
        store(to + at, sum); } };
float edge[TILE * IN], a[TILE * WIDTH], s[TILE * WIDTH], o[TILE * PAD];
// The tile's rows of x: where they lie, or a copy with zeros behind.
auto rows_of = FN(long long first) -> const float* {
    if (first + TILE <= M) return P.x + first * IN;
    long long there = (M - first) * IN;
    __builtin_memcpy(edge, P.x + first * IN, 4 * there);
    __builtin_memset(edge + there, 0, 4 * (TILE * IN - there));
    return edge; };

if (stage == 0) for (long long first; (first = take() * TILE) < M;) {
    long long count = M - first < TILE ? M - first : TILE;
    F slope;
    product(TILE, rows_of(first), IN, 1, P.trunk_t, IN, a, WIDTH, P.trunk_b);
    for (int i = 0; i < TILE * WIDTH; i += 16) store(a + i, bend(load(a + i), slope));
    for (int h = 0; h < HEADS; h++) {
        product(TILE, a, WIDTH, 1, P.hidden_t + h * WIDTH * WIDTH, WIDTH, s, WIDTH, P.hidden_b + h * WIDTH);
        for (int i = 0; i < TILE * WIDTH; i += 16) store(s + i, bend(load(s + i), slope));
        product(TILE, s, WIDTH, 1, P.out_t + h * WIDTH * PAD, WIDTH, o, PAD, P.out_b + h * PAD);
        long long size = sizes[h];
        for (long long p = 0; p < count; p++) for (long long j = 0; j < size; j++)
            results[h][(first + p) * size + j] = o[p * PAD + j];
    }
}
if (stage == 1) for (long long unit; (unit = take()) < P.units;) {
    float slope_a[TILE * WIDTH], da[TILE * WIDTH], slope_s[TILE * WIDTH], ds[TILE * WIDTH], dx[TILE * IN];
    const float zeros[WIDTH > IN ? WIDTH : IN] = {};
    float* mine = P.partial + unit * TOTAL;
    __builtin_memset(mine, 0, 4 * TOTAL);
    long long last = (unit + 1) * P.rows < M ? (unit + 1) * P.rows : M;
    for (long long first = unit * P.rows; first < last; first += TILE) {
        long long count = last - first < TILE ? last - first : TILE;
        const float* x = rows_of(first);
        product(TILE, x, IN, 1, P.trunk_t, IN, a, WIDTH, P.trunk_b);
        for (int i = 0; i < TILE * WIDTH; i += 16) {
            F slope, value = bend(load(a + i), slope);
            store(a + i, value); store(slope_a + i, slope); store(da + i, (F)0.f); }
        for (int h = 0; h < HEADS; h++) {
            float* to = mine + WIDTH * IN + WIDTH + h * HEAD;
            long long size = sizes[h];
            product(TILE, a, WIDTH, 1, P.hidden_t + h * WIDTH * WIDTH, WIDTH, s, WIDTH, P.hidden_b + h * WIDTH);
            for (int i = 0; i < TILE * WIDTH; i += 16) {
                F slope, value = bend(load(s + i), slope);
                store(s + i, value); store(slope_s + i, slope); }
            __builtin_memset(o, 0, sizeof(o));
            for (long long p = 0; p < count; p++) for (long long j = 0; j < size; j++)
                o[p * PAD + j] = pulls[h][(first + p) * size + j];
            product(WIDTH, s, 1, WIDTH, o, TILE, to + WIDTH * WIDTH + WIDTH, PAD, nullptr);
            columns_added(o, PAD, to + WIDTH * WIDTH + WIDTH + WIDTH * PAD);
            product(TILE, o, PAD, 1, P.out + h * PAD * WIDTH, size, ds, WIDTH, zeros);
            for (int i = 0; i < TILE * WIDTH; i += 16) store(ds + i, load(ds + i) * load(slope_s + i));
            product(WIDTH, ds, 1, WIDTH, a, TILE, to, WIDTH, nullptr);
            columns_added(ds, WIDTH, to + WIDTH * WIDTH);
            product(TILE, ds, WIDTH, 1, P.hidden + h * WIDTH * WIDTH, WIDTH, da, WIDTH, nullptr);
        }
        for (int i = 0; i < TILE * WIDTH; i += 16) store(da + i, load(da + i) * load(slope_a + i));
        product(WIDTH, da, 1, WIDTH, x, TILE, mine, IN, nullptr);
        columns_added(da, WIDTH, mine + WIDTH * IN);
        product(TILE, da, WIDTH, 1, P.trunk, WIDTH, dx, IN, zeros);
        __builtin_memcpy(P.dx + first * IN, dx, 4 * count * IN);
    }
}
if (stage == 2) for (long long at; (at = take() * 1024) < TOTAL;) {
    long long last = at + 1024 < TOTAL ? at + 1024 : TOTAL;
    for (long long i = at; i < last; i += 16) {
        F sum = (F)0.f;
        for (long long unit = 0; unit < P.units; unit++) sum += load(P.partial + unit * TOTAL + i);
        store(P.sums + i, sum); }
}
