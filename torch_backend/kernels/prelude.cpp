// What every snippet of `native.py` begins with, after its parameter block P.

typedef float F __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED); };
