"""Masks that grow, shrink and close, against definitions that take each pixel by itself."""

import numpy as np
import pytest
import torch

from torch_backend.freeze.views.regions import enclosed, grown, larger, opened
from torch_backend.freeze.views.reproject import narrowed, widened


def around(matte: np.ndarray, by: int, pick) -> np.ndarray:
    h, w = matte.shape
    out = np.empty_like(matte)
    for y in range(h):
        for x in range(w):
            out[y, x] = pick(matte[max(0, y - by) : y + by + 1, max(0, x - by) : x + by + 1])
    return out


@pytest.mark.parametrize("by", [0, 1, 2, 3, 5, 20])
@pytest.mark.parametrize("kind", [np.float32, bool])
def test_each_pixel_is_the_greatest_or_least_of_its_square(by, kind):
    rng = np.random.default_rng(by)
    matte = rng.normal(size=(9, 14)).astype(np.float32)
    matte = matte if kind is np.float32 else matte > 1.0
    assert np.array_equal(widened(torch.from_numpy(matte), by).numpy(), around(matte, by, np.max))
    assert np.array_equal(narrowed(torch.from_numpy(matte), by).numpy(), around(matte, by, np.min))


def test_what_is_thin_leads_nowhere():
    where = torch.zeros(40, 80, dtype=torch.bool)
    where[10:30, 4:30] = where[10:30, 50:76] = True
    where[19:22, 30:50] = True  # a string from one square to the other
    seeds = torch.zeros_like(where)
    seeds[18:22, 6:10] = True
    assert opened(where, 2).sum() == 2 * 20 * 26
    reached = grown(seeds, where, 200, thin=2)
    assert reached[10:30, 4:30].all() and not reached[10:30, 50:76].any()
    assert grown(seeds, where, 200)[10:30, 50:76].any(), "else the string leads nowhere anyhow"


def test_growing_ends_at_its_reach():
    where = torch.zeros(20, 100, dtype=torch.bool)
    where[6:14] = True
    seeds = where.clone()
    seeds[:, 10:] = False
    columns = grown(seeds, where, 16).any(dim=0).nonzero()
    assert abs(int(columns.max()) - (9 + 16)) <= 2


def test_what_is_enclosed_stands_on_its_ground_all_around_and_is_no_speck():
    mask = torch.zeros(60, 120, dtype=torch.bool)
    mask[20:40, 10:30] = mask[20:40, 60:80] = mask[50:53, 100:103] = True
    ground = torch.ones_like(mask)
    ground[:, 70:90] = False  # half of what surrounds the second one
    assert torch.equal(enclosed(mask, ground, 3, 0.9, 20.0) == 1.0, mask & (torch.arange(120) < 40))
    assert torch.equal(enclosed(mask, ground, 3, 0.4, 20.0) == 1.0, mask & (torch.arange(120) < 90))
    assert (enclosed(mask, ground, 3, 0.4) == mask).all()
    assert not enclosed(torch.zeros_like(mask), ground, 3, 0.0).any()


def test_regions_of_too_few_pixels_are_dropped_whole():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[2:6, 2:7] = mask[10:13, 10:16] = True
    mask[6, 7] = True  # hangs on the first by its corner
    assert torch.equal(larger(mask, 10.0), mask.float()) and not larger(mask, 30.0).any()
    mask[14:19, 2:12] = True
    assert torch.equal(larger(mask, 30.0), (mask & (torch.arange(20)[:, None] >= 14)).float())
