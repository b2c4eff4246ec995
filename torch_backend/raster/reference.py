"""Reference backend of the rasteriser: plain torch, any float type and device, gradients by autograd.

It favours clarity over speed and defines what every other backend must compute; `constants.py` holds the rules.
Projection: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, section 4).
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ..torch_types import (
    AutogradContext,
    applied,
    checkpoint,
    cross,
    integers,
    norm,
    norm_1,
    on_gradient,
    unflatten,
)
from . import constants as k
from .settings import RasterOutput, Scene, camera_limits

# Largest number of (pixel, Gaussian) pairs blended at once. Blending takes a dozen arrays of this size.
_LANES = 2**20


class _FloorAtZero(torch.autograd.Function):
    """max(x, 0) whose gradient also passes at x <= 0 if a descent step would raise x, so that black can recover."""

    @staticmethod
    def forward(ctx: AutogradContext, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp_min(0.0)

    @staticmethod
    def backward(ctx: AutogradContext, *grads: Tensor) -> Tensor:
        x: Tensor = ctx.saved_tensors[0]
        (grad,) = grads
        return torch.where((x > 0) | (grad < 0), grad, torch.zeros_like(grad))


def sh_basis(dirs: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics [N, (degree+1)^2] of unit directions [N, 3], degree 0 to 3."""
    x, y, z = dirs.unbind(-1)
    out = [torch.full_like(x, k.SH_C0)]
    if degree > 0:
        out += [-k.SH_C1 * y, k.SH_C1 * z, -k.SH_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out += [
            k.SH_C2[0] * x * y,
            k.SH_C2[1] * y * z,
            k.SH_C2[2] * (2 * zz - xx - yy),
            k.SH_C2[3] * x * z,
            k.SH_C2[4] * (xx - yy),
        ]
        if degree > 2:
            out += [
                k.SH_C3[0] * y * (3 * xx - yy),
                k.SH_C3[1] * x * y * z,
                k.SH_C3[2] * y * (4 * zz - xx - yy),
                k.SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                k.SH_C3[4] * x * (4 * zz - xx - yy),
                k.SH_C3[5] * z * (xx - yy),
                k.SH_C3[6] * x * (xx - 3 * yy),
            ]
    return torch.stack(out, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of quaternions [N, 4] wxyz of any non-zero norm."""
    quats = quats / quats.detach().abs().amax(-1, keepdim=True)  # avoids underflow and overflow of the norm's squares
    w, x, y, z = (quats / norm(quats, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ),
        -1,
    ).reshape(-1, 3, 3)


@dataclass
class _Projected:
    """The visible Gaussians of one camera, front to back."""

    index: Tensor
    mean2d: Tensor
    conic: Tensor
    opacity: Tensor
    depth: Tensor
    colors: Tensor
    extent: Tensor
    radius: Tensor
    absgrad: Tensor | None = None
    """[V, 2]: the backward pass adds |d loss / d mean2d| of every pixel."""


def _finite_inputs(scene: Scene) -> Tensor:
    """Mask [N] of Gaussians that pass the culling tests that do not need a camera."""
    ok = scene.means.isfinite().all(-1) & (scene.quats.abs().amax(-1) > k.QUAT_MIN)
    ok &= scene.quats.isfinite().all(-1) & (scene.log_scales <= k.LOG_SCALE_MAX).all(-1)
    ok &= ~scene.opacity_logits.isnan()
    if scene.colors is not None:
        ok &= scene.colors.isfinite().all(-1)
    if scene.sh is not None:
        ok &= scene.sh[:, : (scene.sh_degree + 1) ** 2].isfinite().all(-1).all(-1)
    return ok


def _colors(scene: Scene, index: Tensor, means: Tensor, viewmat: Tensor) -> Tensor:
    """Channels [V, D] of the Gaussians `index`, seen from this camera."""
    parts: list[Tensor] = []
    if scene.sh is not None:
        position = -viewmat[:3, :3].T @ viewmat[:3, 3]
        dirs = means - position
        basis = sh_basis(dirs / norm(dirs, dim=-1, keepdim=True), scene.sh_degree)
        coefficients = scene.sh[index][:, : basis.shape[1]]
        parts.append(applied(_FloorAtZero, torch.einsum("nk,nkd->nd", basis, coefficients) + 0.5))
    if scene.colors is not None:
        parts.append(scene.colors[index])
    return torch.cat(parts, -1)


@dataclass
class _Footprint:
    """Projections of V Gaussians into one camera."""

    mean2d: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor
    det: Tensor
    opacity: Tensor
    depth: Tensor


def _footprint(scene: Scene, camera: int, index: Tensor) -> _Footprint:
    """Project the Gaussians `index`, which must have positive depth."""
    viewmat, K = scene.viewmats[camera], scene.Ks[camera].to(scene.means)
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = (scene.means[index] @ R.T + t).unbind(-1)
    mean2d = torch.stack((fx * x / z + cx, fy * y / z + cy), -1)

    x_low, x_high, y_low, y_high = camera_limits(scene, camera, k.FRUSTUM_MARGIN)
    # Only the Jacobian uses clamped positions, as in 3DGS: off screen, it would grow without bound.
    u, v, zero = (x / z).clamp(x_low, x_high), (y / z).clamp(y_low, y_high), torch.zeros_like(z)
    J = torch.stack((fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z), -1).reshape(-1, 2, 3)
    scales = scene.log_scales[index].clamp_min(k.LOG_SCALE_MIN).exp()
    B = J @ R @ (rotation_matrices(scene.quats[index]) * scales[:, None, :])
    raw = B @ B.transpose(-1, -2)
    # EWA's low-pass filter (Zwicker et al. 2001), as a variance in px^2.
    xx, xy, yy = raw[:, 0, 0] + k.LOW_PASS, raw[:, 0, 1], raw[:, 1, 1] + k.LOW_PASS
    # |b0 x b1|^2 equals det(B B^T), and avoids the cancellation in xx yy - xy^2.
    det_raw = cross(B[:, 0], B[:, 1]).square().sum(-1)
    det = det_raw + k.LOW_PASS * (raw[:, 0, 0] + raw[:, 1, 1]) + k.LOW_PASS**2
    opacity = torch.sigmoid(scene.opacity_logits[index])
    if scene.settings.antialiased:
        # Keeps the integral of a Gaussian that the low-pass widens (Mip-Splatting, Yu et al. 2024).
        opacity = opacity * (det_raw / det).clamp_min(k.COMPENSATION2_MIN).sqrt()
    return _Footprint(mean2d, xx, xy, yy, det, opacity, z)


def _project(scene: Scene, camera: int, candidates: Tensor) -> _Projected:
    """Project Gaussians `candidates` (indices) into one camera, cull, and sort by depth."""
    viewmat = scene.viewmats[camera]
    with torch.no_grad():
        z = scene.means[candidates] @ viewmat[2, :3] + viewmat[2, 3]
        candidates = candidates[(z > scene.settings.near) & z.isfinite()]
        f = _footprint(scene, camera, candidates)
        level = 2 * torch.log(f.opacity / k.ALPHA_MIN)
        # The box of the ellipse alpha >= ALPHA_MIN, which is smaller than 3 sigma for faint Gaussians.
        extent = torch.stack((f.xx, f.yy), -1).mul(level.clamp_min(0)[:, None]).sqrt()
        size = torch.tensor((scene.width, scene.height), dtype=extent.dtype, device=extent.device)
        keep = (level > 0) & (f.xx + f.yy < k.VARIANCE_MAX)
        keep &= ((f.mean2d + extent >= 0.5) & (f.mean2d - extent <= size - 0.5)).all(-1)
        half = 0.5 * (f.xx + f.yy)
        eigenvalue = half + ((0.5 * (f.xx - f.yy)).square() + f.xy * f.xy).sqrt()
        radius = (eigenvalue * level.clamp_min(0)).sqrt().ceil()
        order = keep.nonzero()[:, 0]
        order = order[torch.sort(f.depth[order], stable=True).indices]
    # Project only the kept Gaussians again: culled ones that overflowed would turn their zero gradient into NaN.
    index = candidates[order]
    f = _footprint(scene, camera, index)
    conic = torch.stack((f.yy, -f.xy, f.xx), -1) / f.det[:, None]
    return _Projected(
        index,
        f.mean2d,
        conic,
        f.opacity,
        f.depth,
        _colors(scene, index, scene.means[index], viewmat),
        extent[order],
        radius[order],
        torch.zeros_like(f.mean2d) if scene.settings.absgrad else None,
    )


@torch.no_grad()
def _hits(p: _Projected, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Hits of the Gaussians on `across` x `down` tiles: (members [hits], counts [tiles]).

    `members` are positions in `p`, tile after tile in raster order, front to back within each tile. A pair is left out
    if the ellipse alpha >= ALPHA_MIN misses the rectangle of the tile's pixel centres.
    """
    last = torch.tensor((across - 1, down - 1), device=p.mean2d.device)

    def tile(at: Tensor) -> Tensor:  # clamped as float, because a box may exceed the range of int64
        return (at.clamp(0, k.TILE * max(across, down)) / k.TILE).long().minimum(last)

    low, high = tile(p.mean2d - p.extent - 0.5), tile(p.mean2d + p.extent - 0.5)
    spans = (high - low + 1).clamp_min(0)
    boxes = spans.prod(-1)
    members = torch.arange(len(boxes), device=boxes.device).repeat_interleave(boxes)
    number = torch.arange(len(members), device=boxes.device) - (boxes.cumsum(0) - boxes)[members]
    xs, ys = low[members, 0] + number % spans[members, 0], low[members, 1] + number // spans[members, 0]
    keep = _ellipse_meets_tile(p, members, torch.stack((xs, ys), -1))
    tiles, order = torch.sort((ys * across + xs)[keep], stable=True)
    return members[keep][order], torch.bincount(tiles, minlength=across * down)


def _ellipse_meets_tile(p: _Projected, members: Tensor, tiles: Tensor) -> Tensor:
    """Mask [hits]: True if the Gaussian's ellipse reaches the rectangle of pixel centres of its tile.

    `tiles` [hits, 2] are tile numbers (x, y).
    """
    low = tiles * k.TILE + 0.5 - p.mean2d[members]
    high = low + (k.TILE - 1)
    a, b, c = p.conic[members].unbind(-1)
    inside = ((low <= 0) & (high >= 0)).all(-1)
    nearest = torch.full_like(a, torch.inf)
    for x in (low[:, 0], high[:, 0]):  # the minimum on an edge is where the slope is 0, or at an end of the edge
        y = torch.minimum(torch.maximum(-b * x / c, low[:, 1]), high[:, 1])
        nearest = torch.minimum(nearest, a * x * x + 2 * b * x * y + c * y * y)
    for y in (low[:, 1], high[:, 1]):
        x = torch.minimum(torch.maximum(-b * y / a, low[:, 0]), high[:, 0])
        nearest = torch.minimum(nearest, a * x * x + 2 * b * x * y + c * y * y)
    # The margin is harmless, because each pixel is tested again during blending.
    return inside | ~(nearest > 2 * torch.log(p.opacity[members] / k.ALPHA_MIN) + 0.01)


@dataclass
class _Batch:
    """Tiles with similar numbers of hits, padded to the largest: B tiles, P pixels each, M hits."""

    members: Tensor
    """[B, M]: positions in _Projected, front to back; arbitrary where not `valid`."""
    valid: Tensor
    """[B, M]: False for padding."""
    xs: Tensor
    """[B, TILE]: pixel centres of the columns; P = TILE * TILE in raster order."""
    ys: Tensor
    """[B, TILE]: pixel centres of the rows."""


def _blend(p: _Projected, batch: _Batch, transmittance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend the batch behind `transmittance` [B, P].

    Returns weights alpha T [B, P, M]; the transmittance after each hit [B, P, M] (no gradient; meaningless once it is
    at T_STOP); the weighted sums of colour and depth [B, P, D + 1]; the transmittance after all hits [B, P].
    """
    members = batch.members
    # Axes are [tile, row, column, hit]. dx has no row axis and dy no column axis, so most of the exponent is cheap.
    x, y = p.mean2d[members][:, None, None].unbind(-1)
    a, b, c = p.conic[members][:, None, None].unbind(-1)
    dx, dy = batch.xs[:, None, :, None] - x, batch.ys[:, :, None, None] - y
    exponent = (-0.5 * a * dx - b * dy) * dx - 0.5 * c * dy * dy
    if p.absgrad is not None and exponent.requires_grad:
        totals, slopes = p.absgrad.unbind(-1), ((a, dx, b, dy), (b, dx, c, dy))

        def gather(grad: Tensor) -> None:
            for total, (s, dx, t, dy) in zip(totals, slopes, strict=True):
                # Absolute per pixel, so that opposite gradients do not cancel (AbsGS, Ye et al. 2024).
                pixel = grad * (s.detach() * dx.detach() + t.detach() * dy.detach())
                total.index_add_(0, members.flatten(), norm_1(pixel, dims=(1, 2)).flatten())

        on_gradient(exponent, gather)
    opacity = (p.opacity[members] * batch.valid)[:, None]
    alpha = opacity * torch.exp(exponent.flatten(1, 2))
    alpha = alpha.clamp_max(k.ALPHA_MAX).masked_fill(alpha < k.ALPHA_MIN, 0.0)
    after = transmittance[..., None] * torch.cumprod(1 - alpha, -1)
    before = torch.cat((transmittance[..., None], after[..., :-1]), -1)
    # The Gaussian that crosses T_STOP still counts: the test is on the transmittance before it.
    weights = (alpha * before).masked_fill(before <= k.T_STOP, 0.0)
    sums = weights @ torch.cat((p.colors, p.depth[:, None]), -1)[members]
    return weights, after.detach(), sums, transmittance - weights.sum(-1)


@dataclass
class _Pixels:
    """Result of blending at P pixels of B tiles; no gradient in the last three fields."""

    sums: Tensor
    """[B, P, D + 1]: sum of alpha T times colour, and times depth."""
    transmittance: Tensor
    """[B, P]: remaining transmittance."""
    top: Tensor
    """[B, P] int64: position in _Projected of the Gaussian with the largest alpha T, -1 for none."""
    top_weight: Tensor
    """[B, P]: the largest alpha T."""
    median: Tensor
    """[B, P]: median depth as in RasterOutput."""


class _Camera:
    """Blends one camera's tiles, batch by batch. To bound memory, the backward pass recomputes each batch."""

    def __init__(self, scene: Scene, p: _Projected):
        self.scene, self.p = scene, p
        self.dtype, self.device = scene.means.dtype, scene.means.device
        self.weight_sum = torch.zeros(len(p.index), dtype=self.dtype, device=self.device)
        self.weight_max = torch.zeros_like(self.weight_sum)
        self.across, self.down = -(-scene.width // k.TILE), -(-scene.height // k.TILE)
        self.members, self.counts = _hits(p, self.across, self.down)
        self.starts = self.counts.cumsum(0) - self.counts

    def _batches(self) -> Iterator[Tensor]:
        """Batches of all tiles, those with most hits first; `_LANES` limits the size of a batch."""
        order = self.counts.argsort(descending=True)
        counts, first = integers(self.counts[order]), 0
        while first < len(counts):
            size = max(1, _LANES // (max(counts[first], 1) * k.TILE**2))
            yield order[first : first + size]
            first += size

    def _empty(self, tiles: Tensor) -> tuple[Tensor, Tensor, _Pixels]:
        """Pixel centres of columns and rows [B, TILE] of `tiles` [B], and the pixels before any Gaussian."""
        centres = torch.arange(k.TILE, dtype=self.dtype, device=self.device) + 0.5
        xs, ys = (at[:, None] * k.TILE + centres for at in (tiles % self.across, tiles // self.across))
        inside = ((ys < self.scene.height)[:, :, None] & (xs < self.scene.width)[:, None, :]).flatten(1)
        # Pixels outside the image start as finished.
        transmittance = torch.where(inside, 1.0, k.T_STOP).to(dtype=self.dtype, device=self.device)
        sums = transmittance.new_zeros(*transmittance.shape, self.p.colors.shape[1] + 1)
        top, top_weight = torch.full_like(transmittance, -1, dtype=torch.int64), torch.zeros_like(transmittance)
        return xs, ys, _Pixels(sums, transmittance, top, top_weight, torch.full_like(transmittance, k.DEPTH_EMPTY))

    def _tiles(self, tiles: Tensor) -> _Pixels:
        """Blend `tiles` [B], in steps over their hits if a single tile exceeds `_LANES`."""
        xs, ys, out = self._empty(tiles)
        starts, counts = self.starts[tiles, None], self.counts[tiles, None]
        crossed = torch.zeros_like(out.transmittance, dtype=torch.bool)
        most, step = int(counts.max()), _LANES // k.TILE**2
        for first in range(0, most, step):
            numbers = torch.arange(first, min(first + step, most), device=tiles.device)
            valid = numbers < counts
            batch = _Batch(self.members[torch.where(valid, starts + numbers, 0)], valid, xs, ys)
            weights, after, sums, out.transmittance = checkpoint(_blend, self.p, batch, out.transmittance)
            out.sums = out.sums + sums
            with torch.no_grad():
                if self.scene.with_contributions:
                    self._contribute(batch, weights)
                if self.scene.with_depth or self.scene.with_top:
                    crossed = self._pick(batch, weights, after, out, crossed)
        return out

    def _contribute(self, batch: _Batch, weights: Tensor) -> None:
        members = batch.members.flatten()
        self.weight_sum.index_add_(0, members, weights.sum(1).flatten())
        self.weight_max.scatter_reduce_(0, members, weights.amax(1).flatten(), "amax")

    def _pick(self, batch: _Batch, weights: Tensor, after: Tensor, out: _Pixels, crossed: Tensor) -> Tensor:
        """Update top and median. Returns a mask [B, P] of pixels with transmittance <= 0.5, whose median is final."""
        weight, at = weights.max(-1)  # returns the first of equal maxima
        larger = weight > out.top_weight
        out.top = torch.where(larger, batch.members.gather(1, at), out.top)
        out.top_weight = torch.where(larger, weight, out.top_weight)
        median = torch.where(larger, self.p.depth[out.top], out.median)
        crosses = after <= 0.5
        crossing = batch.members.gather(1, crosses.to(torch.uint8).argmax(-1))
        median = torch.where(crosses.any(-1), self.p.depth[crossing], median)
        out.median = torch.where(crossed, out.median, median)
        return crossed | crosses.any(-1)

    def images(self) -> _Pixels:
        """All pixels as [H, W, ...]."""
        tiles = list(self._batches())
        pixels = [self._tiles(batch) for batch in tiles]
        place = torch.cat(tiles).argsort()

        def image(name: str) -> Tensor:
            value = torch.cat([getattr(batch, name) for batch in pixels])[place]
            value = unflatten(unflatten(value, 1, (k.TILE, k.TILE)), 0, (self.down, self.across))
            return value.transpose(1, 2).flatten(2, 3).flatten(0, 1)[: self.scene.height, : self.scene.width]

        return _Pixels(*(image(field.name) for field in fields(_Pixels)))


def _watch_gradients(p: _Projected, gradient: Tensor, absgradient: Tensor) -> None:
    """Make the backward pass write one camera's densification figures into `gradient` and `absgradient` [N]."""
    if not p.mean2d.requires_grad:
        return

    def write(grad: Tensor) -> None:
        gradient.zero_()[p.index] = norm(grad, dim=-1)
        if p.absgrad is not None:
            absgradient.zero_()[p.index] = norm(p.absgrad, dim=-1)
            p.absgrad.zero_()

    on_gradient(p.mean2d, write)


def expected_depth(depth_sum: Tensor, alphas: Tensor) -> Tensor:
    """depth_sum / alphas; DEPTH_EMPTY with zero gradient where alpha is 0."""
    empty = ~(alphas > 0)
    return torch.where(empty, torch.full_like(depth_sum, k.DEPTH_EMPTY), depth_sum / alphas.masked_fill(empty, 1.0))


def rasterize(scene: Scene) -> RasterOutput:
    """Rasterise all cameras of `scene`, one after the other."""
    n, cameras = scene.means.shape[0], scene.viewmats.shape[0]
    zeros = scene.means.new_zeros
    gradient, absgradient, weight_sum, weight_max = zeros(4, cameras, n)
    radii = torch.zeros(cameras, n, dtype=torch.int32, device=scene.means.device)
    means2d = zeros(cameras, n, 2)
    background = zeros(scene.channels) if scene.background is None else scene.background
    candidates = _finite_inputs(scene).nonzero()[:, 0]
    size = (0, scene.height, scene.width)
    images: list[tuple[Tensor, ...]] = []
    for camera in range(cameras):
        p = _project(scene, camera, candidates)
        _watch_gradients(p, gradient[camera], absgradient[camera])
        radii[camera, p.index] = p.radius.clamp_max(2.0**30).to(torch.int32)
        means2d[camera, p.index] = p.mean2d.detach()
        blender = _Camera(scene, p)
        out = blender.images()
        weight_sum[camera, p.index], weight_max[camera, p.index] = blender.weight_sum, blender.weight_max
        top = torch.cat((p.index, p.index.new_tensor([-1])))[out.top].to(torch.int32)
        images.append(
            (
                out.sums[..., :-1] + out.transmittance[..., None] * background,
                1 - out.transmittance,
                out.sums[..., -1],
                out.median,
                top,
                out.top_weight,
            )
        )
    if cameras:
        colors, alphas, depth_sum, median, top, top_weight = (torch.stack(i) for i in zip(*images, strict=True))
    else:
        colors, top = zeros(*size, scene.channels), radii.new_zeros(size)
        alphas = depth_sum = median = top_weight = zeros(size)
    return RasterOutput(
        colors=anchor(colors, scene),
        alphas=alphas,
        depth_expected=expected_depth(depth_sum, alphas) if scene.with_depth else None,
        depth_median=median if scene.with_depth else None,
        radii=radii,
        means2d=means2d,
        weight_sum=weight_sum if scene.with_contributions else None,
        weight_max=weight_max if scene.with_contributions else None,
        means2d_grad=gradient,
        means2d_absgrad=absgradient,
        top_ids=top if scene.with_top else None,
        top_weights=top_weight if scene.with_top else None,
    )


def anchor(colors: Tensor, scene: Scene) -> Tensor:
    """`colors` connected to every input, so that inputs without influence get zero gradients instead of None."""
    inputs = (
        scene.means,
        scene.quats,
        scene.log_scales,
        scene.opacity_logits,
        scene.colors,
        scene.sh,
        scene.viewmats,
        scene.background,
    )
    for value in inputs:
        if value is not None and value.requires_grad:
            colors = colors + value.reshape(-1)[:0].sum()
    return colors
