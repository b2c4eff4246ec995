"""Extensions: additional steps for a finished run, and their learning rates.

The summary and checkpoint of the finished run stay valid until the last added step is done. Until then the extension
is saved to a separate file, which replaces the checkpoint at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import EXTENSION_FILE as EXTENSION_FILE
from .checkpoint import read_meta

# Maximum rewind of the learning rate schedule, as a share of the run.
_REWIND = 1.0 / 3.0


@dataclass(frozen=True)
class Extension:
    """Steps added to a finished run."""

    from_iteration: int
    """Iterations of the run before the extension."""
    steps: int
    """Number of added steps."""
    heldout_psnr_db_before: float | None
    """Mean PSNR in dB on held-out frames before the extension; None without such frames."""
    train_seconds_before: float
    """Training time in seconds before the extension."""

    @property
    def end(self) -> int:
        """Iteration at which the extended run ends."""
        return self.from_iteration + self.steps

    def rate_progress(self, iteration: int, iterations: int) -> float:
        """Progress, in a run of `iterations` steps, at which learning rates are evaluated.

        The schedule is rewound by the number of added steps, at most by a third of the run, and then runs to its end
        again.
        """
        # At the final rates the model would hardly change; high rates for a few steps would leave noise.
        back = min(self.steps / iterations, _REWIND)
        done = min(max((iteration - self.from_iteration) / self.steps, 0.0), 1.0)
        return 1.0 - back * (1.0 - done)


def pending(folder: Path, finished: dict[str, Any]) -> Extension | None:
    """Unfinished extension in a run's folder that continues the checkpoint with the facts `finished`; None without."""
    path = folder / EXTENSION_FILE
    facts = read_meta(path) if path.is_file() else {}
    if not facts.get("extensions") or facts.get("key") != finished.get("key"):
        return None
    last = Extension(**facts["extensions"][-1])
    begun_on = (last.from_iteration, last.train_seconds_before)
    return last if begun_on == (finished["iteration"], finished["trained_seconds"]) else None
