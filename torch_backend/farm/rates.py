"""Seconds per unit of work, measured for docs/farm.md or on the farm whose cost is estimated."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..contract import ExitCode, JobError, from_dict, read_json

VERSION = 1


@dataclass(frozen=True)
class Rate:
    """Rate of one kind of step on one host."""

    fixed: float
    """Seconds of a task that do not depend on its amount of work: starting, loading."""
    per_unit: float
    """Seconds per unit of `work.Step.amounts`."""
    cores: float
    """Mean number of processor cores that the step keeps busy."""
    memory_mib: int
    """Largest memory use that was measured, in MiB."""

    def seconds(self, amount: float) -> float:
        """Seconds that a task with this amount of work takes."""
        return self.fixed + self.per_unit * amount


MEASURED: dict[str, Rate] = {
    "import": Rate(1.4, 0.11, 1.0, 400),
    "solve": Rate(2.7, 3.0, 1.0, 1000),
    "train": Rate(4.0, 0.228, 1.0, 1500),
    "open": Rate(6.2, 0.3, 1.0, 1000),
    "freeze": Rate(3.0, 0.63, 1.0, 1250),
    "finish": Rate(2.8, 0.5, 1.0, 700),
    "bake": Rate(1.5, 0.73, 1.0, 600),
    "deliver": Rate(1.3, 0.0, 1.0, 500),
}
"""Step -> rate on one core of the processor of docs/farm.md, which says how they were measured."""
SESSION_SECONDS = 0.6
"""Core seconds that a host's session takes besides its tasks. The engine starts the session and enters the job's
environment, which is already set up. Measured with openjd-cli 0.8.0, see docs/farm.md."""
TASK_SECONDS = 0.11
"""Seconds of each task that `records` cannot measure: the engine starts the task before, and the system frees its
memory after."""
WATCH_CORES = 0.015
"""Cores that the engine keeps busy while it waits for a task."""


def measure(records: Iterable[dict[str, Any]]) -> dict[str, Rate]:
    """Rates measured from the records of tasks (`records.read`), for steps that have records.

    If the amounts of work differ, a line fitted to the records gives a fixed cost and a cost per unit; neither is below
    0. Otherwise both costs are those of `MEASURED`, scaled by the ratio of actual to expected seconds.
    """
    by_step: dict[str, list[tuple[float, float, float, float]]] = {}
    for record in records:
        try:
            row = tuple(float(record[name]) for name in ("amount", "seconds", "cpu_seconds", "memory_mib"))
            by_step.setdefault(str(record["step"]), []).append(row)  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError):
            continue
    return {step: _fitted(step, np.array(rows)) for step, rows in sorted(by_step.items()) if step in MEASURED}


def _fitted(step: str, rows: np.ndarray) -> Rate:
    amounts, seconds = rows[:, 0], rows[:, 1]
    usual = MEASURED[step]
    slower = float(seconds.mean()) / usual.seconds(float(amounts.mean()))
    fixed, per = slower * usual.fixed, slower * usual.per_unit
    if np.ptp(amounts) > 0.2 * amounts.max():
        per, fixed = (float(v) for v in np.polyfit(amounts, seconds, 1))
        if per < 0.0:
            fixed, per = float(seconds.mean()), 0.0
        elif fixed < 0.0:
            fixed, per = 0.0, float(seconds.sum() / amounts.sum())
    cores = float(rows[:, 2].sum() / max(1e-9, seconds.sum()))
    return Rate(round(fixed, 4), round(per, 6), round(max(0.1, cores), 3), int(rows[:, 3].max()))


def to_json(rates: dict[str, Rate]) -> dict[str, Any]:
    """Rates as rates.json holds them."""
    return {"version": VERSION, "rates": {step: dataclasses.asdict(rate) for step, rate in rates.items()}}


def read_rates(path: str | Path) -> dict[str, Rate]:
    """`MEASURED`, overridden by the rates in a file. JobError if the file is invalid."""
    try:
        record = read_json(path)
        if record.get("version") != VERSION:
            raise ValueError("it was written by another version")
        overrides = {str(step): from_dict(Rate, rate) for step, rate in dict(record["rates"]).items()}
        if set(overrides) - set(MEASURED):
            raise ValueError(f"it contains the unknown step {sorted(set(overrides) - set(MEASURED))[0]}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError(
            f"{path} is not a file of rates: {error}.", "Use the rates.json of `farm measure`.", ExitCode.USAGE
        ) from error
    return MEASURED | overrides
