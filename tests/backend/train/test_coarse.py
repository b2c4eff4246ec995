"""Coarse to fine: what the first part of a run is trained on, and that nothing else knows of it."""

import pytest
import torch

from torch_backend.contract import TrainParams
from torch_backend.scene import load_images, load_scene
from torch_backend.train import PRESETS, config_from_params
from torch_backend.train.coarse import picture_sizes
from torch_backend.train.config import config_from_json, config_to_json
from torch_backend.train.trainer import Trainer

WIDTH, HEIGHT = 96, 72


@pytest.fixture
def scene(world):
    return load_scene(world.shot)


@pytest.fixture
def begin(scene, quiet):
    def make(method="auto", **changes):
        config = config_from_params(TrainParams(iterations=40, max_gaussians=800, method=method))
        for name, value in changes.items():
            setattr(config, name, value)
        return Trainer(scene, load_images(scene, scene.solved, WIDTH, HEIGHT), scene.solved, config, quiet())

    return make


def go_on(trainer, steps):
    sizes = []
    for _ in range(steps):
        trainer.schedule_events()
        sizes.append((trainer.pictures.width, trainer.pictures.height))
        trainer.step()
        trainer.iteration += 1
    return sizes


def test_a_coarse_picture_is_the_mean_of_its_pixels_and_its_camera_sees_the_same(scene):
    whole, coarse = picture_sizes(scene, WIDTH, HEIGHT, torch.device("cpu"))
    image = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    assert whole.of(image) is image
    small = coarse.of(image)
    assert small.shape == (36, 48, 3)
    assert torch.allclose(small[5, 7], image[10:12, 14:16].mean((0, 1)))
    point = torch.tensor([0.3, -0.2, 2.0])
    seen, seen_small = (size.Ks[0] @ point / point[2] for size in (whole, coarse))
    assert torch.allclose(0.5 * seen[:2], seen_small[:2], atol=1e-4)
    assert coarse.area == 4.0
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[10, 14] = True
    assert coarse.any_of(mask).nonzero().tolist() == [[5, 7]]
    assert whole.any_of(mask) is mask


def test_pictures_that_would_be_too_small_stay_whole(scene):
    whole, coarse = picture_sizes(scene, 64, 48, torch.device("cpu"))
    assert coarse is whole


@pytest.mark.parametrize(("method", "small"), [("auto", 12), ("static", 12), ("hexplane", 0)])
def test_the_first_steps_of_our_own_runs_are_coarse(begin, method, small):
    assert go_on(begin(method), 40) == [(48, 36)] * small + [(96, 72)] * (40 - small)


def test_growth_waits_for_whole_pictures():
    for preset in PRESETS:
        ours = config_from_params(TrainParams(preset=preset))
        assert ours.densify.start == ours.coarse <= ours.gate.harden < ours.densify.stop
        published = config_from_params(TrainParams(preset=preset, method="hexplane"))
        assert (published.coarse, published.densify.start, published.densify.stop) == (0.0, 0.06, 0.5)


def test_a_resumed_run_goes_on_at_its_size(begin, tmp_path):
    """To the bit, from the middle of the coarse part and beyond its end."""
    straight = begin()
    go_on(straight, 8)
    straight.save(tmp_path / "checkpoint.safetensors")
    resumed = begin()
    resumed.restore(tmp_path / "checkpoint.safetensors")
    assert go_on(straight, 8) == go_on(resumed, 8) == [(48, 36)] * 4 + [(96, 72)] * 4
    for name, value in straight.model.gaussians.params.items():
        assert torch.equal(value, resumed.model.gaussians.params[name])


def test_a_gaussian_counts_as_seen_by_what_it_paints_of_the_whole_picture(begin, monkeypatch):
    trainer, weights = begin(), []
    module = __import__(Trainer.__module__, fromlist=["mark_seen"])
    monkeypatch.setattr(module, "mark_seen", lambda _, __, weight: weights.append(float(weight.sum())))
    go_on(trainer, 1)
    trainer.config.coarse = 0.0
    go_on(trainer, 1)
    assert weights[0] == pytest.approx(weights[1], rel=0.1)


def test_what_is_held_out_is_measured_whole_and_probes_as_they_are_trained_on(begin, scene):
    trainer = begin()
    index = scene.solved[3]
    image = trainer.images[3].float()
    shown = trainer.render_frame(index)
    assert shown.shape == (HEIGHT, WIDTH, 3)
    mse = (shown.clamp(0, 1).double() - image.double()).square().mean()
    assert trainer.heldout_psnr([index], image[None]) == pytest.approx(float(-10 * torch.log10(mse)))
    coarse = trainer.render_frame(index, size=trainer.pictures)
    mse = (coarse.clamp(0, 1).double() - trainer.pictures.of(image).double()).square().mean()
    assert trainer.probe_psnr([3]) == pytest.approx(float(-10 * torch.log10(mse)))


def test_runs_of_before_have_no_coarse_part():
    plain = config_to_json(config_from_params(TrainParams()))
    del plain["coarse"]
    assert config_from_json(plain).coarse == 0.0
