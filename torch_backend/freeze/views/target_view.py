"""The target view, that is, the frozen frame being composited: its camera, visible surface and scene flow."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...raster import RasterSettings
from ...scene import resize_intrinsics
from ...torch_types import norm_of_all
from ...train.model import render
from ..frozen import FrozenGaussians, FrozenImage, OutputFrame
from .reproject import pixel_centres, resized, unproject
from .source_views import SourceViews


@dataclass
class TargetView:
    """A frozen frame being composited: its camera, its render, and maps of the visible surface."""

    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] in pixels of the picture with its overscan."""
    image: FrozenImage
    """The splats' render of the frame, overscan included."""
    exposed_at: float
    """Normalised time whose exposure the frame has."""
    is_clip_view: bool
    """True if pose, lens, exposure and size are those of a frame of the clip."""
    t: int
    """Frame number of plate t*, the plate nearest to the instant."""
    frozen: FrozenGaussians
    """The scene at t*."""
    points: Tensor
    """[h, w, 3] visible world points, at decision resolution."""
    depth: Tensor
    """[h, w] depth of `points` along the camera's axis."""
    motion: Tensor
    """[h, w] in 0..1: moving surfaces at t*."""
    per_pixel: float
    """Pixels at decision resolution per pixel of the picture."""
    beyond: tuple[int, int]
    """Pixels of overscan: (left and right, above and below)."""
    doubt: Tensor
    """[h, w] in 0..1: where plates of other times are trusted only if they agree with the model."""
    moved: Tensor
    """[h, w] in 0..1: `motion`, and on the clip's own poses also the pixels where the frame's own plate is rejected."""
    out_of_view: Tensor
    """[h, w] in 0..1: pixels of moving surfaces that no plate near t* shows, so their state at t* is unknown."""
    centre: Tensor
    """[3] camera centre, scene units; on the CPU, as the cameras of the clip."""

    def settings(self, width: int, height: int) -> RasterSettings:
        """Settings to render the picture, overscan included, at another size."""
        rows, columns = self.image.alpha.shape
        return RasterSettings(overscan=(self.beyond[0] * width / columns, self.beyond[1] * height / rows))


def target_view(
    source_views: SourceViews,
    output: OutputFrame,
    frozen: FrozenGaussians,
    image: FrozenImage,
    width: int,
    height: int,
) -> TargetView:
    """The target view of a frame, from the splats alone.

    Args:
        output: camera and instant of the frame.
        frozen: the scene frozen at `output.t_star`.
        image: the splats' render of the frame, overscan included.
        width, height: pixels of the frame without overscan.
    """
    rows, columns = image.alpha.shape
    K, beyond = with_overscan(output.K, image, width, height)
    per_pixel = min(1.0, source_views.config.width / width)
    w, h = max(8, round(columns * per_pixel)), max(8, round(rows * per_pixel))
    device = image.depth.device
    viewmat, small = output.viewmat.to(device), pixel_centres(w, h, device)
    # Pixel at each centre, in integers: a centre on the border of two pixels always belongs to the second.
    across, down = ((2 * torch.arange(n, device=device) + 1) * of // (2 * n) for n, of in ((w, columns), (h, rows)))
    depth = image.depth[down[:, None], across]
    points = unproject(small, depth, viewmat, resize_intrinsics(K[None], columns, rows, w, h)[0].to(device))
    t = min(source_views.frames, key=lambda frame: abs(frame - output.t_star))
    motion = resized(image.motion, w, h)
    is_clip_view = _is_clip_view(source_views, output, width, height)
    zeros = torch.zeros_like(motion)
    return TargetView(
        viewmat, K.to(device), image, source_views.scene.time_of_frame(output.exposed_like), is_clip_view, t, frozen,
        points, depth, motion, w / columns, beyond, zeros, motion, zeros,
        -output.viewmat[:3, :3].T @ output.viewmat[:3, 3],
    )  # fmt: skip


def _is_clip_view(source_views: SourceViews, output: OutputFrame, width: int, height: int) -> bool:
    """True if the frame has the pose, lens and exposure of a frame of the clip, and the size of its plate."""
    i = source_views.index.get(output.frame)
    return (
        i is not None
        and (width, height) == (source_views.plates.width, source_views.plates.height)
        and output.frame in source_views.frames
        and output.exposed_like == float(output.frame)
        and torch.equal(output.viewmat, source_views.scene.viewmats[i])
        and torch.allclose(output.K, source_views.scene.camera_at(width, height)[i], rtol=1e-4)
    )


def parallax(source_views: SourceViews, target: TargetView, frame: int, depth: Tensor, depth_error: float) -> Tensor:
    """Misplacement of points in a plate by a relative depth error `depth_error`, in pixels at width 640."""
    travel = norm_of_all(source_views.centres[source_views.index[frame]] - target.centre)
    focal = target.K[0, 0] * target.per_pixel
    return focal * travel / depth.clamp_min(1e-6) * depth_error / source_views.unit


def displacements(
    source_views: SourceViews, target: TargetView, chosen: list[int], size: tuple[int, int] | None = None
) -> list[Tensor]:
    """[h, w, 3] scene flow of the visible surface from t* to each plate, scene units.

    `size` is (w, h). None: decision resolution.
    """
    w, h = size or target.depth.shape[::-1]
    rows, state = source_views.rows, target.frozen.state
    if not len(rows):
        return [target.points.new_zeros(h, w, 3) for _ in chosen]
    extra = torch.zeros(len(state["means"]), 3 * len(chosen), device=state["means"].device)
    now = state["means"][rows]
    for n, frame in enumerate(chosen):
        extra[rows, 3 * n : 3 * n + 3] = source_views.view(frame).offsets - now
    rows_full, columns = target.image.alpha.shape
    K = resize_intrinsics(target.K[None], columns, rows_full, w, h)[0]
    out = render(
        state, 0, target.viewmat, K, w, h, colors=extra, with_contributions=False, settings=target.settings(w, h),
    )  # fmt: skip
    flow = out.colors[0, ..., 3:] / out.alphas[0].clamp_min(1e-3)[..., None]
    return [flow[..., 3 * n : 3 * n + 3] for n in range(len(chosen))]


def with_overscan(K: Tensor, image: FrozenImage, width: int, height: int) -> tuple[Tensor, tuple[int, int]]:
    """(intrinsics [3, 3] of a frame of `width` x `height` with its overscan, pixels of overscan on the left and right,
    and above and below)."""
    rows, columns = image.alpha.shape
    beyond = (columns - width) // 2, (rows - height) // 2
    padded = K.clone()
    padded[:2, 2] += torch.tensor(beyond, dtype=K.dtype, device="cpu")
    return padded, beyond
