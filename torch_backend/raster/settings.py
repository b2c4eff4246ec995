"""Settings, inputs and outputs of the rasteriser."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..native import default_threads


@dataclass(frozen=True)
class RasterSettings:
    """Settings of the rasteriser apart from scene and camera."""

    near: float = 0.01
    """Gaussians at or nearer than this camera depth are culled, in world units; the default suits a scene whose cameras
    have unit extent."""
    antialiased: bool = False
    """Scale opacities by sqrt(det / det_blurred), so that the low-pass does not thicken thin Gaussians."""
    absgrad: bool = True
    """Also compute the sum over pixels of |d loss / d mean2d| in the backward pass (RasterOutput.means2d_absgrad)."""
    overscan: tuple[float, float] = (0.0, 0.0)
    """Extra pixels around the camera's frame: on the left and on the right, above and below. The Jacobian is clamped to
    the frame's frustum, so overscan does not change the pixels within the frame."""
    threads: int = field(default_factory=default_threads)
    """Worker threads of the CPU backend. The result is bitwise the same for any number."""


@dataclass
class RasterOutput:
    """Images and per-Gaussian figures of C cameras, N Gaussians, D channels. Float tensors are float32 (reference: the
    inputs' type)."""

    colors: Tensor
    """[C, H, W, D]: sum of alpha T color, plus the remaining transmittance times the background."""
    alphas: Tensor
    """[C, H, W]: 1 - remaining transmittance."""
    depth_expected: Tensor | None
    """[C, H, W]: camera depth (planar) averaged with weights alpha T; 1e10 where alpha is 0. Differentiable."""
    depth_median: Tensor | None
    """[C, H, W]: camera depth of the Gaussian at which the transmittance falls to 0.5 or below. Where it stays above
    0.5, depth of the Gaussian with the largest alpha T; 1e10 where alpha is 0. No gradient."""
    radii: Tensor
    """[C, N] int32: half the major axis, in px, of the ellipse alpha >= 1/255, rounded up; 0 = culled."""
    means2d: Tensor
    """[C, N, 2]: projected means, px (pixel centres at +0.5); 0 where culled. No gradient."""
    weight_sum: Tensor | None
    """[C, N]: sum over pixels of alpha T. No gradient."""
    weight_max: Tensor | None
    """[C, N]: largest alpha T over pixels. No gradient."""
    means2d_grad: Tensor
    """[C, N]: |d loss / d mean2d| in 1/px. Zeros until a backward pass writes it in place; each pass overwrites."""
    means2d_absgrad: Tensor
    """[C, N]: norm of (sum over pixels |d loss / d x|, sum |d loss / d y|) in 1/px. Each backward pass overwrites it,
    as it does `means2d_grad`. Zeros if settings.absgrad is off."""
    top_ids: Tensor | None = None
    """[C, H, W] int32: index of the Gaussian with the largest alpha T at the pixel, the front one if several are equal;
    -1 where alpha is 0."""
    top_weights: Tensor | None = None
    """[C, H, W]: the largest alpha T at the pixel; 0 where alpha is 0. No gradient."""
    hits: Tensor | None = None
    """[2] int64, CUDA backend only: number of (Gaussian, tile) pairs of the call, and capacity of its list. If the
    first exceeds the second, the call was slower but correct (`hit_lists.py`)."""


@dataclass
class Scene:
    """Validated inputs of one call, passed to the backends."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    colors: Tensor | None
    sh: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    """float64 on the CPU; for the CUDA backend float32 on the device."""
    background: Tensor | None
    width: int
    height: int
    sh_degree: int
    settings: RasterSettings
    with_depth: bool
    with_contributions: bool
    with_top: bool = False
    sh_rest: Tensor | None = None
    """Harmonics above degree 0, [N, K - 1, 3], if `sh` is [N, 1, 3]. The CPU backend reads both without copying."""

    @property
    def channels(self) -> int:
        """D: 3 channels of the harmonics, if any, then those of `colors`."""
        return (0 if self.sh is None else 3) + (0 if self.colors is None else self.colors.shape[1])


def camera_limits(scene: Scene, camera: int, margin: float) -> tuple[float, float, float, float]:
    """Bounds of x/z and y/z for the Jacobian: (x_low, x_high, y_low, y_high) of a camera's widened frustum.

    `margin` is a share of half the frame without overscan. Overscan larger than the margin widens the frustum to the
    picture's edge.
    """
    K, (across, down), width, height = scene.Ks[camera], scene.settings.overscan, scene.width, scene.height
    fx, fy, cx, cy = (float(v) for v in torch.stack((K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
    mx = max(0.0, margin * 0.5 * (width - 2 * across) - across) / fx
    my = max(0.0, margin * 0.5 * (height - 2 * down) - down) / fy
    return -cx / fx - mx, (width - cx) / fx + mx, -cy / fy - my, (height - cy) / fy + my
