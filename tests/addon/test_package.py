"""Manifest and zip of the extension, checked with Blender's own packager."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import pytest


@pytest.fixture
def packager(tmp_path):
    """packager(*arguments): runs Blender's `extension` command line with this Python and returns its output."""
    scripts = Path(bpy.utils.system_resource("SCRIPTS"))
    tool = scripts / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    assert tool.is_file()

    def run(*arguments) -> str:
        done = subprocess.run([sys.executable, str(tool), *map(str, arguments)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_source_and_zip_are_valid_and_hold_what_is_needed(packager, root, tmp_path):
    packager("validate", root)
    target = tmp_path / "splannequin.zip"
    packager("build", "--source-dir", root, "--output-filepath", target)
    packager("validate", target)
    with zipfile.ZipFile(target) as archive:
        names = archive.namelist()
    assert {n.partition("/")[0] for n in names} == {
        "LICENSE", "README.md", "__init__.py", "blender_manifest.toml", "launcher", "pyproject.toml", "requirements",
        "splannequin.py", "splannequin_addon", "torch_backend",
    }  # fmt: skip
    needed = {"backend.txt", "backend.lock", "torch.lock", "torch-cpu.lock", "torch-cu130.lock", "cuda.lock"}
    assert {"splannequin_addon/registration.py", *(f"requirements/{name}" for name in needed)} <= set(names)
    for_developers = ("requirements/test", "requirements/bench")
    assert not [n for n in names if n.startswith(for_developers)]
    assert {"torch_backend/contract/__init__.py", "torch_backend/contract/options.py"} <= set(names)
    assert {"splannequin_addon/translations/__init__.py", "splannequin_addon/translations/de_DE.py"} <= set(names)
    # Kernels are not Python modules; the rasteriser reads them when it draws its first picture.
    kernels = [p for p in (root / "torch_backend").rglob("kernels/**/*") if p.is_file()]
    assert kernels and {p.relative_to(root).as_posix() for p in kernels} <= set(names)
    assert not [n for n in names if "__pycache__" in n or n.endswith((".pyc", ".whl", ".so", ".pyd"))]


def test_manifest_agrees_with_the_package(root):
    manifest = tomllib.loads((root / "blender_manifest.toml").read_text(encoding="utf-8"))
    version = re.search(r'__version__ = "(.+)"', (root / "torch_backend" / "__init__.py").read_text())
    assert version and manifest["version"] == version.group(1)
    assert manifest["id"] == "splannequin" and manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert all(host in manifest["permissions"]["network"] for host in ("pypi.org", "pytorch.org"))
    assert len(manifest["tagline"]) <= 64 and not manifest["tagline"].endswith(".")
