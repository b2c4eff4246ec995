"""The bench of depth maps: maps hold truth by scale and shift, figures are those that were judged."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from benchmarks.depth_maps import FARTHEST, NOISE, SCALE, SHIFT, table, write_maps
from torch_backend.footage.depth_maps import read_map
from torch_backend.train.depth_fit import fit_sequence


def test_maps_are_truth_by_scale_and_shift_and_empty_in_the_sky(tmp_path):
    metres = np.linspace(1.0, 20.0, 64 * 48, dtype=np.float32).reshape(48, 64)
    metres[:4] = np.inf
    scene = SimpleNamespace(frames=[1, 2], frame_depth=lambda frame: metres)
    folder = write_maps(scene, tmp_path / "maps")
    read = read_map(folder / "000002.png")
    assert np.isnan(read[:4]).all() and np.isfinite(read[4:]).all()
    fit = fit_sequence({2: (read[4:].ravel().astype(np.float64), metres[4:].ravel().astype(np.float64))})
    assert fit is not None and fit.kind == "depth"
    scaled = fit.frames[2].slope * (SCALE * FARTHEST + SHIFT)
    assert abs(scaled / SCALE - 1.0) < NOISE


def test_the_table_says_from_and_to():
    def row(median):
        return {"median": median, "beyond": 0.5, "splats_db": 24.0, "delivered_db": None}

    told = table({"arm, 0": {"without": {r: row(0.05) for r in ("moving", "still")},
                             "with": {r: row(0.02) for r in ("moving", "still")}}})  # fmt: skip
    assert told[2] == "| arm, 0 | moving | 5.00 to 2.00 | 50.00 to 50.00 | 24.00 to 24.00 | – |"
