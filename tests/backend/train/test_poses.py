"""Camera corrections: rigid, without a common part, recovery of wrong cameras, and no influence of moving objects."""

import numpy as np
import pytest
import torch

from tests.backend.trainings import take_steps
from torch_backend.contract import TrainParams
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params
from torch_backend.train.poses import Poses, PosesConfig, _Gauge, _series, corrected
from torch_backend.train.resume import restore_run, save_run
from torch_backend.train.trainer import Trainer

CPU = torch.device("cpu")


def random_viewmats(count, generator):
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator)).Q
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = torch.randn(count, 3, generator=generator)
    return viewmats


def test_a_correction_is_rigid_and_moves_the_world():
    g = torch.Generator().manual_seed(0)
    viewmats = random_viewmats(5, g)
    assert torch.equal(corrected(viewmats, torch.zeros(5, 6)), viewmats)
    moved = corrected(viewmats, 0.3 * torch.randn(5, 6, generator=g))
    assert torch.allclose(moved[:, :3, :3] @ moved[:, :3, :3].mT, torch.eye(3).expand(5, 3, 3), atol=1e-5)
    assert torch.equal(moved[:, 3], viewmats[:, 3])
    shift = corrected(torch.eye(4), torch.tensor([0.0, 0, 0, 1, 2, 3]))
    assert torch.allclose(shift[:3, 3], torch.tensor([1.0, 2, 3]))
    turn = corrected(torch.eye(4), torch.tensor([0.0, 0, torch.pi / 2, 0, 0, 0]))
    assert torch.allclose(turn[:3, :3] @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)


def test_gradients_are_those_of_finite_differences():
    g = torch.Generator().manual_seed(1)
    viewmats = random_viewmats(2, g).double()
    values = (0.1 * torch.randn(2, 6, generator=g)).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: corrected(viewmats, x), (values,))


def test_gauge_is_fixed_and_anchored_frames_follow_neighbours():
    poses = Poses([0.0, 0.2, 0.4, 0.8, 1.0], PosesConfig(), CPU)
    with torch.no_grad():
        poses.values[:] = torch.tensor([3.0, 100.0, 1.0, 2.0, 4.0])[:, None]
    poses.fix_gauge({1})
    assert poses.values[[0, 2, 3, 4], 0].tolist() == pytest.approx([0.5, -1.5, -0.5, 1.5])  # minus their mean, 2.5
    assert float(poses.values.detach()[1, 0]) == pytest.approx(-0.5)
    between = poses.at(np.array([0.0, 0.6, 1.0, 2.0]))
    assert between[:, 3].tolist() == pytest.approx([0.5, -1.0, 1.5, 1.5])


def wrong_cameras(world, quiet, on):
    """(trainer, true cameras) of the tiny shot with camera errors of about half a pixel, trained as a static scene."""
    scene = load_scene(world.shot)
    truth = scene.viewmats.clone()
    wrong = 0.008 * torch.randn(len(truth), 6, generator=torch.Generator().manual_seed(3))
    wrong[:, 2:] *= 0.1
    scene.viewmats = corrected(truth, wrong - wrong.mean(0))
    config = config_from_params(TrainParams(iterations=900, max_gaussians=1200, method="static"))
    config.poses.on = on
    trainer = Trainer(scene, load_images(scene, scene.solved, 64, 48), scene.solved, config, quiet())
    take_steps(trainer, 320)
    return trainer, truth


def shifts(trainer, viewmats):
    """[F, P, 2] pixel shifts of the scene's points against the solve's cameras, minus the mean over all frames."""
    seen = []
    for cameras in (viewmats, trainer.scene.viewmats):
        pixel = (trainer.scene.points @ cameras[:, :3, :3].mT + cameras[:, None, :3, 3]) @ trainer.Ks.mT
        seen.append(pixel[..., :2] / pixel[..., 2:])
    difference = seen[0] - seen[1]
    return difference - difference.mean(0)


def test_wrong_cameras_are_found_and_frozen(world, quiet, tmp_path):
    plain, truth = wrong_cameras(world, quiet, on=False)
    trainer, _ = wrong_cameras(world, quiet, on=True)
    assert trainer.refined
    assert float(trainer.poses.values.detach().mean(0).abs().max()) < 1e-6
    wanted, found = shifts(trainer, truth), shifts(trainer, trainer.viewmats)
    assert float(wanted.norm(dim=-1).mean()) > 0.3
    assert float((wanted * found).sum() / (wanted.norm() * found.norm())) > 0.35
    frames = [trainer.train_ids[n] for n in (3, 8, 12)]
    images = plain.images[[3, 8, 12]]
    assert trainer.heldout_psnr(frames, images) > plain.heldout_psnr(frames, images) + 0.2
    kept, cameras = trainer.poses.values.detach().clone(), trainer.viewmats.clone()
    trainer.step()
    assert torch.equal(trainer.poses.values, kept)
    save_run(trainer, tmp_path / "checkpoint.safetensors")
    scene = load_scene(world.shot)
    scene.viewmats = plain.viewmats
    again = Trainer(scene, trainer.images, scene.solved, trainer.config, quiet())
    restore_run(again, tmp_path / "checkpoint.safetensors")
    assert torch.equal(again.viewmats, cameras)


def test_what_a_gpu_computes_of_a_correction_is_the_same():
    g = torch.Generator().manual_seed(4)
    twists = torch.zeros(6, 4, 4)
    turn = 0.3 * torch.randn(6, 3, generator=g)
    twists[:, [2, 0, 1], [1, 2, 0]], twists[:, [1, 2, 0], [2, 0, 1]] = turn, -turn
    twists[:, :3, 3] = 0.3 * torch.randn(6, 3, generator=g)
    assert torch.allclose(_series(twists), torch.matrix_exp(twists), atol=1e-6)
    times = np.array([0.0, 0.2, 0.4, 0.8, 1.0])
    for anchored in ({1}, {0, 3}, {2, 4}, {0, 1}):
        poses = Poses(times.tolist(), PosesConfig(), CPU)
        with torch.no_grad():
            poses.values[:] = torch.randn(5, 6, generator=g)
        gauge = _Gauge(times, anchored, CPU)
        between = torch.lerp(poses.values[gauge.left], poses.values[gauge.right], gauge.share)
        assert gauge.rows.tolist() == sorted(anchored)
        assert torch.allclose(between, poses.at(times[sorted(anchored)], anchored), atol=1e-6)
