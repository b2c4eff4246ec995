"""More steps for a run that has ended: what an extension is, where its rates stand, and the one that is not done yet.

The finished run stays what it is, summary and checkpoint, until the last added step is done: an extension saves itself
to a file of its own, and takes the checkpoint's place only then.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import EXTENSION_FILE as EXTENSION_FILE
from .checkpoint import read_meta

_REWIND = 1.0 / 3.0
"""Most of the run's schedule, as a share of it, that the learning rates go back."""


@dataclass(frozen=True)
class Extension:
    """Steps added to a run that had ended."""

    from_iteration: int
    """Iterations that the run had."""
    steps: int
    """How many are added."""
    heldout_psnr_db_before: float | None
    """What the run was worth then: mean PSNR in dB on held-out frames, None without any."""
    train_seconds_before: float
    """Seconds it had trained for."""

    @property
    def end(self) -> int:
        """Iterations after which the run is over again."""
        return self.from_iteration + self.steps

    def rate_progress(self, iteration: int, iterations: int) -> float:
        """The progress, of a run of `iterations`, at which learning rates are looked up.

        They go back by as many steps as are added, at most by a third of the run, and fall to their end again: rates
        that stay at their end learn next to nothing, and a few steps at high rates would leave noise behind.
        """
        back = min(self.steps / iterations, _REWIND)
        done = min(max((iteration - self.from_iteration) / self.steps, 0.0), 1.0)
        return 1.0 - back * (1.0 - done)


def pending(folder: Path, finished: dict[str, Any]) -> Extension | None:
    """The extension in a run's folder that was begun on the checkpoint with the facts `finished` and is not done."""
    path = folder / EXTENSION_FILE
    facts = read_meta(path) if path.is_file() else {}
    if not facts.get("extensions") or facts.get("key") != finished.get("key"):
        return None
    last = Extension(**facts["extensions"][-1])
    begun_on = (last.from_iteration, last.train_seconds_before)
    return last if begun_on == (finished["iteration"], finished["trained_seconds"]) else None
