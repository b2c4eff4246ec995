"""What moves, is not seen by plate t*, and is not in the model: an apple on a thread while the camera looks elsewhere.

Of what plate t* does not see the frozen scene has what the model has, as it was when it was last seen, or next. What
the model lost, because it is small or fast, would be missing from the shot, although plates show it all along. So
other plates are asked, the nearest to t* first, and what they show, nobody nearer can tell of, and the run has not even
at that plate's own time, is made of that plate's pixels (`missing_layer.py`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..gaussians.model import SH_C0
from ..scene import Scene, evenly_spaced
from ..torch_types import from_numpy
from ..train import LoadedRun
from .frozen import SUPPORT_SECONDS, FrozenGaussians, FrozenImage
from .instant_bench import InstantBench, InstantConfig, Motion, disc, grown
from .missing_layer import Asked, InstantLayer, in_its_place, join, small_things, taken
from .reproject import look_up, project

_THERE = 0.3
"""Opacity of a layer from which on a thing is there."""
_TURNS = 4
"""So often its colours are put right."""


@dataclass(frozen=True)
class UnseenConfig:
    """Who is asked of what plate t* does not see. Lengths are in pixels of pictures 320 wide."""

    frames: int = 24
    """Trained frames that are asked, at most, evenly over the clip."""
    unseen: float = 0.1
    """Share of a thing's place that plate t* may see, at most: of the rest it tells nothing."""
    cut: float = 0.5
    """The same of other plates nearer to t*: one that sees less, at its border, could not tell whether it is there."""
    before: tuple[float, ...] = (1.0, 0.8, 0.6)
    """A thing may be at these shares of the depth of what is behind it, until its own is told."""
    margin: float = 6.0
    """What is this near to the border of a picture may be cut by it: it is left to others, and it says nothing."""
    least: float = 30.0
    """Square pixels; smaller things are left alone."""
    around: float = 4.0
    """A thing is looked for this far around its matte."""
    off: float = 0.15
    """Difference of single pixels between plate and frozen scene, display-referred, from which on one is of it,"""
    lacking: float = 0.7
    """and share of their mean difference that is there at the plate's own time, too: by less, the run has the thing,
    elsewhere at t*."""
    near: float = 1.5
    """So many times its size around a thing the frozen scene is searched for it,"""
    alike: float = 0.15
    """by its colour, display-referred,"""
    stands: float = 0.3
    """and has it if that covers this share of its area."""
    depth: float = 0.03
    """Share of its depth by which a place may lie behind what a camera sees and still be seen."""


@dataclass
class _Witness:
    """A frame that has had its say."""

    bench: InstantBench
    frozen: FrozenGaussians
    """The scene as it was then."""
    margin: float
    """Pixels along the border in which it says nothing."""
    least: float
    """Share of a thing's place from which on it has its say."""

    @functools.cached_property
    def image(self) -> FrozenImage:
        """The scene as its camera sees it."""
        return self.bench.render(self.frozen)

    def tells(self, points: Tensor, tolerance: float) -> bool:
        """True if enough of world points [M, 3] is in view."""
        return float(self._sees(points, tolerance).float().mean()) > self.least

    def _sees(self, points: Tensor, tolerance: float) -> Tensor:
        bench, i = self.bench, self.bench.index
        pixels, away = project(points, bench.scene.viewmats[i], bench.Ks[i])
        size = torch.tensor([bench.width, bench.height], device="cpu")
        there = (torch.minimum(pixels, size - pixels).amin(dim=-1) > self.margin) & (away > 0.0)
        if not bool(there.any()):
            return there
        return there & (away <= look_up(self.image.depth, pixels, "nearest") * (1.0 + tolerance))


@torch.no_grad()
def with_unseen(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: int,
    motion: Motion,
    config: UnseenConfig | None = None,
    check: Callable[[], None] | None = None,
) -> FrozenGaussians:
    """A scene frozen at frame `t_star`, with what plate t* does not see and the run does not have behind it in order.

    What is added has the support of the time at which it was seen, below 1. `check` is called before each plate, and
    raises to cancel.
    """
    config = config or UnseenConfig()
    index = scene.frames.index(t_star)
    own = InstantBench(run, scene, index, InstantConfig(), motion)
    witnesses = [_Witness(own, frozen, 0.0, config.unseen)]
    asked = [run.train_frames[n] for n in evenly_spaced(len(run.train_frames), config.frames)]
    away = {frame: abs(float(scene.seconds[scene.frames.index(frame)] - scene.seconds[index])) for frame in asked}
    for frame in sorted(asked, key=lambda frame: away[frame]):
        if check is not None:
            check()
        if frame == t_star:
            continue
        bench = InstantBench(run, scene, scene.frames.index(frame), InstantConfig(), motion)
        witness = _Witness(bench, frozen, config.margin * bench.unit, config.cut)
        for layer in _missing(witness, witnesses, config):
            before = len(frozen.support)
            others = torch.ones(before - len(layer.kept), device="cpu")  # of the same plate, which stay
            frozen = join(frozen, replace(layer, kept=torch.cat([layer.kept, others])))
            support = frozen.support.clone()
            support[before:] = math.exp(-away[frame] / SUPPORT_SECONDS)
            frozen = replace(frozen, support=support)
        witnesses.append(witness)
    return frozen


def _missing(own: _Witness, nearer: list[_Witness], config: UnseenConfig) -> Iterator[InstantLayer]:
    """What a plate shows of what the frozen scene lacks, where none of those `nearer` to t* sees anything."""
    bench, frozen, matte = own.bench, own.frozen, own.bench.matte()
    things = [] if matte is None else _whole(matte > 0.5, config, bench.unit)
    if not things:
        return
    image, grid = own.image, bench.view.grid()
    depth = image.depth.double().numpy()
    ways = [bench.view.unproject(grid[..., 0], grid[..., 1], share * depth) for share in config.before]
    points = [from_numpy(way).float() for way in ways]
    places = [
        where
        for where in things
        if any(not any(w.tells(way[from_numpy(where)], config.depth) for w in nearer) for way in points)
    ]
    off = bench.single(image)
    lacking = [where & (off >= config.off) for where in places]
    lacking = [where for where in lacking if where.sum() >= config.least * bench.unit**2]
    if not lacking:
        return
    then = bench.single(bench.at_its_time(bench.index))
    lacking = [where for where in lacking if then[where].mean() >= config.lacking * off[where].mean()]
    lacking = [where for where in lacking if not _stands_elsewhere(bench, image, where, config)]
    small = small_things(bench, image) if lacking else []
    for where in lacking:
        empty = InstantLayer.empty(
            frozen, bench.scene.frames[bench.index], np.zeros_like(where), torch.ones(len(frozen.motion), device="cpu")
        )
        only = grown(where, config.around * bench.unit)
        _, layer, _ = taken(Asked(bench, frozen, image, small, None, empty, only), None)
        means = layer.state["means"].cpu()
        if layer.stands_for(where) and not any(witness.tells(means, config.depth) for witness in nearer):
            yield _as_plate(bench, frozen, _instead(bench, frozen, _solid(bench, layer)))


def _instead(bench: InstantBench, frozen: FrozenGaussians, layer: InstantLayer) -> InstantLayer:
    """A layer in the place of the pale trace that the run has of it: before it, that would be a veil."""
    there, away = layer.mask.numpy() > _THERE, bench.scene.viewmats[bench.index]
    depth = float((layer.state["means"].cpu() @ away[2, :3] + away[2, 3]).median())
    return replace(layer, kept=layer.kept.index_fill(0, in_its_place(bench, frozen, there, depth), 0.0))


def _as_plate(bench: InstantBench, frozen: FrozenGaussians, layer: InstantLayer) -> InstantLayer:
    """A layer that looks as the plate does through what the run has before it: a plain wall is a thin fog to it."""
    fine = bench.as_plate()
    pixels, _ = project(layer.state["means"].cpu(), bench.scene.viewmats[bench.index], fine.Ks[bench.index])
    plate = from_numpy(fine.view.picture)
    most = max(1.0, float(plate.max()))
    for _ in range(_TURNS):
        shown = fine.render(join(frozen, layer)).color
        lacks = look_up(plate - shown, pixels, "nearest")[:, None].to(layer.state["sh0"])
        color = (0.5 + SH_C0 * layer.state["sh0"] + lacks).clamp(0.0, most)
        layer = replace(layer, state={**layer.state, "sh0": (color - 0.5) / SH_C0})
    return layer


def _solid(bench: InstantBench, layer: InstantLayer) -> InstantLayer:
    """A layer whose inside lets nothing through: nothing develops it, and what is in shadow on it seemed half there."""
    import cv2

    there = (layer.mask.numpy() > _THERE).astype(np.float32)
    within = np.asarray(cv2.erode(there, disc(bench.unit)), np.float32)
    pixels, _ = project(layer.state["means"].cpu(), bench.scene.viewmats[bench.index], bench.Ks[bench.index])
    inner = (look_up(from_numpy(within), pixels, "nearest") > 0.5).to(layer.state["means"].device)
    solid = math.log(bench.config.opacity / (1.0 - bench.config.opacity))
    logits = layer.state["opacity_logits"].masked_fill(inner, solid)
    return replace(layer, state={**layer.state, "opacity_logits": logits})


def _whole(moving: NDArray[np.bool_], config: UnseenConfig, unit: float) -> list[NDArray[np.bool_]]:
    """The connected parts of what moves [h, w] that are wholly in the picture, and large enough."""
    import cv2

    count, labels, about, _ = cv2.connectedComponentsWithStats(moving.astype(np.uint8), connectivity=8)
    (h, w), margin = moving.shape, config.margin * unit
    found: list[NDArray[np.bool_]] = []
    for label in range(1, count):
        left, top, width, height, area = (int(value) for value in about[label])
        cut = min(left, top, w - left - width, h - top - height) < margin
        if not cut and area >= config.least * unit**2:
            found.append(labels == label)
    return found


def _stands_elsewhere(bench: InstantBench, image: FrozenImage, where: NDArray[np.bool_], config: UnseenConfig) -> bool:
    """True if the frozen scene has a thing of the same colour that moves, near where the plate has it."""
    color, area = np.median(bench.view.picture[where], axis=0), float(where.sum())
    same = np.abs(image.color.numpy() - color).max(axis=-1) < config.alike
    found = grown(where, config.near * math.sqrt(area)) & (image.motion.numpy() > 0.5) & same
    return bool(found.sum() >= config.stands * area)
