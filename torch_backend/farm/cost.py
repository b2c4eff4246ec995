"""Cost of a job, by measured rates: core-hours, card-hours, disk, and the critical path."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

from .rates import SESSION_SECONDS, TASK_SECONDS, WATCH_CORES, Rate
from .shots import FarmShot
from .template import Needs
from .work import Step, disk_bytes

ON_A_CARD = ("train", "open", "freeze")
"""Steps that run on a graphics card, if one is requested."""
SPARE = 1.5
"""Ratio of the requested memory to the measured memory."""
MIB_PER_MEGAPIXEL = 160
"""Memory per megapixel of a take's frames: docs/benchmarks.md, "What a frame costs", 640 x 360 against 4K."""
_OF_FRAMES = ("open", "freeze", "finish", "bake")
ENGINE = "engine"
"""Row for the time of the farm's engine itself; its tasks are sessions."""
HOSTS = (1, 2, 10, 100)
"""Numbers of hosts for which the total time is estimated."""


@dataclass(frozen=True)
class Row:
    """One kind of step of a job, or `ENGINE`."""

    kind: str
    tasks: int
    seconds: float
    """Sum of the wall seconds of all its tasks."""
    core_seconds: float
    """Processor seconds."""


@dataclass(frozen=True)
class Estimate:
    """Estimated cost of a whole job."""

    rows: list[Row]
    shots: int
    tasks: int
    core_hours: float
    card_hours: float
    """0 if no card is requested."""
    disk_gb: float
    """Disk space of takes and intermediate files."""
    critical_seconds: float
    """Shortest time of the job with any number of hosts: the longest chain of tasks."""
    on_hosts: dict[int, float]
    """Number of hosts, with one task at a time each -> seconds until the last task has ended."""


def estimate(steps: Sequence[Step], rates: dict[str, Rate], card: bool, bake: bool, session_tasks: int = 0) -> Estimate:
    """The cost of a job.

    Args:
        steps: steps of all shots; those of one shot in order.
        rates: kind of step -> rate.
        card: True if a graphics card is requested.
        bake: True if takes are baked.
        session_tasks: tasks of a step that a host runs in one session of the engine; 0: all of the host's tasks.
    """
    shots: dict[str, FarmShot] = {step.shot.name: step.shot for step in steps}
    chains = [[_times(step, rates) for step in steps if step.shot.name == name] for name in shots]
    rows: list[Row] = []
    for kind in dict.fromkeys(step.kind for step in steps):
        durations = [seconds for step in steps if step.kind == kind for seconds in _times(step, rates)]
        rows.append(Row(kind, len(durations), sum(durations), sum(durations) * rates[kind].cores))
    tasks = sum(row.tasks for row in rows)
    sessions = sum(step.sessions(session_tasks) for step in steps)
    engine = SESSION_SECONDS * sessions + TASK_SECONDS * tasks
    rows.append(Row(ENGINE, sessions, engine, engine + WATCH_CORES * sum(row.seconds for row in rows)))
    makespans = {hosts: _makespan(chains, hosts, session_tasks) for hosts in HOSTS}
    return Estimate(
        rows,
        len(shots),
        tasks,
        sum(row.core_seconds for row in rows) / 3600.0,
        sum(row.seconds for row in rows if row.kind in ON_A_CARD) / 3600.0 if card else 0.0,
        sum(disk_bytes(shot, bake) for shot in shots.values()) / 1e9,
        max((sum(max(times) + SESSION_SECONDS + TASK_SECONDS for times in chain) for chain in chains), default=0.0),
        makespans,
    )


def needs(rates: dict[str, Rate], card: bool, megapixels: float) -> dict[str, Needs]:
    """Requirements of each step on hosts, by measured rates; `megapixels`: size of the largest take's frames."""
    found: dict[str, Needs] = {}
    for kind, rate in rates.items():
        memory = SPARE * rate.memory_mib + (MIB_PER_MEGAPIXEL * megapixels if kind in _OF_FRAMES else 0.0)
        found[kind] = Needs(int(-(-memory // 512) * 512), card and kind in ON_A_CARD)
    return found


def sentences(costs: Estimate, rates_from: str) -> list[str]:
    """Text of an estimate, line by line."""
    lines = [
        f"{costs.shots} shots, {costs.tasks} tasks. Estimated from rates {rates_from}, on hosts that run one task at a "
        "time:"
    ]
    for row in costs.rows:
        of = "sessions" if row.kind == ENGINE else "tasks"
        lines.append(f"  {row.kind:<8} {row.tasks:>6} {of:<8} {_hours(row.seconds):>10}")
    lines.append(f"Processor: {costs.core_hours:.2f} core-hours.")
    if costs.card_hours:
        lines.append(f"Card: {costs.card_hours:.2f} card-hours, if the card is as fast as in the rates.")
    lines.append(f"Disk: up to {costs.disk_gb:.1f} GB.")
    ends = ", ".join(f"{hosts} {_hours(seconds)}" for hosts, seconds in costs.on_hosts.items())
    lines.append(
        f"Time until the last task ends, by number of hosts: {ends}; at least {_hours(costs.critical_seconds)}."
    )
    return lines


def _times(step: Step, rates: dict[str, Rate]) -> list[float]:
    rate = rates[step.kind]
    return [rate.seconds(amount) for amount in step.tasks()]


@dataclass(order=True)
class _Host:
    """A host that does one task at a time."""

    free: float
    """Time in seconds at which the host becomes free."""
    number: int
    session: tuple[int, int] = (-1, -1)
    """Shot and step of its current session."""
    tasks: int = 0
    """Number of tasks done in that session."""

    def does(self, step: tuple[int, int], since: float, seconds: float, session_tasks: int) -> float:
        """Does a task of a step that is ready at the time `since`; returns the time at which the task ends."""
        if step != self.session or self.tasks == session_tasks > 0:
            self.session, self.tasks = step, 0
            seconds += SESSION_SECONDS
        self.tasks += 1
        self.free = max(self.free, since) + TASK_SECONDS + seconds
        return self.free


def _makespan(chains: list[list[list[float]]], hosts: int, session_tasks: int) -> float:
    """Time at which the last task ends, if a free host takes a task of the step that was ready first.

    `chains`: shot -> step -> seconds of each task.
    """
    free = [_Host(0.0, number) for number in range(hosts)]
    ready = [(0.0, n) for n, chain in enumerate(chains) if chain]
    at = [0] * len(chains)
    last = 0.0
    while ready:
        since, n = heapq.heappop(ready)
        ends = since
        for seconds in chains[n][at[n]]:
            host = heapq.heappop(free)
            ends = max(ends, host.does((n, at[n]), since, seconds, session_tasks))
            heapq.heappush(free, host)
        at[n] += 1
        last = max(last, ends)
        if at[n] < len(chains[n]):
            heapq.heappush(ready, (ends, n))
    return last


def _hours(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.1f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
