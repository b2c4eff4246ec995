"""Frozen frames made of the plates: splats give geometry, motion and occlusion, plates give the pixels.

For a camera and an instant t*, with C the frozen render, I_m plate m and R_m the model's own render of plate m (its
camera, its time, its exposure), a pixel x is

    out(x) = A(x) I_n(p_n(x)) + (1 - A(x)) (C(x) + b(x) sum_m w_m(x) (I_m - R_m)(p_m(x)) / sum_m w_m(x))

n is the leading plate: the frame's own on the clip's poses, the nearest in pose on others. A, its matte, is 1 wherever
nothing that moves is seen, at t* or in the plate; so a still world is the plate itself, bit for bit. The rest is
filled: what the model missed in other plates (texture, edges, light) is carried along the surface point that x shows
to where plate m shows the same point, moved from t* to m as the model moves it. Plate t* is believed even where the
model cannot explain it, because what it shows is the truth of the frozen instant; others where nothing moves, or where
they agree with the model. b fades to the splats alone where no plate can be believed. Residuals are carried in display
space, in which splats blend; A mixes scene-linear light, so that the same mix of an artist's plate gives the frame.

Source: Buehler et al. 2001, "Unstructured Lumigraph Rendering"; Li et al. 2023, "DynIBaR"; figures: docs/benchmarks.md.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..scene import Scene, resize_intrinsics
from ..shot import Shot
from ..solve.motion import load_motion
from ..train import LoadedRun
from ..train.model import render
from .bands import bands, hand_back, look_up_near
from .instant import InstantLayer, instant_layer, join
from .query import FrozenGaussians, FrozenImage, OutputFrame, render_frozen
from .regions import closed, opened
from .reproject import blurred, look_up, pixel_centres, project, resized, unproject, widened
from .sightings import MovingOf, PlateReader, Sighting, SightingConfig, Sightings
from .transfer import to_display, to_linear
from .warp import sample, snap

_ALL = 0.999
"""Matte from which on the leading plate gives the whole pixel."""
_NOTHING = 0.5 / 1024.0
"""Matte up to which it rounds to nothing."""


@dataclass(frozen=True)
class DetailConfig:
    """How plates are chosen, weighed and mixed. Lengths are in pixels of pictures 640 wide."""

    sources: int = 5
    """Plates that a frame is made of, at most: its own and that of t* among them."""
    reach: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """How many frames before and after a pose plates are looked for that see what its own hides."""
    depth_error: float = 0.15
    """Share of the depth by which surfaces may be wrong: with the baseline, an error in pixels, at 1 of which a plate
    is believed by half. A cautious figure: near plates are right where far ones only look so."""
    margin: int = 2
    """Pixels around what moves in which the leading plate is not believed: hair, motion blur, the flow's own error."""
    feather: float = 1.5
    """Sigma of the leading plate's matte along its border, pixels."""
    doubt: float = 0.05
    """Sum of weights at which a pixel is half plate, half splats: what plates say is believed in part, as it is wrong
    in part. On truth the best share of a single plate's residual in what moves is 0.4 to 0.65."""
    travel: float = 1.0
    """Pixels that the model moves a point by, from t* to the frame's own plate, from which on that plate is not
    believed there if it bears the motion out: sways too small for the flow."""
    borne_out: float = 0.03
    """By how much, display-referred, the plate's own time must explain it better than t* does."""
    alike: float = 0.15
    """Low-passed difference of the frozen render and its own plate, display-referred, up to which they agree."""
    denied: float = 0.15
    """Low-passed difference of the frozen render and its own plate, display-referred, from which on that plate is not
    believed where plate t* agrees with the render: something held still that was elsewhere."""
    own_time: float = 0.3
    """Share of such a difference that must be gone in the render of the plate's own time."""
    denied_too: float = 0.1
    """The same, for what hangs together with such a spot."""
    thin: int = 3
    """Half the width in pixels below which such a spot, of either kind, is an outline, which a wrong depth explains."""
    gap: int = 4
    """Half the width in pixels up to which gaps within what moves belong to it: there depth is rough, and what plate t*
    sees flickers from pixel to pixel."""
    sway: float = 3.0
    """Travel in pixels from t* to a plate at which what moves in it is believed 1/e: longer ones are known less."""
    sway_trust: float = 0.15
    """How far a plate of another time is believed in what moves, where the model explains it. Depths that are off by a
    pixel carry plate t* to a wrong place far away in pose; the own plate's residual is at its place, at another time:
    either alone is worse than both."""
    agreement: float = 0.03
    """Low-passed difference, display-referred, between a plate of another time and plate t* at which the first is
    believed 1/e in what moves: it may show another state."""
    instant: bool = True
    """Give what plate t* shows and the model lacks a surface of its own (`instant.py`)."""
    sightings: SightingConfig = field(default_factory=SightingConfig)
    """How plates are compared with the model."""


@dataclass
class DetailedFrame:
    """One frozen frame made of plates, on the CPU, with overscan if the render had it."""

    linear: Tensor
    """[H, W, 3] premultiplied, scene-linear: matte * plate(st) + fill."""
    alpha: Tensor
    """[H, W] in 0..1."""
    splat: Tensor
    """[H, W, 3] premultiplied, display-referred: the splats alone."""
    splat_alpha: Tensor
    """[H, W] in 0..1: how much of the pixel they cover."""
    plate: Tensor
    """[H, W] in 0..1: share of the pixel that is plate; 0: invented by splats."""
    source: Tensor
    """[H, W] float32: number of the frame whose plate gives most; 0 where `plate` is 0."""
    depth: Tensor
    """[H, W] as in `FrozenImage`."""
    support: Tensor
    """[H, W] as in `FrozenImage`."""
    motion: Tensor
    """[H, W] in 0..1: how much of what is seen moves in the clip, by the plates where they tell. On the clip's own
    poses 1 also where the frame's own plate shows what moves and is let go of: where it is 0 that plate may stand."""
    leading: int
    """Frame number of the plate that `st` looks into."""
    st: Tensor
    """[H, W, 2] s to the right, t up, 0..1 over the undistorted plate `leading`, pixel centres at (i + 0.5) / size."""
    matte: Tensor
    """[H, W] in 0..1: how much of the pixel the leading plate gives."""
    fill: Tensor
    """[H, W, 3] scene-linear, premultiplied by 1 - matte: the rest of the pixel."""

    @property
    def color(self) -> Tensor:
        """[H, W, 3] `linear`, extended display-referred; made anew each time, because few need it whole."""
        out = torch.empty_like(self.linear)
        for rows in bands(*self.alpha.shape):
            out[rows] = to_display(self.linear[rows])
        return out


@dataclass
class _Shot:
    """A frame that is being made: its camera at both sizes, and what it shows."""

    viewmat: Tensor
    K: Tensor
    """[3, 3] in pixels of the picture with its overscan."""
    image: FrozenImage
    own: bool
    """True if it is one of the clip's own frames, seen as its camera saw it."""
    t: int
    """Frame whose plate shows the instant."""
    frozen: FrozenGaussians
    points: Tensor
    """[h, w, 3] world points seen, at the size of decisions."""
    depth: Tensor
    """[h, w]"""
    motion: Tensor
    """[h, w] in 0..1: what moves in the clip, at t*."""
    per_pixel: float
    """Pixels of decisions per pixel of the picture."""
    doubt: Tensor
    """[h, w] in 0..1: where plates of other times are believed only if they agree with the model."""
    moved: Tensor
    """[h, w] in 0..1: what moves in the clip, at t* or in the frame's own plate; else `motion`."""

    @property
    def centre(self) -> Tensor:
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass
class _Fillers:
    """The plates that fill what the leading one does not give."""

    chosen: list[int]
    """Their frame numbers."""
    moved: list[Tensor]
    """[h, w, 3] each: scene units from t* to that plate of what is seen, at the size of decisions."""
    unknown: Tensor
    """[h, w] in 0..1: share of it whose way nobody knows."""
    agreed: list[Tensor]
    """[h, w] in 0..1 each: it does not contradict plate t* about what is seen."""
    residuals: list[Tensor]
    """[H, W, 3] float16 each, as `Sightings.residual`."""


@dataclass
class _Rest:
    """Pixels of some rows that the leading plate does not give, P of them."""

    y: Tensor
    """[P] int64 row, from the first of these rows."""
    x: Tensor
    """[P] int64 column."""
    color: Tensor
    """[P, 3] premultiplied, display-referred."""
    share: Tensor
    """[P] in 0..1: how much of it is plate."""
    source: Tensor
    """[P] number of the frame that gives most."""


class Detailer:
    """Makes frozen frames of one run out of plates. What it computes of a plate serves all frames that use it."""

    def __init__(
        self,
        run: LoadedRun,
        scene: Scene,
        plates: PlateReader,
        config: DetailConfig | None = None,
        moving: MovingOf | None = None,
    ) -> None:
        """`moving`: see `Sightings`."""
        self.run, self.scene, self.plates = run, scene, plates
        self.config = config or DetailConfig()
        self._moving = moving
        self.seen = Sightings(run, scene, plates, moving, self.config.sightings)
        """The plates as the scene at hand has them: the run's, or that of a developed instant."""
        self._layers: OrderedDict[tuple[int, float], InstantLayer | None] = OrderedDict()

    @torch.no_grad()
    def frame(
        self,
        output: OutputFrame,
        frozen: FrozenGaussians,
        image: FrozenImage,
        width: int,
        height: int,
        withheld: Collection[int] = (),
    ) -> DetailedFrame:
        """One frozen frame.

        Args:
            output: its camera and instant.
            frozen: the scene frozen at `output.t_star`.
            image: the splats' render of it, which may show more around the frame: overscan.
            width, height: pixels of the frame without overscan.
            withheld: frames whose plates are not to be used.
        """
        splat = image
        self._turn_to(frozen)
        frozen, image = self._joined(output, frozen, image, width, height)
        shot = self._shot(output, frozen, image, width, height)
        usable = [frame for frame in self.seen.frames if frame not in withheld]
        leading = self._leading(output, shot, usable)
        matte, st, own = self._lead(output, shot, leading, usable, (width, height))
        fillers = self._fillers(shot, matte, leading, usable)
        return self._mixed(shot, splat, leading, matte, st, own, fillers)

    # ------------------------------------------------------------------------------------------------- the frame

    def _turn_to(self, frozen: FrozenGaussians) -> None:
        """Looks at the plates as a scene has them; frames of one instant come one after another."""
        developed = frozen if frozen.descent is not None else None
        if developed is not self.seen.stage.developed:
            config = self.config.sightings
            self.seen = Sightings(self.run, self.scene, self.plates, self._moving, config, developed)

    def _joined(
        self, output: OutputFrame, frozen: FrozenGaussians, image: FrozenImage, width: int, height: int
    ) -> tuple[FrozenGaussians, FrozenImage]:
        """The frozen scene with what plate t* shows and the model lacks, and its render."""
        layer = self._layer(output.t_star, frozen) if frozen.descent is None else None  # developed ones have theirs
        if layer is None:
            return frozen, image
        frozen = join(frozen, layer)
        K, exposed_at = _with_overscan(output.K, image, width, height), self.scene.time_of_frame(output.exposed_like)
        rows, columns = image.alpha.shape
        exposure = self.run.model.exposure
        return frozen, render_frozen(frozen, output.viewmat, K, columns, rows, exposure, exposed_at)

    def _layer(self, t_star: float, frozen: FrozenGaussians) -> InstantLayer | None:
        key = len(frozen.support), t_star
        if not self.config.instant:
            return None
        if key not in self._layers:
            folder = Shot(self.scene.folder.parent)
            motion = lambda frame: load_motion(folder, frame)  # noqa: E731
            self._layers[key] = instant_layer(self.run, self.scene, None, frozen, t_star, motion=motion)
            while len(self._layers) > 2:
                self._layers.popitem(last=False)
        return self._layers[key]

    def _shot(self, output: OutputFrame, frozen: FrozenGaussians, image: FrozenImage, width: int, height: int) -> _Shot:
        rows, columns = image.alpha.shape
        K = _with_overscan(output.K, image, width, height)
        per_pixel = min(1.0, self.config.sightings.width / width)
        w, h = max(8, round(columns * per_pixel)), max(8, round(rows * per_pixel))
        small = pixel_centres(w, h)
        depth = look_up(image.depth, small * torch.tensor([columns / w, rows / h], device="cpu"), "nearest")
        points = unproject(small, depth, output.viewmat, resize_intrinsics(K[None], columns, rows, w, h)[0])
        t = min(self.seen.frames, key=lambda frame: abs(frame - output.t_star))
        motion = resized(image.motion, w, h)
        own = self._is_own(output, width, height)
        nothing = torch.zeros_like(motion)
        return _Shot(output.viewmat, K, image, own, t, frozen, points, depth, motion, w / columns, nothing, motion)

    def _is_own(self, output: OutputFrame, width: int, height: int) -> bool:
        """True if the frame is one of the clip's own, seen as its camera saw it and as large as its plate."""
        i = self.seen.index.get(output.frame)
        return (
            i is not None
            and (width, height) == (self.plates.width, self.plates.height)
            and output.frame in self.seen.frames
            and output.exposed_like == float(output.frame)
            and torch.equal(output.viewmat, self.scene.viewmats[i])
            and torch.allclose(output.K, self.scene.camera_at(width, height)[i], rtol=1e-4)
        )

    def _leading(self, output: OutputFrame, shot: _Shot, usable: list[int]) -> int:
        """The frame's own plate, else the nearest in pose of those usable: in travel over depth, and in direction."""
        if shot.own and output.frame in usable:
            return output.frame
        at = torch.tensor([self.seen.index[frame] for frame in usable], device="cpu")
        solid = shot.depth[shot.depth < 1e9]
        depth = float(solid.median()) if len(solid) else 1.0
        travel = (self.seen.centres[at] - shot.centre).norm(dim=1) / max(depth, 1e-6)
        turned = 1.0 - self.scene.viewmats[at][:, 2, :3] @ shot.viewmat[2, :3]
        return usable[int((travel + turned).argmin())]

    def _lead(
        self, output: OutputFrame, shot: _Shot, leading: int, usable: list[int], size: tuple[int, int]
    ) -> tuple[Tensor, Tensor, bool]:
        """(matte [H, W] of the leading plate, its ST [H, W, 2], True if that is the identity).

        Also settles `shot.motion`: by the mattes of plate t* where that sees the point, else by the model's;
        `shot.doubt`: what the leading plate shows wrongly others may, too, though their mattes do not say so; and
        `shot.moved`.
        """
        rows, columns = shot.image.alpha.shape
        lead = self.seen.seen(leading, shot.points)
        own = shot.own
        truth = self.seen.seen(shot.t, shot.points) if shot.t in usable else None
        hidden = torch.minimum(shot.motion, lead.moving) if own else shot.motion
        if truth is not None:
            shot.motion = truth.visible * truth.moving + (1.0 - truth.visible) * hidden
        else:
            shot.motion = torch.maximum(shot.motion, lead.moving) if own else shot.motion
        shot.moved = shot.motion
        st, within = self._places(shot, leading, own, size)
        if own and leading != output.frame:  # its own plate is withheld
            return torch.zeros(rows, columns, device="cpu"), st, own
        if own and leading == output.t_star:  # its own plate shows the instant itself
            return within, st, own
        wrong = torch.maximum(shot.motion, lead.moving) > 0.5
        if own:
            off, gained = self._off(shot, leading)
            wrong = wrong | self._swayed(shot, leading, gained) | self._beside(shot, leading, usable, off)
            # What the model lacks at the plate's own time, too, is its fault and no motion.
            off = torch.where(gained > self.config.own_time * off, off, 0.0)
            if truth is not None:
                wrong = wrong | self._denied(truth, off)
            wrong = closed(self.seen.whole(wrong, off), round(self.config.gap * self.seen.unit))
        shot.doubt = widened(wrong.float(), round(self.config.margin * self.seen.unit))
        let_go = blurred(shot.doubt, self.config.feather * self.seen.unit)
        matte = 1.0 - let_go
        if own:
            shot.moved = torch.maximum(shot.motion, let_go)
        else:
            error = self._parallax(shot, leading, shot.depth)
            matte = matte * lead.visible * torch.exp(-error.square())
        return resized(matte, columns, rows) * within, st, own

    def _off(self, shot: _Shot, frame: int) -> tuple[Tensor, Tensor]:
        """([h, w] low-passed difference of the frozen render and its own plate, [h, w] by how much that is more than
        the difference of the model at the plate's own time); 0 beyond the plate."""
        h, w = shot.depth.shape
        view = self.seen.view(frame)
        inside = _middle(view.missed, shot.depth)
        off, gained = torch.zeros(h, w, device="cpu"), torch.zeros(h, w, device="cpu")
        off[inside] = self.seen.difference(view.picture.float(), resized(shot.image.color, w, h)[inside])
        gained[inside] = off[inside] - view.missed.float()
        return off, gained

    def _beside(self, shot: _Shot, frame: int, usable: list[int], off: Tensor) -> Tensor:
        """[h, w] bool: what the plate before or after sees and calls moving, or both call moving that is before it.

        What only one of three finds would come and go. Where its own plate shows what the frozen render does (`off`)
        nothing would, and the plate stays.
        """
        h, w = shot.depth.shape
        at, points = usable.index(frame), shot.points[::2, ::2]  # a quarter of the work
        around = usable[max(0, at - 1) : at] + usable[at + 1 : at + 2]
        found, both = torch.zeros(points.shape[:2], device="cpu"), torch.ones(points.shape[:2], device="cpu")
        for neighbour in around:
            sighting = self.seen.seen(neighbour, points)
            found, both = torch.maximum(found, sighting.visible * sighting.moving), both * sighting.moving
        if len(around) == 2:
            found = torch.maximum(found, both)
        near = widened((off > self.config.alike).float(), round(self.config.margin * self.seen.unit))
        return (resized(found, w, h) > 0.5) & (near > 0.5)

    def _denied(self, truth: Sighting, off: Tensor) -> Tensor:
        """[h, w] bool: plate t* (`truth`) bears the frozen render out, its own plate shows something else (`off`).

        A hand that is held still where it was not at t* is still to the flow; a wrong depth explains edges only.
        """
        denied = (off > self.config.denied) & (truth.visible * truth.explained > 0.5)
        spots = opened(denied, round(self.config.thin * self.seen.unit))
        return self.seen.whole(spots, off, self.config.denied_too)

    def _swayed(self, shot: _Shot, frame: int, gained: Tensor) -> Tensor:
        """[h, w] bool: the model moves what is seen from t* to its own plate, and the plate bears it out.

        That is, the render of t* differs from the plate by more than the render of the plate's own time does (`gained`,
        as `_off`). A textureless shirt that the model lets drift is no evidence; flow at small sizes misses sways
        that are.
        """
        out = (gained > self.config.borne_out) & (self._travel(shot, frame) > self.config.travel)
        # Outlines are errors of depth; what moves is a region.
        return opened(out, round(self.config.thin * self.seen.unit))

    def _travel(self, shot: _Shot, frame: int) -> Tensor:
        """[h, w] pixels of 640 by which the model moves what is seen from t* to a plate, as that plate sees it."""
        h, w = shot.depth.shape
        size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work: Gaussians of what moves are larger than its pixels
        moved, points = self._displacements(shot, [frame], size)[0][0], shot.points[::2, ::2]
        view = self.seen.view(frame)
        ends = project(points + moved, view.viewmat, view.K)[0]
        travel = (ends - project(points, view.viewmat, view.K)[0]).norm(dim=-1) / self.seen.unit
        return resized(travel, w, h)

    def _places(self, shot: _Shot, leading: int, own: bool, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """(ST [H, W, 2] into the leading plate, [H, W] 1 within it): the identity on the clip's own poses."""
        rows, columns = shot.image.alpha.shape
        if own:
            x = (torch.arange(columns, device="cpu") + 0.5 - (columns - size[0]) // 2) / size[0]
            y = (torch.arange(rows, device="cpu") + 0.5 - (rows - size[1]) // 2) / size[1]
            share = torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1)
        else:
            viewmat, K = self.seen.camera(leading, self.plates.width, self.plates.height)
            whole = torch.tensor([self.plates.width, self.plates.height], device="cpu")
            share = torch.empty(rows, columns, 2, device="cpu")
            for band in bands(rows, columns):
                pixels = pixel_centres(columns, band.stop - band.start)
                pixels[..., 1] += band.start
                points = unproject(pixels, shot.image.depth[band], shot.viewmat, shot.K)
                share[band] = project(points, viewmat, K)[0] / whole
        within = ((share > 0.0) & (share < 1.0)).all(dim=-1).float()
        share[..., 1] = 1.0 - share[..., 1]
        return snap(share.clamp_(-4.0, 5.0), (self.plates.width, self.plates.height)), within

    def _parallax(self, shot: _Shot, frame: int, depth: Tensor) -> Tensor:
        """Pixels of 640 by which a wrong depth moves points at `depth`, against this camera, in a plate."""
        travel = (self.seen.centres[self.seen.index[frame]] - shot.centre).norm()
        focal = shot.K[0, 0] * shot.per_pixel
        return focal * travel / depth.clamp_min(1e-6) * self.config.depth_error / self.seen.unit

    # ------------------------------------------------------------------------------------------------- the fill

    def _fillers(self, shot: _Shot, matte: Tensor, leading: int, usable: list[int]) -> _Fillers | None:
        """The plates for what the leading one does not give; None if it gives everything."""
        if not bool((matte < _ALL).any()):
            return None
        chosen = self._chosen(shot, matte, leading, usable)
        moved, unknown = self._displacements(shot, chosen)
        agreed = self._agreed(shot, chosen, moved)
        return _Fillers(chosen, moved, unknown, agreed, [self.seen.residual(frame) for frame in chosen])

    def _agreed(self, shot: _Shot, chosen: list[int], moved: list[Tensor]) -> list[Tensor]:
        """[h, w] in 0..1 for each plate: 1 where plate t* does not see what is seen, or sees it alike."""
        h, w = shot.depth.shape
        if shot.t not in chosen:
            return [torch.ones_like(shot.depth) for _ in chosen]
        points = shot.points[::2, ::2]  # a quarter of the work: it is low-passed
        truth = self.seen.seen(shot.t, points)
        told = look_up(self.seen.view(shot.t).picture.float(), truth.pixels)
        out = []
        for frame, way in zip(chosen, moved, strict=True):
            if frame == shot.t:
                out.append(torch.ones_like(shot.depth))
                continue
            there = self.seen.seen(frame, points + way[::2, ::2])
            says = look_up(self.seen.view(frame).picture.float(), there.pixels)
            both = (truth.visible * there.visible)[..., None]
            off = self.seen.difference(says * both, told * both, 0.5)
            out.append(resized(torch.exp(-(off / self.config.agreement).square()), w, h))
        return out

    def _rest(self, shot: _Shot, fillers: _Fillers, matte: Tensor, rows: slice) -> _Rest:
        """What the leading plate does not give of some rows: the splats, with what they missed from other plates."""
        at = (matte[rows] < _ALL).nonzero()
        y, x = at[:, 0], at[:, 1]
        count = len(at)
        rest = _Rest(y, x, shot.image.color[rows][y, x], *(torch.zeros(count, device="cpu") for _ in range(2)))
        if not count:
            return rest
        pixels = torch.stack([x + 0.5, (y + rows.start) + 0.5], dim=-1)
        small = pixels * shot.per_pixel
        points = unproject(pixels, shot.image.depth[rows][y, x], shot.viewmat, shot.K)
        motion, unknown = look_up(shot.motion, small), look_up(fillers.unknown, small)
        larger = torch.tensor(
            [self.plates.width / self.seen.size[0], self.plates.height / self.seen.size[1]], device="cpu"
        )
        doubt = look_up(shot.doubt, small)
        weights, places = [], []
        untold = 1.0 - unknown
        truth = self.seen.seen(shot.t, points) if shot.t in fillers.chosen else None
        if truth is not None:  # the better plate t* shows it, the less another time is needed
            untold = untold * (1.0 - self._near(shot, shot.t, truth))
        for n, frame in enumerate(fillers.chosen):
            if truth is not None and frame == shot.t:
                sighting = truth
            else:
                sighting = self.seen.seen(frame, points + look_up(fillers.moved[n], small))
            sighting = self._doubted(sighting, doubt)
            sway = self._sway(frame, points, sighting) * untold * look_up(fillers.agreed[n], small)
            weights.append(self._weight(shot, frame, sighting, motion, sway))
            places.append(sighting.pixels * larger)
        believed = torch.stack(weights)
        rest.source = torch.tensor([float(frame) for frame in fillers.chosen], device="cpu")[believed.argmax(dim=0)]
        total, carried = believed.sum(dim=0).clamp_min(1e-6), torch.zeros(count, 3, device="cpu")
        rest.share = total / (total + self.config.doubt)
        for n, residual in enumerate(fillers.residuals):
            carried += (believed[n] / total)[:, None] * look_up_near(residual, places[n], "bicubic")
        rest.color += carried * rest.share[:, None]
        return rest

    def _doubted(self, sighting: Sighting, doubt: Tensor) -> Sighting:
        """The sighting, with what it shows of points in doubt [...] taken for moving where the model says otherwise."""
        return replace(sighting, moving=torch.maximum(sighting.moving, doubt * (1.0 - sighting.explained)))

    def _sway(self, frame: int, points: Tensor, sighting: Sighting) -> Tensor:
        """[...] how far plate `frame` is believed in what moves: it agrees with the model, which moved it little."""
        view = self.seen.view(frame)
        travel = (project(points, view.viewmat, view.K)[0] - sighting.pixels).norm(dim=-1)
        trust = torch.exp(-travel / (self.config.sway * self.seen.unit))
        return self.config.sway_trust * sighting.explained * trust

    def _near(self, shot: _Shot, frame: int, sighting: Sighting) -> Tensor:
        """[...] in 0..1: how surely a plate shows points where the depth says."""
        return sighting.visible / (1.0 + self._parallax(shot, frame, sighting.depth))

    def _weight(self, shot: _Shot, frame: int, sighting: Sighting, motion: Tensor, sway: Tensor) -> Tensor:
        """[...] how far a plate is believed at points, `motion` of which belongs to what moves at t*."""
        near = self._near(shot, frame, sighting)
        if frame == shot.t:
            return near
        still = (1.0 - motion) * (1.0 - sighting.moving)
        return near * (still + (1.0 - still) * sway)

    def _chosen(self, shot: _Shot, matte: Tensor, leading: int, usable: list[int]) -> list[int]:
        """The plates to fill with: that of t*, the own one for what sways, and those that see most of the rest."""
        h, w = shot.depth.shape
        need = 1.0 - resized(matte, w, h)[::4, ::4]
        points, motion, doubt = (of[::4, ::4] for of in (shot.points, shot.motion, shot.doubt))
        k = self.seen.frames.index(leading)
        around = {k + side * step for step in self.config.reach for side in (-1, 1)} | {k}
        reach = {self.seen.frames[i] for i in around if 0 <= i < len(self.seen.frames)} | {shot.t}
        zero = torch.zeros_like(motion)
        gains = {
            frame: need * self._weight(shot, frame, self._doubted(self.seen.seen(frame, points), doubt), motion, zero)
            for frame in sorted(reach)
            if frame in usable
        }
        first = [frame for frame in (shot.t, leading) if frame in gains]
        chosen, have = list(dict.fromkeys(first)), torch.zeros_like(need)
        for frame in chosen:
            have = have + gains[frame]
        while len(chosen) < min(self.config.sources, len(gains)):
            # Diminishing returns: a second plate of the same wall helps less than a first one of another.
            worth = {
                frame: float((torch.log1p(10.0 * (have + gain)) - torch.log1p(10.0 * have)).sum())
                for frame, gain in gains.items()
                if frame not in chosen
            }
            frame = max(worth, key=lambda candidate: worth[candidate])
            if worth[frame] < 1e-3 * float(need.sum()):
                break
            chosen.append(frame)
            have = have + gains[frame]
        return chosen

    def _displacements(
        self, shot: _Shot, chosen: list[int], size: tuple[int, int] | None = None
    ) -> tuple[list[Tensor], Tensor]:
        """([h, w, 3] scene units from t* to each plate of what is seen, [h, w] share whose way nobody knows).

        `size` (w, h) None: that of decisions.
        """
        w, h = size or shot.depth.shape[::-1]
        rows, state = self.seen.rows, shot.frozen.state
        strangers = self.seen.stage.strangers(shot.frozen)
        extra = torch.zeros(len(strangers), 3 * len(chosen) + 1, device=state["means"].device)
        extra[strangers, -1] = 1.0
        if len(rows):
            now = state["means"][rows].cpu()
            for n, frame in enumerate(chosen):
                extra[rows, 3 * n : 3 * n + 3] = (self.seen.view(frame).offsets - now).to(extra.device)
        if not len(rows) and not bool(strangers.any()):
            return [torch.zeros(h, w, 3, device="cpu") for _ in chosen], torch.zeros(h, w, device="cpu")
        rows_full, columns = shot.image.alpha.shape
        K = resize_intrinsics(shot.K[None], columns, rows_full, w, h)[0]
        out = render(
            state, 0, shot.viewmat.to(extra.device), K.to(extra.device), w, h, colors=extra, with_contributions=False
        )
        shown = (out.colors[0, ..., 3:] / out.alphas[0].clamp_min(1e-3)[..., None]).cpu()
        return [shown[..., 3 * n : 3 * n + 3] for n in range(len(chosen))], shown[..., -1]

    # ------------------------------------------------------------------------------------------------- the mix

    def _mixed(
        self,
        shot: _Shot,
        splat: FrozenImage,
        leading: int,
        matte: Tensor,
        st: Tensor,
        own: bool,
        fillers: _Fillers | None,
    ) -> DetailedFrame:
        image = shot.image
        rows, columns = image.alpha.shape
        parts = bands(rows, columns)
        if len(parts) > 1:
            hand_back()
        gives = bool((matte > _NOTHING).any())
        plate = self.plates.linear(leading) if gives and not own else None
        # A render that is not the splats' layer is no longer needed once it is mixed.
        ours = image is not splat
        made = DetailedFrame(
            image.color if ours else torch.empty(rows, columns, 3, device="cpu"),
            image.alpha if ours else image.alpha.clone(), splat.color, splat.alpha,
            torch.empty(rows, columns, device="cpu"), torch.empty(rows, columns, device="cpu"), image.depth,
            image.support, resized(shot.moved, columns, rows), leading, st, matte,
            torch.zeros(rows, columns, 3, device="cpu"),
        )  # fmt: skip
        for band in parts:
            rest = None if fillers is None else self._rest(shot, fillers, matte, band)
            matte[band] = (matte[band] * 1024.0).round() / 1024.0
            lead = sample(plate, st[band]) if plate is not None else None
            if gives and own:
                lead = self._placed(leading, rows, columns, band)
            self._mix(made, rest, lead, band)
        return made

    def _placed(self, frame: int, rows: int, columns: int, band: slice) -> Tensor:
        """[h, columns, 3] scene-linear: some rows of a plate in the middle of `rows` x `columns`, 0 around it."""
        height, width = self.plates.height, self.plates.width
        if (height, width) == (rows, columns):
            return self.plates.linear(frame, band)
        out = torch.zeros(band.stop - band.start, columns, 3, device="cpu")
        top, left = (rows - height) // 2, (columns - width) // 2
        first, last = max(band.start, top), min(band.stop, top + height)
        if first < last:
            part = self.plates.linear(frame, slice(first - top, last - top))
            out[first - band.start : last - band.start, left : left + width] = part
        return out

    def _mix(self, made: DetailedFrame, rest: _Rest | None, lead: Tensor | None, rows: slice) -> None:
        """Fills some rows of a frame whose `matte` is settled and whose `alpha` is the splats'.

        `lead` [h, W, 3] are the leading plate's pixels there, scene-linear; None where it gives nothing.
        """
        matte, alpha, fill = made.matte[rows], made.alpha[rows], made.fill[rows]
        share = matte.clone()
        source = torch.full_like(share, float(made.leading))
        if rest is not None:
            at = rest.y, rest.x
            left = 1.0 - matte[at]
            alpha[at] += (1.0 - alpha[at]) * rest.share
            covered = torch.maximum(alpha, matte)[at].clamp_min(1e-4)[:, None]
            color = rest.color if self.plates.deep else rest.color.clamp(0.0, 1.0)
            fill[at] = left[:, None] * covered * to_linear(color / covered)
            share[at] += left * rest.share
            source[at] = torch.where(left > 0.5, rest.source, float(made.leading))
        torch.maximum(alpha, matte, out=alpha)
        source[share <= 0.0] = 0.0
        made.plate[rows], made.source[rows] = share, source
        made.linear[rows] = fill if lead is None else torch.addcmul(fill, matte[..., None], lead)


def _middle(inner: Tensor, outer: Tensor) -> tuple[slice, slice]:
    """(rows, columns) of a picture [h, w, ...] that lies in the middle of a larger one."""
    (rows, columns), (h, w) = outer.shape[:2], inner.shape[:2]
    top, left = (rows - h) // 2, (columns - w) // 2
    return slice(top, top + h), slice(left, left + w)


def _with_overscan(K: Tensor, image: FrozenImage, width: int, height: int) -> Tensor:
    """[3, 3] the camera of a frame of `width` x `height` in pixels of its render, which may show more around it."""
    rows, columns = image.alpha.shape
    wide = K.clone()
    wide[0, 2] += (columns - width) // 2
    wide[1, 2] += (rows - height) // 2
    return wide
