// Runs the GPU variant of the project's kernels on a CPU: reads launches from a file and prints their results.
// `device_text.py` writes kernels.inc and the launches, and documents the build and the comparison.
//
// A block has 128 threads, in warps of 32. Without THREADS each thread is a fiber with its own stack, and fibers switch
// at votes, shuffles and barriers. That is fast and deterministic, and detects a barrier that not all threads reach.
// With THREADS each is a system thread, for the thread sanitizer. Blocks run one after another, because shared memory is
// static.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>
#ifdef THREADS
#include <barrier>
#include <thread>
#else
#include <ucontext.h>
#endif

constexpr int BLOCK = 128, WARP = 32;
struct alignas(16) float4 { float x, y, z, w; };

#ifdef THREADS
thread_local int tid_now;
struct Meeting {
    std::barrier<> all{BLOCK}, warp[4] = {std::barrier<>(WARP), std::barrier<>(WARP), std::barrier<>(WARP),
                                          std::barrier<>(WARP)};
};
std::unique_ptr<Meeting> meeting;
static void meet_block() { meeting->all.arrive_and_wait(); }
static void meet_warp() { meeting->warp[tid_now / WARP].arrive_and_wait(); }
#else
int tid_now;
enum { RUNS, AT_WARP, AT_BLOCK, ENDED };
struct Fiber { ucontext_t at; int state; };
static Fiber fibers[BLOCK];
static ucontext_t home;
static void wait_as(int state) { fibers[tid_now].state = state; swapcontext(&fibers[tid_now].at, &home); }
static void meet_block() { wait_as(AT_BLOCK); }
static void meet_warp() { wait_as(AT_WARP); }
#endif

static int votes[BLOCK];
static float values[BLOCK];
static bool vote(bool mine) {
    votes[tid_now] = mine;
    meet_warp();
    bool any = false;
    for (int i = 0; i < WARP; i++) any |= votes[tid_now / WARP * WARP + i] != 0;
    meet_warp();
    return any;
}
static float swapped(float mine, int mask) {
    values[tid_now] = mine;
    meet_warp();
    const float its = values[tid_now ^ mask];
    meet_warp();
    return its;
}
template <class To, class From> static To same_bits(From x) { To y; memcpy(&y, &x, sizeof y); return y; }
static void add(float* at, float value) {
    auto* place = (std::atomic<float>*)at;
    float before = place->load(std::memory_order_relaxed);
    while (!place->compare_exchange_weak(before, before + value, std::memory_order_relaxed)) {}
}
static void add(unsigned long long* at, unsigned long long value) {
    ((std::atomic<unsigned long long>*)at)->fetch_add(value, std::memory_order_relaxed);
}
static void raise_to(int* at, int value) {
    auto* place = (std::atomic<int>*)at;
    int before = place->load(std::memory_order_relaxed);
    while (before < value && !place->compare_exchange_weak(before, value, std::memory_order_relaxed)) {}
}

#define __shared__ static
#define __any_sync(mask, x) vote(x)
#define __shfl_xor_sync(mask, v, lanes) swapped(v, lanes)
#define __fdividef(a, b) ((a) / (b))
#define __float_as_int same_bits<int, float>
#define __int_as_float same_bits<float, int>
#define atomicAdd add
#define atomicMax raise_to
namespace wp { using int64 = long long; using std::pow; using std::sqrt; }
#define SAME(flag) __atomic_store_n(&flag, 1, __ATOMIC_RELAXED)
#define asm(text) (y = exp2f(x))
#define WP_TILE_THREAD_IDX tid_now
#define WP_TILE_SYNC() meet_block()
#define __CUDA_ARCH__ 890
using Kernel = void (*)(const uint64_t*, int);
#include "kernels.inc"
#undef asm

static Kernel kernel_now;
static std::vector<uint64_t> values_now;
static int block_now, tasks_now;
static void run_task(int task) { if (task < tasks_now) kernel_now(values_now.data(), task); }

#ifdef THREADS
static bool run_block() {
    meeting = std::make_unique<Meeting>();
    std::vector<std::thread> threads;
    for (int t = 0; t < BLOCK; t++)
        threads.emplace_back([t] {
            tid_now = t;
            run_task(block_now * BLOCK + t);
            meeting->warp[t / WARP].arrive_and_drop();
            meeting->all.arrive_and_drop();
        });
    for (auto& thread : threads) thread.join();
    return true;
}
#else
constexpr size_t STACK = 128 << 10;
static void begin() {
    run_task(block_now * BLOCK + tid_now);
    fibers[tid_now].state = ENDED;
    swapcontext(&fibers[tid_now].at, &home);
}
static bool all_of(int first, int count, int state) {
    for (int i = first; i < first + count; i++) if (fibers[i].state != state && fibers[i].state != ENDED) return false;
    return true;
}
static bool run_block() {
    static std::vector<char> stacks(BLOCK * STACK);
    for (int t = 0; t < BLOCK; t++) {
        getcontext(&fibers[t].at);
        fibers[t].at.uc_stack.ss_sp = stacks.data() + t * STACK;
        fibers[t].at.uc_stack.ss_size = STACK;
        fibers[t].at.uc_link = &home;
        makecontext(&fibers[t].at, begin, 0);
        fibers[t].state = RUNS;
    }
    for (;;) {
        for (tid_now = 0; tid_now < BLOCK; tid_now++)
            if (fibers[tid_now].state == RUNS) swapcontext(&home, &fibers[tid_now].at);
        if (all_of(0, BLOCK, ENDED)) return true;
        bool moved = false;
        for (int first = 0; first < BLOCK; first += WARP) {
            // A vote or shuffle needs all 32 lanes, so it never completes after one has ended.
            bool met = true;
            for (int i = first; i < first + WARP; i++) met &= fibers[i].state == AT_WARP;
            for (int i = first; met && i < first + WARP; i++) fibers[i].state = RUNS;
            moved |= met;
        }
        if (!moved && all_of(0, BLOCK, AT_BLOCK)) {
            for (auto& fiber : fibers) if (fiber.state == AT_BLOCK) fiber.state = RUNS;
            moved = true;
        }
        if (!moved) return false;
    }
}
#endif

static FILE* file;
static void take(void* into, size_t bytes) {
    if (bytes && fread(into, 1, bytes, file) != bytes) { fprintf(stderr, "the launches end too early\n"); exit(2); }
}

// Memory reached by a pointer: its address when the launch was recorded, and its address now.
struct Region {
    char name[32];
    int kind;  // 1: floats, 2: a table with addresses among its words
    uint64_t was;
    void* at = nullptr;
    std::vector<char> want;
};
static std::vector<Region> regions;
static uint64_t moved(uint64_t address) {
    for (auto& region : regions) if (region.was == address) return (uint64_t)region.at;
    return address;
}
static void move_words(void* table, size_t bytes) {
    for (size_t i = 0; i < bytes / 8; i++) ((uint64_t*)table)[i] = moved(((uint64_t*)table)[i]);
}

// Format of a launch: kernel, threads; its values, each with a pointer flag; then its memory regions: name, kind,
// address, size, content before and after on Warp's cpu device.
int main(int argc, char** argv) {
    file = fopen(argv[1], "rb");
    const int most = argc > 2 ? atoi(argv[2]) : 1 << 30;
    int launches, bad = 0;
    take(&launches, 4);
    for (int l = 0; l < launches; l++) {
        char name[64];
        int threads, values, count;
        take(name, 64); take(&threads, 4); take(&values, 4);
        std::vector<int> points(values);
        values_now.resize(values);
        for (int i = 0; i < values; i++) { take(&points[i], 4); take(&values_now[i], 8); }
        take(&count, 4);
        regions.assign(count, {});
        for (auto& region : regions) {
            int64_t bytes;
            take(region.name, 32); take(&region.kind, 4); take(&region.was, 8); take(&bytes, 8);
            // Exactly as large as the tensor, so that the address sanitizer detects accesses beyond it.
            if (posix_memalign(&region.at, 16, bytes ? bytes : 1)) return 2;
            take(region.at, bytes);
            region.want.resize(bytes);
            take(region.want.data(), bytes);
        }
        for (auto& region : regions) if (region.kind == 2) {
            move_words(region.at, region.want.size()); move_words(region.want.data(), region.want.size()); }
        for (int i = 0; i < values; i++) if (points[i]) values_now[i] = moved(values_now[i]);
        kernel_now = nullptr;
        const int blocks = (threads + BLOCK - 1) / BLOCK;
        for (auto& entry : TABLE) if (!strcmp(entry.name, name)) {
            kernel_now = entry.run;
            tasks_now = entry.blocks ? blocks * BLOCK : threads;
            if (entry.blocks) fill(values_now.data()); }
        if (!kernel_now) { fprintf(stderr, "no kernel %s\n", name); return 2; }
        bool whole = blocks <= most, met = true;
        const int count_now = std::min(blocks, most);  // evenly spaced if not all blocks run
        for (int i = 0; i < count_now && met; i++) { block_now = (int64_t)i * blocks / count_now; met = run_block(); }
        printf("{\"kernel\": \"%s\", \"blocks\": %d, \"whole\": %s, \"met\": %s, \"differs\": {", name, blocks,
               whole ? "true" : "false", met ? "true" : "false");
        bool first = true;
        for (auto& [label, kind, was, at, want] : regions) {
            if (!whole || !met || want.empty() || !memcmp(at, want.data(), want.size())) continue;
            double off = 0.0, norm = 0.0;
            const size_t words = want.size() / 4;
            size_t other = 0;
            for (size_t j = 0; j < words; j++) {
                float x, y;
                memcpy(&x, (char*)at + 4 * j, 4); memcpy(&y, want.data() + 4 * j, 4);
                other += memcmp(&x, &y, 4) != 0;
                if (std::isnan(x) && std::isnan(y)) continue;
                const double gap = x == y ? 0.0 : std::isfinite(x) && std::isfinite(y) ? double(x) - y : 1e9;
                off += gap * gap;
                norm += std::isfinite(y) ? double(y) * y : 0.0;
            }
            printf("%s\"%s\": [%zu, %zu, %.3e]", first ? "" : ", ", label, other, words,
                   kind == 1 ? std::min(sqrt(off / std::max(norm, 1e-30)), 1e9) : 1e9);
            first = false;
        }
        printf("}}\n");
        fflush(stdout);
        bad += !met;
        for (auto& region : regions) free(region.at);
    }
    return bad ? 1 : 0;
}
