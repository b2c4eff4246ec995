"""Memory plans of runs on GPUs with 4, 6, 8 or 12 GB; tests/backend/card/test_card.py uses a simulated GPU."""

import pytest

from torch_backend.contract import JobError, TrainParams
from torch_backend.train.config import config_from_params
from torch_backend.train.memory import PIECE, MemoryPlan, gaussian_bytes, peak_bytes, plan_memory

SIZE = (1920, 1080)
FRAMES = 300
IMAGES = FRAMES * SIZE[0] * SIZE[1] * 6
DESKTOP = 900_000_000
"""Bytes of a GPU that a desktop and a driver use."""


def plan(card_gb: float, method: str = "auto", gaussians: int = 1_000_000, **more: int) -> MemoryPlan:
    config = config_from_params(TrainParams(preset="final", method=method, max_gaussians=gaussians))
    return plan_memory(config, SIZE, FRAMES, IMAGES, int(card_gb * 1e9) - DESKTOP, **more)


def test_a_large_card_is_not_reckoned_small():
    found = plan(24)
    assert found == MemoryPlan(1_000_000, None, True, "")


@pytest.mark.parametrize("card_gb", [4, 6, 8, 12])
@pytest.mark.parametrize("method", ["static", "auto", "mlp", "control_points"])
def test_what_is_planned_fits(card_gb, method):
    found = plan(card_gb, method)
    config = config_from_params(TrainParams(preset="final", method=method))
    frames = IMAGES if found.on_card else 0
    whole = found.pieces is None
    needed = peak_bytes(config, SIZE[0] * SIZE[1], FRAMES, found.gaussians, is_single_call=whole, frames=frames)
    assert needed * 1.15 + 450e6 <= card_gb * 1e9 - DESKTOP
    assert found.gaussians <= 1_000_000


def test_smaller_gpus_get_fewer_gaussians_with_a_note():
    plans = {card: plan(card) for card in (4, 6, 8, 12)}
    counts = [found.gaussians for found in plans.values()]
    assert counts == sorted(counts) and counts[0] < 1_000_000
    assert plans[4].pieces == PIECE and f"at most {counts[0]:,}" in plans[4].sentence
    assert "4.0 GB" not in plans[4].sentence and "3.1 GB free" in plans[4].sentence
    assert plans[12] == MemoryPlan(1_000_000, None, False, ""), "12 GB hold a million, with the frames in host memory"


def test_a_small_run_fits_every_card_as_it_is():
    config = config_from_params(TrainParams(preset="preview"))
    found = plan_memory(config, (320, 180), 74, 74 * 320 * 180 * 6, 4_000_000_000 - DESKTOP)
    assert found == MemoryPlan(config.densify.budget, None, True, "")


def test_frames_that_would_fill_a_card_wait_in_host_memory():
    config = config_from_params(TrainParams(preset="preview"))
    found = plan_memory(config, (320, 180), 74, 5_000_000_000, 8_000_000_000)
    assert not found.on_card and not found.sentence and found.gaussians == config.densify.budget


def test_too_little_is_said_in_words():
    with pytest.raises(JobError, match="0.5 GB free, too little to train 1,000,000 Gaussians on images of 1920 x 1080"):
        plan(1.4)
    with pytest.raises(JobError, match="too little"):  # a resumed run cannot have fewer Gaussians than it has
        plan_memory(
            config_from_params(TrainParams(preset="final")), SIZE, FRAMES, IMAGES, 3_000_000_000, gaussians=1_000_000
        )


def test_more_harmonics_and_more_frames_take_more():
    low, high = (config_from_params(TrainParams(preset=preset)) for preset in ("preview", "final"))
    assert gaussian_bytes(low, 74) < gaussian_bytes(high, 74) < gaussian_bytes(high, 256) == gaussian_bytes(high, 999)
