"""Training starts from surface points of a solve: their number, and the points that are left out."""

import shutil

import numpy as np
import pytest
import torch

from torch_backend.gaussians.initialise import InitConfig, initialise
from torch_backend.motion.surface import write_surface
from torch_backend.motion_search import find_motion
from torch_backend.scene import load_images, load_scene, surface_of
from torch_backend.shot import Shot

WITHHELD, FAR, COUNT = 7, 3, 400


@pytest.fixture(scope="module")
def dense(world, tmp_path_factory, quiet):
    """(scene, images) of the tiny shot, with surface points whose colours mark their kind.

    Points of a held-out frame are red, points far outside are green, all others are blue.
    """
    shot = Shot(shutil.copytree(world.shot.root, tmp_path_factory.mktemp("dense") / "a.splannequin"))
    find_motion(shot, quiet(), static_model=None)
    with np.load(shot.solve / "points.npz") as stored:
        xyz = stored["xyz"]
    rng = np.random.default_rng(0)
    scene = load_scene(shot)
    for file in shot.motion.glob("*.npz"):
        file.unlink()
    for index, color in ((WITHHELD, (255, 0, 0)), (FAR, (0, 255, 0)), (5, (0, 0, 255)), (9, (0, 0, 255))):
        near = xyz[rng.integers(len(xyz), size=COUNT)] + rng.normal(0, 1e-3, (COUNT, 3)).astype(np.float32)
        far = near + 50 * np.ptp(xyz, axis=0)
        points = (far if index == FAR else near).astype(np.float32)
        write_surface(shot.surface(scene.frames[index]), points, np.tile(np.uint8(color), (COUNT, 1)))
    images = load_images(scene, scene.solved, 64, 48)
    return scene, images


def start(dense, budget=5000, **options):
    scene, images = dense
    train = [i for i in scene.solved if i != WITHHELD]
    generator = torch.Generator("cpu").manual_seed(0)
    pictures = images[[scene.solved.index(i) for i in train]]
    return initialise(scene, pictures, train, 8, InitConfig(**options), generator, budget).params


def blues(params) -> int:
    """Number of surface points among the Gaussians; asserts that there are no red and green ones."""
    colors = (params["sh0"][:, 0] * 0.28209479177387814 + 0.5).round(decimals=3)
    assert not (colors == torch.tensor([1.0, 0, 0])).all(1).any()
    assert not (colors == torch.tensor([0.0, 1, 0])).all(1).any()
    return int((colors == torch.tensor([0.0, 0, 1])).all(1).sum())


def test_training_starts_from_the_points_of_still_surfaces(dense):
    scene, _ = dense
    points, colors, frames = surface_of(scene)
    assert points.shape == colors.shape == (4 * COUNT, 3) and len(frames) == 4 * COUNT
    with_them, without = start(dense), start(dense, surface=0)
    assert blues(with_them) == 2 * COUNT and blues(without) == 0
    assert (with_them["means"][: len(scene.points)] == scene.points).all()


def test_they_take_a_third_of_the_budget_at_most(dense):
    assert blues(start(dense, surface=150)) == 150
    assert blues(start(dense, budget=900, seeds=0)) <= 300
