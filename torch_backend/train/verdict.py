"""Is a trained run any good? A word about what it leaves unexplained of its frames, from figures of real clips."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from ..contract import Reporter
from .trainer import Trainer

POOR_MEDIAN_DB, POOR_TENTH_DB = 21.5, 18.0
"""Below one of them a run is poor: PSNR of the median frame, and of the worst tenth.

Presets' runs of clips whose people hold still give 24.6 to 28.8 dB on held-out frames (docs/benchmarks.md); the bundled
clip, the hardest of them, 24.4 and 22.8 dB (median, tenth) there and 25.7 and 23.4 dB on the frames that it trained on.
With a figure painted in that walks across all of it, 1200 preview steps left it at 18.9 and 17.6 dB (training frames:
19.7 and 17.9).
"""
_MOST = 24
"""Frames that are looked at, evenly over the clip, where none are held out."""


def judge(trainer: Trainer, test: list[int], held_out: Tensor) -> dict[str, Any]:
    """`quality` (Good or Poor) of a run, and the figures behind the word, for its summary.

    On held-out frames [I, H, W, 3] at scene indices `test`; on some of those it trained on if there are none.
    """
    if test:
        values, on = trainer.frame_psnrs(test, held_out), "held-out frames"
    else:
        count = len(trainer.train_ids)
        picked = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int)).tolist()
        values = trainer.frame_psnrs([trainer.train_ids[n] for n in picked], trainer.images[picked])
        on = "training frames"
    median, tenth = (round(float(np.percentile(values, share)), 2) for share in (50, 10))
    poor = not (median >= POOR_MEDIAN_DB and tenth >= POOR_TENTH_DB)
    return {
        "quality": "Poor" if poor else "Good",
        "quality_on": on,
        "median_psnr_db": median,
        "worst_tenth_psnr_db": tenth,
    }


def tell(summary: dict[str, Any], report: Reporter) -> None:
    """Warns of a poor run, from its summary."""
    if summary["quality"] != "Poor":
        return
    median, tenth = summary["median_psnr_db"], summary["worst_tenth_psnr_db"]
    report.warning(
        f"The run is poor: {median:.1f} dB on half of its {summary['quality_on']}, {tenth:.1f} dB on the worst tenth.",
        "Look at its previews. Somebody walks through, or the camera is wrong: take a range in which all hold still, "
        "or solve again.",
    )
