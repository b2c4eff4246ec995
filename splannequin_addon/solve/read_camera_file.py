"""Script that runs `camera_file.main` in a separate Blender process.

blender --background --factory-startup --python read_camera_file.py -- JSON
python read_camera_file.py -- JSON
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path


def main() -> int:
    """Loads the package without registering it. Returns the exit code of `camera_file.main`."""
    script = Path(__file__).resolve().parents[1] / "run_in_bpy.py"
    spec = importlib.util.spec_from_file_location("_splannequin_run_in_bpy", script)
    assert spec is not None and spec.loader is not None
    loader = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loader)
    loader.load_package()
    reader = importlib.import_module(f"{loader.PACKAGE}.splannequin_addon.solve.camera_file")
    return int(reader.main(sys.argv[sys.argv.index("--") + 1]))


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # skip the clean-up: nothing to save, and bpy as a module may crash in it
