"""Fixtures for tests inside real bpy: a wheel (`.venv-bpy-X.Y/bin/python -m pytest tests/addon`) or a Blender
(.ci/blender_tests.py).

The package is registered once, under the name that Blender gives an installed extension. Every test starts from
Blender's factory startup file.
"""

import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import types
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
make_shot = _load(DATA / "make_shot.py")
write_png, add_take = make_shot.write_png, make_shot.add_take
pixels = _load(DATA / "pixels.py")
PACKAGE = _load(ROOT / "splannequin_addon" / "run_in_bpy.py")


@pytest.fixture(scope="session")
def package() -> Iterator[types.ModuleType]:
    loaded = PACKAGE.load_package()
    loaded.register()
    yield loaded
    loaded.unregister()


@pytest.fixture(scope="session")
def addon(package: types.ModuleType) -> Callable[[str], types.ModuleType]:
    """addon(name): the add-on's module of that name, such as addon("process.jobs")."""
    return lambda name: importlib.import_module(f"{package.__name__}.splannequin_addon.{name}")


@pytest.fixture(scope="session")
def contract(package: types.ModuleType) -> types.ModuleType:
    return importlib.import_module(f"{package.__name__}.torch_backend.contract")


@pytest.fixture(autouse=True)
def new_file(package: types.ModuleType, addon) -> None:
    addon("process.job_timer").forget()
    bpy.ops.wm.read_homefile(use_factory_startup=True)


@pytest.fixture
def scene():
    return bpy.context.scene


@pytest.fixture
def layers() -> Callable[[int], dict[str, np.ndarray]]:
    return make_frames.layers


def srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB encoding of linear values (IEC 61966-2-1), in float64."""
    linear = np.clip(linear.astype(np.float64), 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.fixture
def pictures() -> types.SimpleNamespace:
    return types.SimpleNamespace(
        write=write_png, png=make_shot.png, read=lambda path: pixels.read(path)[..., :3], srgb=srgb
    )


@pytest.fixture
def run(addon, capfd):
    """run(*arguments): runs the command line; returns (exit code, standard output, standard error)."""

    def call(*arguments) -> tuple[int, str, str]:
        capfd.readouterr()
        code = addon("command_line.headless").main([str(a) for a in arguments])
        out, err = capfd.readouterr()
        return code, out, err

    return call


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return make_shot.make_shot(tmp_path)


@pytest.fixture
def with_shot(scene, shot: Path):
    """The scene with `shot` as its shot folder."""
    scene.splannequin.shot_path = str(shot)
    return scene


@pytest.fixture(scope="session")
def _frozen_world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    python = os.environ.get("SPLANNEQUIN_BACKEND_PYTHON")
    if not python:
        pytest.skip("no backend to train with: SPLANNEQUIN_BACKEND_PYTHON names its Python")
    folder = tmp_path_factory.mktemp("frozen world")
    subprocess.run([python, str(DATA / "make_matte_take.py"), str(ROOT), str(folder)], check=True, timeout=600)
    return folder


@pytest.fixture(scope="module")
def frozen_world(_frozen_world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Module-scoped folder with tiny.splannequin, trained and frozen at 105 by a real backend, and truth.json."""
    return Path(shutil.copytree(_frozen_world, tmp_path_factory.mktemp("world") / "frozen"))


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """stand_in(line): a shell script with this line takes the place of the backend's Python; returns its path."""
    if sys.platform == "win32":
        pytest.skip("the stand-in is a shell script")

    def put(line: str) -> str:
        program = tmp_path / "stand-in"
        program.write_text(f"#!/bin/sh\n{line}\n")
        program.chmod(0o755)
        monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(program))
        return str(program)

    return put


@pytest.fixture
def new_take() -> Callable[[Path, str], Path]:
    return add_take


@pytest.fixture
def previews() -> Callable[[Path, str], None]:
    """previews(shot, take): writes the preview files that the backend writes with frozen frames."""

    def write(shot: Path, take: str = "freeze") -> None:
        folder = shot / "takes" / take / "preview"
        folder.mkdir()
        for n in make_frames.FRAMES:
            write_png(folder / f"{n:06d}.png", np.full((make_frames.HEIGHT, make_frames.WIDTH, 3), 20 * n, np.uint8))

    return write


@pytest.fixture
def clip() -> Path:
    """The bundled clip."""
    return ROOT / "examples" / "sitting.mp4"


@pytest.fixture
def root() -> Path:
    return ROOT


sys.dont_write_bytecode = True
