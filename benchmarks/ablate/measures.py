"""Figures of one variant at one instant, against truth or on a clip."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from torch import Tensor

from benchmarks.ablate.cases import Case
from benchmarks.ablate.instants import Instant
from benchmarks.ablate.switches import RULES, detail_config, replaced, rules_disabled
from benchmarks.detail_clip import DetailClip, View, over
from benchmarks.detail_figures import Flow, textured, unexplained_flow, unsteadiness
from benchmarks.detail_flow import LEAST, Pair, Shown, lay_over
from benchmarks.report.metrics import known_mean, psnr_by_region, psnr_of
from benchmarks.report.things import recall_of
from benchmarks.report.truth import TruthScene
from torch_backend.freeze.composite.compositor import CompositeFrame, Compositor
from torch_backend.freeze.frozen import FrozenImage, OutputFrame

DECISIONS = (("composite.compositor", "primary_matte"),)
"""Functions that choose the plate of each pixel; their CPU seconds are the cost of the decision."""
Row = dict[str, Any]


class FrameMaker:
    """Frozen frames of one instant, with frame rules off. Plates are examined once for all variants."""

    def __init__(self, clip: DetailClip, t_star: int, instant: Instant) -> None:
        self.clip, self.t_star, self.instant = clip, t_star, instant
        self._compositor: tuple[Any, Compositor] | None = None
        self._images: dict[int, FrozenImage] = {}

    def image(self, frame: int) -> FrozenImage:
        """The render of the Gaussians, without plate detail."""
        if frame not in self._images:
            self._images[frame] = self.clip.splats(frame, self.t_star, self.instant.frozen)
            self.make(frame, frozenset())  # computes the results cached per plate, so that no variant pays for them
        return self._images[frame]

    def _maker(self, disabled: frozenset[str]) -> Compositor:
        """A compositor with rules `disabled`. The cache of plates is kept until a rule that affects it changes."""
        config = detail_config(disabled)
        views = {name for name in disabled if any(each.module.startswith("views.") for each in RULES[name].switches)}
        key = config.source_views, views
        if self._compositor is None or self._compositor[0] != key:
            self._compositor = key, Compositor(self.clip.run, self.clip.scene, self.clip.plates, config)
        self._compositor[1].config = config
        return self._compositor[1]

    def make(self, frame: int, disabled: frozenset[str]) -> tuple[CompositeFrame, float, float]:
        """(frame with rules `disabled`, CPU seconds of its decisions, CPU seconds without the Gaussians' render)."""
        clip, image = self.clip, self.image(frame)
        output = OutputFrame(frame, *clip.camera(frame), float(self.t_star), float(frame))
        spent, compositor = [0.0], self._maker(disabled)
        with rules_disabled(disabled), timed(spent):
            since = time.process_time()
            composite = compositor.frame(output, self.instant.frozen, image, clip.width, clip.height)
            return composite, spent[0], time.process_time() - since


@contextmanager
def timed(spent: list[float]) -> Iterator[None]:
    """Context that adds CPU seconds of `DECISIONS` to `spent[0]`."""

    def clock(step: Callable[..., Any]) -> Callable[..., Any]:
        def timed_step(*args: Any) -> Any:
            since = time.process_time()
            try:
                return step(*args)
            finally:
                spent[0] += time.process_time() - since

        return timed_step

    with ExitStack() as stack:
        for module, name in DECISIONS:
            stack.enter_context(replaced(module, name, clock))
        yield


def shown(composite: CompositeFrame) -> Tensor:
    """[H, W, 3] a delivered frame over grey, in 0..1."""
    return over(composite.color, composite.alpha)


def judge(
    case: Case, maker: FrameMaker, variants: Mapping[str, frozenset[str]], poses: Sequence[int],
    pairs: Sequence[tuple[int, int]],
) -> dict[str, Row]:  # fmt: skip
    """{variant: figures} with frame rules off, at `poses` of a scene with truth or at `pairs` of a clip."""
    if case.truth is not None:
        return _judge_truth(case.truth, maker, variants, poses)
    return _judge_clip(maker, variants, pairs)


def poses_of(truth: TruthScene, t_star: int, every: int) -> list[int]:
    """Frame numbers of every `every`-th pose with truth, without t* itself, whose plate is the truth."""
    return [pose for pose in truth.poses(t_star, []) if pose != t_star][every // 2 :: every]


# ------------------------------------------------------------------------------------------------- against truth


def _judge_truth(
    truth: TruthScene, maker: FrameMaker, variants: Mapping[str, frozenset[str]], poses: Sequence[int]
) -> dict[str, Row]:
    rows: dict[str, list[Row]] = {name: [] for name in variants}
    t_star, size = maker.t_star, (maker.clip.width, maker.clip.height)
    for pose in poses:
        target, regions = truth.truth(t_star, pose, *size), truth.regions(t_star, pose, *size)
        behind, image = truth.behind(t_star, pose, *size), maker.image(pose)
        developed = psnr_by_region(over(image.color, image.alpha), target, regions)
        for name, disabled in variants.items():
            composite, decided, took = maker.make(pose, disabled)
            picture = shown(composite)
            row: Row = {"pose": pose, "developed": developed, "delivered": psnr_by_region(picture, target, regions)}
            row["recalled"] = recall_of(behind, picture, target, regions)
            rows[name].append(row | {"decision_s": decided, "frame_s": took, "own": float(composite.matte.mean())})
    return {name: {"frames": found} for name, found in rows.items()}


# ------------------------------------------------------------------------------------------------------- on a clip


def _judge_clip(
    maker: FrameMaker, variants: Mapping[str, frozenset[str]], pairs: Sequence[tuple[int, int]]
) -> dict[str, Row]:
    flow = Flow()
    rows: dict[str, list[Row]] = {name: [] for name in variants}
    for first, second in pairs:
        laid: tuple[Pair, Tensor] | None = None
        for name, disabled in variants.items():
            a, b = (maker.make(frame, disabled) for frame in (first, second))
            if laid is None:  # frame rules change neither depth nor the correspondence that follows from it
                laid = _laid(maker, (first, second), (a[0], b[0]))
            pair, still = laid
            row = judge_pair(flow, pair, still, shown(a[0]), shown(b[0]), maker.clip.plate(first))
            row |= {"frame": first, "own": float(a[0].matte.mean())}
            rows[name].append(row | {"decision_s": 0.5 * (a[1] + b[1]), "frame_s": 0.5 * (a[2] + b[2])})
    return {name: {"frames": found} for name, found in rows.items()}


def _laid(
    maker: FrameMaker, frames: tuple[int, int], composites: tuple[CompositeFrame, CompositeFrame]
) -> tuple[Pair, Tensor]:
    """(correspondence of two neighbouring frames, bool [H, W] still pixels of the first)."""
    clip, t_star, both = maker.clip, maker.t_star, list[Shown]()
    still: Tensor | None = None
    for frame, detailed in zip(frames, composites, strict=True):
        image, picture = maker.image(frame), shown(detailed)
        view = View(image, detailed, picture, picture)
        matte, matte_t_star = clip.mattes(frame, t_star, view)
        still = clip.still(frame, t_star, view) if still is None else still
        both.append(Shown(frame, {"delivered": detailed.depth}, {"delivered": picture}, matte, matte_t_star))
    assert still is not None
    return lay_over(clip, both[0], both[1], "delivered"), still


def judge_pair(flow: Flow, pair: Pair, still: Tensor, one: Tensor, two: Tensor, plate: Tensor) -> Row:
    """Figures of two neighbouring frozen frames: error of still pixels, residual flow in pixels, flicker of 255."""
    error = (one - plate).double().square().mean(-1)[still]
    left, judged = unexplained_flow(flow, one, two, pair.places, pair.both), textured(one)
    in_region = pair.moving | pair.still
    row: Row = {"still_mse": float(error.mean()) if len(error) else None}
    row["flicker"] = (
        255.0 * float(unsteadiness(one, two, pair.places)[in_region].mean()) if bool(in_region.any()) else None
    )
    for region, mask in (("moving", pair.moving), ("still", pair.still)):
        values = left[mask & judged]
        enough = len(values) >= LEAST
        for percent in (50, 99):
            row[f"{region}_p{percent}"] = float(values.quantile(percent / 100.0)) if enough else None
    return row


# ------------------------------------------------------------------------------------------------------- summaries


def summary(row: Row) -> dict[str, float | None]:
    """{figure: mean over the frames of one variant at one instant}; None for a figure that no frame has."""
    frames, found = row["frames"], dict[str, float | None]()
    for what in ("delivered", "developed"):
        for region in ("whole", "never_seen", "moving", "static"):
            found[f"{what} {region}"] = known_mean(f[what].get(region) for f in frames if what in f)
    counts = [count for f in frames for count in f.get("recalled", {}).values()]
    should = sum(count[1] for count in counts)
    found["recall"] = sum(count[0] for count in counts) / should if should else None
    error = known_mean(f.get("still_mse") for f in frames)
    found["still"] = None if error is None else psnr_of(error)
    for name in ("flicker", "moving_p50", "moving_p99", "still_p50", "still_p99", "decision_s", "frame_s", "own"):
        found[name] = known_mean(f.get(name) for f in frames)
    moving, rest = found["moving_p99"], found["still_p99"]
    found["excess"] = None if moving is None or rest is None else moving - rest
    return found
