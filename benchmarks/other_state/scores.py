"""Scores of the pixels that a frozen frame rejects of its own plate, against the painted masks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.detail_clip import DetailClip, View, over
from benchmarks.detail_figures import MOVER_MATTE
from benchmarks.report.metrics import known_mean
from torch_backend.lens.plate_lens import load_plate_lenses

from .masks import CHANGED, SAME, Labels, Painted, plate_labels

LET_GO = 0.5
"""A pixel's own plate is rejected if its matte is below this: more than half of the pixel comes from elsewhere."""
METHODS = ("delivered", "mattes")
"""Pixels rejected by the delivered frame, and pixels that motion mattes alone would reject: movers of the plate's own
matte, and of the matte of plate t* warped to the plate by the frozen depth."""


@dataclass(frozen=True)
class Counts:
    """Scored pixels of one frame or of several."""

    both: int
    """Rejected, and painted as another state."""
    extra: int
    """Rejected, although the same at t*."""
    missed: int
    """Kept, although painted as another state."""
    right: int
    """Kept, and the same at t*."""

    @property
    def iou(self) -> float | None:
        """Intersection over union; None if nothing is painted (see `extra_share` for such a frame)."""
        return _ratio(self.both, self.both + self.extra + self.missed) if self.both + self.missed else None

    @property
    def precision(self) -> float | None:
        """Share of the rejected pixels that is painted; None if nothing is rejected or nothing is painted."""
        return _ratio(self.both, self.both + self.extra) if self.both + self.missed else None

    @property
    def recall(self) -> float | None:
        """Share of the painted pixels that is rejected; None if nothing is painted."""
        return _ratio(self.both, self.both + self.missed)

    @property
    def extra_share(self) -> float | None:
        """Share of the pixels unchanged at t* that is wrongly rejected; None without such pixels."""
        return _ratio(self.extra, self.extra + self.right)

    def figures(self) -> dict[str, float | int | None]:
        """All ratios and counts, for JSON."""
        ratios = {"iou": self.iou, "precision": self.precision, "recall": self.recall, "extra_share": self.extra_share}
        return {**ratios, **vars(self)}


@dataclass(frozen=True)
class Row:
    """The scores of one pair of t* and frame."""

    t_star: int
    """Frame number of the frozen instant."""
    frame: int
    """Frame number of the plate."""
    counts: dict[str, Counts]
    """Counts by `METHODS`."""

    def figures(self) -> dict[str, Any]:
        """All values of the row, for JSON."""
        named = {name: counts.figures() for name, counts in self.counts.items()}
        return {"t_star": self.t_star, "frame": self.frame, **named}


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def count(is_let_go: NDArray[np.bool_], labels: Labels) -> Counts:
    """Counts of one frame, from rejected pixels and labels, both [H, W]."""
    is_changed, is_same = labels == CHANGED, labels == SAME
    return Counts(
        int((is_let_go & is_changed).sum()), int((is_let_go & is_same).sum()),
        int((~is_let_go & is_changed).sum()), int((~is_let_go & is_same).sum()),
    )  # fmt: skip


def pooled_counts(counts: Iterable[Counts]) -> Counts:
    """Sum over frames, so that large regions weigh more."""
    rows = [(c.both, c.extra, c.missed, c.right) for c in counts]
    return Counts(*(sum(column) for column in zip(*rows, strict=True))) if rows else Counts(0, 0, 0, 0)


def mean_counts(counts: Sequence[Counts]) -> dict[str, float | None]:
    """{figure: mean over the frames where it is not None}; frames weigh equally."""
    names = ("iou", "precision", "recall", "extra_share")
    return {name: known_mean(getattr(c, name) for c in counts) for name in names}


def score(clip: DetailClip, masks: Painted) -> list[Row]:
    """Scores of a trained shot's frozen frames, one row per painted pair.

    Frames are rendered as in a take; instants are developed if the clip develops them.
    """
    return [row for row, _, _ in judged(clip, masks)]


def judged(clip: DetailClip, masks: Painted) -> Iterable[tuple[Row, View, Labels]]:
    """Yields (scores, frozen frame, labels [H, W] of its plate) of every painted pair."""
    # A shot with exact cameras has no solve record, and its frames have no lens distortion.
    lenses = load_plate_lenses(clip.shot) if clip.shot.solve_record.is_file() else {}
    scale = np.array([masks.width / clip.width, masks.height / clip.height], np.float32)
    straight = np.stack(np.meshgrid(np.arange(clip.width) + 0.5, np.arange(clip.height) + 0.5), -1).astype(np.float32)
    for pair in masks.pairs:
        image = clip.splats(pair.frame, pair.t_star)
        detailed = clip.detailed(pair.frame, pair.t_star, image)
        view = View(image, detailed, over(image.color, image.alpha), over(detailed.color, detailed.alpha))
        where = lenses[pair.frame].where(clip.width, clip.height) if lenses else straight
        labels = plate_labels(masks.labels(pair), where * scale)
        counts = {
            name: count(rejected.numpy(), labels)
            for name, rejected in zip(METHODS, _let_go(clip, pair.t_star, pair.frame, view), strict=True)
        }
        yield Row(pair.t_star, pair.frame, counts), view, labels


def _let_go(clip: DetailClip, t_star: int, frame: int, view: View) -> tuple[Tensor, Tensor]:
    """bool [H, W] rejected pixels of each of `METHODS`."""
    detailed = view.detailed
    # At the clip's own poses the own plate is the primary source. Otherwise no pixel of the own plate is kept.
    delivered = (detailed.matte < LET_GO) | (detailed.primary != frame)
    matte, frozen = clip.mattes(frame, t_star, view)
    return delivered, torch.maximum(matte, frozen) > MOVER_MATTE
