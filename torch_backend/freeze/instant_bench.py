"""Plate t* beside what a frozen scene shows of it: where what `missing_layer.py` finds is looked for and judged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..scene import Scene, evenly_spaced, read_image, resize_intrinsics
from ..shot import Shot
from ..torch_types import from_numpy
from ..train import LoadedRun
from ..train.model import gathered
from .frozen import FrozenGaussians, FrozenImage, freeze_at, render_frozen
from .ignored import ignore_mattes
from .instant_depth import DepthConfig, View
from .instant_track import TrackConfig
from .reproject import inside, look_up, project, resized
from .sightings import matte_of

_SIZE = 320.0
"""Lengths in pixels in the configuration are those of pictures this wide; others are scaled with the width."""

Motion = Callable[[int], "NDArray[np.uint8] | None"]
"""Motion matte [h, w] of a frame number, None where there is none."""


@dataclass
class InstantConfig:
    """What counts as missing, and what stands in for it. Lengths are in pixels of pictures 320 wide."""

    width: int = 640
    """Plates are compared, and the layer is made, at the trained size, but no wider than this."""
    blur: float = 3.0
    """Standard deviation of the low-pass before plate and render are compared."""
    shift: float = 1.0
    """The render may be this far from where the plate has an edge: a difference it explains is none."""
    seed: float = 0.12
    """A region has a low-passed difference of at least this somewhere (display-referred)."""
    grow: float = 0.06
    """And of at least this everywhere."""
    least: float = 30.0
    """Square pixels; smaller regions are left alone."""
    moving: float = 0.5
    """Least share of a region that the motion matte calls moving, if there is one."""
    own_motion: float = 0.12
    """Least distance of a region's flow from its epipolar lines, per frame; twice that where there is no matte."""
    surely_own: float = 3.0
    """Times that of what has fallen apart from aside (`torn.py`): t*'s camera sees nothing amiss there."""
    solid: float = 0.14
    """Difference at a pixel from which on it is wholly the layer's; below half of it, the model's."""
    sigma: float = 0.6
    """Standard deviation of a Gaussian in pixels of the layer: no holes at twice the size, and not softer than that."""
    opacity: float = 0.97
    """Of a Gaussian inside a region."""
    fade: float = 0.5
    """A moving Gaussian is a ghost if at least this share of what is seen of it lies where plate t* shows what is
    behind it."""
    gain: float = 0.1
    """Layer and fading are kept if they lower the low-passed difference where they act by at least this share,"""
    detail: float = 0.3
    """or the difference of single pixels by this share, and the low-passed one at all: a hand that the field has but
    blurred is where plate t* has it, and has no fingers."""
    veil: float = 16.0
    """So far about a piece that stands too near its veil reaches,"""
    before: float = 1.25
    """and what is seen there for the most part is at least so many times as far away as the veil."""
    crumb: float = 0.2
    """Share of a thing that was taken out that a piece left of it has at most,"""
    crumb_reach: float = 4.0
    """so far from it at most;"""
    crumb_steady: float = 0.06
    """depths of neighbouring pixels that differ by a smaller share are of one piece."""
    stuck: float = 0.5
    """Detail that correlates this well with that at the same pixels of other frames is on the picture (a logo)."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """How depth is told."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """How small things are followed."""


class InstantBench:
    """Plate t* and its camera, with its neighbours, at the size at which they are compared."""

    def __init__(
        self, run: LoadedRun, scene: Scene, index: int, config: InstantConfig, motion: Motion | None, width: int = 0
    ) -> None:
        """`width` in pixels; 0: as the run was trained, `InstantConfig.width` at most."""
        self.config, self.exposure, self.index, self._run = config, run.model.exposure, index, run
        self.width = width or min(run.width, config.width)
        self.height = max(1, round(run.height * self.width / run.width))
        self.unit = self.width / _SIZE
        self.time = float(scene.times[index])
        self.scene, self._motion = scene, motion
        self.Ks = resize_intrinsics(scene.Ks, scene.width, scene.height, self.width, self.height)
        self._views: dict[int, View] = {}
        self.view = self.at(index)
        mask = ignore_mattes(Shot(scene.folder.parent))(scene.frames[index])
        self.ignored = None if mask is None else resized(mask, self.width, self.height).numpy() > 0.0
        """[h, w] bool what of plate t* is no part of the scene: nothing is missing there."""

    def as_plate(self) -> InstantBench:
        """The same at the plate's size, `InstantConfig.width` at most: what is drawn is as sharp as the plate."""
        width = min(self.scene.width, self.config.width)
        if width <= self.width:
            return self
        return InstantBench(self._run, self.scene, self.index, self.config, self._motion, width)

    def at(self, index: int) -> View:
        """Delivered frame `index`: its plate and camera. Kept."""
        if index not in self._views:
            self._views[index] = self._read(index)
        return self._views[index]

    def _read(self, index: int) -> View:
        scene = self.scene
        picture = read_image(scene.image_path(index), self.width, self.height, scene.display).numpy()
        return self.camera(index, np.ascontiguousarray(picture, np.float32))

    def camera(self, index: int, picture: NDArray[np.float32] | None = None) -> View:
        """Its camera, with a picture or none."""
        viewmat, K = self.scene.viewmats[index].double().numpy(), self.Ks[index].double().numpy()
        return View(index, np.zeros((0, 0, 3), np.float32) if picture is None else picture, viewmat, K)

    def frame(self, index: int) -> tuple[View, NDArray[np.bool_]] | None:
        """A plate with its camera, and what moves there [h, w]; None if that is not known. Not kept."""
        matte = self.matte(index) if 0 <= index < len(self.scene.frames) else None
        return None if matte is None else (self._views.get(index) or self._read(index), matte > 0.5)

    def neighbours(self) -> list[View]:
        """Frames around t*, on both sides where there are any."""
        steps = self.config.depth.neighbours
        found = [self.index + sign * step for step in steps for sign in (-1, 1)]
        return [self.at(i) for i in found if 0 <= i < len(self.scene.frames)]

    def spread(self, count: int) -> list[View]:
        """Up to `count` frames, evenly over the clip, without t*."""
        chosen = evenly_spaced(len(self.scene.frames), count)
        return [self.at(i) for i in chosen if i != self.index]

    def matte(self, index: int | None = None) -> NDArray[np.float32] | None:
        """Motion matte of a frame, or of t*, [h, w] in 0..1, if there is one; unknown is `DOUBT`, so still."""
        index = self.index if index is None else index
        found = self._motion(self.scene.frames[index]) if self._motion else None
        if found is None:
            return None
        return resized_array(matte_of(found).numpy(), self.width, self.height)

    def render(self, frozen: FrozenGaussians) -> FrozenImage:
        """A frozen scene as camera t* sees it, exposed as plate t* is."""
        camera = self.scene.viewmats[self.index], self.Ks[self.index]
        return render_frozen(frozen, *camera, self.width, self.height, self.exposure, self.time)

    def at_its_time(self, index: int) -> FrozenImage:
        """Delivered frame `index` as the run has it at that frame's own time."""
        time, camera = float(self.scene.times[index]), (self.scene.viewmats[index], self.Ks[index])
        then = freeze_at(self._run.model, time, 1.0)
        return render_frozen(then, *camera, self.width, self.height, self.exposure, time)

    def as_exposed(self, picture: NDArray[np.float32], index: int) -> NDArray[np.float32]:
        """Colours [..., 3] of plate `index` as the exposure of plate t* shows them."""
        (gain, offset), (own_gain, own_offset) = (
            (value.detach().cpu().numpy() for value in self.exposure.at(time))
            for time in (float(self.scene.times[index]), self.time)
        )
        return np.asarray((picture - offset) / gain * own_gain + own_offset, np.float32)

    def seen_inside(self, frozen: FrozenGaussians, mask: NDArray[np.bool_]) -> tuple[Tensor, Tensor]:
        """What camera t* sees of each Gaussian, [N] each: sums of alpha T over pixels of a mask [h, w], and all."""
        within, whole = self.gathered(frozen, mask.astype(np.float32), np.ones_like(mask, np.float32)).unbind(1)
        return within, whole

    def gathered(self, frozen: FrozenGaussians, *values: NDArray[np.float32]) -> Tensor:
        """[N, C]: sums of alpha T times each of C `values` [h, w] over the pixels in which t* sees a Gaussian."""
        device, i = frozen.support.device, self.index
        camera = self.scene.viewmats[i].to(device), self.Ks[i].to(device)
        asked = from_numpy(np.stack(values, axis=-1)).to(device)
        return gathered(frozen.state, *camera, self.width, self.height, asked).cpu()

    def within(self, frozen: FrozenGaussians, mask: NDArray[np.bool_]) -> Tensor:
        """bool [N]: whose middle camera t* has inside a mask [h, w], seen or not."""
        pixels, _ = project(frozen.state["means"].cpu(), self.scene.viewmats[self.index], self.Ks[self.index])
        found = look_up(from_numpy(mask.astype(np.float32)), pixels, "nearest")
        return (found > 0.5) & (inside(pixels, self.width, self.height) > 0.0)

    def painters(self, frozen: FrozenGaussians, mask: NDArray[np.bool_], nearer: float) -> Tensor:
        """int64 [M]: what is `nearer` than so many scene units and is seen inside a mask [h, w] for the most part, also
        where the run holds it for still; and what moves and is hidden behind that. Left behind, it would hang in the
        air."""
        inside, whole = self.seen_inside(frozen, mask)
        seen = whole > 1e-3
        hidden = ~seen & (frozen.motion > 0.5).cpu() & self.within(frozen, mask)
        paints = ((seen & (inside >= 0.5 * whole)) | hidden) & (self.depths(frozen) < nearer)
        return torch.nonzero(paints).flatten()

    def veils(self, frozen: FrozenGaussians, pieces: NDArray[np.bool_]) -> tuple[Tensor, Tensor]:
        """(rows int64 [M], times [M]): the veil of pieces [h, w] that are at their place now: what moves, is seen about
        them, and stands far before what is seen there for the most part, so that no median shows it; and so many times
        farther away it would be just before that."""
        about = grown(pieces, self.config.veil * self.unit).astype(np.float32)
        image = self.render(frozen)
        covered = (image.alpha.numpy() > 0.5).astype(np.float32)
        log_depth = np.log(np.maximum(image.depth.numpy(), 1e-6)) * covered
        asked = about, np.ones_like(covered), log_depth, covered
        inside, whole, log_sum, count = self.gathered(frozen, *asked).unbind(1)
        behind = (log_sum / count.clamp_min(1e-6)).exp() / (1.0 + self.config.depth.front)
        times = behind / self.depths(frozen).clamp_min(1e-6)
        moves = (frozen.motion > 0.5).cpu()
        veils = moves & (whole > 1e-3) & (inside >= 0.5 * whole) & (times > self.config.before)
        rows = torch.nonzero(veils).flatten()
        return rows, times[rows]

    def depths(self, frozen: FrozenGaussians) -> Tensor:
        """[N] scene units from camera t* to each Gaussian, along its axis."""
        view = self.scene.viewmats[self.index].to(frozen.support.device)
        return (frozen.state["means"] @ view[2, :3] + view[2, 3]).cpu()

    def difference(self, image: FrozenImage) -> NDArray[np.float32]:
        """Low-passed difference [h, w] between plate and render, beyond what misplaced edges explain."""
        shown = image.color.numpy()
        return low_difference(self._plate(shown), shown, self.config.blur * self.unit, self.config.shift * self.unit)

    def single(self, image: FrozenImage) -> NDArray[np.float32]:
        """Difference [h, w] of single pixels, the greatest of the channels."""
        shown = image.color.numpy()
        return np.abs(shown - self._plate(shown)).max(axis=-1)

    def _plate(self, shown: NDArray[np.float32]) -> NDArray[np.float32]:
        """[h, w, 3] plate t*, where it counts; elsewhere what is `shown`."""
        return (
            self.view.picture if self.ignored is None else np.where(self.ignored[..., None], shown, self.view.picture)
        )


def low_difference(
    plate: NDArray[np.float32], shown: NDArray[np.float32], blur: float, shift: float
) -> NDArray[np.float32]:
    """Difference between two pictures [h, w, 3] after a low-pass, [h, w], the greatest of the channels.

    A picture that is off by s pixels differs, to first order, by s times the gradient: the difference that `shift`
    pixels explain is subtracted, so that an edge out of place is none. `blur` is a standard deviation in pixels.
    """
    low = low_passed(plate - shown, blur)
    smooth = low_passed(plate, blur)
    down, right = np.gradient(smooth, axis=(0, 1))
    explained = shift * np.hypot(down, right)
    return np.maximum(np.abs(low) - explained, 0.0).max(-1)


def low_passed(values: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """A Gaussian low-pass of [h, w] or [h, w, C]; sigma in pixels."""
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)


def disc(radius: float) -> NDArray[np.uint8]:
    """A disc of a radius in pixels, at least 1."""
    import cv2

    side = 2 * max(1, math.ceil(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)


def grown(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """A mask [h, w], larger by a radius in pixels, at least 1."""
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc(radius)) > 0, np.bool_)


def large(mask: NDArray[np.bool_], seeds: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    """The connected parts of a mask [h, w] with at least `least` pixels and one of `seeds`."""
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    sizes = np.bincount(labels.ravel(), minlength=count)
    seeded = np.bincount(labels[seeds], minlength=count) > 0
    good = (sizes >= least) & seeded
    good[0] = False
    return good[np.asarray(labels, np.int32)]


def resized_array(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """[H, W] or [H, W, C] at another size: averaged where it shrinks."""
    import cv2

    if values.shape[:2] == (height, width):
        return values
    kind = cv2.INTER_AREA if width <= values.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(values, (width, height), interpolation=kind), np.float32)
