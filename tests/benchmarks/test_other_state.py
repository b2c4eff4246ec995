"""Painted masks: valid, drawn at their corners, and scored like a count by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.other_state import CHANGED, SAME, UNSCORED, Painted, Pair, Polygon, load_masks, plate_labels
from benchmarks.other_state.masks import CLIPS, fill_polygon
from benchmarks.other_state.scores import count, mean_counts, pooled_counts


@pytest.mark.parametrize("clip", CLIPS)
def test_masks_are_sound(clip: str) -> None:
    masks = load_masks(clip)
    assert masks.clip == clip and len(masks.sha256) == 64
    assert len({(pair.t_star, pair.frame) for pair in masks.pairs}) == len(masks.pairs) == 10
    for pair in masks.pairs:
        assert pair.frame != pair.t_star
        for polygon in pair.polygons:
            where = f"{clip}, t* {pair.t_star}, frame {pair.frame}: {polygon.shows}"
            assert len(polygon.points) >= 3 and polygon.shows, where
            assert (polygon.points >= 0).all() and (polygon.points <= (masks.width, masks.height)).all(), where


def box(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], np.float64)


def test_pixels_whose_centres_lie_inside_are_painted() -> None:
    labels = np.zeros((8, 10), np.uint8)
    fill_polygon(labels, box(2, 3, 5.6, 6.4), CHANGED)
    assert labels[3:6, 2:6].all() and labels.sum() == 12
    concave = np.array([(0, 0), (10, 0), (10, 8), (5, 0.1), (0, 8)], np.float64)
    labels[:] = 0
    fill_polygon(labels, concave, CHANGED)
    assert labels[6, 0] == CHANGED and labels[6, 9] == CHANGED and labels[6, 5] == SAME


def test_later_polygons_replace_earlier_ones_and_borders_are_not_scored() -> None:
    polygons = (Polygon(box(0, 0, 20, 40), "a person", CHANGED), Polygon(box(0, 20, 20, 40), "a soft edge", UNSCORED))
    masks = Painted("clip", "", 40, 40, (Pair(1, 2, 2, polygons),))
    labels = masks.labels(masks.pairs[0])
    assert labels[5, 5] == CHANGED and labels[30, 5] == UNSCORED and labels[5, 30] == SAME
    # Edges at x = 20 and y = 20: two pixels on either side are not scored.
    assert (labels[5, 16:24] == [CHANGED, CHANGED, *[UNSCORED] * 4, SAME, SAME]).all()
    assert (labels[16:24, 5] == [CHANGED, CHANGED, *[UNSCORED] * 6]).all()


def test_labels_follow_the_lens() -> None:
    labels = np.zeros((4, 6), np.uint8)
    labels[1, 2] = CHANGED
    x, y = np.meshgrid(np.arange(6) + 0.5, np.arange(4) + 0.5)
    where = np.stack([x + 1.0, y], axis=-1).astype(np.float32)
    found = plate_labels(labels, where)
    assert found[1, 1] == CHANGED and (found == CHANGED).sum() == 1
    assert (found[:, 5] == UNSCORED).all(), "the last column looks past the source frame"


def test_scores_are_those_counted_by_hand() -> None:
    labels = np.full((10, 10), SAME, np.uint8)
    labels[:4] = CHANGED
    labels[4] = UNSCORED
    is_let_go = np.zeros((10, 10), bool)
    is_let_go[2:6] = True
    counts = count(is_let_go, labels)
    assert vars(counts) == {"both": 20, "extra": 10, "missed": 20, "right": 40}
    assert counts.iou == 0.4 and counts.recall == 0.5 and counts.extra_share == 0.2
    assert counts.precision == pytest.approx(2 / 3)
    unchanged = count(is_let_go, np.full((10, 10), SAME, np.uint8))
    assert unchanged.iou is None and unchanged.precision is None and unchanged.extra_share == 0.4
    means = mean_counts([counts, unchanged])
    assert means["iou"] == 0.4, "a frame in which nothing changed has no IoU"
    assert means["extra_share"] == pytest.approx(0.3)
    assert pooled_counts([counts, unchanged]).extra_share == pytest.approx(50 / 150)


def test_a_clip_without_masks_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="sitting"):
        load_masks("garden", tmp_path)
