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
- Time nodes: from how long what the static model gets wrong stays the same (`residual.correlation_frames`).

The policy sees a run through `Probe` and changes nothing of it: the trainer carries out what `decide` yields, and reads
the rest, which stands until the run is over, from the policy's properties.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor

_LEAST_PROBES, _MOST_PROBES = 3, 12
_GROWN = 1.5
"""Growth is judged over measurements between which the Gaussians grew by this factor, at least `_POINTS` of them."""
_POINTS = 4
_SPAN = 0.1
"""These measurements span this share of the run. In a long one the schedule doubles the Gaussians in three rounds, and
judged on those that are as many steps old growth ended at 42,000 of 160,000."""


@dataclass
class StoppingConfig:
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
    """Least gain over `stop_window`, after the gate has hardened and of whole pictures, for the run to go on."""
    stop_window: float = 0.15
    """Share of the run over which that gain is searched for."""
    anneal: float = 0.1
    """Share of the run over which a run that has enough brings its learning rates to their end."""


def probe_frames(frames: int, every: int, least: int = 24) -> list[int]:
    """Positions among `frames` trained frames of those kept back, evenly spread, never an end; [] for short clips."""
    if every <= 0 or frames < least:
        return []
    count = min(max(frames // every, _LEAST_PROBES), _MOST_PROBES)
    return [int((n + 0.5) * frames / count) for n in range(count)]


def growth_gain(measured: list[tuple[int, int, float]], steps: int = 0) -> float | None:
    """dB per 10 % more Gaussians: slope of PSNR over log count. None if they grew too little to tell.

    Over the newest of the measurements (iteration, Gaussians, PSNR) that span a growth by `_GROWN` and so many `steps`.
    """
    for first in range(len(measured) - _POINTS, -1, -1):
        iterations, counts, values = zip(*measured[first:], strict=True)
        if counts[-1] >= _GROWN * counts[0] and iterations[-1] - iterations[0] >= steps:
            slope = np.polyfit(np.log(counts), values, 1)[0]
            return float(slope) * math.log(1.1)
    return None


def newest_gain(measured: list[tuple[int, int, float]], since: int) -> float | None:
    """dB by which the best PSNR after iteration `since` exceeds the best until then. None without both."""
    before = [value for iteration, _, value in measured if iteration <= since]
    after = [value for iteration, _, value in measured if iteration > since]
    return max(after) - max(before) if before and after else None


def lasting(since: float, now: float, rates_end: float) -> float:
    """How far harmonics that learn since a share of the run will go by its end, over how far they came until `now`.

    Adam moves a parameter by about a rate per step, and the rate falls to a share `rates_end` over the run.
    """
    if rates_end >= 1.0:
        return (1.0 - since) / max(1e-6, now - since)
    return (rates_end**since - rates_end) / max(1e-6, rates_end**since - rates_end**now)


class Probe(Protocol):
    """What the policy sees of a run in training."""

    @property
    def iteration(self) -> int:
        """Steps that are done."""
        ...

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        ...

    @property
    def gaussian_count(self) -> int:
        """Gaussians there are now."""
        ...

    @property
    def sh_degree(self) -> int:
        """SH degree in use."""
        ...

    def probe_psnr(
        self,
        frames: list[int],
        *,
        sh_degree: int | None = None,
        exposure: bool = True,
        field: bool = True,
        viewmats: Tensor | None = None,
    ) -> float | None:
        """Mean PSNR in dB on trained frames (positions); None if it is no number.

        With another SH degree, without the exposure or the field (None if the run has none), or seen from other cameras
        [F, 4, 4] of the scene's frames.
        """
        ...

    def correlation_frames(self) -> float | None:
        """`residual.correlation_frames` of the static model's residual at open Gaussians."""
        ...


@dataclass(frozen=True)
class RunSchedule:
    """What of a run's configuration decisions hang on. Shares are of the run's length."""

    iterations: int
    """Training steps, if nothing ends the run before."""
    densify_every: int
    """Steps between two rounds of densification."""
    densify_stop: float
    """Share at which growth ends of itself."""
    give_up: float
    """Share at which the gate's trial is over, whatever moved."""
    sh_every: float
    """The SH degree rises by one every this share; 0: it is the highest from the start."""
    rates_end: float
    """Share of the harmonics' learning rate that is left at the end."""
    softened: float = 0.0
    """Share until which what moves is learnt from softened pictures; 0: never."""


@dataclass(frozen=True)
class LimitHarmonics:
    """A decision: the harmonics above a degree go, with their moments, and do not come back."""

    degree: int
    """Highest SH degree from now on."""


@dataclass(frozen=True)
class FieldOpened:
    """When the field was made."""

    iteration: int
    """Steps that were done."""
    seconds: float
    """Seconds of training until then."""


@dataclass
class RunFacts:
    """What a run learnt about itself on the way. None: not measured, or it has not happened (yet)."""

    growth_gain_db: float | None = None
    """dB per 10 % more Gaussians when growth was judged last, what optimisation gained meanwhile included."""
    opened: FieldOpened | None = None
    """The creation of the deformation field; None before it."""
    hardened: int | None = None
    """Iteration at which the gate closed what did not move."""
    correlation_frames: float | None = None
    """Lag in frames at which the residual of the static model correlates with itself by half."""
    time_nodes: int | None = None
    """Number of nodes on the field's time axis, chosen from that lag."""
    poses_gain_db: float | None = None
    """What refined cameras gained on the probes."""
    exposure_gain_db: float | None = None
    """What the exposure is worth on the probes, as they join."""
    field_gain_db: float | None = None
    """What motion is worth on them."""
    probe_psnr_db: float | None = None
    """What the whole model reaches on them."""

    @property
    def on_trial(self) -> bool:
        """True while the field exists and the gate has not decided yet which Gaussians move."""
        return self.opened is not None and self.hardened is None

    def to_json(self) -> dict[str, Any]:
        """Those that are known."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> RunFacts:
        """Inverse of `to_json`."""
        known = {field.name: data[field.name] for field in dataclasses.fields(cls) if field.name in data}
        if known.get("opened") is not None:
            known["opened"] = FieldOpened(**known["opened"])
        return cls(**known)


class StoppingPolicy:
    """Probe frames and decisions of one run. `frames`: how many it trains on; 0: it decides nothing."""

    def __init__(self, config: StoppingConfig, frames: int, schedule: RunSchedule) -> None:
        self.config, self.frames, self.schedule = config, frames, schedule
        self.probes = probe_frames(frames, config.probes, config.least)
        self.joined = not self.probes
        self.measured: list[tuple[int, int, float]] = []
        self.degrees: dict[int, float] = {}
        self.sh_limit: int | None = None
        self.growth_ended: int | None = None
        self.stopped: int | None = None
        self.facts = RunFacts()

    def state(self) -> dict[str, Any]:
        """JSON-able, for a checkpoint."""
        return {
            "joined": self.joined, "measured": self.measured, "degrees": list(self.degrees.items()),
            "sh_limit": self.sh_limit, "growth_ended": self.growth_ended, "stopped": self.stopped,
            "facts": self.facts.to_json(),
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state`."""
        self.joined, self.sh_limit = state["joined"], state["sh_limit"]
        self.measured = [(int(i), int(n), float(v)) for i, n, v in state["measured"]]
        self.degrees = {int(degree): float(gain) for degree, gain in state["degrees"]}
        self.growth_ended, self.stopped = state["growth_ended"], state["stopped"]
        self.facts = RunFacts.from_json(state["facts"])

    # ------------------------------------------------------------------ what stands, for the trainer

    @property
    def held(self) -> set[int]:
        """Positions of the trained frames that are kept back now."""
        return set() if self.joined else set(self.probes)

    def sh_degree(self, configured: int) -> int:
        """The scheduled SH degree `configured`, or the one that proved enough."""
        return configured if self.sh_limit is None else min(configured, self.sh_limit)

    @property
    def growing(self) -> bool:
        """May the Gaussians still become more?"""
        return self.growth_ended is None

    @property
    def end(self) -> int:
        """Iterations after which the run is over."""
        iterations = self.schedule.iterations
        return iterations if self.stopped is None else min(iterations, self.stopped + self._anneal)

    def rate_progress(self, iteration: int, iterations: int) -> float:
        """The progress at which learning rates are looked up: a run that has enough hastens to its end."""
        if self.stopped is None:
            return iteration / iterations
        at = self.stopped / iterations
        return at + (1.0 - at) * min(1.0, (iteration - self.stopped) / self._anneal)

    @property
    def _anneal(self) -> int:
        """Steps in which a run that has enough brings its learning rates to their end."""
        return max(1, round(self.config.anneal * self.schedule.iterations))

    # ------------------------------------------------------------------ decisions

    def decide(self, probe: Probe) -> Iterator[LimitHarmonics]:
        """Called between steps; what it yields is carried out before the next is asked for.

        A decision interrupted by a cancel is taken again when the run goes on.
        """
        if not self.probes:
            return
        s = self.schedule
        grid = s.densify_every * max(1, round(self.config.every * s.iterations / s.densify_every))
        # Before a round of densification, when the splits of the last one have settled.
        due = probe.iteration > 0 and probe.iteration % grid == 0
        if due and self.stopped is None and (not self.measured or self.measured[-1][0] < probe.iteration):
            self._measure(probe)
        if not self.joined:
            if self._excess_degree(probe):
                self.sh_limit = probe.sh_degree - 1
                yield LimitHarmonics(self.sh_limit)
            if probe.progress >= self.config.join:
                self._join(probe)

    def field_opened(self, iteration: int, seconds: float) -> None:
        """The trainer made the field."""
        self.facts.opened = FieldOpened(iteration, seconds)

    def gate_hardened(self, iteration: int) -> None:
        """The gate closed what did not move."""
        self.facts.hardened = iteration

    def _measure(self, probe: Probe) -> None:
        value = probe.probe_psnr(self.probes)
        if value is None:
            return
        self.measured.append((probe.iteration, probe.gaussian_count, value))
        # While a field is on trial probes fall and rise by it: one measured 3 steps after it had opened ended growth.
        if not self.joined and self.growing and not self.facts.on_trial:
            gain = self.facts.growth_gain_db = growth_gain(self.measured, round(_SPAN * self.schedule.iterations))
            if gain is not None and gain < self.config.growth_gain:
                self.growth_ended = probe.iteration
        s = self.schedule
        hardened = (s.give_up * s.iterations if self.facts.hardened is None else self.facts.hardened) / s.iterations
        # Softened pictures gain nothing on sharp probes: a run of 9000 steps ended at 5500 by what it had not yet seen.
        sharp = s.softened + self.config.stop_window if s.softened > 0.0 else 0.0
        over = probe.progress > max(hardened, sharp, s.densify_stop if self.growing else 0.0)
        gain = newest_gain(self.measured, probe.iteration - round(self.config.stop_window * s.iterations))
        early = probe.iteration + self._anneal < s.iterations
        if over and early and gain is not None and gain < self.config.stop_gain:
            self.stopped = probe.iteration

    def _excess_degree(self, probe: Probe) -> bool:
        """Is it time to judge the SH degree in use, and does it gain too little?"""
        every, degree = self.schedule.sh_every, probe.sh_degree
        if degree == 0 or degree in self.degrees or self.sh_limit is not None or every <= 0:
            return False
        if int(probe.progress / every) <= degree and probe.progress < self.config.join:
            return False
        whole, cut = probe.probe_psnr(self.probes), probe.probe_psnr(self.probes, sh_degree=degree - 1)
        if whole is None or cut is None:
            return False
        self.degrees[degree] = whole - cut
        return (whole - cut) * lasting(degree * every, probe.progress, self.schedule.rates_end) <= self.config.sh_gain

    def judge_cameras(self, probe: Probe, refined: Tensor) -> None:
        """Gain by refined cameras [F, 4, 4], measured before they replace those of the run."""
        if self.joined or self.facts.poses_gain_db is not None:
            return
        without, value = probe.probe_psnr(self.probes), probe.probe_psnr(self.probes, viewmats=refined)
        self.facts.poses_gain_db = _difference(value, without)

    def _join(self, probe: Probe) -> None:
        """The last look at frames that were not trained on: what exposure and motion are worth; then they join."""
        whole = probe.probe_psnr(self.probes)
        self.facts.exposure_gain_db = _difference(whole, probe.probe_psnr(self.probes, exposure=False))
        self.facts.field_gain_db = _difference(whole, probe.probe_psnr(self.probes, field=False))
        self.facts.probe_psnr_db = whole
        self.joined = True

    def time_nodes(self, probe: Probe) -> int:
        """How many nodes the time axis of a field needs for what the open Gaussians do; 0: nothing is decided."""
        most = max(4, round(self.frames / 2))
        if not self.probes or most == 4:
            return 0
        same = self.facts.correlation_frames = probe.correlation_frames()
        nodes = most if same is None else min(max(round((self.frames - 1) / same) + 1, 4), most)
        self.facts.time_nodes = nodes
        return nodes


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b
