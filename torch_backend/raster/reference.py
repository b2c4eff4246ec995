"""Rasteriser oracle: plain torch, any float type and device, gradients by autograd.

Slow and clear. It states in tensor language what every other body must compute; `constants.py` holds the rules.
Projection: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, section 4).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from . import constants as k
from .settings import RasterOutput, Scene, camera_limits


class _FloorAtZero(torch.autograd.Function):
    """max(x, 0) that lets a gradient through below 0 when descending it would raise x: black is no trap."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp_min(0.0)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return torch.where((x > 0) | (grad < 0), grad, torch.zeros_like(grad))


def sh_basis(dirs: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics [N, (degree+1)^2] of unit directions [N, 3], degree 0 to 3."""
    x, y, z = dirs.unbind(-1)
    out = [torch.full_like(x, k.SH_C0)]
    if degree > 0:
        out += [-k.SH_C1 * y, k.SH_C1 * z, -k.SH_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out += [k.SH_C2[0] * x * y, k.SH_C2[1] * y * z, k.SH_C2[2] * (2 * zz - xx - yy),
                k.SH_C2[3] * x * z, k.SH_C2[4] * (xx - yy)]
        if degree > 2:
            out += [k.SH_C3[0] * y * (3 * xx - yy), k.SH_C3[1] * x * y * z, k.SH_C3[2] * y * (4 * zz - xx - yy),
                    k.SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), k.SH_C3[4] * x * (4 * zz - xx - yy),
                    k.SH_C3[5] * z * (xx - yy), k.SH_C3[6] * x * (xx - 3 * yy)]
    return torch.stack(out, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of quaternions [N, 4] wxyz of any non-zero norm."""
    quats = quats / quats.detach().abs().amax(-1, keepdim=True)  # the norm's squares neither vanish nor overflow
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack((
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1).reshape(-1, 3, 3)


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


def _finite_inputs(scene: Scene) -> Tensor:
    """Mask [N] of Gaussians whose parameters all obey the rules that need no camera."""
    ok = scene.means.isfinite().all(-1) & (scene.quats.abs().amax(-1) > k.QUAT_MIN)
    ok &= scene.quats.isfinite().all(-1) & (scene.log_scales <= k.LOG_SCALE_MAX).all(-1)
    ok &= ~scene.opacity_logits.isnan()
    if scene.colors is not None:
        ok &= scene.colors.isfinite().all(-1)
    if scene.sh is not None:
        ok &= scene.sh[:, : (scene.sh_degree + 1) ** 2].isfinite().all(-1).all(-1)
    return ok


def _colors(scene: Scene, index: Tensor, means: Tensor, viewmat: Tensor) -> Tensor:
    """Channels [V, D] of the Gaussians `index` as this camera sees them."""
    parts = []
    if scene.sh is not None:
        position = -viewmat[:3, :3].T @ viewmat[:3, 3]
        dirs = means - position
        basis = sh_basis(dirs / dirs.norm(dim=-1, keepdim=True), scene.sh_degree)
        coefficients = scene.sh[index][:, : basis.shape[1]]
        parts.append(_FloorAtZero.apply(torch.einsum("nk,nkd->nd", basis, coefficients) + 0.5))
    if scene.colors is not None:
        parts.append(scene.colors[index])
    return torch.cat(parts, -1)


def _project(scene: Scene, camera: int, candidates: Tensor) -> _Projected:
    """Project Gaussians `candidates` (indices) into one camera, cull, and sort by depth."""
    viewmat, K = scene.viewmats[camera], scene.Ks[camera].to(scene.means)
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    with torch.no_grad():
        z = scene.means[candidates] @ R[2] + t[2]
        candidates = candidates[(z > scene.settings.near) & z.isfinite()]
    means = scene.means[candidates]
    x, y, z = (means @ R.T + t).unbind(-1)
    mean2d = torch.stack((fx * x / z + cx, fy * y / z + cy), -1)

    x_low, x_high, y_low, y_high = camera_limits(scene.Ks[camera], scene.width, scene.height, k.FRUSTUM_MARGIN)
    u, v, zero = (x / z).clamp(x_low, x_high), (y / z).clamp(y_low, y_high), torch.zeros_like(z)
    J = torch.stack((fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z), -1).reshape(-1, 2, 3)
    scales = scene.log_scales[candidates].clamp_min(k.LOG_SCALE_MIN).exp()
    B = J @ R @ (rotation_matrices(scene.quats[candidates]) * scales[:, None, :])
    raw = B @ B.transpose(-1, -2)
    xx, xy, yy = raw[:, 0, 0] + k.LOW_PASS, raw[:, 0, 1], raw[:, 1, 1] + k.LOW_PASS
    # |b0 x b1|^2 is det(B B^T) without the cancellation of xx yy - xy^2.
    det_raw = torch.linalg.cross(B[:, 0], B[:, 1]).square().sum(-1)
    det = det_raw + k.LOW_PASS * (raw[:, 0, 0] + raw[:, 1, 1]) + k.LOW_PASS**2
    opacity = torch.sigmoid(scene.opacity_logits[candidates])
    if scene.settings.antialiased:
        opacity = opacity * (det_raw / det).clamp_min(k.COMPENSATION2_MIN).sqrt()

    with torch.no_grad():
        level = 2 * torch.log(opacity / k.ALPHA_MIN)
        extent = torch.stack((xx, yy), -1).mul(level.clamp_min(0)[:, None]).sqrt()
        size = torch.tensor((scene.width, scene.height), dtype=extent.dtype, device=extent.device)
        keep = (level > 0) & (xx + yy < k.VARIANCE_MAX)
        keep &= ((mean2d + extent >= 0.5) & (mean2d - extent <= size - 0.5)).all(-1)
        half = 0.5 * (xx + yy)
        radius = ((half + ((0.5 * (xx - yy)).square() + xy * xy).sqrt()) * level.clamp_min(0)).sqrt().ceil()
        order = keep.nonzero()[:, 0]
        order = order[torch.sort(z[order], stable=True).indices]
    conic = torch.stack((yy, -xy, xx), -1) / det[:, None]
    index = candidates[order]
    return _Projected(index, mean2d[order], conic[order], opacity[order], z[order],
                      _colors(scene, index, means[order], viewmat), extent[order], radius[order])


def _blend_tile(p: _Projected, members: Tensor, pixels: Tensor, absgrad: Tensor | None) -> tuple[Tensor, Tensor]:
    """Weights alpha T [P, M] and transmittance after each [P, M] of Gaussians `members` [M] at pixel centres [P, 2]."""
    mean2d = p.mean2d[members].expand(pixels.shape[0], -1, -1)
    if absgrad is not None and mean2d.requires_grad:
        index = p.index[members]

        def gather(grad: Tensor) -> None:
            absgrad.index_add_(0, index, grad.abs().sum(0))

        mean2d.register_hook(gather)
    dx, dy = (pixels[:, None, :] - mean2d).unbind(-1)
    a, b, c = p.conic[members].unbind(-1)
    alpha = p.opacity[members] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= k.ALPHA_MIN, alpha.clamp_max(k.ALPHA_MAX), torch.zeros_like(alpha))
    with torch.no_grad():
        before = torch.cumprod(1 - alpha, -1).roll(1, -1)
        before[:, 0] = 1
        live = before > k.T_STOP
    alpha = torch.where(live, alpha, torch.zeros_like(alpha))
    after = torch.exp(torch.cumsum(torch.log1p(-alpha), -1))
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), -1)
    return alpha * before, after


def _median_depth(weights: Tensor, after: Tensor, depth: Tensor) -> Tensor:
    """Depth [P] at which the transmittance reaches 0.5, else that of the largest weight, else DEPTH_EMPTY."""
    crossing = after <= 0.5
    pick = torch.where(crossing.any(-1), crossing.to(torch.uint8).argmax(-1), weights.argmax(-1))
    return torch.where(weights.amax(-1) > 0, depth[pick], torch.full_like(weights[:, 0], k.DEPTH_EMPTY))


class _Camera:
    """Accumulates the images of one camera tile by tile; rows of the images are pixels in raster order."""

    def __init__(self, scene: Scene, p: _Projected, absgrad: Tensor | None):
        self.scene, self.p, self.absgrad = scene, p, absgrad
        like = {"dtype": scene.means.dtype, "device": scene.means.device}
        n = scene.means.shape[0]
        self.weight_sum, self.weight_max = torch.zeros(n, **like), torch.zeros(n, **like)
        background = scene.background
        self.background = torch.zeros(scene.channels, **like) if background is None else background

    def tile(self, x0: int, y0: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """(flat pixel ids, colors, alphas, depth sums, depth medians) of the tile whose first pixel is x0, y0."""
        scene, p = self.scene, self.p
        like = {"dtype": scene.means.dtype, "device": scene.means.device}
        xs = torch.arange(x0, min(x0 + k.TILE, scene.width), device=scene.means.device)
        ys = torch.arange(y0, min(y0 + k.TILE, scene.height), device=scene.means.device)
        ids = (ys[:, None] * scene.width + xs[None, :]).reshape(-1)
        pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).reshape(-1, 2).to(**like) + 0.5
        with torch.no_grad():
            low, high = pixels[0], pixels[-1]
            hit = ((p.mean2d + p.extent >= low) & (p.mean2d - p.extent <= high)).all(-1)
            members = hit.nonzero()[:, 0]
        if members.numel() == 0:
            zero = torch.zeros(len(ids), **like)
            return ids, self.background.expand(len(ids), -1), zero, zero, torch.full_like(zero, k.DEPTH_EMPTY)
        weights, after = _blend_tile(p, members, pixels, self.absgrad)
        left = after[:, -1]
        colors = weights @ p.colors[members] + left[:, None] * self.background
        depth = p.depth[members]
        with torch.no_grad():
            index = p.index[members]
            self.weight_sum.index_add_(0, index, weights.sum(0))
            self.weight_max[index] = torch.maximum(self.weight_max[index], weights.amax(0))
            median = _median_depth(weights, after, depth)
        return ids, colors, 1 - left, weights @ depth, median

    def images(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(colors [H, W, D], alphas, depth sums, depth medians [H, W])."""
        w, h = self.scene.width, self.scene.height
        tiles = [self.tile(x, y) for y in range(0, h, k.TILE) for x in range(0, w, k.TILE)]
        ids, *images = (torch.cat(part) for part in zip(*tiles, strict=True))
        place = torch.empty_like(ids)
        place[ids] = torch.arange(len(ids), device=ids.device)
        colors, alphas, depth, median = (image[place] for image in images)
        return colors.reshape(h, w, -1), alphas.reshape(h, w), depth.reshape(h, w), median.reshape(h, w)


def _watch_gradients(p: _Projected, norm: Tensor, absnorm: Tensor, absgrad: Tensor | None) -> None:
    """Have the backward pass write the densification figures of one camera into `norm` and `absnorm` [N]."""
    if not p.mean2d.requires_grad:
        return

    def write(grad: Tensor) -> None:
        norm.zero_()[p.index] = grad.norm(dim=-1)
        if absgrad is not None:
            absnorm.copy_(absgrad.norm(dim=-1))
            absgrad.zero_()

    p.mean2d.register_hook(write)


def expected_depth(depth_sum: Tensor, alphas: Tensor) -> Tensor:
    """depth_sum / alphas, DEPTH_EMPTY where alpha is 0 (with zero gradient there)."""
    empty = ~(alphas > 0)
    return torch.where(empty, torch.full_like(depth_sum, k.DEPTH_EMPTY), depth_sum / alphas.masked_fill(empty, 1.0))


def rasterize(scene: Scene) -> RasterOutput:
    """All cameras of `scene`, one after the other."""
    n, cameras = scene.means.shape[0], scene.viewmats.shape[0]
    like = {"dtype": scene.means.dtype, "device": scene.means.device}
    norm, absnorm = torch.zeros(cameras, n, **like), torch.zeros(cameras, n, **like)
    radii = torch.zeros(cameras, n, dtype=torch.int32, device=scene.means.device)
    means2d = torch.zeros(cameras, n, 2, **like)
    candidates = _finite_inputs(scene).nonzero()[:, 0]
    rows: list[tuple[Tensor, ...]] = []
    for camera in range(cameras):
        p = _project(scene, camera, candidates)
        absgrad = torch.zeros(n, 2, **like) if scene.settings.absgrad else None
        _watch_gradients(p, norm[camera], absnorm[camera], absgrad)
        radii[camera, p.index] = p.radius.clamp_max(2.0**30).to(torch.int32)
        means2d[camera, p.index] = p.mean2d.detach()
        state = _Camera(scene, p, absgrad)
        rows.append((*state.images(), state.weight_sum, state.weight_max))
    if cameras:
        colors, alphas, depth_sum, median, weight_sum, weight_max = (torch.stack(r) for r in zip(*rows, strict=True))
    else:
        size = (0, scene.height, scene.width)
        colors, alphas, depth_sum, median = (torch.zeros(*size, *d, **like) for d in ((scene.channels,), (), (), ()))
        weight_sum = weight_max = torch.zeros(0, n, **like)
    colors = anchor(colors, scene)
    return RasterOutput(
        colors=colors, alphas=alphas,
        depth_expected=expected_depth(depth_sum, alphas) if scene.with_depth else None,
        depth_median=median if scene.with_depth else None, radii=radii, means2d=means2d,
        weight_sum=weight_sum if scene.with_contributions else None,
        weight_max=weight_max if scene.with_contributions else None,
        means2d_grad=norm, means2d_absgrad=absnorm)


def anchor(colors: Tensor, scene: Scene) -> Tensor:
    """Tie `colors` to every input, so that inputs that reach no pixel get zero gradients instead of none."""
    inputs = (scene.means, scene.quats, scene.log_scales, scene.opacity_logits, scene.colors, scene.sh, scene.viewmats,
              scene.background)
    for value in inputs:
        if value is not None and value.requires_grad:
            colors = colors + value.reshape(-1)[:0].sum()
    return colors
