"""Adam over all of a model's tensors in one pass: gradients checked, moments and parameters updated, ranges kept.

The mathematics is `torch.optim.Adam`'s (Kingma & Ba 2015; no weight decay, no amsgrad) and so are the names of its
state, so checkpoints fit both. A step whose gradients are not all finite changes nothing. On the CPU a compiled snippet
runs over chunks on threads; on CUDA a Warp kernel does the same per element, and nothing waits for the device.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..native import INTEGER, POINTER, Snippet, initialised_warp, launch_on

_CHUNK = 4096
"""Elements per unit of work."""
_WHOLE, _REAL = 8, 8
"""Columns of a segment's tables: addresses of p, g, m, v, elements, row width (0: no rows), first chunk, address of
the step count | rate, 1 - b1, 1 - b2, eps, low, high, rate / (1 - b1^t), 1 / sqrt(1 - b2^t). No p: only a check."""

_SOURCE = r"""
const long long CHUNK = @CHUNK@;
auto root = FN(F x) -> F { return __builtin_elementwise_sqrt(x); };
const long long* whole = (const long long*)P.whole;
for (long long chunk, s = 0; (chunk = take()) < P.chunks;) {
    while (s + 1 < P.segments && whole[(s + 1) * @WHOLE@ + 6] <= chunk) s++;
    const long long* w = whole + s * @WHOLE@;
    const float* r = P.real + s * @REAL@;
    long long first = (chunk - w[6]) * CHUNK, last = first + CHUNK < w[4] ? first + CHUNK : w[4];
    if (stage == 1 && !w[0]) continue;
    float *p = (float*)w[0], *m = (float*)w[2], *v = (float*)w[3];
    const float* g = (const float*)w[1];
    if (stage == 0) {
        // A value minus itself is 0 unless it is infinite or no number.
        F odd = (F)0.f; float rest = 0.f; long long i = first;
        for (; i + 16 <= last; i += 16) { F x = load(g + i); odd += x - x; }
        for (; i < last; i++) rest += g[i] - g[i];
        float lanes[16]; store(lanes, odd);
        for (int l = 0; l < 16; l++) rest += lanes[l];
        if (rest != 0.f) __atomic_store_n((int*)P.bad, 1, __ATOMIC_RELAXED);
        continue;
    }
    float w1 = r[1], w2 = r[2], eps = r[3], low = r[4], high = r[5], step = r[6], spread = r[7];
    auto update = FN(F G, F& M, F& V, F& X) -> void {
        M += w1 * (G - M);
        V += w2 * (G * G - V);
        X -= step * (M / (root(V) * spread + eps));
        X = X < low ? (F)low : (X > high ? (F)high : X); };
    float edge[4][16] = {};
    auto run = FN(long long i, long long count) -> void {
        if (count == 16) {
            F M = load(m + i), V = load(v + i), X = load(p + i);
            update(load(g + i), M, V, X);
            store(m + i, M); store(v + i, V); store(p + i, X);
            return; }
        for (long long l = 0; l < count; l++) {
            edge[0][l] = g[i + l]; edge[1][l] = m[i + l]; edge[2][l] = v[i + l]; edge[3][l] = p[i + l]; }
        F M = load(edge[1]), V = load(edge[2]), X = load(edge[3]);
        update(load(edge[0]), M, V, X);
        store(edge[1], M); store(edge[2], V); store(edge[3], X);
        for (long long l = 0; l < count; l++) {
            m[i + l] = edge[1][l]; v[i + l] = edge[2][l]; p[i + l] = edge[3][l]; } };
    long long width = P.visible ? w[5] : 0;
    const unsigned char* visible = (const unsigned char*)P.visible;
    for (long long i = first; i < last;) {
        // Runs of visible rows; a chunk may begin and end inside a row.
        long long end = last;
        if (width) {
            long long row = i / width;
            bool seen = visible[row];
            while (row * width < last && visible[row] == (seen ? 1 : 0)) row++;
            end = row * width < last ? row * width : last;
            if (!seen) { i = end; continue; }
        }
        for (; i + 16 <= end; i += 16) run(i, 16);
        if (i < end) { run(i, end - i); i = end; }
    }
}
"""


@functools.lru_cache(maxsize=1)
def _snippet() -> Snippet:
    source = _SOURCE.replace("@CHUNK@", str(_CHUNK)).replace("@WHOLE@", str(_WHOLE)).replace("@REAL@", str(_REAL))
    fields = {
        **dict.fromkeys(("whole", "real", "bad", "visible"), POINTER),
        **dict.fromkeys(("segments", "chunks"), INTEGER),
    }
    return Snippet("adam", fields, source)


def warm_up() -> None:
    """Compile, or load from the cache, from the main thread."""
    _snippet().warm_up()


_ELEMENT = r"""
// stage 0: check one gradient; 1: advance one segment's step count; 2: update one element.
const wp::int64* whole = (const wp::int64*)wholes; float* real = (float*)reals; int* bad = (int*)flag;
if (stage == 1) {
    const wp::int64* w = whole + tid * @WHOLE@; float* r = real + tid * @REAL@; float* t = (float*)w[7];
    if (bad[0] || !t) return;
    t[0] += 1.f;
    r[6] = (float)(r[0] / (1.0 - wp::pow(1.0 - (double)r[1], (double)t[0])));
    r[7] = (float)(1.0 / wp::sqrt(1.0 - wp::pow(1.0 - (double)r[2], (double)t[0])));
    return; }
wp::int64 chunk = tid / @CHUNK@, s = 0, high = segments;
while (high - s > 1) {
    wp::int64 middle = (s + high) / 2;
    if (whole[middle * @WHOLE@ + 6] <= chunk) s = middle; else high = middle; }
const wp::int64* w = whole + s * @WHOLE@; const float* r = real + s * @REAL@;
wp::int64 i = (chunk - w[6]) * @CHUNK@ + tid % @CHUNK@;
if (i >= w[4]) return;
const float* g = (const float*)w[1];
if (stage == 0) { float odd = g[i] - g[i]; if (!(odd == 0.f)) bad[0] = 1; return; }
if (bad[0] || !w[0] || (w[5] > 0 && visible && !((const unsigned char*)visible)[i / w[5]])) return;
float *p = (float*)w[0], *m = (float*)w[2], *v = (float*)w[3];
float M = m[i] + r[1] * (g[i] - m[i]), V = v[i] + r[2] * (g[i] * g[i] - v[i]);
float X = p[i] - r[6] * (M / (wp::sqrt(V) * r[7] + r[3]));
m[i] = M; v[i] = V; p[i] = X < r[4] ? r[4] : (X > r[5] ? r[5] : X);
"""


@functools.lru_cache(maxsize=1)
def _kernel() -> Any:
    """The Warp kernel of `_ELEMENT`, for CUDA; it runs on Warp's cpu device too, where tests compare it."""
    wp = initialised_warp()
    source = _ELEMENT.replace("@CHUNK@", str(_CHUNK)).replace("@WHOLE@", str(_WHOLE)).replace("@REAL@", str(_REAL))

    def adam_element(
        wholes: wp.uint64, reals: wp.uint64, flag: wp.uint64, visible: wp.uint64, segments: wp.int32, stage: wp.int32,
        tid: wp.int32,
    ): ...  # fmt: skip

    native = wp.func_native(source)(adam_element)

    def entry(
        wholes: wp.uint64, reals: wp.uint64, flag: wp.uint64, visible: wp.uint64, segments: wp.int32, stage: wp.int32
    ):
        native(wholes, reals, flag, visible, segments, stage, wp.tid())

    module = wp.get_module(f"{__name__}.kernel")
    return wp.Kernel(entry, key="adam", module=module, options={"enable_backward": False})


class FusedAdam(torch.optim.Optimizer):
    """Adam as `torch.optim.Adam(params, lr, betas, eps)`, for float32 parameters on one device.

    A group may say `rows=True`: its parameters' first axis is the Gaussian's, and `step(visible=...)` skips the rows
    that are not visible, moments included; and `clamp=(low, high)`: the range its parameters are kept in.
    `applied` is 0-dim bool on the parameters' device: whether the last step was carried out.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        threads: int | None = None,
        kernel: bool | None = None,
    ) -> None:
        """`threads`: workers on the CPU (default: all cores). `kernel`: use the Warp kernel (default: not on a CPU)."""
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "rows": False, "clamp": (-math.inf, math.inf)})
        self.threads, self.kernel = threads, kernel
        self.applied = torch.tensor(True, device="cpu")

    @torch.no_grad()
    def step(self, closure: None = None, *, visible: Tensor | None = None, guard: Sequence[Tensor] = ()) -> None:  # type: ignore[override]
        """Updates every parameter that has a gradient, unless a gradient or a value of `guard` is not finite.

        visible: bool [N], the Gaussians whose rows are updated (None: all). ValueError for parameters that are not
        dense float32, or a `closure`.
        """
        if closure is not None:
            raise ValueError("FusedAdam takes no closure")
        found = [(p, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        if not found:
            return
        device = found[0][0].device
        kernel = device.type != "cpu" if self.kernel is None else self.kernel
        whole, real, kept, chunks = [], [], [], 0
        for value in guard:
            value = value.detach().float().reshape(-1)
            kept.append(value)
            whole += (0, value.data_ptr(), 0, 0, value.numel(), 0, chunks, 0)
            real += (0.0,) * _REAL
            chunks += -(-value.numel() // _CHUNK)
        steps = []
        for p, group in found:
            if p.dtype != torch.float32 or p.device != device:
                raise ValueError(f"FusedAdam takes float32 parameters on one device, got {p.dtype} on {p.device}")
            m, v, t = self._state_of(p)
            grad = p.grad if p.grad.stride() == p.stride() else torch.empty_like(p).copy_(p.grad)
            kept.append(grad)
            steps.append(t)
            lr, (b1, b2), (low, high) = group["lr"], group["betas"], group["clamp"]
            width = p.numel() // max(1, len(p)) if group["rows"] else 0
            whole += (p.data_ptr(), grad.data_ptr(), m.data_ptr(), v.data_ptr(), p.numel(), width, chunks, t.data_ptr())
            count = 0.0 if kernel else float(t) + 1.0
            scale = (0.0, 0.0) if kernel else (lr / (1.0 - b1**count), 1.0 / math.sqrt(1.0 - b2**count))
            real += (lr, 1.0 - b1, 1.0 - b2, group["eps"], low, high, *scale)
            chunks += -(-p.numel() // _CHUNK)
        rows = None if visible is None else visible.contiguous().view(torch.uint8)
        bad = torch.zeros(1, dtype=torch.int32, device=device)
        if kernel:
            self._run_kernel(whole, real, bad, rows, chunks)
            self.applied = bad[0] == 0
        else:
            self.applied = self._run_snippet(whole, real, bad, rows, chunks)
            if bool(self.applied):
                for t in steps:
                    t += 1.0

    def _state_of(self, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Moments and step count; moments lie in memory as their parameter does, wherever they came from."""
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=p.device)
            state["exp_avg"] = torch.zeros_like(p, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(p, memory_format=torch.preserve_format)
        for name in ("exp_avg", "exp_avg_sq"):
            if state[name].stride() != p.stride() or state[name].device != p.device:
                state[name] = torch.empty_like(p).copy_(state[name])
        if state["step"].device != p.device:
            state["step"] = state["step"].to(p.device)
        return state["exp_avg"], state["exp_avg_sq"], state["step"]

    def _run_snippet(
        self, whole: list[int], real: list[float], bad: Tensor, visible: Tensor | None, chunks: int
    ) -> Tensor:
        table, numbers = (
            torch.tensor(values, dtype=kind, device="cpu")
            for values, kind in ((whole, torch.int64), (real, torch.float32))
        )
        for stage in (0, 1):
            _snippet().run(
                self.threads, stage, whole=table.data_ptr(), real=numbers.data_ptr(), bad=bad.data_ptr(),
                visible=0 if visible is None else visible.data_ptr(), segments=len(whole) // _WHOLE, chunks=chunks,
            )  # fmt: skip
            if int(bad):
                break
        return bad[0] == 0

    def _run_kernel(
        self, whole: list[int], real: list[float], bad: Tensor, visible: Tensor | None, chunks: int
    ) -> None:
        pinned = bad.device.type == "cuda"
        table = torch.tensor(whole, dtype=torch.int64, device="cpu", pin_memory=pinned)
        numbers = torch.tensor(real, dtype=torch.float32, device="cpu", pin_memory=pinned)
        table, numbers = table.to(bad.device, non_blocking=True), numbers.to(bad.device, non_blocking=True)
        segments = len(whole) // _WHOLE
        mask = 0 if visible is None else visible.data_ptr()
        for stage, threads in ((0, chunks * _CHUNK), (1, segments), (2, chunks * _CHUNK)):
            inputs = [table.data_ptr(), numbers.data_ptr(), bad.data_ptr(), mask, segments, stage]
            launch_on(_kernel(), threads, inputs, bad.device)
