"""Who was seen when, and what holds a Gaussian at times at which nobody saw it."""

from .anchors import (
    Anchored,
    PaperView,
    SupervisionConfig,
    draw_anchored,
    paper_loss,
    stillness,
    support_loss,
    well_supervised,
)
from .support import bin_of, bin_times, mark_hidden, mark_seen, nearest_bin, nearest_supported, support_confidence

__all__ = [
    "Anchored",
    "PaperView",
    "SupervisionConfig",
    "bin_of",
    "bin_times",
    "draw_anchored",
    "mark_hidden",
    "mark_seen",
    "nearest_bin",
    "nearest_supported",
    "paper_loss",
    "stillness",
    "support_confidence",
    "support_loss",
    "well_supervised",
]
