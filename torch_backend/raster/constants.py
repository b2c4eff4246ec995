"""Constants and rules of culling, blending and projection that every backend of the rasteriser follows.

Culling (per Gaussian and camera). A Gaussian is kept if all tests hold; each test is phrased so that NaN fails it:
  finite parameters; ``log_scales <= LOG_SCALE_MAX``; largest quaternion component > ``QUAT_MIN``; camera depth > near;
  trace of the projected covariance < ``VARIANCE_MAX``; effective opacity > ``ALPHA_MIN``; the bounding box of the
  ellipse ``alpha >= ALPHA_MIN`` meets the rectangle of the image's pixel centres.
Blending (per pixel, front to back by camera depth, ties by index):
  skip where alpha < ``ALPHA_MIN``; clamp alpha to ``ALPHA_MAX`` (no gradient through the clamp); stop once the
  transmittance *before* a Gaussian is <= ``T_STOP``, so the Gaussian that crosses it counts (3DGS leaves it out).
Projection: EWA with ``LOW_PASS`` px^2 added to the diagonal. For the Jacobian, x/z and y/z are clamped to the frustum
widened by ``FRUSTUM_MARGIN`` half-widths on each side, with zero gradient outside. The frustum's limits are relative to
the principal point.
"""

import math

# As in Kerbl et al. 2023, like the numbers of the two constants below: less than one step of an 8-bit image.
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is skipped at a pixel where its alpha is below this."""
ALPHA_MAX = 0.99
"""Upper clamp of alpha, so that 1 - alpha stays positive."""
T_STOP = 1e-4
"""(1 - ALPHA_MAX)^2: a pixel is finished once its transmittance is at or below this. The number is that of Kerbl et
al., the rule is not: see above."""
# As in 3DGS: it makes every Gaussian at least about one pixel wide.
LOW_PASS = 0.3
"""Variance in px^2 added to both diagonal entries of every projected covariance."""
# The affine approximation (EWA) grows without bound off screen, so its position is clamped, as in 3DGS.
FRUSTUM_MARGIN = 0.3
"""Widening of the frustum for the Jacobian's clamp; the limit of a centred frustum is 1.3 tan(fov / 2)."""
QUAT_MIN = 1e-6
"""Gaussians whose largest quaternion component has at most this magnitude are culled."""
LOG_SCALE_MIN = -30.0
"""Lower clamp of log-scales; exp(-30) is a negligible extent."""
LOG_SCALE_MAX = 30.0
"""Gaussians with a log-scale above this are culled."""
VARIANCE_MAX = 1e12
"""Gaussians whose projected variances sum to this or more, in px^2, are culled: float32 cannot invert them."""
COMPENSATION2_MIN = 0.005**2
"""Floor of the squared opacity compensation of the antialiased mode; zero gradient below it."""
DEPTH_EMPTY = 1e10
"""Depth of a pixel whose alpha is 0."""
TILE = 16
"""Edge of a tile in pixels."""
SIDE_MAX = 2**18
"""Largest width and height of an image. Beyond it float32 positions are coarser than 1/64 px, and the number of tiles
in a column would exceed 15 bits."""

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
"""Real spherical harmonics in the order and signs of 3D Gaussian Splatting (Kerbl et al. 2023), degrees 0 to 3."""
