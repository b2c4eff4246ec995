"""The shot's working frames at one size, with cameras and motion mattes, for developing and judging an instant."""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene import Scene, read_image
from ...shot import Shot
from ...train.model import gathered
from ..frozen import FrozenGaussians
from .ignored import ignore_mattes
from .reproject import dilate, resized
from .source_views import LENGTHS_OF, MARGIN, MovingOf

SEEN = 0.05
"""Smallest contribution of a Gaussian to a frame, in pixels, for the frame to count in decisions on the Gaussian."""

MEASURED_WIDTH = 320
"""Largest width in pixels of the pictures that compare scenes and measure surfaces."""
VIEWS = 12
"""Number of evenly spaced frames that judge a scene, where all frames would take too long."""


class WorkingPlates:
    """Pictures, cameras and mattes of a shot's frames, at most `width` pixels wide."""

    def __init__(
        self, scene: Scene, width: int, moving: MovingOf, margin: float = MARGIN, device: torch.device | str = "cpu"
    ) -> None:
        """`margin`: radius by which motion mattes are dilated, in pixels at width `LENGTHS_OF`."""
        self.scene, self.moving, self.device = scene, moving, device
        self.width = min(scene.width, width)
        self.height = max(16, round(scene.height * self.width / scene.width))
        self.index = {frame: i for i, frame in enumerate(scene.frames)}
        self.margin = round(margin * self.width / LENGTHS_OF)
        self._Ks, self._viewmats = scene.camera_at(self.width, self.height).to(device), scene.viewmats.to(device)
        self._pictures: dict[int, Tensor] = {}
        self._mattes: dict[int, Tensor] = {}
        self._ignored = ignore_mattes(Shot(scene.folder.parent))

    def camera(self, frame: int) -> tuple[Tensor, Tensor, int, int]:
        """(world-to-camera [4, 4], K [3, 3], width, height) of a frame, in the order of the arguments of `render`."""
        i = self.index[frame]
        return self._viewmats[i], self._Ks[i], self.width, self.height

    def centre(self, frame: int) -> Tensor:
        """[3] camera centre of a frame, scene units."""
        viewmat = self._viewmats[self.index[frame]]
        return -viewmat[:3, :3].T @ viewmat[:3, 3]

    def picture(self, frame: int) -> Tensor:
        """[H, W, 3] working frame in 0..1, in the scene's display."""
        if frame not in self._pictures:
            path = self.scene.image_path(self.index[frame])
            image = read_image(path, self.width, self.height, self.scene.display)
            self._pictures[frame] = (image * 255.0).round().byte()
        return self._pictures[frame].to(self.device).float() / 255.0

    def matte(self, frame: int) -> Tensor:
        """[H, W] in 0..1, the dilated motion matte; 0 (still) for frames without a matte."""
        if frame not in self._mattes:
            found = self.moving(frame)
            found = torch.zeros(self.height, self.width, device="cpu") if found is None else found
            found = resized(found.float(), self.width, self.height)
            self._mattes[frame] = dilate(found, self.margin).half()
        return self._mattes[frame].to(self.device).float()

    def ignored(self, frame: int) -> Tensor | None:
        """bool [H, W]: ignored pixels of a frame, dilated; None: no pixel is ignored."""
        mask = self._ignored(frame)
        if mask is None:
            return None
        return (dilate(resized(mask, self.width, self.height), max(1, self.margin)) > 0.0).to(self.device)

    def moving_share(self, frozen: FrozenGaussians, frame: int) -> Tensor:
        """[N] in 0..1: share of each Gaussian's contribution to a frame that falls on moving pixels."""
        matte = self.matte(frame)
        weights = torch.stack([matte, torch.ones_like(matte)], dim=-1)
        inside, total = gathered(frozen.state, *self.camera(frame), weights).unbind(1)
        return torch.where(total > SEEN, inside / total.clamp_min(1e-6), 0.0)


def showing(trained: list[int], t_star: int) -> list[int]:
    """The trained frames that show an instant: frame `t_star`, or else the nearest trained frame on either side."""
    if t_star in trained:
        return [t_star]
    before, after = [f for f in trained if f < t_star], [f for f in trained if f > t_star]
    return [*before[-1:], *after[:1]]


def spread(frames: list[int], most: int) -> list[int]:
    """At most `most` evenly spaced elements of ascending frames."""
    if len(frames) <= most:
        return list(frames)
    step = len(frames) / max(1, most)
    return [frames[int((n + 0.5) * step)] for n in range(most)]
