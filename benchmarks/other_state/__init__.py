"""Hand-painted masks of real plates: pixels of plate m that show another state of the scene than plate t*.

The masks are polygons in `sitting.json`, `kitchen.json` and `hall.json` in this folder; each file says how they were
painted. `score` compares them with the pixels that a frozen frame rejects of its own plate.
"""

from .masks import CHANGED, SAME, UNSCORED, Painted, Pair, Polygon, load_masks, plate_labels
from .scores import Counts, Row, mean_counts, pooled_counts, score

__all__ = [
    "CHANGED",
    "SAME",
    "UNSCORED",
    "Counts",
    "Painted",
    "Pair",
    "Polygon",
    "Row",
    "load_masks",
    "mean_counts",
    "plate_labels",
    "pooled_counts",
    "score",
]
