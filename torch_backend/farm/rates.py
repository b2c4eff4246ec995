"""Seconds per unit of work: measured here, or on the farm for which the cost is estimated."""

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
    """Of one kind of step, on one host."""

    fixed: float
    """Seconds that a task takes whatever it has to do: starting, loading."""
    per_unit: float
    """Seconds per unit of `work.Step.amounts`."""
    cores: float
    """Processor cores that it keeps busy, in the mean."""
    memory_mib: int
    """Most memory in MiB that was seen."""

    def seconds(self, amount: float) -> float:
        """How long a task takes."""
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
"""Seconds of one core that a session of a host takes besides its tasks: the engine begins it, and enters the job's
environment, which is set up. Seen with openjd-cli 0.8.0, see docs/farm.md."""
TASK_SECONDS = 0.11
"""Of each task in it: what `records` cannot see, for the engine starts the task before, and the system clears up its
memory after."""
WATCH_CORES = 0.015
"""Cores that the engine keeps busy while it waits for a task."""


def measure(records: Iterable[dict[str, Any]]) -> dict[str, Rate]:
    """Rates by what tasks took (`records.read`), for those steps that there are records of.

    Where tasks had different amounts of work, a fixed cost and a cost per unit are fitted by non-negative least
    squares. Otherwise both are those of `MEASURED`, scaled by how much slower or faster the tasks were.
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
    """`MEASURED` with those of a file in their place. JobError if it is no such file."""
    try:
        record = read_json(path)
        if record.get("version") != VERSION:
            raise ValueError("it is not of this version")
        own = {str(step): from_dict(Rate, rate) for step, rate in dict(record["rates"]).items()}
        if set(own) - set(MEASURED):
            raise ValueError(f"it names the step {sorted(set(own) - set(MEASURED))[0]}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError(
            f"{path} holds no rates: {error}.", "Give the rates.json of `farm measure`.", ExitCode.USAGE
        ) from error
    return MEASURED | own
