"""A shot with known ground truth: a textured wall of Gaussians, a moving patch on it, and a moving camera."""

from __future__ import annotations

import math
import os
import shutil

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch, as cli.main does: spinning threads starve others

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests.backend.pictures import write
from tests.backend.quiet import Quiet
from tests.backend.solved_room import again, solved, tools  # noqa: F401 - fixtures
from torch_backend.contract import CameraFrame, CameraPath
from torch_backend.footage.images import read_png, write_png
from torch_backend.motion.mattes import MOVING, STILL, write_matte
from torch_backend.raster import rasterize
from torch_backend.shot import Shot, write_json

WIDTH, HEIGHT, FRAMES = 64, 48, 16
FIRST = 101


@dataclass
class World:
    """Ground truth of the tiny shot."""

    shot: Shot
    viewmats: torch.Tensor
    K: torch.Tensor
    state: dict[str, torch.Tensor]
    moving: torch.Tensor
    summary: dict[str, Any] = field(default_factory=dict)
    """Of the training, if it was trained."""

    def at(self, time: float) -> dict[str, torch.Tensor]:
        """The Gaussians at a time in [0, 1]: the patch sways by 0.2 units.

        A steady drift would be ambiguous: with a steadily moving camera it looks like a patch at another depth.
        """
        means = self.state["means"].clone()
        means[self.moving, 0] += 0.2 * math.sin(2 * math.pi * time)
        return {**self.state, "means": means}

    def image(self, frame: int, time: float) -> torch.Tensor:
        """[H, W, 3]: view from the pose of a frame, at a time."""
        out = rasterize(
            **self.at(time),
            viewmats=self.viewmats[frame : frame + 1],
            Ks=self.K[None],
            width=WIDTH,
            height=HEIGHT,
            background=torch.full((3,), 0.5),
        )
        return out.colors[0].clamp(0, 1)

    def patch(self, frame: int, time: float) -> np.ndarray:
        """[H, W]: coverage of the patch, from the pose of a frame, at a time."""
        state = {name: value[self.moving] for name, value in self.at(time).items()}
        pose = {"viewmats": self.viewmats[frame : frame + 1], "Ks": self.K[None]}
        return rasterize(**state, **pose, width=WIDTH, height=HEIGHT).alphas[0].numpy()


def outline(mask: np.ndarray) -> list[list[float]]:
    """Polygon of the largest area of a mask, in pixels."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return (max(found, key=len)[:, 0] + 0.5).tolist()


def film(world: World, folder: Path, picture: Callable[[int], np.ndarray], paint: bool = True, **config) -> Shot:
    """A shot of pictures in FOLDER/source, of PNG or scene-linear EXR by their type, solved like the world and without
    a lens. `paint`: everything is painted as static."""
    from torch_backend.footage import FootageConfig, import_footage

    (folder / "source").mkdir()
    for n in range(FRAMES):
        pixels = picture(n)
        suffix = "png" if pixels.dtype == np.uint8 else "exr"
        write(folder / "source" / f"a.{FIRST + n}.{suffix}", pixels)
    shot = Shot.create(folder / "filmed.splannequin")
    import_footage(shot, str(folder / "source"), FootageConfig(**config), Quiet())
    shot.solve.mkdir()
    for name in ("cameras.json", "points.npz"):
        shutil.copyfile(world.shot.solve / name, shot.solve / name)
    lens = {"camera_model": "SIMPLE_RADIAL", "distortion": [0.0], "focal_px": 60.0}
    write_json(shot.solve_record, {"version": 1, "key": "k", **lens})
    for n in range(FIRST, FIRST + FRAMES):
        write_png(shot.plate(n), read_png(shot.raw / f"{n:06d}.png"))
        if paint:
            shot.painted_matte(n).parent.mkdir(exist_ok=True)
            write_matte(shot.painted_matte(n), np.full((HEIGHT, WIDTH), STILL, np.uint8))
    return shot


def build_world(root: Path) -> World:
    g = torch.Generator().manual_seed(7)
    grid = torch.stack(torch.meshgrid(torch.linspace(-2.6, 2.6, 30), torch.linspace(-2, 2, 24), indexing="ij"), -1)
    wall = torch.cat([grid.reshape(-1, 2), torch.full((720, 1), 4.0)], dim=1)
    patch = torch.tensor([-0.3, 0.0, 3.2]) + (torch.rand(90, 3, generator=g) - 0.5) * torch.tensor([0.8, 0.8, 0.05])
    means = torch.cat([wall, patch])
    colors = torch.rand(len(means), 3, generator=g)
    colors[:720] = 0.5 + 0.3 * torch.sin(2.5 * wall)
    colors[720:] = torch.tensor([0.9, 0.15, 0.1]) + 0.2 * (colors[720:] - 0.5)
    quats = torch.zeros(len(means), 4)
    quats[:, 0] = 1
    scales = torch.full((len(means), 3), 0.11)
    scales[720:] = 0.07
    state = {
        "means": means,
        "quats": quats,
        "log_scales": scales.log(),
        "opacity_logits": torch.full((len(means),), 3.0),
        "colors": colors,
    }
    moving = torch.zeros(len(means), dtype=torch.bool)
    moving[720:] = True
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(0.6, -0.6, FRAMES)
    viewmats[:, 1, 3] = 0.1 * torch.sin(torch.linspace(0, 6, FRAMES))
    K = torch.tensor([[60.0, 0, 32.0], [0, 60.0, 24.0], [0, 0, 1]])
    world = World(Shot.create(root / "tiny.splannequin"), viewmats, K, state, moving)
    _write(world)
    return world


def paint_motion(world: World) -> None:
    """Paint motion mattes of the patch as an artist would: the patch moves too little for optical flow at this size."""
    for n in range(FRAMES):
        path = world.shot.painted_matte(FIRST + n)
        path.parent.mkdir(exist_ok=True)
        write_matte(path, np.where(world.patch(n, n / (FRAMES - 1)) > 0.1, MOVING, STILL).astype(np.uint8))


def _write(world: World) -> None:
    shot, rows, cameras = world.shot, [], []
    for n in range(FRAMES):
        pixels = (world.image(n, n / (FRAMES - 1)) * 255 + 0.5).to(torch.uint8).numpy()
        write_png(shot.frames / f"{FIRST + n:06d}.png", pixels)
        rows.append(
            {
                "frame": FIRST + n,
                "seconds": n / 10,
                "file": f"raw/{FIRST + n:06d}.png",
                "solve": True,
                "sharpness": 1.0,
                "exposure": 0.0,
                "flags": [],
            }
        )
        K = world.K
        cameras.append(
            CameraFrame(
                FIRST + n,
                world.viewmats[n].flatten().tolist(),
                [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            )
        )
    write_json(
        shot.frames / "frames.json",
        {"version": 1, "width": WIDTH, "height": HEIGHT, "fps": 10.0, "colour": "srgb", "frames": rows},
    )
    write_json(shot.solve / "cameras.json", CameraPath(WIDTH, HEIGHT, cameras).to_json())
    pick = torch.cat([torch.arange(0, 720, 3), torch.arange(720, 810, 3)])
    xyz = world.state["means"][pick]
    rgb = (world.state["colors"][pick].clamp(0, 1) * 255).to(torch.uint8)
    np.savez(
        shot.solve / "points.npz",
        xyz=xyz.numpy(),
        rgb=rgb.numpy(),
        error=np.zeros(len(pick), np.float32),
        track=np.full(len(pick), 5, np.uint16),
    )
    shot.update(first=FIRST, last=FIRST + FRAMES - 1, fps=10.0, width=WIDTH, height=HEIGHT)


@pytest.fixture(scope="session")
def world(tmp_path_factory) -> World:
    """The solved tiny shot and its ground truth; tests must not change it."""
    return build_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> World:
    """The tiny shot with one finished run `main` (auto, support) and painted motion mattes.

    Tests may add takes, but must not change the run.
    """
    from torch_backend.contract import TrainParams
    from torch_backend.train import train_shot

    world = build_world(tmp_path_factory.mktemp("trained"))
    paint_motion(world)
    params = TrainParams(iterations=900, holdout=8, max_gaussians=1500)
    return replace(world, summary=train_shot(world.shot, params, Quiet()))


@pytest.fixture(scope="module")
def trained_copy(trained, tmp_path_factory) -> World:
    """The trained world with a copy of its shot, which the tests of one file may change.

    Takes and instants of this copy do not affect other test files.
    """
    root = tmp_path_factory.mktemp("copy") / trained.shot.root.name
    shutil.copytree(trained.shot.root, root, ignore=shutil.ignore_patterns("takes"))
    return replace(trained, shot=Shot.open(root))


@pytest.fixture(scope="session")
def quiet():
    """Class of a reporter that records all events."""
    return Quiet
