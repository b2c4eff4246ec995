"""The depth benchmark: detection of occlusion boundaries, and figures of known depth errors."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from benchmarks.depth import REGIONS, Pooled, add_frame, mean_of, occlusion_edges, table


def floor_and_box() -> tuple[Tensor, Tensor]:
    """(depth [40, 60] of a floor that recedes to 20 m with a box at 1.5 m in front, bool mask of the box)."""
    rows = torch.arange(40.0) + 2.0
    depth = (80.0 / rows)[:, None].repeat(1, 60)
    box = torch.zeros(40, 60, dtype=torch.bool)
    box[10:30, 20:40] = True
    return torch.where(box, 1.5, depth), box


def test_edges_are_occlusions_and_not_slopes() -> None:
    depth, box = floor_and_box()
    edges = occlusion_edges(depth)
    assert edges[20, 20] and edges[20, 39] and edges[10, 30] and edges[29, 30]
    assert not (edges & ~box).any(), "the floor's far rows differ by more than 5 % and are no boundary"


def test_figures_of_known_errors() -> None:
    truth, box = floor_and_box()
    truth[:2] = float("inf")
    nothing = torch.zeros_like(box)
    pooled = {region: Pooled() for region in REGIONS}
    add_frame(pooled, truth * torch.where(box, 1.02, 1.004), truth, box, nothing, torch.full_like(truth, 0.02))
    still, moving = pooled["still"].figures(), pooled["moving"].figures()
    assert still["median"] == pytest.approx(0.004, rel=1e-3) and still["beyond"] == 0.0
    assert moving["median"] == pytest.approx(0.02, rel=1e-3) and moving["beyond"] == 1.0
    assert moving["boundary_f"] == 1.0 and moving["within_2_sigma"] == 1.0
    assert moving["within_1_sigma"] == 0.0, "0.03 off, and sure to 0.02"
    assert "2.00 | 100.0 | 1.000" in table({"box": mean_of([pooled_figures(pooled), pooled_figures(pooled)])})[-1]


def pooled_figures(pooled: dict[str, Pooled]) -> dict[str, dict[str, float | None]]:
    return {region: of.figures() for region, of in pooled.items()}


@pytest.mark.parametrize(("shift", "score"), [(1, 1.0), (4, 0.5)])
def test_one_pixel_boundary_error_is_found(shift: int, score: float) -> None:
    truth, box = floor_and_box()
    pooled = Pooled()
    pooled.add_boundary(torch.where(torch.roll(box, shift, 1), 1.5, 80.0 / (torch.arange(40.0) + 2.0)[:, None]), truth,
                        torch.ones_like(box))  # fmt: skip
    found = pooled.figures()["boundary_f"]
    assert found is not None and (found == 1.0 if score == 1.0 else found < 0.9)
