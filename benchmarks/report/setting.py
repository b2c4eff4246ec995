"""All runs of one way of training and freezing, with their means: a row of the report's tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .metrics import METRICS, WHOLE, Key, Paired, Summary, known_mean, paired, summarise
from .records import FrameScore, RunRecord

NONE = "–"
"""Text of an empty table cell."""


def plain(value: float | None, digits: int = 2) -> str:
    """A formatted number, or a dash for None."""
    return NONE if value is None else f"{value:.{digits}f}"


@dataclass
class Setting:
    """All runs of one way of training and freezing, on one kind of scene."""

    label: str
    host: str
    supervision: str
    preset: str
    variant: str
    cameras: str
    shown: str
    """Variant of its frames: splats, developed, withheld or delivered."""
    runs: list[RunRecord]

    def summary(self, metric: str, region: str = WHOLE) -> Summary | None:
        """Summary of a metric over all frames of all runs."""
        return self.of_frames(lambda row: row.value(metric, region), METRICS[metric])

    def of_frames(self, read: Callable[[FrameScore], float | None], more_is_better: bool = True) -> Summary | None:
        """Summary of a figure of a frame over all runs."""
        return summarise([v for run in self.runs for v in run.per_frame(read)], more_is_better)

    def of_runs(self, read: Callable[[RunRecord], float | None]) -> float | None:
        """Mean of a figure of a run; None if any run lacks it."""
        values = [read(run) for run in self.runs]
        known = [v for v in values if v is not None]
        return float(np.mean(known)) if known and len(known) == len(values) else None

    def jod(self) -> float | None:
        """Mean ColorVideoVDP over the instants of all runs; None without any."""
        return known_mean(v for run in self.runs for v in run.jod.values())

    def of_heldout(self, region: str) -> float | None:
        """Mean PSNR in dB over a region of the clip's held-out frames of all runs; None if no frame has the region."""
        return known_mean(v for run in self.runs for v in run.heldout_values(region).values())

    def against(self, reference: Setting, metric: str, region: str = WHOLE) -> Paired | None:
        """Comparison with another setting, frame by frame, or for `jod` instant by instant."""
        if metric == "jod":
            return self._against(reference, RunRecord.jod_values)
        return self._against(reference, lambda run: run.values(metric, region), METRICS[metric])

    def against_heldout(self, reference: Setting, region: str) -> Paired | None:
        """Comparison of PSNR on the clip's held-out frames with another setting, frame by frame."""
        return self._against(reference, lambda run: run.heldout_values(region))

    def _against(
        self, reference: Setting, read: Callable[[RunRecord], dict[Key, float | None]], more_is_better: bool = True
    ) -> Paired | None:
        mine, theirs = ({k: v for run in s.runs for k, v in read(run).items()} for s in (self, reference))
        return paired(mine, theirs, more_is_better)

    def ratio(self, reference: Setting, read: Callable[[RunRecord], float | None]) -> float | None:
        """Geometric mean, over scenes and seeds, of a cost relative to another setting's; None without common runs."""
        of_place = {run.place: read(run) for run in reference.runs}
        pairs = [(read(run), of_place.get(run.place)) for run in self.runs]
        logs = [float(np.log(a / b)) for a, b in pairs if a and b]
        return float(np.exp(np.mean(logs))) if logs else None
