"""CPU backend of the rasteriser: C++ snippets compiled by Warp, run by Python threads over chunks and tiles.

The backward pass is explicit. `native.py` compiles and runs the snippets; `warm_up` compiles them in advance.
"""

import ctypes
import threading
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..native import Launch, build, run_workers
from ..torch_types import AutogradContext, applied, floats
from . import cpu_source as source
from .constants import FRUSTUM_MARGIN, TILE
from .reference import expected_depth
from .settings import RasterOutput, Scene, camera_limits

# Limit of hits: they take 1 GB, and 8 GB more for their gradients. A scene with more is broken rather than large.
_HITS_MAX = 2**27
_lock = threading.RLock()
_kernels: dict[int, Launch] = {}
_idle: list["_Workspace"] = []
_IDLE_MAX = 4


def _compile(channels: int) -> Launch:
    """Kernel of the stages independent of the channels (channels = 0), or of blending for `channels` channels.

    It is called as f(block, stage, worker).
    """
    with _lock:
        if channels not in _kernels:
            _kernels[channels] = (
                build(f"raster_blend{channels}", source.blend_source(channels))
                if channels
                else build("raster_stages", source.stages_source())
            )
        return _kernels[channels]


def warm_up(channels: int = 3) -> None:
    """Compile, or load from the cache, the kernels for images of `channels` channels (one more with depth).

    Call it from the main thread before the first `rasterize` of a worker thread.
    """
    _compile(0)
    _compile(channels)


class _Workspace:
    """Scratch memory of one camera, held from forward to backward pass, and reused."""

    def __init__(self):
        self.buffers: dict[str, Tensor] = {}
        self.block = source.Block()

    def need(self, name: str, count: int) -> None:
        """Set the block's field `name` to a buffer of `count` 4-byte values, 64-byte aligned, contents undefined."""
        buffer = self.buffers.get(name)
        if buffer is None or buffer.numel() < count:
            # A quarter larger than needed, because a new buffer means fresh pages, which are slow.
            buffer = self.buffers[name] = torch.empty(max(64, count + count // 4), dtype=torch.int32)
        setattr(self.block, name, buffer.data_ptr())


class _Lease:
    """Holds a workspace, and returns it to the pool when the lease is garbage-collected."""

    def __init__(self):
        with _lock:
            self.workspace = _idle.pop() if _idle else _Workspace()

    def __del__(self):
        with _lock:
            if len(_idle) < _IDLE_MAX:
                _idle.append(self.workspace)


def _point(block: source.Block, **tensors: Tensor | None) -> None:
    for name, tensor in tensors.items():
        setattr(block, name, 0 if tensor is None else tensor.data_ptr())


def _rest(sh: Tensor | None, rest: Tensor | None) -> int:
    """Address of the first Gaussian's harmonics above degree 0: in `rest` if given, else behind degree 0 in `sh`."""
    if rest is not None:
        return rest.data_ptr()
    return 0 if sh is None else sh.data_ptr() + 3 * sh.element_size()


def _set_up(workspace: _Workspace, scene: Scene, camera: int, image_channels: int) -> None:
    """Fill the block with the sizes, flags and camera of one view."""
    block, n = workspace.block, scene.means.shape[0]
    block.n, block.width, block.height = n, scene.width, scene.height
    block.tiles_x, block.tiles_y = -(-scene.width // TILE), -(-scene.height // TILE)
    block.chunks = -(-n // source.CHUNK)
    block.n_colors = 0 if scene.colors is None else scene.colors.shape[1]
    block.n_sh, block.sh_degree = (0, 0) if scene.sh is None else (3, scene.sh_degree)
    block.sh_stride = 0 if scene.sh is None else 3 * scene.sh.shape[1]
    block.rest_stride = block.sh_stride if scene.sh_rest is None else 3 * scene.sh_rest.shape[1]
    block.channels = image_channels
    # Rows of whole vectors of 16 floats, aligned to 64 bytes.
    block.record_stride = -(-(source.HEAD + image_channels) // 16) * 16
    block.grad_stride = -(-(source.MOMENTS + image_channels) // 16) * 16
    block.antialiased, block.want_depth = int(scene.settings.antialiased), int(scene.with_depth)
    block.want_weights, block.want_top = int(scene.with_contributions), int(scene.with_top)
    block.want_abs = int(scene.settings.absgrad)
    block.workers = max(1, min(scene.settings.threads, block.chunks))
    block.view[:] = floats(scene.viewmats[camera, :3].reshape(-1))
    K = scene.Ks[camera]
    block.fx, block.fy, block.cx, block.cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    limits = camera_limits(scene, camera, FRUSTUM_MARGIN)
    block.x_low, block.x_high, block.y_low, block.y_high = limits
    block.near = scene.settings.near
    slots = block.chunks * source.CHUNK
    for name, per_slot in (
        ("record", block.record_stride),
        ("aux", 4),
        ("index", 1),
        ("hit_count", 1),
        ("hit_start", 1),
        ("order", 1),
        ("order2", 1),
        ("key", 1),
        ("key2", 1),
        ("span_start", 1),
        ("span_count", 1),
    ):
        workspace.need(name, slots * per_slot)
    tiles = block.tiles_x * block.tiles_y
    workspace.need("span", 2 * source.SPANS * block.chunks)
    for name, count in (
        ("chunk_count", block.chunks),
        ("histogram", tiles * block.workers),
        ("tile_start", tiles + 1),
        ("tile_end", tiles),
    ):
        workspace.need(name, count)


def _forward_camera(workspace: _Workspace, scene: Scene, image_channels: int) -> None:
    """Project, bin and blend one camera. The block's pointers to inputs and outputs must be set."""
    block, threads = workspace.block, scene.settings.threads
    stages, blend = _compile(0), _compile(image_channels)
    address = ctypes.addressof(block)
    by_chunk, by_tile = min(threads, block.chunks), min(threads, block.tiles_x * block.tiles_y)
    run_workers(stages, block, source.PROJECT, by_chunk)
    stages(address, source.SORT, 0)
    if block.hits > _HITS_MAX:
        raise RuntimeError(
            f"{block.visible} Gaussians cover {block.hits} tiles of a {block.width}x{block.height} "
            f"image, more than the {_HITS_MAX} that fit; their scales are far too large"
        )
    workspace.need("hit_slot", block.hits)
    workspace.need("hit_place", block.hits)
    if block.want_weights:
        workspace.need("hit_weight", 2 * block.hits)
    run_workers(stages, block, source.COUNT, block.workers)
    stages(address, source.PREFIX, 0)
    run_workers(stages, block, source.EMIT, block.workers)
    run_workers(blend, block, source.BLEND, by_tile)
    if block.want_weights:
        run_workers(stages, block, source.WEIGHTS, by_chunk)


class _Images(NamedTuple):
    """Outputs of a call: images of C cameras and figures of N Gaussians, with shapes as in `RasterOutput`."""

    image: Tensor
    """[C, H, W, D]: channels of the scene, then, with depth, the sum of alpha T depth."""
    alpha: Tensor
    median: Tensor
    """Empty without depth."""
    radii: Tensor
    means2d: Tensor
    weights: Tensor
    """[2, C, N]: sum and maximum of alpha T; N is 0 if they were not requested."""
    top_ids: Tensor
    top_weights: Tensor


class _Saved(NamedTuple):
    """Tensors saved for the backward pass: the differentiable inputs and the images."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    colors: Tensor | None
    sh: Tensor | None
    sh_rest: Tensor | None
    viewmats: Tensor
    background: Tensor | None
    image: Tensor
    alpha: Tensor
    channel_background: Tensor
    """[D]: background of every channel, 0 for depth."""


class _Context(AutogradContext, Protocol):
    scene: Scene
    norms: tuple[Tensor, Tensor]
    """[C, N] each: where the backward pass writes `means2d_grad` and `means2d_absgrad`."""
    leases: list[_Lease]
    """One for each camera."""


class _Rasterize(torch.autograd.Function):
    """Autograd function of the CPU backend. Tensors are float32, contiguous, on the CPU."""

    @staticmethod
    def forward(
        ctx: _Context,
        scene: Scene,
        norms: tuple[Tensor, Tensor],
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        colors: Tensor | None,
        sh: Tensor | None,
        sh_rest: Tensor | None,
        viewmats: Tensor,
        background: Tensor | None,
    ) -> _Images:
        cameras, n = viewmats.shape[0], means.shape[0]
        channels = scene.channels + int(scene.with_depth)
        size = (cameras, scene.height, scene.width)
        image, alpha = torch.empty(*size, channels), torch.empty(size)
        median = torch.empty(size if scene.with_depth else (0,))
        top_size = size if scene.with_top else (cameras, 0)
        top_ids, top_weights = torch.empty(top_size, dtype=torch.int32), torch.empty(top_size)
        radii, means2d = torch.zeros(cameras, n, dtype=torch.int32), torch.zeros(cameras, n, 2)
        weights = torch.zeros(2, cameras, n if scene.with_contributions else 0)
        channel_background = torch.zeros(channels)
        if background is not None:
            channel_background[: scene.channels] = background
        leases = [_Lease() for _ in range(cameras)]
        for c, lease in enumerate(leases):
            _set_up(lease.workspace, scene, c, channels)
            _point(
                lease.workspace.block,
                means=means,
                quats=quats,
                log_scales=log_scales,
                logits=logits,
                colors=colors,
                sh=sh,
                background=channel_background,
                image=image[c],
                alpha=alpha[c],
                median=median[c] if scene.with_depth else None,
                radii=radii[c],
                means2d=means2d[c],
                top_ids=top_ids[c],
                top_weights=top_weights[c],
                weight_sum=weights[0, c],
                weight_max=weights[1, c],
            )
            lease.workspace.block.sh_rest = _rest(sh, sh_rest)
            _forward_camera(lease.workspace, scene, channels)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(
                means, quats, log_scales, logits, colors, sh, sh_rest, viewmats, background, image, alpha,
                channel_background,
            )  # fmt: skip
            ctx.scene, ctx.norms, ctx.leases = scene, norms, leases
        ctx.mark_non_differentiable(median, radii, means2d, weights, top_ids, top_weights)
        # Outputs that the loss does not use stay None, without images of zeros.
        ctx.set_materialize_grads(False)
        return _Images(image, alpha, median, radii, means2d, weights, top_ids, top_weights)

    @staticmethod
    def backward(ctx: _Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved, scene = _Saved(*ctx.saved_tensors), ctx.scene
        (means, quats, log_scales, logits, colors, sh, sh_rest, viewmats, background, image, alpha,
         channel_background) = saved  # fmt: skip
        grad_image = torch.zeros_like(image) if grads[0] is None else grads[0].contiguous()
        grad_alpha = torch.zeros_like(alpha) if grads[1] is None else grads[1].contiguous()
        parameters = {
            "grad_means": means,
            "grad_quats": quats,
            "grad_log_scales": log_scales,
            "grad_logits": logits,
            "grad_colors": colors,
            "grad_sh": sh,
            "grad_sh_rest": sh_rest,
        }
        # The first camera's threads zero these tensors in parallel. Zeroing the harmonics of a million Gaussians on
        # this thread would take a tenth of a step.
        empty = torch.empty_like if ctx.leases else torch.zeros_like
        out = {name: None if p is None else empty(p) for name, p in parameters.items()}
        grad_view = torch.zeros_like(viewmats)
        stages, blend = _compile(0), _compile(image.shape[-1])
        for norm in ctx.norms:
            norm.zero_()
        for c, lease in enumerate(ctx.leases):
            workspace = lease.workspace
            block = workspace.block
            workspace.need("hit_grad", block.hits * block.grad_stride)
            partial = torch.zeros(max(1, block.chunks), 12)
            _point(
                block,
                means=means,
                quats=quats,
                log_scales=log_scales,
                logits=logits,
                colors=colors,
                sh=sh,
                background=channel_background,
                image=image[c],
                alpha=alpha[c],
                grad_image=grad_image[c],
                grad_alpha=grad_alpha[c],
                grad_view=partial,
                grad_norm=ctx.norms[0][c],
                grad_abs=ctx.norms[1][c],
                **out,
            )
            block.sh_rest = _rest(sh, sh_rest)
            block.grad_sh_rest = _rest(out["grad_sh"], out["grad_sh_rest"])
            block.clear = 0 if c else (1 if sh_rest is None else 2)
            threads = scene.settings.threads
            run_workers(blend, block, source.BLEND_BACKWARD, min(threads, block.tiles_x * block.tiles_y))
            run_workers(stages, block, source.PROJECT_BACKWARD, min(threads, block.chunks))
            # One sum per chunk, added in a fixed order: the result does not depend on the number of threads.
            grad_view[c, :3] = partial.double().sum(0).reshape(3, 4).float()
        grad_background = None
        if background is not None and ctx.needs_input_grad[10]:
            grad_background = ((1 - alpha)[..., None] * grad_image[..., : scene.channels]).sum((0, 1, 2))
        return (None, None, *out.values(), grad_view, grad_background)


def rasterize(scene: Scene) -> RasterOutput:
    """Rasterise all cameras of `scene` (float32, contiguous, CPU)."""
    channels = scene.channels + int(scene.with_depth)
    if channels > source.MAX_CHANNELS:
        raise ValueError(f"{channels} channels, depth included; one call carries at most {source.MAX_CHANNELS}")
    cameras, n = scene.viewmats.shape[0], scene.means.shape[0]
    norms = (torch.zeros(cameras, n), torch.zeros(cameras, n))
    inputs = (scene.means, scene.quats, scene.log_scales, scene.opacity_logits, scene.colors, scene.sh, scene.sh_rest)
    out = _Images(*applied(_Rasterize, scene, norms, *inputs, scene.viewmats, scene.background))
    colors, depth = out.image, None
    if scene.with_depth:
        colors, depth_sum = out.image[..., :-1], out.image[..., -1]
        depth = expected_depth(depth_sum, out.alpha)
    return RasterOutput(
        colors=colors,
        alphas=out.alpha,
        depth_expected=depth,
        depth_median=out.median if scene.with_depth else None,
        radii=out.radii,
        means2d=out.means2d,
        weight_sum=out.weights[0] if scene.with_contributions else None,
        weight_max=out.weights[1] if scene.with_contributions else None,
        means2d_grad=norms[0],
        means2d_absgrad=norms[1],
        top_ids=out.top_ids if scene.with_top else None,
        top_weights=out.top_weights if scene.with_top else None,
    )
