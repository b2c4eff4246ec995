"""Figures of plate detail, on pictures with known results."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, shift

from benchmarks.detail import means, picture_figures, table
from benchmarks.detail_figures import (
    Flow,
    Histogram,
    induced_places,
    inside,
    mean_difference,
    sampled,
    seen_again,
    still_pixels,
    textured,
    unexplained_flow,
    unsteadiness,
)
from benchmarks.report.metrics import gradient_magnitude

HEIGHT, WIDTH = 120, 160


@pytest.fixture(scope="module")
def scene() -> torch.Tensor:
    """[H, W, 3] picture with structure in every direction, like a photograph."""
    rng = np.random.default_rng(4)
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (2, 2, 0))
    return torch.from_numpy((0.5 + 0.15 * noise / noise.std()).clip(0.02, 0.98)).float()


@pytest.fixture
def grid() -> torch.Tensor:
    """[H, W, 2] pixel centres of a picture."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    return torch.stack([x, y], dim=2)


def moved(image: torch.Tensor, x: float) -> torch.Tensor:
    """Picture shifted to the right by `x` pixels."""
    return torch.from_numpy(shift(image.numpy(), (0, x, 0), order=3, mode="nearest")).float().clamp(0, 1)


def test_figures_of_one_frame_are_what_they_are_called(scene):
    image = scene.clone()
    bad = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    bad[: HEIGHT // 10] = True  # a tenth of the picture: a person who has moved
    image[bad], image[~bad] = 1.0 - scene[bad], (scene + 0.01)[~bad].clamp(0, 1)
    found = picture_figures(image, scene, ~bad)
    assert found["best_90_db"] == pytest.approx(40.0, abs=0.02) == found["still_db"]
    error = (image.double() - scene.double()).square().mean()
    assert found["whole_db"] == pytest.approx(float(-10 * torch.log10(error)), abs=1e-6) and found["whole_db"] < 25
    assert picture_figures(image, scene, torch.zeros_like(bad))["still_db"] is None


def test_shifted_and_soft_pictures_are_distinguished(scene):
    still = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    same = picture_figures(scene, scene, still)
    assert same["gradient"] == 1.0 and same["whole_db"] == same["best_90_db"] == 120.0
    by = [picture_figures(moved(scene, x), scene, still) for x in (0.25, 1.0)]
    assert by[0]["best_90_db"] > by[1]["best_90_db"] + 6.0 and by[1]["gradient"] == pytest.approx(1.0, abs=0.05)
    soft = torch.from_numpy(gaussian_filter(scene.numpy(), (2, 2, 0)))
    assert picture_figures(soft, scene, still)["gradient"] < 0.7


def test_the_gradient_of_a_slope_is_its_slope():
    slope = torch.linspace(0.0, 0.5, 101)[None, :, None].expand(50, 101, 3)
    inner = torch.zeros(50, 101, dtype=torch.bool)
    inner[1:-1, 1:-1] = True
    assert gradient_magnitude(slope, inner) == pytest.approx(0.005, rel=1e-5)
    both = slope + torch.linspace(0.0, 0.49, 50)[:, None, None] * (12 / 9.8 / 2)
    assert gradient_magnitude(both, inner) == pytest.approx(float(np.hypot(0.005, 0.01 * 12 / 9.8 / 2)), rel=1e-4)


def test_still_is_far_from_movers_and_known():
    matte = torch.zeros(40, 60)
    matte[:, :10] = 1.0  # moving
    matte[:, 50:] = 128 / 255  # unknown
    still = still_pixels(matte)
    assert not still[:, :18].any() and still[:, 18:50].all() and not still[:, 50:].any()
    unknown = torch.zeros(40, 60, dtype=torch.bool)
    unknown[20, 30] = True
    still = still_pixels(matte, unknown)
    assert not still[12:29, 22:39].any() and still[11, 30] and still[20, 39]


def test_points_project_into_the_second_camera():
    rng = np.random.default_rng(1)
    depth = rng.uniform(2.0, 5.0, (6, 8))
    K = np.array([[50.0, 0, 4.2], [0, 52.0, 2.9], [0, 0, 1]])
    a, b = np.eye(4), np.eye(4)
    turn = 0.1
    b[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    a[:3, 3], b[:3, 3] = [0.1, 0.0, 0.3], [-0.2, 0.05, -0.1]
    places, is_inside = induced_places(*(torch.from_numpy(v) for v in (depth, a, K, b, 2 * K)))
    for y, x in ((0, 0), (3, 5), (5, 7)):
        point = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1.0] * depth[y, x]
        point = b @ np.linalg.inv(a) @ [*point, 1.0]
        seen = 2 * K @ point[:3]
        np.testing.assert_allclose(places[y, x], seen[:2] / seen[2], atol=2e-4)
        assert is_inside[y, x] == pytest.approx(point[2], abs=1e-5)
    b[2, 3] = -100.0
    places, is_inside = induced_places(*(torch.from_numpy(v) for v in (depth, a, K, b, K)))
    assert (is_inside < 0).all() and not inside(places, 8, 6).any()


def test_what_another_surface_hides_is_not_seen_again(grid):
    depth = torch.full((HEIGHT, WIDTH), 4.0)
    depth[:, 80:] = 2.0
    seen = seen_again(grid, torch.full((HEIGHT, WIDTH), 4.0), depth)
    assert seen[5:-5, 5:78].all() and not seen[:, 82:].any() and not seen[:, 0].any()
    assert sampled(depth, grid, nearest=True).equal(depth)


def test_a_mover_in_a_frozen_shot_is_caught_and_an_exposure_is_not(scene, grid):
    """The camera pans by 5.4 pixels. The honest picture has no other motion; in the other, a hand moves by 3 more."""
    panned = grid + torch.tensor([5.4, 0.0])
    both = inside(panned, WIDTH, HEIGHT, 4.0)
    honest = (moved(scene, 5.4) * 0.93).clamp(0, 1)
    hand = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hand[40:80, 60:100] = True
    waving = torch.where(hand.roll(5, 1)[..., None], moved(scene, 8.4), moved(scene, 5.4))
    flow = Flow()
    judged = textured(scene) & both
    assert judged[hand].float().mean() > 0.9
    left = unexplained_flow(flow, scene, honest, panned, both)
    assert left[judged].quantile(0.99) < 0.15
    left = unexplained_flow(flow, scene, waving, panned, both)
    inner = torch.zeros_like(hand)
    inner[48:72, 68:92] = True
    assert left[inner].median() == pytest.approx(3.0, abs=0.3)
    far = torch.ones_like(hand)
    far[24:96, 44:116] = False
    assert left[judged & hand].quantile(0.99) > left[judged & far].quantile(0.99) + 2.0
    steady, restless = (unsteadiness(scene, b, panned)[hand].mean() for b in (moved(scene, 5.4), waving))
    assert steady < 0.01 and restless > 5 * steady


def test_light_that_wanders_over_a_wall_is_no_motion(scene):
    """A poster on a plain wall, seen twice from one place; the second time, one side of the picture is 7 % darker."""
    wall = torch.full((240, 320, 3), 0.6)
    wall[60:180, 80:240] = scene
    y, x = torch.meshgrid(torch.arange(240) + 0.5, torch.arange(320) + 0.5, indexing="ij")
    darker = wall * torch.linspace(0.93, 1.0, 320)[None, :, None]
    left = unexplained_flow(Flow(), wall, darker, torch.stack([x, y], dim=2), torch.ones(240, 320, dtype=torch.bool))
    assert left[textured(wall)].quantile(0.99) < 0.2


def test_a_flat_wall_is_not_judged_by_flow(scene):
    flat = torch.full((HEIGHT, WIDTH, 3), 0.5)
    flat += torch.randn(flat.shape, generator=torch.Generator().manual_seed(0)) * 1.5 / 255
    edge = torch.zeros(HEIGHT, WIDTH, 3)
    edge[:, 80:] = 1.0  # structure in only one direction: flow along it is a guess
    assert textured(flat).float().mean() < 0.001 and not textured(edge)[20:-20].any()
    assert textured(scene).float().mean() > 0.8


def test_pooled_percentiles_equal_those_of_all_values():
    rng = np.random.default_rng(2)
    values = [rng.exponential(1.5, n) for n in (500, 3000, 40)]
    histogram = Histogram()
    assert histogram.percentile(99) is None
    for part in values:
        histogram.add(torch.from_numpy(part))
    together = np.concatenate(values)
    assert histogram.count == len(together)
    for percent in (50, 99):
        assert histogram.percentile(percent) == pytest.approx(np.percentile(together, percent), abs=0.06)


def test_difference_is_measured_inside_the_mask():
    a, b = torch.zeros(4, 4, 3), torch.zeros(4, 4, 3)
    b[0] = 0.5
    where = torch.zeros(4, 4, dtype=torch.bool)
    assert mean_difference(a, b, where) is None
    where[:2] = True
    assert mean_difference(a, b, where) == pytest.approx(0.25)


def test_the_table_has_a_row_per_freeze_and_variant():
    def row(frame: int, value: float, still: float | None):
        figures = {"whole_db": value, "best_90_db": value + 5, "still_db": still, "gradient": 0.9}
        return {"frame": frame, "still_share": 0.5, "splats": figures, "withheld": figures, "delivered": figures}

    rows = [row(9, 20.0, None), row(17, 22.0, 30.0)]
    assert means(rows)["withheld"] == {"whole_db": 21.0, "best_90_db": 26.0, "still_db": 30.0, "gradient": 0.9}
    freezes = [{"t_star": t, "frames": rows, "mean": means(rows)} for t in (8, 45)]
    lines = table("sitting", {"freezes": freezes, "instants_differ_255": 0.125, "motion_from": "the gate"})
    assert "| t* 45, delivered | 21.00 | 26.00 | 30.00 | 0.90 |" in lines and len(lines) == 2 + 3 * 3 + 2
    assert "50 % of the pixels, by the gate" in lines[-1] and "0.125 / 255" in lines[-1]
