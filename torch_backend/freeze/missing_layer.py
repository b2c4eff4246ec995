"""What plate t* shows and the model does not have: a waving hand, a pointing arm, a swinging apple. It gets a depth,
so that it stands where it stood from every pose, as a layer of small Gaussians in front of the frozen scene.

Whole regions are looked for, on a low-passed residual: a model trained at 320 px is soft everywhere, and softness is
not disagreement. What it has painted onto the wall behind (`contradicted.py`) counts as missing, too. Depth is told by
what a region hangs on (the arm), by the frames around t*, and by what it hides; where the field has the hand itself, if
paler or softer than the plate, it is as deep as that. Unless the field has it far before the arm on which it hangs: no
frame tells how far away a thing is that moves, and the price on motion prefers it near (`adrift.py`). What the field
has there is taken out then. So it is where a scene that looks right to t* falls apart from aside (`torn.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..array_types import connected
from ..scene import Scene
from ..torch_types import from_numpy
from ..train import LoadedRun
from .contradicted import contradicted
from .frozen import FrozenGaussians, FrozenImage, fade
from .instant_bench import InstantBench, InstantConfig, Motion, disc, grown, large, low_passed
from .instant_depth import Region, as_field, inverse_depth, own_motion
from .instant_track import Track, swing, tracks
from .layer_gaussians import Part, gaussians_of, share_of
from .torn import mends, torn

_KNOWN = 0.25
"""Share of a region whose depth is known from which on all of it is as deep as that."""

_WITHIN = 0.8
"""Share of a piece that has to lie where something missing is looked for."""

_COVERED = 0.6
"""Share of a piece's pixels that a layer has to cover to stand for it."""


@dataclass
class InstantLayer:
    """What is added to a frozen scene, and what is taken back."""

    state: dict[str, Tensor]
    """means, quats, log_scales, opacity_logits, sh0, shN of M Gaussians in scene units, as `FrozenGaussians.state`."""
    frame: int
    """Number of the frame whose plate they show."""
    mask: Tensor
    """[h, w] float32 in 0..1: where in that plate they are from."""
    ghost: Tensor
    """[h, w] bool: where the model showed what that plate does not, and moving Gaussians were faded for it."""
    kept: Tensor
    """[N] in 0..1: what is left of the opacity of each Gaussian of the frozen scene."""
    regions: list[Region]
    """What was found, with depths."""

    @classmethod
    def empty(cls, frozen: FrozenGaussians, frame: int, ghost: NDArray[np.bool_], kept: Tensor) -> InstantLayer:
        """One that adds nothing."""
        state = {name: value[:0] for name, value in frozen.state.items()}
        return cls(state, frame, torch.zeros(ghost.shape, device="cpu"), from_numpy(ghost), kept, [])

    def stands_for(self, where: NDArray[np.bool_]) -> bool:
        """True if it shows what there is at the pixels `where` [h, w] of plate t*, so that others need not."""
        return bool((self.mask.numpy()[where] > 0.5).mean() >= _COVERED)


@torch.no_grad()
def instant_layer(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: float,
    config: InstantConfig | None = None,
    motion: Motion | None = None,
    known: NDArray[np.float32] | None = None,
) -> InstantLayer | None:
    """Finds what plate t* shows and a scene frozen at t* does not, and makes Gaussians of it.

    Args:
        frozen: the scene at t*, on any device.
        t_star: frame number; between two frames the nearer one's plate is looked at.
        motion: motion mattes; without them flow off its epipolar lines alone tells what moves.
        known: [h, w] inverse depth of what is missing, at the size of the bench, 0 where it has to be told.

    Returns None if plate and scene agree.
    """
    index = scene.nearest(t_star)
    bench = InstantBench(run, scene, index, config or InstantConfig(), motion)
    image = bench.render(frozen)
    things = small_things(bench, image)
    kept, ghost = _ghosts(bench, frozen, image)
    if ghost.any():
        frozen = fade(frozen, kept)
        image = bench.render(frozen)
    asked = Asked(bench, frozen, image, things, known, InstantLayer.empty(frozen, scene.frames[index], ghost, kept))
    joined, layer, _ = taken(asked, None)
    apart = torn(bench, joined, bench.render(joined))
    if apart.where.any():
        joined, again, anew = taken(asked, apart.where)
        if mends(bench, joined, apart, anew):
            layer = again
    return layer if len(layer.state["means"]) or ghost.any() else None


@dataclass
class Asked:
    """A scene at t*, and what is needed to find what it lacks."""

    bench: InstantBench
    frozen: FrozenGaussians
    """The scene, less ghosts."""
    image: FrozenImage
    """Of it, by t*'s camera."""
    things: list[Track]
    known: NDArray[np.float32] | None
    """As in `instant_layer`."""
    empty: InstantLayer
    """A layer that adds nothing to it."""
    only: NDArray[np.bool_] | None = None
    """[h, w] what is missing elsewhere is left alone; None: nowhere."""


def taken(asked: Asked, apart: NDArray[np.bool_] | None) -> tuple[FrozenGaussians, InstantLayer, NDArray[np.bool_]]:
    """(the scene with what it lacks, that alone, where [h, w] what it had was taken out for that).

    `apart` [h, w] has fallen apart, and is not believed either.
    """
    bench, frozen, image, empty = asked.bench, asked.frozen, asked.image, asked.empty
    found = _found(asked, frozen, image, apart)
    if len(found.astray):
        stays = torch.ones_like(empty.kept).index_fill(0, found.astray, 0.0)
        without = fade(frozen, stays)
        bare = bench.render(without)
        shards = None if apart is None else apart & found.misplaced
        again = _found(asked, without, bare, shards, taken_out=True)
        # From t*'s own camera nothing is missing of what falls apart only from aside.
        before = image if shards is None or not shards.any() else bare
        layer = _drawn(bench, without, before, again, replace(empty, kept=empty.kept * stays))
        if layer.stands_for(found.misplaced):
            return join(without, layer, faded=True), layer, found.misplaced
        found = _found(asked, frozen, image, None, believed=True)
    layer = _drawn(bench, frozen, image, found, empty)
    return join(frozen, layer, faded=True), layer, np.zeros_like(found.misplaced)


def join(frozen: FrozenGaussians, layer: InstantLayer, faded: bool = False) -> FrozenGaussians:
    """The frozen scene with the layer in it, behind it in order; `faded`: its ghosts have been faded already."""
    count, device = len(layer.state["means"]), frozen.support.device
    base = frozen if faded else fade(frozen, layer.kept)
    state = {name: torch.cat([value, layer.state[name].to(value)]) for name, value in base.state.items()}
    ones = torch.ones(count, device=device, dtype=frozen.support.dtype)
    return FrozenGaussians(state, frozen.sh_degree, torch.cat([frozen.support, ones]), torch.cat([frozen.motion, ones]))


def _painted(bench: InstantBench, image: FrozenImage) -> NDArray[np.bool_]:
    """bool [h, w]: what moves at t* and looks right, but is on something still behind, where it cannot be."""
    import cv2

    matte = bench.matte()
    flat = np.zeros((bench.height, bench.width), bool) if matte is None else matte > 0.5
    flat &= (image.motion.numpy() < 0.5) & (bench.difference(image) < bench.config.grow)
    if not flat.any():
        return flat
    found = (flat & contradicted(bench, image)).astype(np.uint8)
    closed = cv2.morphologyEx(found, cv2.MORPH_CLOSE, disc(1.5 * bench.unit))
    return np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc(1.0 * bench.unit)) > 0, np.bool_)


def _regions(
    bench: InstantBench, image: FrozenImage, painted: NDArray[np.bool_], apart: NDArray[np.bool_]
) -> list[NDArray[np.bool_]]:
    """Masks [h, w] of the regions in which plate t* shows something that moves and the render does not, or has
    `painted` [h, w] onto what is behind, or has fallen `apart` [h, w].

    A region of which most has fallen apart is of that; else it is one of its own, that may touch: the other hand.
    """
    c, least = bench.config, bench.config.least * bench.unit**2
    difference = bench.difference(image)
    lacking = _pieces((difference >= c.grow) | painted)
    for region in lacking:
        if apart[region].mean() > 0.5:
            apart = apart | region
    lacking = [piece for region in lacking for piece in _pieces(region & ~apart)]
    found: list[NDArray[np.bool_]] = []
    for region in [*lacking, *_pieces(apart)]:
        missing = difference[region].max() >= c.seed or (painted | apart)[region].sum() >= least
        if missing and region.sum() >= least:
            found.append(region)
    # Something still that a mover's matte covers may fall apart as well, and is none of what moves.
    surely = [c.surely_own if apart[region].mean() > 0.5 else 1.0 for region in found]
    moving = [region for region, least in zip(found, surely, strict=True) if _moves(bench, region, least)]
    return [region for region in moving if not _stuck(bench, region, image)]


def _pieces(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Connected parts [h, w] of a mask [h, w]."""
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    return [labels == label for label in range(1, count)]


def _moves(bench: InstantBench, region: NDArray[np.bool_], surely: float = 1.0) -> bool:
    """True if what plate t* shows in a region moves. What is merely modelled badly stays on its epipolar lines.

    `surely`: times as much of its own motion as usual is asked for.
    """
    c, matte = bench.config, bench.matte()
    share = 1.0 if matte is None else float(matte[region].mean())
    own = own_motion(bench.view, bench.neighbours(), region, c.depth, bench.unit)
    if own is None:  # a hand too fast for its flow is known by its matte alone, and that has to be sure
        return matte is not None and share >= 0.5 * (1.0 + c.moving)
    return share >= c.moving and own >= surely * (1.0 if matte is not None else 2.0) * c.own_motion * bench.unit


def _stuck(bench: InstantBench, region: NDArray[np.bool_], image: FrozenImage) -> bool:
    """True if a region shows the same detail in frames all over the clip, while the world behind it goes by: a logo."""
    view, unit = bench.view, bench.unit
    inverse = 1.0 / float(np.median(image.depth.numpy()[region]))
    alike: list[float] = []
    for other in bench.spread(7):
        travel = np.linalg.norm(view.project(other, inverse) - view.grid(), axis=-1)
        if np.median(travel[region]) > 3.0 * unit:
            a, b = ((v.picture - low_passed(v.picture, 2.0 * unit))[region].ravel() for v in (view, other))
            alike.append(float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9)))
    return bool(alike) and float(np.median(alike)) > bench.config.stuck


@dataclass
class _Found:
    """What is missing of a frozen scene, and how deep it is."""

    image: FrozenImage
    """The scene as t*'s camera sees it."""
    painted: NDArray[np.bool_]
    """[h, w]: what of it is painted onto something still behind."""
    parts: list[Part]
    regions: list[Region]
    """Of the parts."""
    misplaced: NDArray[np.bool_]
    """[h, w]: parts that the field has far before what they hang on,"""
    astray: Tensor
    """int64 [M]: and the rows of what it has there, with its veil."""


def _found(
    asked: Asked,
    frozen: FrozenGaussians,
    image: FrozenImage,
    apart: NDArray[np.bool_] | None,
    taken_out: bool = False,
    believed: bool = False,
) -> _Found:
    """What plate t* shows and `image` of a frozen scene does not.

    Args:
        apart: [h, w] what has fallen apart (`torn.py`), which is not believed either.
        taken_out: of that, and of what stood far before its arm, the scene has nothing any more.
        believed: the field, wherever it has it.
    """
    bench, known = asked.bench, asked.known
    painted = _painted(bench, image)
    apart = np.zeros_like(painted) if apart is None else apart
    doubted = painted | apart
    things = [thing for thing in asked.things if apart[thing.pixels].mean() < _KNOWN]
    regions = _regions(bench, image, painted, apart)
    if asked.only is not None:
        regions = [region for region in regions if asked.only[region].mean() > _WITHIN]
        things = [thing for thing in things if asked.only[thing.pixels].mean() > _WITHIN]
    nothing, nobody = np.zeros_like(painted), torch.zeros(0, dtype=torch.int64, device="cpu")
    found = _Found(image, painted, [], [], nothing, nobody)
    c, others = bench.config.depth, bench.neighbours() if regions or things else []
    matte = bench.matte()

    def told_by(shown: FrozenImage, soft: NDArray[np.float32]) -> tuple[NDArray[np.float32], Region]:
        """Inverse depth [h, w] of a region, and what is known of it, by what is shown about it."""
        explained = (bench.difference(shown) < bench.config.grow) & (shown.alpha.numpy() > 0.9) & ~doubted
        mover = shown.motion.numpy() if matte is None else np.maximum(matte, shown.motion.numpy())
        return inverse_depth(
            bench.view, others, soft >= 0.5, explained & (soft < 0.1), shown.depth.numpy(), mover, c, bench.unit
        )

    alone = np.zeros_like(painted) if not things else np.any([t.pixels for t in things], axis=0)
    covers: list[tuple[NDArray[np.float32], Track | None]]
    covers = [(_cover(bench, image, r, doubted), None) for r in regions if (r & alone).sum() < 0.3 * r.sum()]
    covers += [(_thing_cover(bench, image, thing), thing) for thing in things]
    covers = [(soft, thing) for soft, thing in covers if soft.max() >= 0.5]
    fields = _fields_inverse(bench, frozen) if covers else np.zeros(0, np.float32)
    for soft, thing in covers:
        core = soft >= 0.5
        depths, facts = told_by(image, soft)
        fallen = bool(apart[core].mean() > 0.5)
        swings = None if thing is None else swing(thing, bench.index, bench.camera, bench.config.track, bench.unit)
        if swings is not None:
            depths = np.full_like(depths, 1.0 / swings.depth)
            facts = replace(facts, depth=swings.depth, deviation=swings.deviation)
        elif known is not None and (known[core] > 0.0).mean() >= _KNOWN:
            inverse = float(np.median(known[core & (known > 0.0)]))
            depths, facts = np.full_like(depths, inverse), replace(facts, depth=1.0 / inverse)
        elif fallen and taken_out and facts.attached >= c.surely:
            pass  # what it hangs on tells; what the field has left there are shards
        elif (told := as_field(fields, core, c, bench.unit)) is not None:
            depth = 1.0 / float(np.median(told[core]))
            depths, facts = told, replace(facts, depth=depth)
            nearest = depth * (1.0 + c.deep)
            if not (believed or taken_out):
                rows = in_its_place(bench, frozen, core, nearest)
                _, hangs = told_by(bench.render(_less(frozen, rows)), soft)
                before = nearest < hangs.depth
                if hangs.attached >= c.surely and (before or (fallen and depth > (1.0 + c.behind) * hangs.depth)):
                    found.misplaced |= core
                    if before:
                        rows = in_its_place(bench, frozen, core, hangs.depth / (1.0 + c.deep))
                    crumbs = _crumbs(bench, _less(frozen, rows), core, depth)
                    found.astray = torch.cat([found.astray, rows, crumbs])
        found.parts.append(Part(soft, depths, thing))
        found.regions.append(facts)
    return found


def in_its_place(bench: InstantBench, frozen: FrozenGaussians, core: NDArray[np.bool_], nearer: float) -> Tensor:
    """int64 [M]: rows of what the field has `nearer` than so many scene units where a region [h, w] is, and of its
    veil."""
    rows = bench.painters(frozen, grown(core, bench.unit), nearer)
    veils, _ = bench.veils(_less(frozen, rows), core)
    return torch.cat([rows, veils])


def _crumbs(bench: InstantBench, frozen: FrozenGaussians, core: NDArray[np.bool_], depth: float) -> Tensor:
    """int64 [M]: rows of what is left beside a region [h, w] of a thing that stood there, `depth` scene units away, and
    has been taken out: a finger's tip, a sliver of a wrist, which would hang in the air.

    Small pieces that move and are as deep as it. What was whole without it, another hand or a shoulder, is larger.
    """
    c, image = bench.config, bench.render(frozen)
    shown, moves = image.depth.numpy(), image.motion.numpy() > 0.5
    labels = connected(np.log(np.maximum(shown, 1e-6)), c.crumb_steady)
    sizes, moving = np.bincount(labels.ravel()), np.bincount(labels.ravel(), weights=moves.ravel())
    found = np.zeros_like(core)
    for label in np.unique(labels[grown(core, c.crumb_reach * bench.unit)]):
        if sizes[label] <= c.crumb * core.sum() and moving[label] >= 0.5 * sizes[label]:
            piece = labels == label
            if abs(np.log(np.median(shown[piece]) / depth)) < np.log1p(c.depth.deep):
                found |= piece
    return bench.painters(frozen, grown(found, bench.unit), depth * (1.0 + c.depth.deep))


def _less(frozen: FrozenGaussians, rows: Tensor) -> FrozenGaussians:
    """A frozen scene without Gaussians `rows` int64 [M]."""
    return fade(frozen, torch.ones(len(frozen.motion), device="cpu").index_fill(0, rows, 0.0))


def _drawn(
    bench: InstantBench, frozen: FrozenGaussians, before: FrozenImage, found: _Found, layer: InstantLayer
) -> InstantLayer:
    """A layer that adds nothing, with the Gaussians of what was `found` to be missing of a frozen scene; as it is, if
    that does not help beside what t*'s camera saw `before`."""
    if not found.parts:
        return layer
    state, mask = gaussians_of(bench, frozen, found.image, found.parts)
    layer, empty = replace(layer, state=state, mask=from_numpy(mask), regions=found.regions), layer
    # Of what was painted the difference says nothing, it looked right; nor of pixels beside it, which are mixtures.
    told = (mask > 0) & ~grown(found.painted, 2.0 * bench.unit)
    if told.any() and not _helps(bench, bench.render(join(frozen, layer, faded=True)), before, told):
        return empty
    return layer


def _fields_inverse(bench: InstantBench, frozen: FrozenGaussians) -> NDArray[np.float32]:
    """Inverse depth [h, w] of what the field moves before all that stands still, however faint; 0 where nothing."""
    moves = frozen.motion > 0.5
    if not bool(moves.any()):
        return np.zeros((bench.height, bench.width), np.float32)
    movers, still = bench.render(fade(frozen, moves.float())), bench.render(fade(frozen, (~moves).float()))
    c, depth = bench.config.depth, movers.depth.numpy()
    there = (movers.alpha.numpy() > c.field_alpha) & (depth * (1.0 + c.front) < still.depth.numpy())
    return np.where(there, 1.0 / np.maximum(depth, 1e-6), 0.0).astype(np.float32)


def small_things(bench: InstantBench, image: FrozenImage) -> list[Track]:
    """Small things that move at t* and that the render does not show, however little a low-pass leaves of them."""
    c = bench.config
    return tracks(bench.frame, bench.index, image.color.numpy(), c.track, bench.unit)


def _thing_cover(bench: InstantBench, image: FrozenImage, thing: Track) -> NDArray[np.float32]:
    """How much of each pixel [h, w] a small thing covers: how far it is on the way from what is behind to its colour.

    Its colours differ, so what is farther from what is behind than a third of that way is wholly its own inside. A line
    is no part of it: the outline of a leg that the render has a pixel aside is that of the floor, too.
    """
    import cv2

    near = grown(thing.pixels, 1.0)
    covered = np.where(near, np.clip(share_of(bench, image, thing), 0.0, 1.0), 0.0).astype(np.float32)
    return np.asarray(cv2.morphologyEx(covered, cv2.MORPH_OPEN, disc(1.0 * bench.unit)), np.float32)


def _cover(
    bench: InstantBench, image: FrozenImage, region: NDArray[np.bool_], painted: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """How much of each pixel [h, w] around a region is what the model lacks, or has `painted` elsewhere, 0..1.

    The low-passed region has the shape of a blot. Inside, the model stands for what is hidden, so what differs from
    it is in front of it; gaps where it happens to have the same colour are closed.
    """
    import cv2

    c, unit = bench.config, bench.unit
    shown, plate = image.color.numpy(), bench.view.picture
    down, right = np.gradient(low_passed(shown, 0.7 * unit), axis=(0, 1))
    off = np.abs(low_passed(plate - shown, 0.7 * unit)) - 0.5 * c.shift * unit * np.hypot(down, right)
    ramp = np.clip(2.0 * off.max(-1) / c.solid - 1.0, 0.0, 1.0).astype(np.float32)
    near = grown(region, 2.0 * unit)
    ramp = np.where(near, np.maximum(ramp, painted & region), 0.0).astype(np.float32)
    closed = cv2.morphologyEx(ramp, cv2.MORPH_CLOSE, disc(2.5 * unit))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc(1.0 * unit))
    return np.where(near, opened, 0.0).astype(np.float32)


def _ghosts(bench: InstantBench, frozen: FrozenGaussians, image: FrozenImage) -> tuple[Tensor, NDArray[np.bool_]]:
    """(kept [N], mask [h, w]): moving Gaussians that stand before what plate t* shows, judged on that plate.

    A ghost is seen where the render without all that moves is nearer to the plate, by a low-pass, than with it.
    """
    kept = torch.ones(len(frozen.motion), device="cpu")
    nothing = np.zeros((bench.height, bench.width), bool)
    moves = frozen.motion > 0.5
    if not bool(moves.any()):
        return kept, nothing
    without = bench.render(fade(frozen, (~moves).float()))
    before, after = bench.difference(image), bench.difference(without)
    bare = without.alpha.numpy() < 0.9
    ghost = (before >= bench.config.grow) & (after < 0.5 * before) & ~bare
    ghost = large(ghost, before >= bench.config.seed, bench.config.least * bench.unit**2)
    if not ghost.any():
        return kept, nothing
    inside, whole = bench.seen_inside(frozen, ghost)
    share = inside / whole.clamp_min(1e-6)
    guilty = moves.cpu() & (whole > 1e-3) & (share >= bench.config.fade)
    kept[guilty] = 1.0 - share[guilty]
    if not _helps(bench, bench.render(fade(frozen, kept)), image, ghost):
        return torch.ones_like(kept), nothing
    return kept, ghost


def _helps(bench: InstantBench, after: FrozenImage, before: FrozenImage, where: NDArray[np.bool_]) -> bool:
    """True if the difference, low-passed or of single pixels, falls enough where something was done, and does not rise
    around it."""
    c = bench.config
    around = grown(where, 2.0 * c.blur * bench.unit)
    old, new = bench.difference(before), bench.difference(after)
    if new[where].mean() <= (1.0 - c.gain) * old[where].mean() and new[around].mean() <= old[around].mean():
        return True
    fine, finer = bench.single(before), bench.single(after)
    sharper = finer[where].mean() <= (1.0 - c.detail) * fine[where].mean()
    return bool(sharper and finer[around].mean() <= fine[around].mean() and new[where].mean() <= old[where].mean())
