"""A run that explains its frames badly says so; one that explains them does not."""

import sys

import numpy as np
import pytest

from torch_backend.contract import TrainParams, read_json
from torch_backend.footage.images import read_png, write_png
from torch_backend.train import train_shot


def walk_through(shot):
    """Paints somebody over the frames who crosses the picture, with other folds in the clothes on every frame."""
    random = np.random.default_rng(3)
    files = sorted(shot.frames.glob("*.png"))
    for n, path in enumerate(files):
        pixels = read_png(path)
        left = round(n / len(files) * pixels.shape[1] * 0.8)
        person = pixels[8:, left : left + 14]
        person[:] = random.integers(0, 256, (1, 1, 3)) * np.linspace(0.4, 1.0, len(person))[:, None, None]
        write_png(path, pixels)


def test_a_run_of_people_who_hold_still_is_good(trained):
    world, summary = trained
    assert (summary["quality"], summary["quality_on"]) == ("Good", "held-out frames")
    assert read_json(world.shot.run("main") / "summary.json")["quality"] == "Good"


@pytest.mark.parametrize("holdout", [8, 0])
def test_somebody_who_walks_through_is_told(tmp_path, quiet, holdout):
    world = sys.modules[quiet.__module__].build_world(tmp_path)
    params = TrainParams(iterations=200, max_gaussians=1500, holdout=holdout)
    walk_through(world.shot)
    report = quiet()
    summary = train_shot(world.shot, params, report)
    assert summary["quality"] == "Poor"
    assert summary["worst_tenth_psnr_db"] <= summary["median_psnr_db"]
    assert summary["quality_on"] == ("held-out frames" if holdout else "training frames")
    (told,) = [e for e in report.events if e[0] == "warning" and "poor" in e[1]]
    assert f"{summary['median_psnr_db']:.1f} dB on half of its {summary['quality_on']}" in told[1]
    assert "walks through" in told[2] and "solve" in told[2]
