"""Feature planes of the HexPlane on the CPU, compiled: samples and their product, smoothness, and both gradients.

torch's own path (`hexplane`) is the specification and serves every other device and type. A few thousand scattered
samples leave it waiting for memory: a plane's channels lie a plane apart, and six small operators per sample each cost
more than their arithmetic. Here channels lie together (`channels_last`), one pass makes the product of a level's six
samples, and the gradients of a plane are one worker's, so that any number of threads gives the same bits.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..native import INTEGER, POINTER, Snippet

LANES = 16
"""The number of features must be a multiple of this."""
_POINTS = 64
"""Points per unit of work."""

_SAMPLES = r"""
// planes: [levels * 6] addresses of [H][W][C]; sizes: H, W of each; where: [M][4] in [-1, 1];
// samples: [levels * 6][M][C]; pulls: [M][4], the gradient in `where`.
const long long C = @CHANNELS@, V = C / 16, POINTS = @POINTS@;
const int AXES[6][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};
const float* const* planes = (const float* const*)P.planes;
float* const* grads = (float* const*)P.grads;
const long long* sizes = (const long long*)P.sizes;
struct Corners { long long at[4]; float weight[4]; float fx, fy, dx, dy; };
// Border padding, corners aligned; a NaN goes to the rim.
auto corners = FN(long long plane, const float* where) -> Corners {
    long long H = sizes[2 * plane], W = sizes[2 * plane + 1];
    float x = 0.5f * (where[AXES[plane % 6][0]] + 1.f) * (W - 1);
    float y = 0.5f * (where[AXES[plane % 6][1]] + 1.f) * (H - 1);
    float dx = x > 0.f && x < W - 1 ? 0.5f * (W - 1) : 0.f, dy = y > 0.f && y < H - 1 ? 0.5f * (H - 1) : 0.f;
    x = x > 0.f ? (x < W - 1 ? x : W - 1) : 0.f; y = y > 0.f ? (y < H - 1 ? y : H - 1) : 0.f;
    long long x0 = (long long)x, y0 = (long long)y, x1 = x0 + 1 < W ? x0 + 1 : x0, y1 = y0 + 1 < H ? y0 + 1 : y0;
    float fx = x - x0, fy = y - y0;
    return {{(y0 * W + x0) * C, (y0 * W + x1) * C, (y1 * W + x0) * C, (y1 * W + x1) * C},
            {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy}, fx, fy, dx, dy}; };
const long long M = P.count, L = P.levels;

if (stage == 0) for (long long first; (first = take() * POINTS) < M;) {
    long long last = first + POINTS < M ? first + POINTS : M;
    for (long long m = first; m < last; m++) for (long long level = 0; level < L; level++) {
        F product[V];
        for (int k = 0; k < 6; k++) {
            long long plane = 6 * level + k;
            Corners c = corners(plane, P.where + 4 * m);
            for (int v = 0; v < V; v++) {
                const float* from = planes[plane] + 16 * v;
                F s = c.weight[0] * load(from + c.at[0]) + c.weight[1] * load(from + c.at[1])
                    + c.weight[2] * load(from + c.at[2]) + c.weight[3] * load(from + c.at[3]);
                if (P.samples) store(P.samples + (plane * M + m) * C + 16 * v, s);
                product[v] = k ? product[v] * s : s;
            }
        }
        for (int v = 0; v < V; v++) store(P.features + (m * L + level) * C + 16 * v, product[v]);
    }
}
if (stage == 1) for (long long plane; (plane = take()) < 6 * L;) {
    long long level = plane / 6;
    __builtin_memset(grads[plane], 0, 4 * sizes[2 * plane] * sizes[2 * plane + 1] * C);
    for (long long m = 0; m < M; m++) {
        Corners c = corners(plane, P.where + 4 * m);
        for (int v = 0; v < V; v++) {
            F pull = load(P.features + (m * L + level) * C + 16 * v);
            for (int k = 0; k < 6; k++) if (6 * level + k != plane)
                pull *= load(P.samples + ((6 * level + k) * M + m) * C + 16 * v);
            for (int q = 0; q < 4; q++) {
                float* to = grads[plane] + c.at[q] + 16 * v;
                store(to, load(to) + c.weight[q] * pull);
            }
        }
    }
}
if (stage == 2) for (long long first; (first = take() * POINTS) < M;) {
    long long last = first + POINTS < M ? first + POINTS : M;
    for (long long m = first; m < last; m++) {
        F along[4] = {(F)0.f, (F)0.f, (F)0.f, (F)0.f};
        for (long long plane = 0; plane < 6 * L; plane++) {
            long long level = plane / 6;
            Corners c = corners(plane, P.where + 4 * m);
            for (int v = 0; v < V; v++) {
                F pull = load(P.features + (m * L + level) * C + 16 * v);
                for (int k = 0; k < 6; k++) if (6 * level + k != plane)
                    pull *= load(P.samples + ((6 * level + k) * M + m) * C + 16 * v);
                const float* from = planes[plane] + 16 * v;
                F a = load(from + c.at[0]), b = load(from + c.at[1]);
                F d = load(from + c.at[2]), e = load(from + c.at[3]);
                along[AXES[plane % 6][0]] += c.dx * pull * ((1 - c.fy) * (b - a) + c.fy * (e - d));
                along[AXES[plane % 6][1]] += c.dy * pull * ((1 - c.fx) * (d - a) + c.fx * (e - b));
            }
        }
        for (int axis = 0; axis < 4; axis++) {
            float lanes[16], sum = 0.f; store(lanes, along[axis]);
            for (int l = 0; l < 16; l++) sum += lanes[l];
            P.pulls[4 * m + axis] = sum;
        }
    }
}
"""

_PENALTY = r"""
// rows: [rows] of (plane, row); a unit is one row of one plane.
const long long C = @CHANNELS@;
const float* const* planes = (const float* const*)P.planes;
float* const* grads = (float* const*)P.grads;
const long long* sizes = (const long long*)P.sizes;
const long long* rows = (const long long*)P.rows;
const float* weights = P.weights;  // of each plane: second differences down, along, |1 - p|, each over its count
for (long long unit; (unit = take()) < P.count;) {
    long long plane = rows[2 * unit], h = rows[2 * unit + 1], H = sizes[2 * plane], W = sizes[2 * plane + 1], S = W * C;
    const float* p = planes[plane];
    float down = weights[3 * plane], along = weights[3 * plane + 1], still = weights[3 * plane + 2];
    double total = 0;
    for (long long w = 0; w < W; w++) for (long long c = 0; c < C; c += 16) {
        const float* at = p + h * S + w * C + c;
        auto bend = FN(long long i, long long count, long long step, long long shift) -> F {
            if (i < 1 || i > count - 2) return (F)0.f;
            const float* z = at + shift * step;
            return load(z - step) - 2.f * load(z) + load(z + step); };
        F pull = (F)0.f, sum = (F)0.f;
        if (down != 0.f) {
            F here = bend(h, H, S, 0);
            pull += 2.f * down * (bend(h - 1, H, S, -1) - 2.f * here + bend(h + 1, H, S, 1));
            sum += down * here * here; }
        if (along != 0.f) {
            F here = bend(w, W, C, 0);
            pull += 2.f * along * (bend(w - 1, W, C, -1) - 2.f * here + bend(w + 1, W, C, 1));
            sum += along * here * here; }
        if (still != 0.f) {
            F gap = load(at) - 1.f;
            sum += still * __builtin_elementwise_abs(gap);
            pull += gap > 0.f ? (F)still : (gap < 0.f ? (F)-still : (F)0.f); }
        if (grads) store(grads[plane] + h * S + w * C + c, pull);
        float lanes[16]; store(lanes, sum);
        float line = 0.f; for (int l = 0; l < 16; l++) line += lanes[l];
        total += line;
    }
    P.partial[unit] = (float)total;
}
"""


@functools.lru_cache(maxsize=4)
def _sampler(channels: int) -> Snippet:
    fields = {
        **dict.fromkeys(("planes", "grads", "sizes", "where", "samples", "features", "pulls"), POINTER),
        **dict.fromkeys(("count", "levels"), INTEGER),
    }
    source = _SAMPLES.replace("@CHANNELS@", str(channels)).replace("@POINTS@", str(_POINTS))
    return Snippet(f"hexplane_samples{channels}", fields, source)


@functools.lru_cache(maxsize=4)
def _penalty(channels: int) -> Snippet:
    fields = {
        **dict.fromkeys(("planes", "grads", "sizes", "rows", "weights", "partial"), POINTER), "count": INTEGER,
    }  # fmt: skip
    return Snippet(f"hexplane_penalty{channels}", fields, _PENALTY.replace("@CHANNELS@", str(channels)))


def warm_up(channels: int = 16) -> None:
    """Compile, or load from the cache, from the main thread."""
    _sampler(channels).warm_up()
    _penalty(channels).warm_up()


def supports(planes: Sequence[Tensor]) -> bool:
    """Whether this module takes these planes: float32 on the CPU, channels last, features a multiple of `LANES`."""
    return all(
        p.dtype == torch.float32 and p.device.type == "cpu" and p.shape[1] % LANES == 0
        and p.is_contiguous(memory_format=torch.channels_last) for p in planes
    )  # fmt: skip


def _table(tensors: Sequence[Tensor]) -> Tensor:
    return torch.tensor([t.data_ptr() for t in tensors], dtype=torch.int64, device="cpu")


def _sizes(planes: Sequence[Tensor]) -> Tensor:
    return torch.tensor([p.shape[2:] for p in planes], dtype=torch.int64, device="cpu")


class _Product(torch.autograd.Function):
    """Features of points, with gradients for the planes and the points."""

    @staticmethod
    def forward(ctx, where: Tensor, threads: int | None, *planes: Tensor) -> Tensor:  # type: ignore[override]
        count, channels, levels = len(where), planes[0].shape[1], len(planes) // 6
        features = torch.empty(count, levels * channels, device="cpu")
        wanted = any(ctx.needs_input_grad)
        samples = torch.empty(len(planes), count, channels, device="cpu") if wanted else None
        pointers, sizes = _table(planes), _sizes(planes)
        _sampler(channels).run(
            threads, planes=pointers.data_ptr(), grads=0, sizes=sizes.data_ptr(), where=where.data_ptr(),
            samples=0 if samples is None else samples.data_ptr(), features=features.data_ptr(), pulls=0, count=count,
            levels=levels,
        )  # fmt: skip
        ctx.save_for_backward(where, samples, *planes)
        ctx.threads = threads
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        where, samples, *planes = ctx.saved_tensors
        out = [torch.empty_like(p) for p in planes]
        grad = grad.contiguous()
        pulls = torch.empty_like(where) if ctx.needs_input_grad[0] else None
        pointers, grads, sizes = _table(planes), _table(out), _sizes(planes)
        for stage in (1,) if pulls is None else (1, 2):
            _sampler(planes[0].shape[1]).run(
                ctx.threads, stage, planes=pointers.data_ptr(), grads=grads.data_ptr(), sizes=sizes.data_ptr(),
                where=where.data_ptr(), samples=samples.data_ptr(), features=grad.data_ptr(),
                pulls=0 if pulls is None else pulls.data_ptr(), count=len(where), levels=len(planes) // 6,
            )  # fmt: skip
        return pulls, None, *out


def features(where: Tensor, planes: Sequence[Tensor], threads: int | None = None) -> Tensor:
    """Product over a level's six planes of their bilinear samples, [M, levels * C], differentiable in both arguments.

    where [M, 4]: x, y, z and time in [-1, 1]; outside the rim holds, without gradient. planes: [1, C, rows, columns],
    six per level in the order of the axes xy, xz, yz, xt, yt, zt (first along a row). ValueError unless `supports`
    takes the planes.
    """
    if not supports(planes):
        raise ValueError("planes should be float32 on the CPU, channels last, with a multiple of 16 features")
    return _Product.apply(where.float().contiguous(), threads, *planes)  # type: ignore[no-any-return]


class _Bend(torch.autograd.Function):
    """The penalty's value; its gradient is computed along with it, being linear in the incoming one."""

    @staticmethod
    def forward(ctx, weights: Tensor, threads: int | None, *planes: Tensor) -> Tensor:  # type: ignore[override]
        grads = [torch.empty_like(p) for p in planes] if any(ctx.needs_input_grad) else []
        units = [(n, row) for n, p in enumerate(planes) for row in range(p.shape[2])]
        rows = torch.tensor(units, dtype=torch.int64, device="cpu")
        partial = torch.empty(len(rows), device="cpu")
        pointers, targets, sizes = _table(planes), _table(grads), _sizes(planes)
        _penalty(planes[0].shape[1]).run(
            threads, planes=pointers.data_ptr(), grads=targets.data_ptr() if grads else 0, sizes=sizes.data_ptr(),
            rows=rows.data_ptr(), weights=weights.data_ptr(), partial=partial.data_ptr(), count=len(rows),
        )  # fmt: skip
        ctx.save_for_backward(*grads)
        return partial.double().sum().float()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return None, None, *(saved * grad for saved in ctx.saved_tensors)


def penalty(
    planes: Sequence[Tensor], weights: Sequence[tuple[float, float, float]], threads: int | None = None
) -> Tensor:
    """Sum over planes [1, C, H, W] of weighted means: squared second differences down and along, and |1 - plane|."""
    if not supports(planes):
        raise ValueError("planes should be float32 on the CPU, channels last, with a multiple of 16 features")
    scaled = []
    for plane, (down, along, still) in zip(planes, weights, strict=True):
        _, c, h, w = plane.shape
        scaled.append((down / max(1, c * (h - 2) * w), along / max(1, c * h * (w - 2)), still / (c * h * w)))
    return _Bend.apply(torch.tensor(scaled, device="cpu"), threads, *planes)  # type: ignore[no-any-return]
