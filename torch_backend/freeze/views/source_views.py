"""The clip's plates compared with a run: surface depth, moving pixels, and the residual of the run's own render.

Results are computed once per plate and cached for all frozen frames that use the plate.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...motion.mattes import MOVING, UNKNOWN, load_motion
from ...scene import Scene, read_image, resize_intrinsics
from ...shot import Shot
from ...torch_types import from_numpy
from ...train import LoadedRun
from ..frozen import FrozenGaussians, FrozenImage, render_frozen
from . import decisions
from .ignored import ignore_mattes
from .reproject import blurred, dilate, look_up, pixel_centres, resized
from .scene_flow import MovingScene
from .visibility import Visibility, visible_pixels

MovingOf = Callable[[int], "Tensor | None"]
"""Frame number -> [h, w] in 0..1, motion matte of its plate; None if the frame has no matte."""
DOUBT = 0.5 - decisions.MARGIN
"""Motion matte of an unknown pixel: less than 0.5, because most unknown pixels are textureless wall."""
LENGTHS_OF = 640
"""Picture width in pixels to which all configured lengths refer."""
MARGIN = 2
"""Possible misplacement of an outline, in pixels at width `LENGTHS_OF`: errors of flow and depth, and motion blur."""
# Largest number of cached plates. Between two uses of a plate, 16 frames apart, up to 80 other plates are used. With a
# smaller cache, every plate was computed three times per take.
_VIEWS, _VIEWS_BYTES = 90, 700e6
_RESIDUALS_BYTES = 250e6
# Largest width in pixels of the model's own render of a plate: splats show no finer detail, and 4K costs memory.
_FINEST = 1280
_ROWS = 256


class PlateReader(Protocol):
    """Interface of `footage.plates.Plates`."""

    width: int
    """Width of the undistorted plates in pixels."""
    height: int
    """Height of the undistorted plates in pixels."""
    frames: list[int]
    """Every frame of the clip's range that has a plate, ascending."""

    deep: bool
    """True if values may lie outside 0..1."""

    def display(self, frame: int) -> Tensor:
        """[height, width, 3] float32 plate in the scene's display, not clipped."""
        ...

    def linear(self, frame: int, rows: slice = ...) -> Tensor:
        """[height, width, 3] float32 plate, scene-linear: all rows or a slice of them."""
        ...


@dataclass
class PlateView:
    """One plate and the model's data for it, [h, w] at decision resolution (`SourceViews.size`)."""

    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] intrinsics in pixels at decision resolution."""
    surface: Tensor
    """[h, w, 3], stacked for a joint look-up: median depth; motion matte in 0..1; and, in 0..1, agreement of the model
    with the plate except for detail."""
    picture: Tensor
    """[h, w, 3] float16, the plate, display-referred."""
    missed: Tensor
    """[h, w] float16 in 0..1: low-passed difference between the plate and the model's own render of it."""
    offsets: Tensor
    """[M, 3] means of the open Gaussians in that frame, scene units."""
    rendered: Tensor | None
    """[h, w, 3] float16, the model's own render of the plate; None if plates are larger than decision resolution."""
    ignored: Tensor | None
    """[h, w, 1] in 0..1: ignored pixels, treated as an occluder in front of the scene; None: no pixel is ignored."""


@dataclass(frozen=True)
class VisibilityConfig:
    """Resolution and tolerances of decisions about plates. Lengths are in pixels at width 640."""

    width: int = LENGTHS_OF
    """Largest width in pixels at which mattes, depth and visibility are compared (decision resolution): mattes are
    soft, and the model is no finer."""
    depth_tolerance: float = 0.03
    """Relative depth difference up to which a point belongs to the surface that a plate shows."""
    margin: int = MARGIN
    """Radius by which motion mattes are dilated. Pictures are compared under a low-pass with this sigma or twice this
    sigma, because splats are soft. Differences are dilated by twice this radius, because partly rejected movers would
    leave outlines."""
    unexplained: float = 0.1
    """Low-passed difference, display-referred, at which the trust in a plate falls to 1/e."""


class SourceViews:
    """The plates of a clip, compared with one run or one developed instant."""

    def __init__(
        self,
        run: LoadedRun,
        scene: Scene,
        plates: PlateReader,
        moving: MovingOf | None = None,
        config: VisibilityConfig | None = None,
        frozen: FrozenGaussians | None = None,
        t_star: int | None = None,
    ) -> None:
        """`moving` None: the shot's motion mattes are used; frames without one use the model's own matte.

        `frozen`: a developed instant at frame `t_star`, used as the model. None: the run is the model.
        """
        self.run, self.scene, self.plates = run, scene, plates
        self.moving = moving or motion_mattes(Shot(scene.folder.parent))
        self.ignored = ignore_mattes(Shot(scene.folder.parent))
        self.config = config or VisibilityConfig()
        self.index = {frame: i for i, frame in enumerate(scene.frames)}
        have = set(plates.frames)
        self.frames = [frame for frame in scene.frames if frame in have]
        """Frames of the clip that have both a plate and a camera, ascending."""
        width = min(plates.width, self.config.width)
        self.size = width, max(8, round(plates.height * width / plates.width))
        self.unit = width / LENGTHS_OF
        """Pixels at decision resolution per pixel at width `LENGTHS_OF`."""
        self.stage = MovingScene(run, scene, frozen, t_star)
        """The model in every frame."""
        self.rows = self.stage.rows
        self.device = run.model.device
        """Where pictures are compared and frames composited; cameras and plates as they are read lie on the CPU."""
        views = scene.viewmats
        self.centres = -torch.einsum("nji,nj->ni", views[:, :3, :3], views[:, :3, 3])
        """[F, 3] camera centres of the clip's frames, scene units, on the CPU."""
        self._views: OrderedDict[int, PlateView] = OrderedDict()
        self._residuals: OrderedDict[int, Tensor] = OrderedDict()
        self._displayed: tuple[int, Tensor] | None = None
        self._most: dict[int, float] = {}

    def camera(self, frame: int, width: int, height: int) -> tuple[Tensor, Tensor]:
        """(viewmat [4, 4], K [3, 3]) of a frame of the clip at a picture size."""
        i = self.index[frame]
        return (
            self.scene.viewmats[i],
            resize_intrinsics(self.scene.Ks[i][None], self.scene.width, self.scene.height, width, height)[0],
        )

    def view(self, frame: int) -> PlateView:
        """Plate `frame` with the data that the model has for it."""
        if frame not in self._views:
            self._views[frame] = self._make_view(frame)
            width, height = self.size
            render_bytes = 6.0 if self.size == (self.plates.width, self.plates.height) else 0.0
            view_bytes = (20.0 + render_bytes) * width * height + 12.0 * len(self.rows)
            room = _VIEWS_BYTES - 24.0 * self.plates.width * self.plates.height  # large frames need memory themselves
            while len(self._views) > max(12, min(_VIEWS, room / view_bytes)):
                self._views.popitem(last=False)
        self._views.move_to_end(frame)
        return self._views[frame]

    def residual(self, frame: int) -> Tensor:
        """[H, W, 3] float16: plate `frame` minus the model's own render of it, display-referred, at plate size."""
        if frame not in self._residuals:
            self._residuals[frame] = self._missed(frame)
            residual_bytes = 6.0 * self.plates.width * self.plates.height
            while len(self._residuals) > max(5, min(16, _RESIDUALS_BYTES / residual_bytes)):
                self._residuals.popitem(last=False)
        self._residuals.move_to_end(frame)
        return self._residuals[frame]

    def displayed(self, frame: int) -> Tensor:
        """[H, W, 3] float16: plate `frame`, display-referred, not clipped. The last plate is cached."""
        if self._displayed is None or self._displayed[0] != frame:
            self._displayed = frame, self.plates.display(frame).to(self.device).half()
        return self._displayed[1]

    def most(self, frame: int) -> float:
        """The largest value in plate `frame`, display-referred."""
        if frame not in self._most:
            self.residual(frame)
        return self._most[frame]

    def difference(self, a: Tensor, b: Tensor, margins: int = 1) -> Tensor:
        """[h, w] low-passed difference of two pictures [h, w, 3] at decision resolution, largest over channels.

        `margins`: sigma of the low-pass, in units of `VisibilityConfig.margin`.
        """
        h, w = a.shape[:2]
        sigma = margins * self.config.margin * self.unit
        if sigma < 1.5:
            return blurred(a - b, sigma).abs().amax(dim=-1)
        half = resized(a - b, (w + 1) // 2, (h + 1) // 2)  # enough for a low-passed picture
        return resized(blurred(half, 0.5 * sigma).abs().amax(dim=-1), w, h)

    def seen(self, frame: int, points: Tensor) -> Visibility:
        """Visibility of world points [..., 3] in plate `frame`."""
        view = self.view(frame)
        c, soft = self.config, float(self.config.margin)  # not scaled: the border is as wide in small pictures
        return visible_pixels(points, view.viewmat, view.K, view.surface, view.ignored, c.depth_tolerance, soft)

    def _missed(self, frame: int) -> Tensor:
        width, height = self.plates.width, self.plates.height
        fine = min(1.0, _FINEST / width)
        rendered = self.view(frame).rendered
        if rendered is None:
            rendered = self._render(frame, round(width * fine), max(8, round(height * fine)))[1].color
        plate = self.plates.display(frame).to(self.device)
        self._most[frame] = float(plate.max())
        out = torch.empty(height, width, 3, dtype=torch.float16, device=self.device)
        ignored = self.view(frame).ignored
        if fine == 1.0 and ignored is None:
            return torch.sub(plate, rendered).half()
        for top in range(0, height, _ROWS):  # a second picture of 4K would be another 100 MB
            rows = plate[top : top + _ROWS]
            at = pixel_centres(width, len(rows), self.device)
            at[..., 1] += top
            missed = rows - look_up(rendered, at * fine)
            if ignored is not None:
                missed = missed * (1.0 - look_up(ignored, at * (self.size[0] / width)))
            out[top : top + _ROWS] = missed.half()
        return out

    def _render(self, frame: int, width: int, height: int) -> tuple[FrozenGaussians, FrozenImage]:
        time = self.scene.time_of_frame(frame)
        frozen = self.stage.at(frame)
        viewmat, K = self.camera(frame, width, height)
        return frozen, render_frozen(frozen, viewmat, K, width, height, self.run.model.exposure, time)

    def _make_view(self, frame: int) -> PlateView:
        width, height = self.size
        frozen, image = self._render(frame, width, height)
        viewmat, K = self.camera(frame, width, height)
        matte = self.moving(frame)
        moving = image.motion if matte is None else resized(matte.to(self.device), width, height)
        # The working frame is large enough, and faster to read than 4K footage.
        plate = read_image(self.scene.image_path(self.index[frame]), width, height, self.scene.display).to(self.device)
        ignored = self._ignored(frame)
        if ignored is not None:  # ignored pixels must not count as missed
            plate = torch.lerp(plate, image.color, ignored)
        missed = self.difference(plate, image.color)
        difference = self.difference(plate, image.color, 2)
        region = round(2 * self.config.margin * self.unit)
        difference = blurred(dilate(difference, region), 0.5 * region)
        explained = torch.exp(-(difference / self.config.unexplained).square()).half().float()
        return PlateView(
            viewmat.to(self.device),
            K.to(self.device),
            torch.stack([image.depth, dilate(moving, round(self.config.margin * self.unit)), explained], dim=-1),
            plate.half(),
            missed.half(),
            frozen.state["means"][self.rows],
            image.color.half() if self.size == (self.plates.width, self.plates.height) else None,
            ignored,
        )

    def _ignored(self, frame: int) -> Tensor | None:
        """Ignored pixels as in `PlateView`, dilated by twice the margin, with a soft edge."""
        mask = self.ignored(frame)
        if mask is None or not bool((mask > 0).any()):
            return None
        margin = max(1, round(self.config.margin * self.unit))
        mask = dilate(resized(mask.to(self.device), *self.size), 2 * margin)
        return blurred(mask, 0.5 * margin).clamp(0.0, 1.0)[..., None]


def motion_mattes(shot: Shot) -> MovingOf:
    """The motion mattes of a shot as `MovingOf`: 0 still, `DOUBT` unknown, 1 moving."""

    def moving(frame: int) -> Tensor | None:
        stored = load_motion(shot, frame)
        return None if stored is None else matte_of(stored)

    return moving


def matte_of(stored: NDArray[np.uint8]) -> Tensor:
    """[h, w] in 0..1 from a stored motion matte [h, w]: 0 still, `DOUBT` unknown, 1 moving."""
    matte = torch.zeros(stored.shape, device="cpu")
    codes = from_numpy(stored)
    matte[codes == UNKNOWN] = DOUBT
    matte[codes == MOVING] = 1.0
    return matte
