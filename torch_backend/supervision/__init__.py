"""Temporal support, detection of hidden and defective Gaussians, and anchoring losses for unsupervised states."""

from .anchors import (
    Anchored,
    Draws,
    PaperView,
    SupervisionConfig,
    anchored_pairs,
    draw,
    paper_loss,
    still_weight,
    stillness,
    support_loss,
    well_supervised,
)
from .support import bin_of, bin_times, mark_hidden, mark_seen, nearest_bin, nearest_supported, support_confidence

__all__ = [
    "Anchored",
    "Draws",
    "PaperView",
    "SupervisionConfig",
    "anchored_pairs",
    "bin_of",
    "bin_times",
    "draw",
    "mark_hidden",
    "mark_seen",
    "nearest_bin",
    "nearest_supported",
    "paper_loss",
    "still_weight",
    "stillness",
    "support_confidence",
    "support_loss",
    "well_supervised",
]
