"""Only what a scene needs: what a run of `auto` decides while it trains, from what, and what it says in the end.

A few trained frames are kept back as probes, and every decision reads the PSNR on them: the frames that are reported
on (`TrainConfig.holdout`) decide nothing. Late in the run the probes are trained on like all others. Decisions depend
on nothing but the run's numbers, and their state is in the checkpoint: a resumed run decides the same.

- SH degree: a raise is kept if the model beats itself cut to the degree below. When that is asked, harmonics have
  learnt for a while only; what they gained is scaled by how far their learning rate still lets them go (`lasting`).
- Growth: PSNR rises by optimisation alone too, and a run cannot be had twice. So growth ends on a bound: when all that
  the probes gained while the Gaussians grew, optimisation included, falls below a threshold per 10 % more of them,
  what growth gained is below it as well. It errs on the side of growing.
- End: when the probes gain nothing more. By then they are trained on, so what they gain is at least what a frame kept
  back would gain: this too errs on the side of going on.
- Time nodes: from how long what the static model gets wrong stays the same (`correlation_frames`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..gaussians import Gaussians, sh_bases
from ..scene import resize_intrinsics
from .model import render

if TYPE_CHECKING:
    from .trainer import Trainer

_LEAST_PROBES, _MOST_PROBES = 3, 12
_GROWN = 1.2
"""Growth is judged over measurements between which the Gaussians grew by this factor, at least `_POINTS` of them."""
_POINTS = 4
_LOOKED_AT = 48
"""Most frames whose residual is looked at for the time nodes."""


@dataclass
class NeedsConfig:
    """What is enough. Gains are dB of mean PSNR on the probe frames, shares are of the run's length."""

    probes: int = 12
    """Every how many trained frames one is a probe, 3 to 12 in all; 0: none, all is spent."""
    least: int = 48
    """A clip of fewer trained frames keeps none back: it can spare none (3 of 42 cost 0.1 dB)."""
    join: float = 0.6
    """Share of the run at which the probe frames are trained on too; until then they decide."""
    every: float = 0.025
    """Share of the run between two measurements, rounded to rounds of densification."""
    sh_gain: float = 0.015
    """Least gain of a higher SH degree by the end of the run, over the model cut to the degree below: measured when
    the next raise is due, and scaled."""
    growth_gain: float = 0.03
    """Least gain per 10 % more Gaussians, what optimisation gained meanwhile included, for growth to go on."""
    stop_gain: float = 0.05
    """Least gain over `stop_window`, after the gate has hardened, for the run to go on."""
    stop_window: float = 0.15
    """Share of the run over which that gain is looked for."""
    anneal: float = 0.1
    """Share of the run over which a run that has enough brings its learning rates to their end."""


def probe_frames(frames: int, every: int, least: int = 24) -> list[int]:
    """Positions among `frames` trained frames of those kept back, evenly spread, never an end; [] for short clips."""
    if every <= 0 or frames < least:
        return []
    count = min(max(frames // every, _LEAST_PROBES), _MOST_PROBES)
    return [int((n + 0.5) * frames / count) for n in range(count)]


def growth_gain(measured: list[tuple[int, int, float]]) -> float | None:
    """dB per 10 % more Gaussians: slope of PSNR over log count. None if they grew too little to tell.

    Over the newest of the measurements (iteration, Gaussians, PSNR) that span a growth by `_GROWN`.
    """
    for first in range(len(measured) - _POINTS, -1, -1):
        _, counts, values = zip(*measured[first:], strict=True)
        if counts[-1] >= _GROWN * counts[0]:
            slope = np.polyfit(np.log(counts), values, 1)[0]
            return float(slope) * math.log(1.1)
    return None


def newest_gain(measured: list[tuple[int, int, float]], since: int) -> float | None:
    """dB by which the best PSNR after iteration `since` exceeds the best until then. None without both."""
    before = [value for iteration, _, value in measured if iteration <= since]
    after = [value for iteration, _, value in measured if iteration > since]
    return max(after) - max(before) if before and after else None


def lasting(since: float, now: float) -> float:
    """How far harmonics that learn since a share of the run will go by its end, over how far they came until `now`.

    Adam moves a parameter by about a rate per step, and the rate falls tenfold over the run.
    """
    return (0.1**since - 0.1) / max(1e-6, 0.1**since - 0.1**now)


class Needs:
    """Probe frames and decisions of one run. `frames`: how many it trains on; 0: it decides nothing."""

    def __init__(self, config: NeedsConfig, frames: int) -> None:
        self.config = config
        self.probes = probe_frames(frames, config.probes, config.least)
        self.joined = not self.probes
        self.measured: list[tuple[int, int, float]] = []
        self.degrees: dict[int, float] = {}
        self.sh_limit: int | None = None
        self.growth_ended: int | None = None
        self.stopped: int | None = None
        self.facts: dict[str, Any] = {}

    def state(self) -> dict[str, Any]:
        """JSON-able, for a checkpoint."""
        return {
            "joined": self.joined, "measured": self.measured, "degrees": list(self.degrees.items()),
            "sh_limit": self.sh_limit, "growth_ended": self.growth_ended, "stopped": self.stopped, "facts": self.facts,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of `state`."""
        self.joined, self.sh_limit = state["joined"], state["sh_limit"]
        self.measured = [(int(i), int(n), float(v)) for i, n, v in state["measured"]]
        self.degrees = {int(degree): float(gain) for degree, gain in state["degrees"]}
        self.growth_ended, self.stopped, self.facts = state["growth_ended"], state["stopped"], state["facts"]

    # ------------------------------------------------------------------ what the trainer asks

    @property
    def held(self) -> set[int]:
        """Positions of the trained frames that are kept back now."""
        return set() if self.joined else set(self.probes)

    def sh_degree(self, wanted: int) -> int:
        """The scheduled SH degree `wanted`, or the one that proved enough."""
        return wanted if self.sh_limit is None else min(wanted, self.sh_limit)

    @property
    def growing(self) -> bool:
        """May the Gaussians still become more?"""
        return self.growth_ended is None

    def end(self, iterations: int) -> int:
        """Iterations after which the run is over."""
        return iterations if self.stopped is None else min(iterations, self.stopped + self._anneal(iterations))

    def rate_progress(self, iteration: int, iterations: int) -> float:
        """The progress at which learning rates are looked up: a run that has enough hastens to its end."""
        if self.stopped is None:
            return iteration / iterations
        at = self.stopped / iterations
        return at + (1.0 - at) * min(1.0, (iteration - self.stopped) / self._anneal(iterations))

    def _anneal(self, iterations: int) -> int:
        return max(1, round(self.config.anneal * iterations))

    # ------------------------------------------------------------------ decisions

    def decide(self, trainer: Trainer) -> None:
        """Called between steps. A decision interrupted by a cancel is taken again when the run goes on."""
        if not self.probes:
            return
        c = trainer.config
        grid = c.densify.every * max(1, round(self.config.every * c.iterations / c.densify.every))
        # Before a round of densification, when the splits of the last one have settled.
        due = trainer.iteration > 0 and trainer.iteration % grid == 0
        if due and self.stopped is None and (not self.measured or self.measured[-1][0] < trainer.iteration):
            self._measure(trainer)
        if not self.joined:
            self._judge_degree(trainer)
            if trainer.progress >= self.config.join:
                self._join(trainer)

    def _measure(self, trainer: Trainer) -> None:
        value = self._psnr(trainer)
        if value is None:
            return
        self.measured.append((trainer.iteration, len(trainer.model.gaussians), value))
        # While a field is on trial probes fall and rise by it: one measured 3 steps after it had opened ended growth.
        on_trial = "opened" in self.facts and "hardened" not in self.facts
        if not self.joined and self.growing and not on_trial:
            gain = growth_gain(self.measured)
            self.facts["growth_gain_db"] = gain
            if gain is not None and gain < self.config.growth_gain:
                self.growth_ended = trainer.iteration
        c = trainer.config
        hardened = self.facts.get("hardened", c.gate.give_up * c.iterations) / c.iterations
        over = trainer.progress > max(hardened, c.densify.stop if self.growing else 0.0)
        gain = newest_gain(self.measured, trainer.iteration - round(self.config.stop_window * c.iterations))
        early = trainer.iteration + self._anneal(c.iterations) < c.iterations
        if over and early and gain is not None and gain < self.config.stop_gain:
            self.stopped = trainer.iteration

    def _judge_degree(self, trainer: Trainer) -> None:
        c, degree = trainer.config, trainer.model.sh_degree
        if degree == 0 or degree in self.degrees or self.sh_limit is not None or c.sh_every <= 0:
            return
        if int(trainer.progress / c.sh_every) <= degree and trainer.progress < self.config.join:
            return
        whole, cut = self._psnr(trainer), self._psnr(trainer, sh_degree=degree - 1)
        if whole is None or cut is None:
            return
        self.degrees[degree] = whole - cut
        lasts = lasting(degree * c.sh_every, trainer.progress)
        if (whole - cut) * lasts <= self.config.sh_gain:
            self.sh_limit = trainer.model.sh_degree = degree - 1
            limit_harmonics(trainer.model.gaussians, trainer.optimizer, degree - 1)

    def judge_cameras(self, trainer: Trainer, refined: Tensor) -> None:
        """What refined cameras [F, 4, 4] are worth, as they are about to replace those of the trainer."""
        if self.joined or "poses_gain_db" in self.facts:
            return
        before, without = trainer.viewmats, self._psnr(trainer)
        try:
            trainer.viewmats = refined
            value = self._psnr(trainer)
        finally:
            trainer.viewmats = before
        self.facts["poses_gain_db"] = None if value is None or without is None else value - without

    def _join(self, trainer: Trainer) -> None:
        """The last look at frames that were not trained on: what exposure and motion are worth; then they join."""
        whole = self._psnr(trainer)
        for name, without in (("exposure", self._without_exposure), ("field", self._without_field)):
            value = without(trainer)
            self.facts[f"{name}_gain_db"] = None if whole is None or value is None else whole - value
        self.facts["probe_psnr_db"] = whole
        self.joined = True

    def _without_exposure(self, trainer: Trainer) -> float | None:
        if not trainer.config.exposure.on:
            return None
        values = trainer.model.exposure.values
        kept = values.data
        try:
            values.data = torch.zeros_like(kept)
            return self._psnr(trainer)
        finally:
            values.data = kept

    def _without_field(self, trainer: Trainer) -> float | None:
        field = trainer.model.field
        if field is None:
            return None
        try:
            trainer.model.field = None
            return self._psnr(trainer)
        finally:
            trainer.model.field = field

    def _psnr(self, trainer: Trainer, sh_degree: int | None = None) -> float | None:
        """Mean PSNR in dB on the probe frames; None if it is not a number."""
        degree = trainer.model.sh_degree
        try:
            trainer.model.sh_degree = degree if sh_degree is None else sh_degree
            value = trainer.heldout_psnr([trainer.train_ids[n] for n in self.probes], trainer.images[self.probes])
        finally:
            trainer.model.sh_degree = degree
        return value if value is not None and math.isfinite(value) else None

    def time_nodes(self, trainer: Trainer) -> int:
        """How many nodes the time axis of a field needs for what the open Gaussians do; 0: nothing is decided."""
        frames = len(trainer.train_ids)
        most = max(4, round(frames / 2))
        if not self.probes or most == 4:
            return 0
        residual, weight = signed_residual(trainer, torch.nonzero(trainer.model.gaussians.open).flatten())
        likely = likely_movers(residual, weight)
        same = correlation_frames(residual[:, likely], weight[:, likely])
        self.facts["correlation_frames"] = same
        nodes = most if same is None else min(max(round((frames - 1) / same) + 1, 4), most)
        self.facts["time_nodes"] = nodes
        return nodes


def limit_harmonics(model: Gaussians, optimizer: torch.optim.Optimizer, degree: int) -> None:
    """Drops the harmonics above `degree` from shN, with their moments."""
    old, bases = model.params["shN"], sh_bases(degree) - 1
    new = nn.Parameter(old.detach()[:, :bases].contiguous())
    state = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {k: v[:, :bases].contiguous() if v.shape == old.shape else v for k, v in state.items()}
    for group in optimizer.param_groups:
        group["params"] = [new if p is old else p for p in group["params"]]
    model.params["shN"] = new


# ---------------------------------------------------------------------- how fast things move


def signed_residual(trainer: Trainer, rows: Tensor) -> tuple[Tensor, Tensor]:
    """What the static model lacks at the Gaussians `rows` [M], frame by frame, at half the size.

    Returns (residual [I, M], weight [I, M]): mean of image - render over the pixels that a Gaussian paints, by
    alpha * T, grey, and the sum of those weights; 0 for frames that were not looked at.
    """
    out_of_use = trainer.unusable | trainer.needs.held
    frames = [n for n in range(len(trainer.train_ids)) if n not in out_of_use]
    if len(frames) > _LOOKED_AT:  # two stretches of neighbours: sparse frames would not show what is fast
        half = _LOOKED_AT // 2
        first, second = len(frames) // 4, 3 * len(frames) // 4
        frames = frames[first - half // 2 :][:half] + frames[second - half // 2 :][:half]
    model, (height, width) = trainer.model, (trainer.height // 2, trainer.width // 2)
    state = {name: p.detach() for name, p in model.gaussians.params.items()}
    residual = torch.zeros(len(trainer.train_ids), len(rows), device=model.device)
    weight = torch.zeros_like(residual)
    background = torch.cat([trainer.background, trainer.background.new_zeros(1)])
    for n in frames:
        index = trainer.train_ids[n]
        K = resize_intrinsics(trainer.Ks[index].cpu(), trainer.width, trainer.height, width, height)
        ink = torch.zeros(len(model.gaussians), 1, device=model.device, requires_grad=True)
        out = render(
            state, model.sh_degree, trainer.viewmats[index], K.to(model.device), width, height, colors=ink,
            background=background, with_depth=False, with_contributions=True,
        )  # fmt: skip
        image = trainer.images[n].to(model.device, torch.float32).permute(2, 0, 1)
        image = F.interpolate(image[None], (height, width), mode="area")[0].permute(1, 2, 0)
        lack = (image - model.exposure.apply(out.colors[0, ..., :3].detach(), trainer.times[n])).mean(-1).detach()
        if out.weight_sum is None:
            raise RuntimeError("the frame was rendered without contributions")
        (pulled,) = torch.autograd.grad(out.colors[0, ..., 3], ink, lack)
        weight[n] = out.weight_sum[0][rows]
        residual[n] = pulled[rows, 0] / weight[n].clamp_min(1e-6)
    return residual, weight


def likely_movers(residual: Tensor, weight: Tensor) -> Tensor:
    """Indices of the tenth of M Gaussians whose residual [I, M] is most alike two frames apart (least 64 of them).

    Noise is not alike, and what a static model merely fits badly is the same in all frames.
    """
    seen = (weight > 0.5).float()
    value = (residual - (residual * seen).sum(0) / seen.sum(0).clamp_min(1.0)) * seen
    pairs = (seen[2:] * seen[:-2]).sum(0)
    alike = torch.where(pairs >= 4, (value[2:] * value[:-2]).sum(0) / pairs.clamp_min(1.0), -torch.inf)
    return alike.topk(min(len(alike), max(64, len(alike) // 10))).indices


def correlation_frames(residual: Tensor, weight: Tensor) -> float | None:
    """How many frames it takes until half of a residual's agreement with itself one frame before is gone.

    Of residual [I, M] of M Gaussians over I frames, where weight [I, M] > 0.5, pooled. For a swing of period P it is
    near P / 6: linear interpolation between nodes that far apart misses 14 % of the swing at most. None where frames
    next to each other have nothing in common: no node would be too many. At most I / 2.
    """
    seen = (weight > 0.5).double()
    mean = (residual.double() * seen).sum(0) / seen.sum(0).clamp_min(1.0)
    value = (residual.double() - mean) * seen

    def agreement(lag: int) -> float | None:
        here, there = slice(lag, None), slice(None, len(value) - lag)
        pairs = float((seen[here] * seen[there]).sum())
        return float((value[here] * value[there]).sum()) / pairs if pairs else None

    alone, next_one = agreement(0), agreement(1)
    if not alone or next_one is None or next_one < 0.1 * alone:
        return None
    before = next_one
    for lag in range(2, max(3, len(value) // 2 + 1)):
        here = agreement(lag)
        if here is None:
            return float(lag - 1)
        if here < 0.5 * next_one:
            return lag - 1 + (before - 0.5 * next_one) / (before - here)
        before = here
    return len(value) / 2


# ---------------------------------------------------------------------- what the run says in the end


def modelled(trainer: Trainer) -> list[dict[str, Any]]:
    """Rows of the end-of-run table: what was modelled, what it cost, what it bought.

    seconds of training, ms_per_step, bytes of parameters, gain_db on the probe frames: None where it was not measured.
    """
    model, c, needs, facts = trainer.model, trainer.config, trainer.needs, trainer.needs.facts
    count = len(model.gaussians)
    opened = facts.get("opened")
    steps, seconds = trainer.iteration, trainer.trained_seconds
    if opened:
        steps, seconds = opened["iteration"], opened["seconds"]
    plain = sum(p[:1].numel() for name, p in model.gaussians.params.items() if name != "shN")
    rows = [
        _row("static world", f"{count} Gaussians; {steps} steps", seconds, steps, 4 * plain * count),
        _row("growth", _growth(trainer), size=4 * (plain + model.gaussians.params["shN"][:1].numel())
             * (count - trainer.initial)),
    ]  # fmt: skip
    for degree in range(1, c.sh_degree + 1):
        gain = needs.degrees.get(degree)
        kept = degree <= model.sh_degree
        detail = "kept" if kept else "dropped" if gain is not None else "not tried"
        size = 4 * count * 3 * (2 * degree + 1) if kept else 0
        rows.append(_row(f"SH degree {degree}", detail, size=size, gain=gain))
    if c.exposure.on:
        values = model.exposure.values
        detail = f"{len(values)} times"
        rows.append(_row("exposure", detail, size=4 * values.numel(), gain=facts.get("exposure_gain_db")))
    if c.poses.on:
        values = trainer.poses.values
        turn = float(values.detach()[:, :3].norm(dim=1).mean()) * float(trainer.Ks[0, 0, 0])
        detail = f"{len(values)} cameras, turned by {turn:.2f} px on average"
        rows.append(_row("poses", detail, size=4 * values.numel(), gain=facts.get("poses_gain_db")))
    if model.field is not None:
        rows.append(_moving(trainer, trainer.iteration - steps, trainer.trained_seconds - seconds))
        if c.supervision.preset != "none":
            rows.append(_row("anchors", c.supervision.preset))
    if needs.stopped is not None:
        end = needs.end(c.iterations)
        rows.append(_row("end", f"stopped at step {end} of {c.iterations}: nothing more was gained"))
    rows += [_row("extension", f"{e.steps} steps from step {e.from_iteration} on") for e in trainer.extensions]
    return rows


def _row(
    what: str, detail: str, seconds: float | None = None, steps: int = 0, size: int | None = None,
    gain: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    return {
        "what": what,
        "detail": detail,
        "seconds": None if seconds is None else round(seconds, 2),
        "ms_per_step": None if seconds is None or not steps else round(1000.0 * seconds / steps, 2),
        "bytes": size,
        "gain_db": None if gain is None else round(gain, 3),
    }


def _growth(trainer: Trainer) -> str:
    needs, count = trainer.needs, len(trainer.model.gaussians)
    text = f"{trainer.initial} to {count} Gaussians"
    if needs.growth_ended is not None:
        text += f", ended at step {needs.growth_ended}"
    gain = needs.facts.get("growth_gain_db")
    return text if gain is None else f"{text}; at most {gain:.2f} dB per 10 % more"


def _moving(trainer: Trainer, steps: int, seconds: float) -> dict[str, Any]:
    model, gain = trainer.model, trainer.needs.facts.get("field_gain_db")
    field = model.field
    if field is None:
        raise RuntimeError("nothing moves")
    size = 4 * sum(p.numel() for p in field.parameters())
    moving = len(model.open_rows())
    detail = f"{moving} Gaussians ({100.0 * moving / max(1, len(model.gaussians)):.1f} %), {trainer.config.host}"
    nodes = trainer.needs.facts.get("time_nodes")
    if nodes:
        detail += f", {nodes} time nodes"
    return _row("moving Gaussians", f"{detail}; {steps} steps", seconds, steps, size, gain)
