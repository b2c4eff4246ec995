"""A synthetic room, rendered through a real lens model, and a shot solved from it once for all tests."""

import functools
import shutil
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from tests.backend.quiet import Quiet
from torch_backend.contract import Cancelled
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import write_png
from torch_backend.motion_search import motion_after_solve
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot

WIDTH, HEIGHT = 320, 240
FOCAL, RADIAL = 300.0, -0.06
COUNT = 15
STEP = 2


class Room:
    """The inside of a textured box of 4 x 3 x 6 units with a textured block in it. y points down."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.low, self.high = np.array([-2.0, -1.5, -1.0]), np.array([2.0, 1.5, 5.0])
        self.block = np.array([-0.9, 0.1, 1.8]), np.array([0.1, 1.5, 2.8])
        self.textures = []
        for _ in range(12):
            octaves = sum(a * _noise(rng, 512, s) for s, a in ((2.5, 0.8), (5.0, 1.0), (12.0, 1.0)))
            self.textures.append(np.clip(0.5 + 0.22 * octaves, 0.0, 1.0))

    def render(self, viewmat, K, radial=0.0, size=(WIDTH, HEIGHT)):
        """[H, W, 3] uint8: view from a [4, 4] world-to-camera pose through fx, fy, cx, cy and one radial
        coefficient."""
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        distorted = np.stack([(x - K[2]) / K[0], (y - K[3]) / K[1]], axis=-1)
        ideal = distorted.copy()
        for _ in range(15):  # fixed-point iteration of distorted = ideal (1 + k |ideal|^2)
            ideal = distorted / (1.0 + radial * (ideal**2).sum(-1, keepdims=True))
        return self.cast(viewmat, np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1))

    def cast(self, viewmat, rays):
        """[H, W, 3] uint8: picture along rays [H, W, 3] in camera axes."""
        size, rays = rays.shape[1::-1], rays.reshape(-1, 3) @ viewmat[:3, :3]
        origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            grey = self._hit(origin, rays, self.low, self.high, inside=True)
            block = self._hit(origin, rays, *self.block, inside=False)
        grey = np.where(np.isnan(block), grey, block)
        return np.repeat(np.rint(255 * grey).astype(np.uint8).reshape(size[1], size[0], 1), 3, axis=2)

    def _hit(self, origin, rays, low, high, inside):
        one, two = (low - origin) / rays, (high - origin) / rays
        near, far = np.minimum(one, two), np.maximum(one, two)
        at = far.min(1) if inside else near.max(1)
        axis = far.argmin(1) if inside else near.argmax(1)
        point = origin + at[:, None] * rays
        value = np.full(len(rays), np.nan)
        valid = np.ones(len(rays), bool) if inside else (at > 0) & (at <= far.min(1))
        for a in range(3):
            side = rays[:, a] > 0
            for s in (0, 1):
                chosen = valid & (axis == a) & (side == bool(s))
                uv = np.delete(point[chosen], a, axis=1) * 80.0
                texture = self.textures[2 * a + s + (0 if inside else 6)]
                value[chosen] = map_coordinates(texture, uv.T, order=1, mode="grid-wrap")
        return value


def _noise(rng, size, sigma):
    field = gaussian_filter(rng.standard_normal((size, size)), sigma, mode="wrap")
    return field / field.std()


@functools.lru_cache(maxsize=1)
def the_room():
    """Room shared by all tests, because making its textures takes time."""
    return Room()


def look(position, yaw=0.0, pitch=0.0):
    """[4, 4] world-to-camera pose at `position`, rotated by yaw about y and pitch about x, in radians."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    rotation = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]) @ np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ np.asarray(position, float)
    return viewmat


def handheld(count):
    """[count] world-to-camera poses of a sideways step with some sway."""
    poses = []
    for t in np.linspace(0.0, 1.0, count):
        position = [-0.9 + 1.5 * t, 0.1 * np.sin(5 * t), 0.4 * np.sin(3 * t)]
        poses.append(look(position, yaw=-0.5 * (t - 0.5), pitch=0.1 * np.sin(4 * t)))
    return poses


def write_clip(folder, poses, noise=1.0, blurred=(), contrast=1.0):
    """Render PNG frames 101, 102, ... into `folder`, with sensor noise; `blurred` frames have almost no detail."""
    room, rng = the_room(), np.random.default_rng(1)
    K = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    for i, viewmat in enumerate(poses):
        clean = 128 + contrast * (room.render(viewmat, K, RADIAL).astype(float) - 128)
        if 101 + i in blurred:
            clean = gaussian_filter(clean, (8, 8, 0))
        noisy = np.clip(np.rint(clean + rng.normal(0.0, noise, clean.shape)), 0, 255).astype(np.uint8)
        write_png(folder / f"f.{101 + i}.png", noisy)
    return folder


def solve_all(shot, config, report, cameras=""):
    """Result of the solve and of the motion search, run as by a job, with optical flow only."""
    solved = solve_shot(shot, config, report, cameras)
    return {**solved, **(motion_after_solve(shot, report, static_model=None) or {})}


@dataclass
class Solved:
    shot: Shot
    poses: list
    result: dict
    report: Quiet


@pytest.fixture(scope="session")
def solved(tmp_path_factory):
    """Clip of 15 frames, every second one solved."""
    folder = tmp_path_factory.mktemp("room")
    poses = handheld(COUNT)
    clip = write_clip(folder, poses)
    shot, report = Shot.create(folder / "room.splannequin"), Quiet()
    import_footage(shot, str(clip), FootageConfig(step=STEP), report)
    return Solved(shot, poses, solve_all(shot, SolveConfig(features=1500), report), report)


def to_solve_again(solved, folder):
    """Copy of the solved shot, and its COLMAP model. A solve from this model is faster than one from the pictures.

    Its frames are still distorted, as if another lens had been used.
    """
    shutil.copytree(solved.shot.solve / "colmap", folder / "model")
    shot = Shot(shutil.copytree(solved.shot.root, folder / "a.splannequin"))
    for raw in (shot.frames / "raw").iterdir():
        shutil.copy(raw, shot.frames)
    return shot, str(folder / "model")


@pytest.fixture
def again(solved, tmp_path):
    return to_solve_again(solved, tmp_path)


@pytest.fixture(scope="session")
def tools():
    """Helpers for the tests of this folder."""

    def request_for(folder, pictures, **changes):
        """A worker's request and frames.json for `pictures`, written into a folder without other frames."""
        (folder / "pictures").mkdir()
        names = [f"{n:06d}.png" for n in range(1, len(pictures) + 1)]
        for name, pixels in zip(names, pictures, strict=True):
            write_png(folder / "pictures" / name, pixels)
        request = {"images": str(folder / "pictures"), "solved": names, "others": [], "camera_model": "SIMPLE_RADIAL"}
        request |= {"overlap": 15, "features": 800, "neighbours": 0, "threads": 1, "size": [WIDTH, HEIGHT], **changes}
        rows = [{"frame": n, "solve": True, "seconds": n / 12, "sharpness": 100.0} for n in range(1, len(pictures) + 1)]
        return request, {"step": 1, "frames": rows}

    def fisheye_rays(focal, k1, size=(WIDTH, HEIGHT)):
        """[H, W, 3] ray directions of a fisheye of `size`."""
        x, y = np.meshgrid(np.arange(size[0]) + 0.5 - size[0] / 2, np.arange(size[1]) + 0.5 - size[1] / 2)
        radius = np.hypot(x, y)
        angle = radius / focal
        for _ in range(30):
            angle -= (angle * (1.0 + k1 * angle**2) - radius / focal) / (1.0 + 3.0 * k1 * angle**2)
        return np.stack([x * np.sin(angle) / radius, y * np.sin(angle) / radius, np.cos(angle)], axis=-1)

    class Tools:
        recorder = Quiet
        cancelled = Cancelled
        handheld = staticmethod(handheld)
        room = staticmethod(the_room)
        look = staticmethod(look)
        write_clip = staticmethod(write_clip)

    Tools.request_for, Tools.fisheye_rays = staticmethod(request_for), staticmethod(fisheye_rays)
    return Tools
