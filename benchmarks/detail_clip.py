"""A trained shot for the benchmarks of plate detail: its plates, frozen frames and moving regions."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.detail_figures import STILL_MATTE, induced_places, inside, sampled, still_pixels
from benchmarks.sources import Log
from torch_backend.contract import FreezeParams
from torch_backend.footage.plates import Plates
from torch_backend.freeze.composite.compositor import CompositeFrame, Compositor
from torch_backend.freeze.composite.measured_depth import MeasuredDepths
from torch_backend.freeze.composite.surface_depth import FrameDepths
from torch_backend.freeze.frozen import (
    FrozenGaussians,
    FrozenImage,
    OutputFrame,
    freeze_at,
    render_frozen,
    span_of,
)
from torch_backend.freeze.instant.instants import developed
from torch_backend.freeze.take.plan import choose_t_star
from torch_backend.freeze.views.reproject import resized
from torch_backend.motion.mattes import load_motion
from torch_backend.scene import load_scene, split_frames
from torch_backend.shot import Shot
from torch_backend.train import load_run

BACKDROP = 0.5
"""Grey level behind uncovered pixels, as in previews."""
VARIANTS = ("splats", "developed", "withheld", "delivered")
"""Gaussians of the run alone; Gaussians of the developed instant alone; the developed instant with plate detail,
without the plate of the same pose; and with all plates. With `--develop off` there is no `developed`."""


@dataclass
class View:
    """One frozen frame."""

    image: FrozenImage
    """Render of the Gaussians alone, at the delivered instant."""
    detailed: CompositeFrame
    """The frame with plate detail."""
    splats: Tensor
    """[H, W, 3] Gaussians alone over grey, in [0, 1]."""
    picture: Tensor
    """[H, W, 3] with plate detail over grey, in [0, 1]."""


class DetailClip:
    """A run of a shot. Pictures are `width` pixels wide; 0 uses the plates' size.

    Instants are developed as for a take; the shot stays unchanged.
    """

    def __init__(self, shot: Shot, run: str = "main", width: int = 0, develop: bool = True) -> None:
        """JobError if the shot is not solved or the run is not trained."""
        self.develop = develop
        self.shot = shot
        self.run, self.scene = load_run(shot, run, torch.device("cpu")), load_scene(shot)
        plates = Plates(shot)
        size = (width, round(plates.height * width / plates.width)) if width else None
        self.plates = Plates(shot, size) if size else plates
        self.width, self.height = self.plates.width, self.plates.height
        self.Ks = self.scene.camera_at(self.width, self.height)
        self.compositor = Compositor(self.run, self.scene, self.plates)
        self.depths = FrameDepths(self.run, self.scene)
        self.measured = MeasuredDepths(self.run, self.scene)
        self._frozen: dict[int, FrozenGaussians] = {}

    @property
    def motion_from(self) -> str:
        """Name of the mattes that define motion."""
        found = self.matte(self.frames[0]) is not None
        return "the shot's motion mattes" if found else "the gate, which misses movers: the shot has no motion mattes"

    @property
    def frames(self) -> list[int]:
        """Numbers of the clip's frames."""
        return self.scene.frames

    def held_out(self) -> list[int]:
        """Numbers of the frames that the run did not train on."""
        _, test = split_frames(self.scene.solved, self.run.config.holdout, self.run.config.holdout_phase)
        return [self.scene.frames[i] for i in test]

    def instants(self) -> list[int]:
        """The suggested t*, and the training frame nearest to half a clip from it."""
        suggested = choose_t_star(self.shot, self.scene, self.run, FreezeParams(), Log())
        half = len(self.frames) // 2
        at = self.frames.index(suggested)
        second = self.frames[at + half if at + half < len(self.frames) else at - half]
        return [suggested, min(self.run.train_frames, key=lambda frame: abs(frame - second))]

    def camera(self, frame: int) -> tuple[Tensor, Tensor]:
        """(world-to-camera [4, 4], K [3, 3]) of a frame, scene units and pixels."""
        index = self.frames.index(frame)
        return self.scene.viewmats[index], self.Ks[index]

    def field(self, t_star: int) -> FrozenGaussians:
        """The trained run at an instant, before development."""
        return freeze_at(self.run.model, self.scene.time_of_frame(t_star), span_of(self.scene, self.run))

    def frozen(self, t_star: int, keep: bool = False) -> FrozenGaussians:
        """The developed instant from which takes are rendered. `keep`: save it with the run for other processes."""
        if t_star not in self._frozen:
            gaussians = self.field(t_star)
            if self.develop and t_star in self.run.train_frames:
                print(f"developing t* {t_star}", file=sys.stderr, flush=True)
                gaussians = developed(self.shot, self.run, self.scene, t_star, gaussians, keep=keep)
            self._frozen[t_star] = gaussians
        return self._frozen[t_star]

    def splats(self, frame: int, t_star: int, frozen: FrozenGaussians | None = None) -> FrozenImage:
        """Render of Gaussians alone, with mattes and depth, from `frozen` or from the delivered instant."""
        viewmat, K = self.camera(frame)
        model, exposed_at = self.run.model, self.scene.time_of_frame(frame)
        frozen = frozen or self.frozen(t_star)
        return render_frozen(frozen, viewmat, K, self.width, self.height, model.exposure, exposed_at)

    def view(self, frame: int, t_star: int, withheld: Collection[int] = (), image: FrozenImage | None = None) -> View:
        """The frozen frame with plate detail. `image`: the result of `splats`, if already computed."""
        image = image or self.splats(frame, t_star)
        detailed = self.detailed(frame, t_star, image, withheld)
        return View(image, detailed, over(image.color, image.alpha), over(detailed.color, detailed.alpha))

    def detailed(self, frame: int, t_star: int, image: FrozenImage, withheld: Collection[int] = ()) -> CompositeFrame:
        """The frozen frame with plate detail as in a take, from its render by `splats`."""
        output = OutputFrame(frame, *self.camera(frame), float(t_star), float(frame))
        return self.compositor.frame(output, self.frozen(t_star), image, self.width, self.height, withheld)

    def depth(self, frame: int, t_star: int, view: View) -> tuple[Tensor, Tensor]:
        """(depth, its standard deviation) of a frozen frame as written by a take, each [H, W] in scene units."""
        measured = self.measured.at(t_star, self.frozen(t_star))
        return self.depths.of(*self.camera(frame), view.detailed.depth, view.image.motion, view.picture, measured)

    def plate(self, frame: int) -> Tensor:
        """The plate of a frame, [H, W, 3] in [0, 1]."""
        return self.plates.display(frame).clamp(0.0, 1.0)

    def matte(self, frame: int) -> Tensor | None:
        """The motion matte of a frame, [H, W] in 0..1; None if the shot has none."""
        matte = load_motion(self.shot, frame)
        if matte is None:
            return None
        values = torch.from_numpy(matte.astype("float32") / 255.0)[None, None]
        return F.interpolate(values, (self.height, self.width), mode="nearest-exact")[0, 0]

    def mattes(self, frame: int, t_star: int, view: View) -> tuple[Tensor, Tensor]:
        """(matte of movers in the frame, matte of the frozen frame's points that move at t*), each [H, W] in 0..1.

        The second is the matte of frame t*, warped to this frame by the frozen depth; 0 outside the view of t*. If the
        shot has no mattes, both are the gate's matte in the frozen frame.
        """
        frame_matte, matte_t_star = self.matte(frame), self.matte(t_star)
        if frame_matte is None or matte_t_star is None:
            gate = (view.image.motion >= STILL_MATTE).float()
            return gate, gate
        places, depth = induced_places(view.detailed.depth, *self.camera(frame), *self.camera(t_star))
        known = inside(places, self.width, self.height, 0.0) & (depth > 0)
        return frame_matte, torch.where(known, sampled(matte_t_star, places, nearest=True), 0.0)

    def still(self, frame: int, t_star: int, view: View) -> Tensor:
        """bool [H, W] pixels where the frozen frame must equal the plate.

        Excludes pixels masked as no part of the scene, such as a burnt-in logo, because the freeze removes them.
        """
        frame_matte, frozen = self.mattes(frame, t_star, view)
        ignored = self.compositor.source_views.view(frame).ignored
        masked = None if ignored is None else resized(ignored[..., 0], self.width, self.height) > 0.0
        return (
            still_pixels(frame_matte, frozen > 0.75)
            if masked is None
            else still_pixels(frame_matte, frozen > 0.75) & ~masked
        )


def over(color: Tensor, alpha: Tensor) -> Tensor:
    """Premultiplied colour [H, W, 3] over grey, in [0, 1]."""
    return (color + (1.0 - alpha[..., None]) * BACKDROP).clamp(0.0, 1.0)


def open_clip(path: str | Path, run: str = "main", width: int = 0, develop: bool = True) -> DetailClip:
    """Opens the clip of a shot folder."""
    return DetailClip(Shot.open(path), run, width, develop)
