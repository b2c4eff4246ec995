"""The frame that plate detail is making: its camera, what it shows of the frozen scene, and how that moves."""

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
    """A frame that is being made: its camera at both sizes, and what it shows."""

    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] in pixels of the picture with its overscan."""
    image: FrozenImage
    """The splats' render of it."""
    exposed_at: float
    """Normalised time whose exposure it has."""
    own: bool
    """True if it is one of the clip's own frames, seen as its camera saw it."""
    t: int
    """Frame whose plate shows the instant."""
    frozen: FrozenGaussians
    """The scene at t*."""
    points: Tensor
    """[h, w, 3] world points seen, at the size of decisions."""
    depth: Tensor
    """[h, w] of those points, along the camera's axis."""
    motion: Tensor
    """[h, w] in 0..1: what moves in the clip, at t*."""
    per_pixel: float
    """Pixels of decisions per pixel of the picture."""
    beyond: tuple[int, int]
    """Pixels of the picture that are overscan, on either side, and above and below."""
    doubt: Tensor
    """[h, w] in 0..1: where plates of other times are trusted only if they agree with the model."""
    moved: Tensor
    """[h, w] in 0..1: what moves in the clip, at t* or in the frame's own plate; else `motion`."""
    unseen: Tensor
    """[h, w] in 0..1: pixels of moving surfaces that no plate near t* shows, so their state at t* is unknown."""

    def settings(self, width: int, height: int) -> RasterSettings:
        """How its camera renders the picture, overscan included, at another size."""
        rows, columns = self.image.alpha.shape
        return RasterSettings(overscan=(self.beyond[0] * width / columns, self.beyond[1] * height / rows))

    @property
    def centre(self) -> Tensor:
        """[3] of its camera, scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


def target_view(
    source_views: SourceViews,
    output: OutputFrame,
    frozen: FrozenGaussians,
    image: FrozenImage,
    width: int,
    height: int,
) -> TargetView:
    """What a frame shows, before any plate has been asked.

    Args:
        output: its camera and instant.
        frozen: the scene frozen there.
        image: the splats' render of it, which may show more around the frame: overscan.
        width, height: pixels of the frame without overscan.
    """
    rows, columns = image.alpha.shape
    K, beyond = with_overscan(output.K, image, width, height)
    per_pixel = min(1.0, source_views.config.width / width)
    w, h = max(8, round(columns * per_pixel)), max(8, round(rows * per_pixel))
    small = pixel_centres(w, h)
    # The pixel at each centre, in whole numbers: a centre that lies between two pixels is always the second's.
    across, down = ((2 * torch.arange(n, device="cpu") + 1) * of // (2 * n) for n, of in ((w, columns), (h, rows)))
    depth = image.depth[down[:, None], across]
    points = unproject(small, depth, output.viewmat, resize_intrinsics(K[None], columns, rows, w, h)[0])
    t = min(source_views.frames, key=lambda frame: abs(frame - output.t_star))
    motion = resized(image.motion, w, h)
    own = _is_own(source_views, output, width, height)
    nothing = torch.zeros_like(motion)
    return TargetView(
        output.viewmat, K, image, source_views.scene.time_of_frame(output.exposed_like), own, t, frozen, points, depth,
        motion, w / columns, beyond, nothing, motion, nothing,
    )  # fmt: skip


def _is_own(source_views: SourceViews, output: OutputFrame, width: int, height: int) -> bool:
    """True if the frame is one of the clip's own, seen as its camera saw it and as large as its plate."""
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
    """Misplacement of points in a plate, in pixels of 640, by a depth that is wrong by the share `depth_error`."""
    travel = norm_of_all(source_views.centres[source_views.index[frame]] - target.centre)
    focal = target.K[0, 0] * target.per_pixel
    return focal * travel / depth.clamp_min(1e-6) * depth_error / source_views.unit


def displacements(
    source_views: SourceViews, target: TargetView, chosen: list[int], size: tuple[int, int] | None = None
) -> list[Tensor]:
    """[h, w, 3] scene units from t* to each plate of what is seen.

    `size` (w, h) None: that of decisions.
    """
    w, h = size or target.depth.shape[::-1]
    rows, state = source_views.rows, target.frozen.state
    if not len(rows):
        return [torch.zeros(h, w, 3, device="cpu") for _ in chosen]
    extra = torch.zeros(len(state["means"]), 3 * len(chosen), device=state["means"].device)
    now = state["means"][rows].cpu()
    for n, frame in enumerate(chosen):
        extra[rows, 3 * n : 3 * n + 3] = (source_views.view(frame).offsets - now).to(extra.device)
    rows_full, columns = target.image.alpha.shape
    K = resize_intrinsics(target.K[None], columns, rows_full, w, h)[0]
    out = render(
        state, 0, target.viewmat.to(extra.device), K.to(extra.device), w, h, colors=extra, with_contributions=False,
        settings=target.settings(w, h),
    )  # fmt: skip
    shown = (out.colors[0, ..., 3:] / out.alphas[0].clamp_min(1e-3)[..., None]).cpu()
    return [shown[..., 3 * n : 3 * n + 3] for n in range(len(chosen))]


def with_overscan(K: Tensor, image: FrozenImage, width: int, height: int) -> tuple[Tensor, tuple[int, int]]:
    """([3, 3] the camera of a frame of `width` x `height` in pixels of its render, how many of those are beside it, and
    above or below it)."""
    rows, columns = image.alpha.shape
    beyond = (columns - width) // 2, (rows - height) // 2
    wide = K.clone()
    wide[:2, 2] += torch.tensor(beyond, dtype=K.dtype, device="cpu")
    return wide, beyond
