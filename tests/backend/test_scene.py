"""The normalised scene: units, time, cameras, hold-out, images."""

import json

import numpy as np
import pytest
import torch

from torch_backend.contract import JobError
from torch_backend.scene import load_images, load_scene, resize_intrinsics, split_frames


def test_normalisation_keeps_every_pixel_and_leads_back(world):
    scene = load_scene(world.shot)
    centres = -torch.einsum("nji,nj->ni", scene.viewmats[:, :3, :3], scene.viewmats[:, :3, 3])
    assert float(torch.quantile(centres.norm(dim=1), 0.95)) == pytest.approx(1.0, rel=0.05)
    with np.load(world.shot.solve / "points.npz") as stored:
        xyz = torch.from_numpy(stored["xyz"])
    for frame in (0, 7, 15):
        before = xyz @ world.viewmats[frame][:3, :3].T + world.viewmats[frame][:3, 3]
        after = scene.points @ scene.viewmats[frame][:3, :3].T + scene.viewmats[frame][:3, 3]
        torch.testing.assert_close(before / before[:, 2:], after / after[:, 2:], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(after / scene.scale, before, rtol=1e-4, atol=1e-4)
    back = scene.points.double() / scene.scale + torch.from_numpy(scene.centre)
    torch.testing.assert_close(back.float(), xyz, rtol=1e-4, atol=1e-5)


def test_time_and_frame_numbers(world):
    scene = load_scene(world.shot)
    assert scene.frames[0] == 101
    assert scene.times[0] == 0.0
    assert scene.times[-1] == 1.0
    assert scene.time_of_frame(101 + 7.5) == pytest.approx(0.5)
    assert scene.time_of_frame(5) == 0.0
    assert [scene.frames[scene.nearest(frame)] for frame in (5, 101, 108.4, 108.5, 108.6, 900)] == [
        101, 101, 108, 108, 109, 116,
    ]  # fmt: skip
    seen = torch.einsum("fij,fj->fi", scene.viewmats[:, :3, :3], scene.camera_centres()) + scene.viewmats[:, :3, 3]
    assert float(seen.abs().max()) < 1e-5, "a camera is where it sees itself at nought"


def test_holdout_never_takes_the_ends():
    train, test = split_frames(list(range(17)), 8)
    assert test == [8]
    assert train == [i for i in range(17) if i != 8]
    assert split_frames(list(range(25)), 8)[1] == [8, 16]
    assert split_frames(list(range(25)), 8, phase=4)[1] == [4, 12, 20]
    assert split_frames(list(range(9)), 0) == (list(range(9)), [])
    with pytest.raises(ValueError, match="holdout"):
        split_frames(list(range(9)), 1)


def test_intrinsics_follow_the_image_size():
    """A pixel centre at +0.5 stays at the same place in the picture."""
    K = torch.tensor([[[60.0, 0, 31.0], [0, 50.0, 25.0], [0, 0, 1]]])
    small = resize_intrinsics(K, 64, 48, 32, 12)
    torch.testing.assert_close(small[0], torch.tensor([[30.0, 0, 15.5], [0, 12.5, 6.25], [0, 0, 1]]))


def test_images_are_area_averages(world):
    scene = load_scene(world.shot)
    full = load_images(scene, [3], 64, 48)[0].float()
    half = load_images(scene, [3], 32, 24)[0].float()
    torch.testing.assert_close(half, full.reshape(24, 2, 32, 2, 3).mean((1, 3)), atol=2e-3, rtol=0)


def test_static_camera_is_refused(world, tmp_path):
    import shutil

    from torch_backend.shot import Shot

    shutil.copytree(world.shot.root, tmp_path / "still")
    shot = Shot.open(tmp_path / "still")
    path = shot.solve / "cameras.json"
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        frame["viewmat"] = data["frames"][0]["viewmat"]
    path.write_text(json.dumps(data))
    with pytest.raises(JobError, match="hardly moves"):
        load_scene(shot)


def test_unsolved_shot_gives_a_readable_error(tmp_path):
    from torch_backend.shot import Shot

    with pytest.raises(JobError, match="no cameras yet"):
        load_scene(Shot.create(tmp_path / "new"))
