"""The reporter of the tests."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch_backend.contract import Cancelled, Reporter


class Quiet(Reporter):
    """Records all events.

    It cancels at the progress `cancel_at` (a stage and a share of it) or after `cancel_after` checks.
    """

    def __init__(self, cancel_at: tuple[str, float] | None = None, cancel_after: int | None = None):
        self.events: list[tuple] = []
        self.cancel_at, self.cancel_after = cancel_at, cancel_after
        self.cancelled, self.checks = False, 0

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        self.events.append(("progress", stage, done, total, message))
        if self.cancel_at and stage == self.cancel_at[0] and done / total >= self.cancel_at[1]:
            self.cancelled = True

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        self.events.append(("metric", stage, dict(values)))

    def image(self, label: str, path: str | Path) -> None:
        self.events.append(("image", label, str(path)))

    def warning(self, message: str, hint: str = "") -> None:
        self.events.append(("warning", message, hint))

    def check_cancelled(self) -> None:
        self.checks += 1
        if self.cancelled or (self.cancel_after is not None and self.checks > self.cancel_after):
            raise Cancelled

    @property
    def warnings(self) -> list[str]:
        """The sentences of the warnings."""
        return [event[1] for event in self.events if event[0] == "warning"]

    @property
    def steps(self) -> list[tuple[str, float, float]]:
        """(stage, done, total) of the progress."""
        return [event[1:4] for event in self.events if event[0] == "progress"]
