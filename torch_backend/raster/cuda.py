"""CUDA backend of the rasteriser: kernels compiled by Warp, an explicit backward pass, no synchronisation with host.

It needs no CUDA toolkit: Warp brings the compiler and caches its output. CPU tensors run the same kernels on Warp's CPU
fibers: slow, for tests on machines without a GPU. `hit_lists.py` determines the capacity of the list of hits.

**CUDA graphs.** `rasterize` and its backward pass can be captured, for instance by `torch.cuda.graph`. Before the
capture, run a call of the same shapes and its backward pass, which compiles the kernels. A captured call keeps the
capacity of its list. Check `hits` regularly: if its first number exceeds the second, enlarge the list by a call outside
the graph, and capture again.
"""

import threading
from contextlib import nullcontext
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from ..native import current_card, initialised_warp, launch_on, warp_stream
from ..torch_types import AutogradContext, applied, once_differentiable
from . import cuda_source as source
from .constants import TILE
from .cuda_entry import warp_kernel
from .hit_lists import Demand, demand_of
from .reference import expected_depth
from .settings import RasterOutput, Scene

MAX_CHANNELS = 64 - source.MOMENTS
"""Largest number of channels per call, depth included."""
_lock = threading.RLock()
_kernels: dict[tuple[str, int], Any] = {}


def _structure(wp: Any) -> Any:
    """Warp type of the kernels' parameter structure, shared by all modules."""
    if ("", 0) not in _kernels:
        types = {name: getattr(wp, kind) for name, kind in source.FIELDS.items()}
        _kernels["", 0] = wp.struct(type("RasterArgs", (), {"__annotations__": types, "__module__": __name__}))
    return _kernels["", 0]


def build(name: str, channels: int = 0) -> Any:
    """Warp kernel `name` of `cuda_source`, in module `module_name(name, channels)`; blending needs `channels`."""
    with _lock:
        if (name, channels) in _kernels:
            return _kernels[name, channels]
        # All kernels of a module are built at once. If one were added later, Warp would recompile the module and unload
        # code that recorded CUDA graphs still run.
        texts = {name: source.blending(channels)[name]} if channels else source.stages()
        for each, text in texts.items():
            options = {"enable_backward": False, "grid_stride": False, "launch_bounds": source.BLOCK}
            wp = initialised_warp()
            _kernels[each, channels] = warp_kernel(
                wp, each, text, wp.get_module(module_name(each, channels)), _structure(wp), options
            )
        return _kernels[name, channels]


def module_name(name: str, channels: int = 0) -> str:
    """Name of the Warp module that holds kernel `name`."""
    return f"{__name__}.{name}{channels}" if channels else f"{__name__}.stages"


def _refusal(device: torch.device) -> str | None:
    """Message why Warp cannot use `device` and what to do; None if Warp can use it."""
    wp = initialised_warp()
    if device.type != "cuda" or (wp.is_cuda_available() and (device.index or 0) < wp.get_cuda_device_count()):
        return None
    return (
        "PyTorch sees the NVIDIA GPU, but Warp, which compiles the rasteriser, does not: update the NVIDIA driver "
        "to version 580 or newer (the GPU must be of the Turing generation, compute capability 7.5, or later), or "
        "choose the CPU"
    )


class _Launcher:
    """Launches kernels on torch's current stream of one device."""

    def __init__(self, device: torch.device):
        self.wp, self.device = initialised_warp(), device
        self.stream = warp_stream(device) if device.type == "cuda" else None

    def __call__(self, name: str, args: Any, threads: int, channels: int = 0) -> None:
        """Run kernel `name` on at least `threads` threads."""
        if threads == 0:
            return
        dim = -(-threads // source.BLOCK) * source.BLOCK
        with nullcontext() if self.device.type == "cuda" else _Fibers(self.wp):
            launch_on(build(name, channels), dim, [args], self.device, source.BLOCK, self.stream)


class _Fibers:
    """Context that enables Warp's CPU blocks, for one thread at a time."""

    def __init__(self, wp: Any):
        self.wp = wp

    def __enter__(self) -> None:
        # Shared memory of fibers is static, so one thread at a time.
        _lock.acquire()
        self.before = self.wp.config.enable_cpu_blocks
        self.wp.config.enable_cpu_blocks = True

    def __exit__(self, *_: object) -> None:
        self.wp.config.enable_cpu_blocks = self.before
        _lock.release()


def _arguments(wp: Any, scene: Scene, channels: int) -> Any:
    """Parameter structure with the sizes and flags of a call."""
    # The bare ctypes structure: setting one of its hundred fields through Warp's wrapper takes ten times as long.
    args = _structure(wp).ctype()
    args.n, args.cameras, args.width, args.height = (
        scene.means.shape[0],
        scene.viewmats.shape[0],
        scene.width,
        scene.height,
    )
    args.overscan_x, args.overscan_y = scene.settings.overscan
    args.tiles_x, args.tiles_y = -(-scene.width // TILE), -(-scene.height // TILE)
    args.n_colors = 0 if scene.colors is None else scene.colors.shape[1]
    args.n_sh, args.bands = (0, 0) if scene.sh is None else (3, (scene.sh_degree + 1) ** 2)
    args.sh_stride = 0 if scene.sh is None else 3 * scene.sh.shape[1]
    # Loads of 16-byte words need rows of 4 or 16 harmonics and an aligned first address.
    args.sh_aligned = int(scene.sh is not None and args.sh_stride % 12 == 0 and scene.sh.data_ptr() % 16 == 0)
    args.channels = channels
    # A record fills whole 32-byte sectors, a gradient whole half-warps (16 floats).
    args.record_stride = -(-(source.HEAD + channels) // 8) * 8
    args.grad_stride = -(-(source.MOMENTS + channels) // 16) * 16
    args.antialiased, args.want_depth = int(scene.settings.antialiased), int(scene.with_depth)
    args.want_weights, args.want_top = int(scene.with_contributions), int(scene.with_top)
    args.want_abs = int(scene.settings.absgrad)
    args.wide = int(args.tiles_x * args.tiles_y * args.cameras >= source.WIDE_FROM)
    args.near = scene.settings.near
    return args


def _point(args: Any, **tensors: Tensor | None) -> None:
    for name, tensor in tensors.items():
        setattr(args, name, 0 if tensor is None else tensor.data_ptr())


class _Maker:
    """Creates tensors on one device."""

    def __init__(self, device: torch.device):
        self.device = device

    def empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=self.device)


class _Zeros(NamedTuple):
    """Tensors of a call that start at zero, as parts of one tensor."""

    tile_start: Tensor
    tile_end: Tensor
    """For this field and `tile_start` see `_Binned`."""
    norms: tuple[Tensor, Tensor]
    """[C, N] each: where the backward pass writes `means2d_grad` and `means2d_absgrad`."""
    hits: Tensor
    """[2] int64: hits of the call, and capacity of the list."""
    weight_sum: Tensor | None
    """[C, N] int64, in units of 1 / WEIGHT_SCALE; None, like `weight_max`, without contributions."""
    weight_max: Tensor | None

    @classmethod
    def of(cls, scene: Scene) -> "_Zeros":
        """The zero tensors of a call on `scene`."""
        cameras, n = scene.viewmats.shape[0], scene.means.shape[0]
        slots, tiles = cameras * n, cameras * -(-scene.width // TILE) * -(-scene.height // TILE)
        with_contributions = scene.with_contributions
        weighed = 3 * slots if with_contributions else 0
        # One tensor for all, because each torch operator costs launches.
        buffer = torch.zeros(4 + weighed + 2 * slots + 2 * tiles, dtype=torch.int32, device=scene.means.device)
        real = buffer.view(torch.float32)

        def part(of: Tensor, first: int) -> Tensor:
            return of.as_strided((cameras, n), (n, 1), first)

        tile_start, tile_end = buffer[buffer.numel() - 2 * tiles :].view(2, tiles).unbind()
        return cls(
            tile_start=tile_start,
            tile_end=tile_end,
            norms=(part(real, 4 + weighed), part(real, 4 + weighed + slots)),
            hits=buffer[:4].view(torch.int64),
            weight_sum=part(buffer[: 4 + weighed - weighed % 2].view(torch.int64), 2) if with_contributions else None,
            weight_max=part(real, 4 + 2 * slots) if with_contributions else None,
        )


class _Binned(NamedTuple):
    """The hits of a call, listed tile by tile, front to back. S slots, T tiles."""

    order: Tensor
    """[S] int64: slots in depth order."""
    ends: Tensor
    """[S] int64: number of hits up to and including each rank."""
    sorted_slot: Tensor
    """[capacity] int32: slot of each hit."""
    tile_start: Tensor
    """[T] int32: first hit of each tile."""
    tile_end: Tensor
    """[T] int32: end of each tile's hits, exclusive."""


def _bin(launch: _Launcher, args: Any, demand: Demand, depth_key: Tensor, hit_count: Tensor, zeros: _Zeros) -> _Binned:
    """List the hits tile by tile, front to back."""
    make, capacity = _Maker(depth_key.device), demand.capacity
    slots, tiles = hit_count.shape[0], args.tiles_x * args.tiles_y * args.cameras
    # Stable, because ties in depth are ordered by index (`constants.py`).
    order = torch.sort(depth_key, stable=True).indices
    ends = torch.cumsum(hit_count.index_select(0, order), 0, dtype=torch.int64)
    sorted_slot = make.empty(capacity, dtype=torch.int32)
    _point(args, order=order, ends=ends, sorted_slot=sorted_slot)
    _point(args, tile_start=zeros.tile_start, tile_end=zeros.tile_end)
    args.capacity = capacity
    if slots and tiles:
        key = torch.full((capacity,), tiles, dtype=torch.int32 if args.wide else torch.int16, device=make.device)
        hit_slot = make.empty(capacity, dtype=torch.int32)
        _point(args, hit_key=key, hit_slot=hit_slot)
        launch("raster_emit", args, slots)
        sorted_key, permutation = torch.sort(key, stable=True)
        _point(args, sorted_key=sorted_key, permutation=permutation, hits=zeros.hits, demand=demand.most)
        launch("raster_ranges", args, capacity)
        demand.report()
    return _Binned(order, ends, sorted_slot, zeros.tile_start, zeros.tile_end)


class _Images(NamedTuple):
    """Outputs of a call: images of C cameras and figures of N Gaussians, with shapes as in `RasterOutput`."""

    image: Tensor
    """[C, H, W, D]: channels of the scene, then, with depth, the sum of alpha T depth."""
    alpha: Tensor
    radii: Tensor
    means2d: Tensor
    hits: Tensor
    median: Tensor | None
    """None if not requested, like the fields below."""
    weight_sum: Tensor | None
    weight_max: Tensor | None
    top_id: Tensor | None
    top_weight: Tensor | None


def _unfilled(make: _Maker, scene: Scene, zeros: _Zeros) -> _Images:
    """Allocated outputs of a call. `weight_sum` receives the kernels' integers; `hits` is still zero."""
    cameras, n = scene.viewmats.shape[0], scene.means.shape[0]
    size = cameras, scene.height, scene.width
    return _Images(
        image=make.empty(*size, scene.channels + int(scene.with_depth)),
        alpha=make.empty(*size),
        radii=make.empty(cameras, n, dtype=torch.int32),
        means2d=make.empty(cameras, n, 2),
        hits=zeros.hits,
        median=make.empty(*size) if scene.with_depth else None,
        weight_sum=zeros.weight_sum,
        weight_max=zeros.weight_max,
        top_id=make.empty(*size, dtype=torch.int32) if scene.with_top else None,
        top_weight=make.empty(*size) if scene.with_top else None,
    )


class _Saved(NamedTuple):
    """Tensors saved for the backward pass: the differentiable inputs, the images and the records."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    colors: Tensor | None
    sh: Tensor | None
    viewmats: Tensor
    background: Tensor | None
    image: Tensor
    alpha: Tensor
    record: Tensor
    aux: Tensor
    hit_count: Tensor
    order: Tensor
    ends: Tensor
    sorted_slot: Tensor
    tile_start: Tensor
    tile_end: Tensor


class _Context(AutogradContext, Protocol):
    scene: Scene
    norms: tuple[Tensor, Tensor]
    """[C, N] each: where the backward pass writes `means2d_grad` and `means2d_absgrad`."""
    capacity: int
    """Capacity of the call's list of hits."""


class _Rasterize(torch.autograd.Function):
    """Autograd function of the CUDA backend. Tensors are float32, contiguous, on one device."""

    @staticmethod
    def forward(
        ctx: _Context,
        scene: Scene,
        zeros: _Zeros,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        colors: Tensor | None,
        sh: Tensor | None,
        viewmats: Tensor,
        background: Tensor | None,
    ) -> _Images:
        make, launch = _Maker(means.device), _Launcher(means.device)
        cameras, n = viewmats.shape[0], means.shape[0]
        channels, slots = scene.channels + int(scene.with_depth), cameras * n
        out = _unfilled(make, scene, zeros)
        args = _arguments(launch.wp, scene, channels)
        record, aux = make.empty(slots, args.record_stride), make.empty(slots, 2)
        hit_count, depth_key = make.empty(slots, dtype=torch.int32), make.empty(slots, dtype=torch.int32)
        inputs = (means, quats, log_scales, logits, colors, sh, viewmats)
        _point(args, means=means, quats=quats, log_scales=log_scales, logits=logits, colors=colors, sh=sh)
        _point(args, viewmats=viewmats, Ks=scene.Ks, background=background)
        _point(args, record=record, aux=aux, hit_count=hit_count, depth_key=depth_key)
        _point(args, radii=out.radii, means2d=out.means2d)
        launch("raster_project", args, slots)
        binned = _bin(launch, args, demand_of(scene, hit_count), depth_key, hit_count, zeros)
        _point(args, image=out.image, alpha=out.alpha, median=out.median, top_id=out.top_id, top_weight=out.top_weight)
        _point(args, weight_sum=out.weight_sum, weight_max=out.weight_max)
        launch("raster_blend", args, source.BLOCK * args.tiles_x * args.tiles_y * cameras, channels)
        if any(ctx.needs_input_grad):
            saved = _Saved(*inputs, background, out.image, out.alpha, record, aux, hit_count, *binned)
            ctx.save_for_backward(*saved)
            ctx.scene, ctx.norms, ctx.capacity = scene, zeros.norms, args.capacity
        if out.weight_sum is not None:
            # Integer sums do not depend on the order of the atomics.
            out = out._replace(weight_sum=out.weight_sum * (1.0 / source.WEIGHT_SCALE))
        ctx.mark_non_differentiable(*(value for value in out[2:] if value is not None))
        ctx.set_materialize_grads(False)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: _Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved, scene = _Saved(*ctx.saved_tensors), ctx.scene
        image, alpha, means, viewmats = saved.image, saved.alpha, saved.means, saved.viewmats
        make, launch = _Maker(means.device), _Launcher(means.device)
        channels, cameras, n = image.shape[-1], viewmats.shape[0], means.shape[0]
        grad_image = torch.zeros_like(image) if grads[0] is None else grads[0].contiguous()
        grad_alpha = None if grads[1] is None else grads[1].contiguous()
        args = _arguments(launch.wp, scene, channels)
        args.capacity, args.want_view = ctx.capacity, int(ctx.needs_input_grad[8])
        grad = make.zeros(cameras * n, args.grad_stride)
        inputs = {
            "grad_means": means,
            "grad_quats": saved.quats,
            "grad_log_scales": saved.log_scales,
            "grad_logits": saved.logits,
            "grad_colors": saved.colors,
            "grad_sh": saved.sh,
        }
        out = {name: None if value is None else torch.empty_like(value) for name, value in inputs.items()}
        grad_view = torch.zeros_like(viewmats) if args.want_view else None
        # The kernels take all saved tensors except the background under the same names.
        kept = {name: value for name, value in saved._asdict().items() if name != "background"}
        _point(
            args,
            **kept,
            Ks=scene.Ks,
            grad_image=grad_image,
            grad_alpha=grad_alpha,
            grad=grad,
            grad_view=grad_view,
            grad_norm=ctx.norms[0],
            grad_abs=ctx.norms[1],
            **out,
        )
        if n:
            launch("raster_blend_backward", args, source.BLOCK * args.tiles_x * args.tiles_y * cameras, channels)
            launch("raster_project_backward", args, n)
        grad_background = None
        if saved.background is not None and ctx.needs_input_grad[9]:
            grad_background = ((1 - alpha)[..., None] * grad_image[..., : scene.channels]).sum((0, 1, 2))
        return (None, None, *out.values(), grad_view, grad_background)


def warm_up(channels: int = 3, device: torch.device | str = "cuda") -> None:
    """Compile, or load from the cache, the kernels for images on `device`.

    `channels`: colour channels, plus one if depth is rendered.

    Raises RuntimeError with what to do if Warp cannot use the GPU.
    """
    device = torch.device(device)
    if refusal := _refusal(device):
        raise RuntimeError(refusal)
    wp = initialised_warp()
    names = [(name, 0) for name in source.stages()] + [(name, channels) for name in source.blending(channels)]
    modules = {module_name(*each): build(*each) for each in names}
    with torch.cuda.device(device) if device.type == "cuda" else _Fibers(wp):
        for module in modules:
            wp.load_module(module, device=str(device), block_dim=source.BLOCK)


def rasterize(scene: Scene) -> RasterOutput:
    """Rasterise all cameras of `scene` (float32, contiguous, on one device).

    Raises ValueError for too many channels, cameras or Gaussians, RuntimeError with what to do if Warp cannot use the
    GPU.
    """
    channels = scene.channels + int(scene.with_depth)
    if channels > MAX_CHANNELS:
        raise ValueError(f"{channels} channels, depth included; one call carries at most {MAX_CHANNELS}")
    device = scene.means.device
    if refusal := _refusal(device):
        raise RuntimeError(refusal)
    cameras, n = scene.viewmats.shape[0], scene.means.shape[0]
    tiles = cameras * -(-scene.width // TILE) * -(-scene.height // TILE)
    # Thread numbers and slots are int32 in the kernels.
    if max(cameras * n, tiles * source.BLOCK) > 2**31 - source.BLOCK:
        raise ValueError(
            f"{cameras} cameras of {scene.width} x {scene.height} px with {n} Gaussians are too much for "
            "one call: split the cameras"
        )
    zeros = _Zeros.of(scene)
    with current_card(device):
        inputs = (scene.means, scene.quats, scene.log_scales, scene.opacity_logits, scene.colors, scene.sh)
        out = _Images(*applied(_Rasterize, scene, zeros, *inputs, scene.viewmats, scene.background))
    colors, depth = out.image, None
    if scene.with_depth:
        colors, depth_sum = out.image[..., :-1], out.image[..., -1]
        depth = expected_depth(depth_sum, out.alpha)
    return RasterOutput(
        colors=colors,
        alphas=out.alpha,
        depth_expected=depth,
        depth_median=out.median,
        radii=out.radii,
        means2d=out.means2d,
        weight_sum=out.weight_sum,
        weight_max=out.weight_max,
        means2d_grad=zeros.norms[0],
        means2d_absgrad=zeros.norms[1],
        top_ids=out.top_id,
        top_weights=out.top_weight,
        hits=out.hits,
    )
