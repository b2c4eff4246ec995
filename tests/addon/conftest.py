"""Runs inside real bpy: a wheel (`.venv-bpy-X.Y/bin/python -m pytest tests/addon`) or a Blender (.ci/blender_tests.py).

The package is registered once, under the name that Blender gives an installed extension; every test starts from
Blender's factory startup file.
"""

import importlib
import importlib.util
import json
import shutil
import struct
import sys
import types
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(__file__).resolve().parent / "data"


def _load(path: Path) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(f"_addon_tests_{path.stem}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_frames = _load(DATA / "make_frames.py")
PACKAGE = _load(ROOT / "splannequin_addon" / "run_in_bpy.py")


@pytest.fixture(scope="session")
def package() -> Iterator[types.ModuleType]:
    loaded = PACKAGE.load_package()
    loaded.register()
    yield loaded
    loaded.unregister()


@pytest.fixture(scope="session")
def addon(package: types.ModuleType) -> Callable[[str], types.ModuleType]:
    """addon("process.jobs") is the add-on's module of that name."""
    return lambda name: importlib.import_module(f"{package.__name__}.splannequin_addon.{name}")


@pytest.fixture(scope="session")
def contract(package: types.ModuleType) -> types.ModuleType:
    return importlib.import_module(f"{package.__name__}.torch_backend.contract")


@pytest.fixture(autouse=True)
def new_file(package: types.ModuleType, addon) -> None:
    addon("process.supervisor").forget()
    bpy.ops.wm.read_homefile(use_factory_startup=True)


@pytest.fixture
def scene():
    return bpy.context.scene


@pytest.fixture
def layers() -> Callable[[int], dict[str, np.ndarray]]:
    return make_frames.layers


def write_png(path: Path, rgb: np.ndarray) -> None:
    """8-bit RGB [H, W, 3] uint8 as a PNG, without help from Blender or the backend."""
    height, width, _ = rgb.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, width * 3)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def read_png(path: Path) -> np.ndarray:
    """Values in 0..1 as they stand in the file, [H, W, 3], top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.array(image.pixels[:]).reshape(height, width, -1)[::-1, :, :3]
    bpy.data.images.remove(image)
    return pixels


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 in float64."""
    linear = np.clip(linear.astype(np.float64), 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.fixture
def pictures() -> types.SimpleNamespace:
    return types.SimpleNamespace(write=write_png, read=read_png, srgb=srgb)


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """[3, 3], Rodrigues."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """A shot as the backend leaves it: frames 5 to 7 of 16 x 12, solved, with one take. Files of the real formats."""
    folder = tmp_path / "my shot é.splannequin"
    (folder / "frames").mkdir(parents=True)
    (folder / "solve").mkdir()
    width, height, frames = make_frames.WIDTH, make_frames.HEIGHT, make_frames.FRAMES
    info = {"version": 1, "name": "my shot é", "first": 5, "last": 7, "fps": 12.5, "width": width, "height": height}
    (folder / "shot.json").write_text(json.dumps(info), encoding="utf-8")
    listed = [{"frame": n, "seconds": n / 12.5, "file": f"raw/{n:06d}.png", "solve": True} for n in frames]
    told = {"version": 1, "width": width, "height": height, "fps": 12.5, "colour": "srgb", "frames": listed}
    (folder / "frames" / "frames.json").write_text(json.dumps(told))
    poses = []
    for n in frames:
        plate = np.full((height, width, 3), 10 * n, np.uint8)
        plate[:, :, 0] = np.arange(width) * 16
        write_png(folder / "frames" / f"{n:06d}.png", plate)
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation((0.2, 1.0, -0.3), 0.1 * n)
        viewmat[:3, 3] = (0.1 * n, -0.2, 3.0)
        poses.append({"frame": n, "viewmat": viewmat.ravel().tolist(), "K": [20.0, 20.0, 9.0, 5.0]})
    path = {"version": 1, "width": width, "height": height, "frames": poses}
    (folder / "solve" / "cameras.json").write_text(json.dumps(path))
    solve = {"version": 1, "registered": 3, "solved_frames": 3, "total_frames": 3, "quality": "A good solve."}
    (folder / "solve" / "solve.json").write_text(json.dumps(solve))
    xyz = np.random.default_rng(0).uniform(-1, 1, (20, 3)).astype(np.float32)
    rgb = np.arange(60, dtype=np.uint8).reshape(20, 3) * 4
    error, track = np.full(20, 0.5, np.float32), np.full(20, 3, np.uint16)
    np.savez(folder / "solve" / "points.npz", xyz=xyz, rgb=rgb, error=error, track=track)
    (folder / "runs" / "main").mkdir(parents=True)
    run = {"run": "main", "gaussians": 12345, "moving_share": 0.05, "heldout_psnr_db": 24.0, "width_px": width}
    (folder / "runs" / "main" / "summary.json").write_text(json.dumps(run))
    add_take(folder, "freeze")
    return folder


def add_take(folder: Path, name: str) -> Path:
    """A take of the test frames."""
    take = folder / "takes" / name
    take.mkdir(parents=True)
    for n in make_frames.FRAMES:
        shutil.copy(DATA / f"{n:06d}.exr", take)
    facts = {"version": 1, "take": name, "run": "main", "t_star_frame": 6, "query": "nearest", "frames": 3}
    facts |= {"width": make_frames.WIDTH, "height": make_frames.HEIGHT, "first": 5, "last": 7}
    (take / "take.json").write_text(json.dumps(facts))
    return take


@pytest.fixture
def new_take() -> Callable[[Path, str], Path]:
    return add_take


@pytest.fixture
def clip() -> Path:
    """The bundled clip."""
    return ROOT / "examples" / "sitting.mp4"


@pytest.fixture
def root() -> Path:
    return ROOT


sys.dont_write_bytecode = True
