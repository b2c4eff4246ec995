"""Training pictures: working frames, or the source's own on a GPU; a run keeps the kind that it started with."""

import json

import numpy as np
import pytest
import torch

from tests.backend.conftest import film
from torch_backend.contract import Cancelled, JobError, TrainParams
from torch_backend.footage.plates import Plates
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params, identity, train_shot
from torch_backend.train.config import config_from_json, config_to_json
from torch_backend.train.pictures import pictures_of, training_size


@pytest.fixture
def shot(tmp_path, world):
    """The tiny shot, filmed at twice the size of its solve."""
    rng = np.random.default_rng(3)

    def picture_of(n):
        small = np.kron(world.image(n, n / 15).numpy(), np.ones((2, 2, 1), np.float32))
        return (255 * small * rng.uniform(0.8, 1.0, (96, 128, 1))).astype(np.uint8)

    return film(world, tmp_path, picture_of, paint=False, working_height=48)


def final(on_card, **changes):
    return config_from_params(TrainParams(preset="final", **changes), on_card)


def test_final_preset_uses_gpu_numbers_unless_overridden():
    card, processor = final(True), final(False)
    assert (card.width, card.densify.budget, card.iterations, card.plates) == (1920, 1_000_000, 30_000, True)
    assert (processor.width, processor.densify.budget, processor.plates) == (0, 400_000, False)
    chosen = final(True, width=640, max_gaussians=5000, iterations=300)
    assert (chosen.width, chosen.densify.budget, chosen.iterations) == (640, 5000, 300)
    for name in ("preview", "standard"):
        same = [config_from_params(TrainParams(preset=name), on_card) for on_card in (False, True)]
        assert same[0] == same[1]


def test_the_processors_runs_are_known_by_what_they_were_known_by_and_a_cards_come_back():
    assert "plates" not in config_to_json(final(False)), "else every run of before would be trained anew"
    for on_card in (False, True):
        assert config_from_json(config_to_json(final(on_card))) == final(on_card)


def test_gpu_training_reads_source_frames_in_any_order(shot, quiet):
    scene, plates = load_scene(shot), Plates(shot)
    assert scene.width == 64 and plates.width == 128
    report = quiet()
    pictures = pictures_of(shot, scene, final(True), report)
    assert pictures.size == (128, 96) and report.events == []
    images = pictures.load([9, 2, 15])
    assert images.shape == (3, 96, 128, 3) and images.dtype == torch.float16
    for image, index in zip(images, (9, 2, 15), strict=True):
        assert torch.equal(image, plates.display(scene.frames[index]).clamp(0, 1).half())
    assert pictures_of(shot, scene, final(True, width=100), report).size == (100, 75)


def test_working_frames_are_used_if_large_enough_or_without_source(shot, quiet):
    scene, report = load_scene(shot), quiet()
    for config, size in (
        (final(False), (64, 48)),
        (final(True, width=64), (64, 48)),
        (final(True, width=32), (32, 24)),
    ):
        pictures = pictures_of(shot, scene, config, report)
        assert pictures.size == size and pictures.plates is None
        assert torch.equal(pictures.load([4]), load_images(scene, [4], *size))
    assert training_size(scene, 32) == (32, 24) and report.events == []
    for path in (shot.root.parent / "source").iterdir():
        path.unlink()
    assert pictures_of(shot, scene, final(True), report).size == (64, 48)
    ((_, sentence, _),) = report.events
    assert "cannot be read" in sentence and sentence.endswith("The run is trained on the working frames.")
    assert "Frozen frames" not in sentence


def test_a_frame_that_cannot_be_read_is_named_whichever_thread_finds_it(shot, quiet):
    (shot.frames / "000107.png").write_bytes(b"no picture")
    with pytest.raises(JobError, match="Frame 107 is damaged"):
        load_images(load_scene(shot), list(range(16)), 64, 48)
    scene, done = load_scene(shot), []

    def read(index):
        done.append(index)
        return torch.zeros(48, 64, 3)

    load_images(scene, [5, 1, 3], 64, 48, read=read)
    assert done == [1, 3, 5], "a video is read in its own order"
    with pytest.raises(Cancelled):
        load_images(scene, list(range(6)), 64, 48, quiet(cancel_at=("loading frames", 0.5)))


def test_a_run_goes_on_with_the_numbers_it_was_begun_with_whatever_the_device(shot, quiet, monkeypatch):
    train_params = TrainParams(run="f", preset="final", iterations=20, max_gaussians=300)
    scene, card = load_scene(shot), torch.device("cuda")
    with pytest.raises(Cancelled):
        train_shot(shot, train_params, quiet(cancel_at=("training", 0.1)))
    report = quiet()
    config, key, _ = identity.requested_identity(shot, scene, shot.run("f"), train_params, card, report, [])
    assert not config.plates and key == json.loads((shot.run("f") / "config.json").read_text())["key"]
    assert [event[1] for event in report.events] == [
        "The run was started with the preset's settings for the processor, and continues with them."
    ]
    again = TrainParams(**{**vars(train_params), "resume": False})
    assert identity.requested_identity(shot, scene, shot.run("f"), again, card, quiet(), [])[0].plates
    assert identity.requested_identity(shot, scene, shot.run("another"), train_params, card, quiet(), [])[0].plates

    on_card = TrainParams(**{**vars(train_params), "run": "c"})
    with monkeypatch.context() as patched, pytest.raises(Cancelled):
        patched.setattr(identity, "config_from_params", lambda params, on_card=False: config_from_params(params, True))
        train_shot(shot, on_card, quiet(cancel_at=("training", 0.1)))
    report = quiet()
    resumed = TrainParams(**{**vars(on_card), "width": 1920, "device": "cpu"})  # as Blender requests a paused run
    assert train_shot(shot, resumed, report)["width_px"] == 128
    assert any(event[0] == "progress" and "resumed at step" in event[4] for event in report.events)
    warned = report.warnings
    assert warned[0] == "The run was started with the preset's settings for a graphics card, and continues with them."
    report = quiet()
    assert train_shot(shot, on_card, report)["width_px"] == 128
    assert ("progress", "training", 1, 1, "already trained") in report.events and not report.events[1:]
