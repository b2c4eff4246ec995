"""Fixtures for add-on modules that do not need bpy; they run in any Python: the backend's here, Blender's in CI.

The package is loaded under the name that Blender gives an installed extension, and is not registered.
"""

import importlib
import importlib.util
import types
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _load(path: Path) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(f"_addon_free_{path.stem}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def package() -> types.ModuleType:
    return _load(ROOT / "splannequin_addon" / "run_in_bpy.py").load_package()


@pytest.fixture(scope="session")
def addon(package: types.ModuleType) -> Callable[[str], types.ModuleType]:
    """addon(name): the add-on's module of that name, such as addon("process.jobs")."""
    return lambda name: importlib.import_module(f"{package.__name__}.splannequin_addon.{name}")


@pytest.fixture(scope="session")
def contract(package: types.ModuleType) -> types.ModuleType:
    return importlib.import_module(f"{package.__name__}.torch_backend.contract")


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return _load(ROOT / "tests" / "addon" / "data" / "make_shot.py").make_shot(tmp_path)
