import importlib.util
import math

import numpy as np
import pytest
import torch

from benchmarks.report import colorvideovdp, stlpips
from benchmarks.report.metrics import (
    best_share_psnr,
    error_maps,
    gradient_energy,
    missing_metrics,
    paired,
    pareto_front,
    score,
    ssim_map,
    summarise,
)
from torch_backend.train.losses import psnr, ssim

needs_lpips = pytest.mark.skipif(stlpips.weights_path() is None, reason="stlpips-pytorch is not installed")
needs_flip = pytest.mark.skipif(importlib.util.find_spec("flip_evaluator") is None, reason="no flip-evaluator")
needs_vdp = pytest.mark.skipif(not colorvideovdp.available(), reason="cvvdp is not installed")


@pytest.fixture(scope="module")
def noisy():
    g = torch.Generator().manual_seed(1)
    truth = torch.rand(40, 56, 3, generator=g)
    return (truth + 0.1 * torch.randn(truth.shape, generator=g)).clamp(0, 1), truth


def test_psnr_and_ssim_are_those_of_the_training_station(noisy):
    image, truth = noisy
    whole = score(image, truth)["whole"]
    assert whole["psnr_db"] == pytest.approx(psnr(image, truth), abs=1e-6)
    assert whole["ssim"] == pytest.approx(float(ssim(image, truth)), abs=1e-5)
    assert whole["pixels"] == 40 * 56


def test_identical_pictures_have_finite_scores(noisy):
    whole = score(noisy[1], noisy[1])["whole"]
    assert (whole["psnr_db"], whole["ssim"]) == (120.0, pytest.approx(1.0))
    assert all(whole[name] in (None, 0.0) for name in ("st_lpips", "flip"))


def test_region_metrics_use_only_region_pixels():
    truth = torch.zeros(40, 40, 3)
    image = truth.clone()
    image[:, :20] = 0.1
    left = torch.zeros(40, 40, dtype=torch.bool)
    left[:, :20] = True
    rows = score(image, truth, {"left": left, "right": ~left})
    assert rows["left"]["psnr_db"] == pytest.approx(20.0, abs=1e-4)
    assert rows["right"]["psnr_db"] == 120.0
    assert rows["whole"]["psnr_db"] == pytest.approx(20 + 10 * math.log10(2), abs=1e-4)
    assert rows["left"]["ssim"] < rows["whole"]["ssim"] < rows["right"]["ssim"]


def test_an_empty_region_has_no_figure(noisy):
    none = torch.zeros(noisy[0].shape[:2], dtype=torch.bool)
    few = none.clone()
    few[0, :4] = True  # 4 of 2240 pixels, below the minimum share
    rows = score(*noisy, {"none": none, "few": few})
    assert rows["none"] == {"pixels": 0, "psnr_db": None, "ssim": None, "st_lpips": None, "flip": None}
    assert rows["few"]["psnr_db"] is None and rows["few"]["pixels"] == 4


def test_the_ssim_window_shrinks_with_the_picture():
    image = torch.rand(6, 30, 3, generator=torch.Generator().manual_seed(2))
    values = ssim_map(image, image.flip(0))
    assert values.shape == (6, 30)
    assert float(values.mean()) < 0.5 and bool((ssim_map(image, image) > 1 - 1e-9).all())


def test_sizes_that_differ_are_refused():
    with pytest.raises(ValueError, match="alike"):
        score(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))


@needs_lpips
def test_st_lpips_of_the_bundled_frame(frame, damaged):
    """The package's own network gives the same values on this frame within 1e-8 (2026-11-21, with CPU torch)."""
    values = {name: float(error_maps(image, frame)["st_lpips"].mean()) for name, image in damaged.items()}
    assert values["blur1"] == pytest.approx(0.158, abs=0.002)
    assert values["blur3"] == pytest.approx(0.687, abs=0.005)
    assert values["ghost"] == pytest.approx(0.150, abs=0.002)


@needs_lpips
def test_st_lpips_forgives_a_shift_that_psnr_does_not(frame):
    crop, aside = frame[100:292, 100:356], frame[100:292, 101:357]
    blurred = torch.nn.functional.avg_pool2d(crop.permute(2, 0, 1), 5, 1, 2).permute(2, 0, 1).permute(2, 0, 1)
    shifted, soft = score(aside, crop)["whole"], score(blurred, crop)["whole"]
    assert shifted["psnr_db"] < soft["psnr_db"] + 3
    assert shifted["st_lpips"] < 0.5 * soft["st_lpips"]


@needs_lpips
def test_st_lpips_map_lies_where_the_damage_is(frame):
    truth = frame[:128, :160]
    image = truth.clone()
    image[40:80, :60] = image[40:80, :60].flip(1)
    values = stlpips.distance_map(image, truth)
    assert values.shape == truth.shape[:2]
    assert float(values[40:80, :60].mean()) > 10 * float(values[:, 110:].mean())


@needs_flip
def test_flip_of_the_bundled_frame(frame, damaged):
    values = {name: float(error_maps(image, frame)["flip"].mean()) for name, image in damaged.items()}
    assert values["blur1"] == pytest.approx(0.082, abs=0.001)
    assert values["blur3"] == pytest.approx(0.230, abs=0.001)
    assert values["ghost"] == pytest.approx(0.212, abs=0.001)


@needs_vdp
def test_colorvideovdp_of_the_bundled_frame(frame, damaged):
    jod = {k: colorvideovdp.sequence_jod(v[None], frame[None], 10.0) for k, v in damaged.items()}
    assert colorvideovdp.sequence_jod(frame[None], frame[None], 10.0) == pytest.approx(10.0)
    assert jod["blur1"] == pytest.approx(9.27, abs=0.02)
    assert jod["blur3"] == pytest.approx(6.52, abs=0.03)
    assert jod["ghost"] == pytest.approx(6.75, abs=0.03)


@needs_vdp
def test_colorvideovdp_sees_flicker_that_no_single_frame_shows(frame):
    still = frame[::4, ::4][None].repeat(10, 1, 1, 1)
    flicker = (still + 0.03 * torch.tensor([1.0, -1.0]).repeat(5)[:, None, None, None]).clamp(0, 1)
    offset = (still + 0.03).clamp(0, 1)
    assert colorvideovdp.sequence_jod(flicker, still, 12.0) < colorvideovdp.sequence_jod(offset, still, 12.0) - 0.2


def test_what_is_missing_is_said():
    said = missing_metrics()
    assert ("st_lpips" in said) == (stlpips.weights_path() is None)
    assert all("not installed" in sentence for sentence in said.values())


def test_best_share_and_gradient_energy():
    truth = torch.zeros(10, 10, 3)
    image = truth.clone()
    image[0] = 1.0  # a tenth of the pixels is completely wrong
    assert best_share_psnr(image, truth, 0.9) == 120.0
    assert best_share_psnr(image, truth, 1.0) == pytest.approx(10.0)
    edge = torch.zeros(8, 8, 3)
    edge[:, 4:] = 1.0
    soft = edge.clone()
    soft[:, 4] = 0.5
    assert gradient_energy(soft) == pytest.approx(0.5 * gradient_energy(edge))


def test_summary_is_of_the_worst():
    more = summarise([1.0, None, 2.0, 3.0, 4.0])
    assert more is not None and (more.count, more.mean, more.worst, more.bottom_25) == (4, 2.5, 1.0, 1.0)
    assert (more.bottom_50, more.bottom_75) == (1.5, 2.0)
    less = summarise([1.0, 2.0, 3.0, 4.0], more_is_better=False)
    assert less is not None and (less.worst, less.bottom_50) == (4.0, 3.5)
    assert summarise([None]) is None


def rows(offset, runs=4, frames=5, spread=0.0, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    table = {}
    for run in range(runs):
        shift = offset + spread * (-1) ** run
        for pose in range(frames):
            table[("scene", "exact", run, 0, pose)] = 20 + pose + shift + noise * rng.standard_normal()
    return table


def test_a_clear_gain_is_a_win_and_its_mirror_a_loss():
    a, b = rows(1.0, noise=0.1), rows(0.0)
    won, lost = paired(a, b), paired(b, a)
    assert (won.verdict, lost.verdict, won.unit, won.units) == ("win", "loss", "runs", 4)
    assert won.mean == pytest.approx(1.0, abs=0.1)
    assert paired(a, b, more_is_better=False).verdict == "loss"


def test_disagreeing_runs_are_undecided_for_any_frame_count():
    """Two runs differ by +3, two by -1: 400 frames suggest +1 with a tiny error, the four runs do not."""
    result = paired(rows(1.0, frames=100, spread=2.0, noise=0.01), rows(0.0, frames=100))
    assert result.mean > 5 * result.frame_se
    assert result.verdict == "undecided" and result.se == pytest.approx(2 / math.sqrt(3), abs=0.05)


def test_few_runs_are_compared_by_freezes_then_by_frames():
    a = {("s", "exact", 0, t, p): 1.0 + 0.1 * t for t in range(4) for p in range(3)}
    assert paired(a, dict.fromkeys(a, 0.0)).unit == "freezes"
    few = {k: v for k, v in a.items() if k[3] < 2}
    assert paired(few, dict.fromkeys(few, 0.0)).unit == "frames"
    one = {("s", "exact", 0, 0, 0): 1.0}
    assert paired(one, {("s", "exact", 0, 0, 0): 0.0}).verdict == "undecided"
    assert paired(one, {}) is None
    three = {("s", "exact", 0, 0, p): 5.0 + 0.01 * p for p in range(3)}  # three frames, 500 standard errors from zero
    assert paired(three, dict.fromkeys(three, 0.0)).verdict == "undecided"


def test_the_error_of_equal_clusters_is_that_of_their_means():
    a = {("s", "exact", s, t, p): float(s == 3) + 0.01 * p for s in range(4) for t in range(2) for p in range(3)}
    means = [np.mean([v for k, v in a.items() if k[2] == s]) for s in range(4)]
    assert paired(a, dict.fromkeys(a, 0.0)).se == pytest.approx(np.std(means, ddof=1) / 2)


def test_pareto_front():
    assert pareto_front([1, 2, 3, 2, 1], [5, 4, 9, 7, 5]) == [0, 3, 2]
    assert pareto_front([], []) == []
