"""Runs the Blender side of Splannequin without an installed extension: in a `bpy` wheel, or in a plain Blender.

    .venv-bpy-5.0/bin/python splannequin_addon/run_in_bpy.py bake --shot SHOT --take TAKE --output DIR
    blender --background --factory-startup --python splannequin_addon/run_in_bpy.py -- bake --shot SHOT ...

The package is loaded from this file's repository under the name of an installed extension. Relative imports,
preferences and operators therefore work the same way. Installs nothing and writes no preferences.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import types
from pathlib import Path

PACKAGE = "bl_ext.user_default.splannequin"


def load_package() -> types.ModuleType:
    """The extension package under its Blender name, loaded once and not registered."""
    with contextlib.suppress(ImportError):  # a Python without Blender, for modules that do not need it
        import bpy  # noqa: F401  # pyright: ignore[reportUnusedImport]  -- makes `bl_ext` where Blender has it

    if PACKAGE in sys.modules:
        return sys.modules[PACKAGE]
    root = Path(__file__).resolve().parent.parent
    for parent in ("bl_ext", "bl_ext.user_default"):
        if parent not in sys.modules:
            try:
                importlib.import_module(parent)
            except ImportError:
                module = types.ModuleType(parent)
                module.__path__ = []
                sys.modules[parent] = module
    spec = importlib.util.spec_from_file_location(PACKAGE, root / "__init__.py", submodule_search_locations=[str(root)])
    if spec is None or spec.loader is None:
        raise FileNotFoundError(f"{root} is not the Splannequin package: it has no __init__.py")
    package = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = package
    spec.loader.exec_module(package)
    return package


def main() -> int:
    """Registers the package and runs the same command line as `blender --command splannequin`."""
    arguments = sys.argv[1:]
    if "--" in arguments:
        arguments = arguments[arguments.index("--") + 1 :]
    package = load_package()
    package.register()
    headless = importlib.import_module(PACKAGE + ".splannequin_addon.command_line.headless")
    try:
        return headless.main(arguments)
    finally:
        # As a module, bpy 4.x frees registered classes after Python has ended, and crashes on panels.
        package.unregister()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    sys.exit(code)
