"""Decisions of an `auto` run during training that limit the model and the run to what the scene needs.

A few training frames are kept back as probes, and every decision is based on their PSNR. Held-out frames
(`TrainConfig.holdout`), on which results are reported, are never used. Late in the run, the probes become training
frames. Decisions are deterministic and their state is stored in the checkpoint, so a resumed run decides the same.

- SH degree: a higher degree is kept if it improves PSNR over the same model truncated to the degree below. At that
  time the new coefficients are only partly trained; `lasting` extrapolates their gain to the end of the run.
- Growth: ends when the total gain while the Gaussians grew falls below a threshold per 10 % more Gaussians.
- End: the run stops when the probes gain nothing more.
- Time nodes: chosen from the time over which the residual of the static model stays correlated
  (`residual.correlation_frames`).

The policy reads a run through `Probe` and does not change it. The trainer carries out the decisions that `decide`
yields, and reads lasting results from the policy's properties.
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
_MIN_GROWTH = 1.5
"""Least growth factor of the number of Gaussians over the measurements by which growth is judged."""
_POINTS = 4
"""Least number of measurements by which growth is judged."""
# Least span of these measurements, as a share of the run. In a long run, the schedule doubles the Gaussians in three
# rounds of densification; judged over three rounds only, growth ended at 42,000 of 160,000.
_SPAN = 0.1


@dataclass
class StoppingConfig:
    """Stopping criteria. Gains are in dB of mean PSNR on the probe frames; shares are of the run's length."""

    probes: int = 12
    """Interval, in training frames, of the probe frames (3 to 12 in all); 0: no probes and no early stop."""
    least: int = 48
    """Least number of training frames of a clip with probes. In a clip of 42 frames, 3 probes cost 0.1 dB."""
    join: float = 0.6
    """Share of the run at which the probe frames become training frames."""
    every: float = 0.025
    """Share of the run between two measurements, rounded to rounds of densification."""
    sh_gain: float = 0.015
    """Least gain of a higher SH degree over the model truncated to the degree below. It is measured when the next
    raise is due, and extrapolated to the end of the run."""
    growth_gain: float = 0.03
    """Least total gain (by growth and optimisation) per 10 % more Gaussians for growth to continue."""
    stop_gain: float = 0.05
    """Least gain within `stop_window` for the run to continue. It is checked once the gate has hardened and training on
    low-resolution images has ended."""
    stop_window: float = 0.15
    """Share of the run over which `stop_gain` is measured."""
    anneal: float = 0.1
    """Share of the run over which a stopped run brings its learning rates to their final values."""


def probe_frames(frames: int, every: int, least: int = 24) -> list[int]:
    """Positions of the probes among `frames` training frames: evenly spaced, without the ends; [] for short clips."""
    if every <= 0 or frames < least:
        return []
    count = min(max(frames // every, _LEAST_PROBES), _MOST_PROBES)
    return [int((n + 0.5) * frames / count) for n in range(count)]


def growth_gain(measured: list[tuple[int, int, float]], steps: int = 0) -> float | None:
    """Gain in dB per 10 % more Gaussians: slope of PSNR over log count. None if the number grew too little.

    The slope is fitted to the fewest latest measurements (iteration, Gaussians, PSNR) that span a growth by the factor
    `_MIN_GROWTH` and `steps` iterations.
    """
    for first in range(len(measured) - _POINTS, -1, -1):
        iterations, counts, values = zip(*measured[first:], strict=True)
        if counts[-1] >= _MIN_GROWTH * counts[0] and iterations[-1] - iterations[0] >= steps:
            slope = np.polyfit(np.log(counts), values, 1)[0]
            return float(slope) * math.log(1.1)
    return None


def newest_gain(measured: list[tuple[int, int, float]], since: int) -> float | None:
    """Gain in dB of the best PSNR after iteration `since` over the best until then. None if either is missing."""
    before = [value for iteration, _, value in measured if iteration <= since]
    after = [value for iteration, _, value in measured if iteration > since]
    return max(after) - max(before) if before and after else None


def lasting(since: float, now: float, rates_end: float) -> float:
    """Expected total change of SH coefficients by the end of the run, relative to their change so far.

    Adam changes a parameter by about the learning rate per step, and the rate decays exponentially to `rates_end` of
    its initial value. So the change is proportional to the integral of the rate.

    Args:
        since: share of the run at which the coefficients started training.
        now: current share of the run.
        rates_end: final learning rate as a share of the initial one.
    """
    if rates_end >= 1.0:
        return (1.0 - since) / max(1e-6, now - since)
    return (rates_end**since - rates_end) / max(1e-6, rates_end**since - rates_end**now)


class Probe(Protocol):
    """Interface through which the policy reads a run in training."""

    @property
    def iteration(self) -> int:
        """Number of finished steps."""
        ...

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        ...

    @property
    def gaussian_count(self) -> int:
        """Current number of Gaussians."""
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
        """Mean PSNR in dB on the training frames at positions `frames`; None if it is not finite.

        Options: another SH degree, no exposure correction, no field, or other cameras [F, 4, 4] of the scene's frames.
        None if the run has no exposure correction or field to switch off.
        """
        ...

    def correlation_frames(self) -> float | None:
        """Result of `residual.correlation_frames` for the static model's residual at open Gaussians."""
        ...


@dataclass(frozen=True)
class RunSchedule:
    """The parts of a run's configuration that decisions depend on. Shares are of the run's length."""

    iterations: int
    """Configured number of training steps."""
    densify_every: int
    """Steps between two rounds of densification."""
    densify_stop: float
    """Share at which growth ends by schedule."""
    give_up: float
    """Latest share at which the gate's trial ends."""
    sh_every: float
    """Share after which the SH degree rises by one; 0: the highest degree is used from the start."""
    rates_end: float
    """Final learning rate of the SH coefficients, as a share of the initial one."""
    softened: float = 0.0
    """Share until which moving pixels are trained on low-resolution images; 0: never."""


@dataclass(frozen=True)
class LimitHarmonics:
    """Decision to remove the SH coefficients above a degree, with their moments, for the rest of the run."""

    degree: int
    """Highest SH degree from now on."""


@dataclass(frozen=True)
class FieldOpened:
    """Time at which the deformation field was created."""

    iteration: int
    """Number of finished steps."""
    seconds: float
    """Training time in seconds."""


@dataclass
class RunFacts:
    """Measurements and events of a run. None: not measured, or not happened yet."""

    growth_gain_db: float | None = None
    """Total gain in dB per 10 % more Gaussians when growth was last judged, including the gain by optimisation."""
    opened: FieldOpened | None = None
    """The creation of the deformation field; None before it."""
    hardened: int | None = None
    """Iteration at which the gate closed the Gaussians that did not move."""
    correlation_frames: float | None = None
    """Lag in frames at which the autocorrelation of the static model's residual is half of that at lag 1."""
    time_nodes: int | None = None
    """Number of nodes on the field's time axis, chosen from that lag."""
    poses_gain_db: float | None = None
    """Gain by refined cameras on the probes."""
    exposure_gain_db: float | None = None
    """Gain by the exposure correction on the probes, just before they become training frames."""
    field_gain_db: float | None = None
    """Gain by the deformation field on the probes, at the same time."""
    probe_psnr_db: float | None = None
    """PSNR of the whole model on the probes, at the same time."""

    @property
    def on_trial(self) -> bool:
        """True while the field exists and the gate has not decided yet which Gaussians move."""
        return self.opened is not None and self.hardened is None

    def to_json(self) -> dict[str, Any]:
        """All facts that are not None, as JSON-able types."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> RunFacts:
        """Inverse of `to_json`."""
        known = {field.name: data[field.name] for field in dataclasses.fields(cls) if field.name in data}
        if known.get("opened") is not None:
            known["opened"] = FieldOpened(**known["opened"])
        return cls(**known)


class StoppingPolicy:
    """Probe frames and decisions of one run. `frames`: number of training frames; 0: nothing is decided."""

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
        """State for a checkpoint, as JSON-able types."""
        return {
            "joined": self.joined, "measured": self.measured, "degrees": list(self.degrees.items()),
            "sh_limit": self.sh_limit, "growth_ended": self.growth_ended, "stopped": self.stopped,
            "facts": self.facts.to_json(),
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restores what `state` returned."""
        self.joined, self.sh_limit = state["joined"], state["sh_limit"]
        self.measured = [(int(i), int(n), float(v)) for i, n, v in state["measured"]]
        self.degrees = {int(degree): float(gain) for degree, gain in state["degrees"]}
        self.growth_ended, self.stopped = state["growth_ended"], state["stopped"]
        self.facts = RunFacts.from_json(state["facts"])

    # ------------------------------------------------------------------ results, for the trainer

    @property
    def excluded(self) -> set[int]:
        """Positions of the training frames that are currently kept back as probes."""
        return set() if self.joined else set(self.probes)

    def sh_degree(self, configured: int) -> int:
        """The scheduled SH degree `configured`, limited to the highest degree that was kept."""
        return configured if self.sh_limit is None else min(configured, self.sh_limit)

    @property
    def growing(self) -> bool:
        """True if the number of Gaussians may still grow."""
        return self.growth_ended is None

    @property
    def end(self) -> int:
        """Iteration at which the run ends."""
        iterations = self.schedule.iterations
        return iterations if self.stopped is None else min(iterations, self.stopped + self._anneal)

    def rate_progress(self, iteration: int, iterations: int) -> float:
        """Progress at which learning rates are evaluated. In a stopped run it rises faster, to reach 1 at the end."""
        if self.stopped is None:
            return iteration / iterations
        at = self.stopped / iterations
        return at + (1.0 - at) * min(1.0, (iteration - self.stopped) / self._anneal)

    @property
    def _anneal(self) -> int:
        """Number of steps in which a stopped run brings its learning rates to their final values."""
        return max(1, round(self.config.anneal * self.schedule.iterations))

    # ------------------------------------------------------------------ decisions

    def decide(self, probe: Probe) -> Iterator[LimitHarmonics]:
        """Makes the decisions that are due; called between steps.

        The caller carries out each yielded decision before it requests the next. A decision interrupted by a
        cancellation is made again when the run is resumed.
        """
        if not self.probes:
            return
        s = self.schedule
        grid = s.densify_every * max(1, round(self.config.every * s.iterations / s.densify_every))
        # Measured just before a round of densification, when the splits of the previous round have settled.
        is_due = probe.iteration > 0 and probe.iteration % grid == 0
        if is_due and self.stopped is None and (not self.measured or self.measured[-1][0] < probe.iteration):
            self._measure(probe)
        if not self.joined:
            if self._excess_degree(probe):
                self.sh_limit = probe.sh_degree - 1
                yield LimitHarmonics(self.sh_limit)
            if probe.progress >= self.config.join:
                self._join(probe)

    def field_opened(self, iteration: int, seconds: float) -> None:
        """Notes that the trainer has created the field."""
        self.facts.opened = FieldOpened(iteration, seconds)

    def gate_hardened(self, iteration: int) -> None:
        """Notes that the gate has closed the Gaussians that did not move."""
        self.facts.hardened = iteration

    def _measure(self, probe: Probe) -> None:
        value = probe.probe_psnr(self.probes)
        if value is None:
            return
        self.measured.append((probe.iteration, probe.gaussian_count, value))
        # A new field disturbs the probes' PSNR during the trial. A measurement 3 steps after its creation ended growth,
        # and a fifth of the Gaussians of `hall` were never made.
        if not self.joined and self.growing and not self.facts.on_trial:
            gain = self.facts.growth_gain_db = growth_gain(self.measured, round(_SPAN * self.schedule.iterations))
            # An upper bound, which favours growth: one run cannot separate the gain by growth from that by
            # optimisation.
            if gain is not None and gain < self.config.growth_gain:
                self.growth_ended = probe.iteration
        s = self.schedule
        hardened = (s.give_up * s.iterations if self.facts.hardened is None else self.facts.hardened) / s.iterations
        # Training at low resolution gains nothing on sharp probes; without this, a run of 9000 steps ended at 5500.
        sharp = s.softened + self.config.stop_window if s.softened > 0.0 else 0.0
        over = probe.progress > max(hardened, sharp, s.densify_stop if self.growing else 0.0)
        gain = newest_gain(self.measured, probe.iteration - round(self.config.stop_window * s.iterations))
        # With fewer steps left than the annealing takes, stopping would save nothing.
        early = probe.iteration + self._anneal < s.iterations
        # The probes are trained on by then, so they gain at least as much as held-out frames. This favours a longer
        # run.
        if over and early and gain is not None and gain < self.config.stop_gain:
            self.stopped = probe.iteration

    def _excess_degree(self, probe: Probe) -> bool:
        """True if the SH degree in use is due to be judged and gains too little."""
        every, degree = self.schedule.sh_every, probe.sh_degree
        if degree == 0 or degree in self.degrees or self.sh_limit is not None or every <= 0:
            return False
        if int(probe.progress / every) <= degree and probe.progress < self.config.join:
            return False
        full, reduced = probe.probe_psnr(self.probes), probe.probe_psnr(self.probes, sh_degree=degree - 1)
        if full is None or reduced is None:
            return False
        self.degrees[degree] = full - reduced
        return (full - reduced) * lasting(
            degree * every, probe.progress, self.schedule.rates_end
        ) <= self.config.sh_gain

    def judge_cameras(self, probe: Probe, refined: Tensor) -> None:
        """Measures the gain by refined cameras [F, 4, 4] before they replace the run's cameras."""
        if self.joined or self.facts.poses_gain_db is not None:
            return
        without, value = probe.probe_psnr(self.probes), probe.probe_psnr(self.probes, viewmats=refined)
        self.facts.poses_gain_db = _difference(value, without)

    def _join(self, probe: Probe) -> None:
        """Measures the gain by exposure and field on the probes for the last time, then makes them training frames."""
        psnr = probe.probe_psnr(self.probes)
        self.facts.exposure_gain_db = _difference(psnr, probe.probe_psnr(self.probes, exposure=False))
        self.facts.field_gain_db = _difference(psnr, probe.probe_psnr(self.probes, field=False))
        self.facts.probe_psnr_db = psnr
        self.joined = True

    def time_nodes(self, probe: Probe) -> int:
        """Number of nodes that the field's time axis needs for the motion of the open Gaussians; 0: not decided."""
        most = max(4, round(self.frames / 2))
        if not self.probes or most == 4:
            return 0
        same = self.facts.correlation_frames = probe.correlation_frames()
        nodes = most if same is None else min(max(round((self.frames - 1) / same) + 1, 4), most)
        self.facts.time_nodes = nodes
        return nodes


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b
