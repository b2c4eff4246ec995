"""Add-on modules that do not need Blender can be tested in a second; bpy must not be imported by them."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FREE = (
    "bake.node_names", "bake.take_files", "freeze.live", "process.children", "process.environment", "process.jobs",
    "process.steps", "scene.axes", "scene.ownership", "scene.numbered", "scene.scene_setup", "shot.checkpoints",
    "shot.inventory", "shot.file_cache", "shot.markers", "shot.shot_state", "shot.source", "solve.alignment",
    "train.estimates", "train.training", "ui.icons",
)  # fmt: skip
IMPORTS = """
import importlib, importlib.util, sys

class NoBlender:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("bpy", "mathutils", "gpu", "blf", "bmesh", "bpy_extras"):
            raise ImportError(f"{name} is Blender's")

sys.meta_path.insert(0, NoBlender())
spec = importlib.util.spec_from_file_location("loader", sys.argv[1])
loader = importlib.util.module_from_spec(spec)
spec.loader.exec_module(loader)
package = loader.load_package().__name__
for name in sys.argv[2:]:
    importlib.import_module(f"{package}.splannequin_addon.{name}")
"""


def imported(*names: str) -> subprocess.CompletedProcess[str]:
    """Import modules of the add-on in a Python without Blender."""
    command = [sys.executable, "-P", "-c", IMPORTS, str(ROOT / "splannequin_addon" / "run_in_bpy.py"), *names]
    return subprocess.run(command, capture_output=True, text=True)


def test_modules_that_need_no_blender_are_imported_without_one():
    done = imported(*FREE)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["compat", "shot.selection"])
def test_a_module_that_needs_blender_is_seen(name: str):
    done = imported(name)
    assert done.returncode != 0 and "is Blender's" in done.stderr
