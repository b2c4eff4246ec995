"""A run stays on one device: checks that work without a GPU, and runs on a GPU if there is one."""

import sys

import pytest
import torch

from tests.backend.train import devices
from tests.backend.trainings import take_steps
from torch_backend.contract import FreezeParams, JobError, TrainParams
from torch_backend.freeze import freeze_shot
from torch_backend.scene import load_images, load_scene
from torch_backend.train import choose_device, config_from_params, load_run, train_shot
from torch_backend.train.device import cuda_refusal, decide_device
from torch_backend.train.resume import restore_run, save_run
from torch_backend.train.trainer import Trainer

needs_gpu = pytest.mark.skipif(bool(cuda_refusal()), reason="no GPU")


def test_checker_finds_tensors_created_without_a_device(monkeypatch):
    monkeypatch.setattr(devices, "STATIONS", [__file__])
    with devices.NamedDevices() as mode:
        torch.zeros(3, device="cpu")
        torch.zeros(2)
    assert len(mode.found) == 1


def test_choice_of_device():
    assert choose_device("cpu").type == "cpu"
    assert choose_device("auto").type == ("cpu" if cuda_refusal() else "cuda")
    with pytest.raises(ValueError, match="tpu"):
        choose_device("tpu")


@pytest.mark.skipif(not cuda_refusal(), reason="there is a GPU")
def test_cuda_without_a_gpu_is_refused_in_words(world, quiet):
    with pytest.raises(JobError, match="GPU"):
        train_shot(world.shot, TrainParams(run="gpu", device="cuda"), quiet())


@pytest.mark.skipif(not cuda_refusal() or sys.platform == "win32", reason="there is a GPU, or no shell")
def test_a_card_that_is_not_used_is_said_at_the_start_of_training(world, quiet, nvidia_smi):
    nvidia_smi("NVIDIA GeForce RTX 3090, 535.183.01, 8.6")
    unused = decide_device("auto")[1]
    assert unused is not None and cuda_refusal() == unused[0]
    with pytest.raises(JobError, match="R580 or newer is needed") as refused:
        choose_device("cuda")
    assert refused.value.hint.startswith("Update the NVIDIA driver")
    report = quiet()
    train_shot(world.shot, TrainParams(run="unused-card", iterations=10, max_gaussians=300), report)
    said = [event for event in report.events if event[0] == "warning" and "RTX 3090" in event[1]]
    assert len(said) == 1 and "driver 535.183.01, and R580" in said[0][1] and "Update" in said[0][2]
    silent = quiet()
    train_shot(world.shot, TrainParams(run="by-wish", iterations=10, max_gaussians=300, device="cpu"), silent)
    assert not [event for event in silent.events if event[0] == "warning" and "RTX 3090" in event[1]]


@needs_gpu
def test_run_resumes_and_freezes_on_a_second_device(world, quiet):
    scene = load_scene(world.shot)
    images = load_images(scene, scene.solved, 64, 48)
    config = config_from_params(TrainParams(iterations=60, max_gaussians=1500))
    trainer = Trainer(scene, images.cuda(), scene.solved, config, quiet(), {}, "cuda")
    take_steps(trainer, 30)
    path = world.shot.root / "gpu.safetensors"
    save_run(trainer, path)
    for device in ("cpu", "cuda"):
        resumed = Trainer(scene, images.to(device), scene.solved, config, quiet(), {}, device)
        restore_run(resumed, path)
        assert torch.equal(resumed.generator.get_state(), trainer.generator.get_state())
        loss = take_steps(resumed, 10)
        assert loss.device.type == device and bool(torch.isfinite(loss))


@needs_gpu
def test_a_gpu_run_is_as_good_as_a_cpu_run(world, quiet):
    """Without a field: with one, five seeds of such a small run differ by 10 dB on the same device."""
    found = {}
    for device in ("cpu", "cuda"):
        params = TrainParams(
            run=f"on-{device}", iterations=300, max_gaussians=1500, holdout=8, device=device, method="static"
        )
        found[device] = train_shot(world.shot, params, quiet())["heldout_psnr_db"]
        run = load_run(world.shot, params.run, choose_device(device))
        assert run.model.device.type == device
    assert abs(found["cuda"] - found["cpu"]) < 0.5


@needs_gpu
def test_a_gpu_run_with_a_field_is_trained_and_frozen(world, quiet):
    params = TrainParams(run="moves", iterations=600, max_gaussians=1500, holdout=8, device="cuda")
    assert train_shot(world.shot, params, quiet())["moving_gaussians"] > 0
    assert freeze_shot(world.shot, FreezeParams(run="moves", take="moves", device="cuda"), quiet())["frames"] > 0


@needs_gpu
def test_bad_frames_are_left_out_on_the_gpu_too(world, quiet):
    scene = load_scene(world.shot)
    images = load_images(scene, scene.solved, 64, 48).cuda()
    report = quiet()
    trainer = Trainer(scene, images, scene.solved, config_from_params(TrainParams()), report, {}, "cuda")
    trainer.images = images * float("nan")  # only now, because colours are initialised from the frames
    before = {name: p.detach().clone() for name, p in trainer.model.gaussians.params.items()}
    for _ in range(9):
        trainer.step()
    trainer.inspect_nonfinite()
    assert any(e[0] == "warning" and "not finite" in e[1] for e in report.events)
    assert all(torch.equal(before[name], p) for name, p in trainer.model.gaussians.params.items())
    for _ in range(12):
        trainer.step()
    with pytest.raises(JobError, match="unstable"):
        trainer.inspect_nonfinite()
