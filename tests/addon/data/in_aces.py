"""Runs in a separate Blender with another colour configuration; tests/addon/test_ocio.py starts it.

    OCIO=config.ocio PYTHON tests/addon/data/in_aces.py -- SHOT FOLDER      (or BLENDER --python ...)

Inserts the take `detail` into an empty scene and renders frame 6 as FOLDER/plate.exr (Mix 0), frozen.exr and warp.exr.
The files are 32-bit float, in the scene's linear space. Messages of the insertion are written to FOLDER/told.json.
"""

import importlib
import importlib.util
import json
import sys
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[3]


def add_on(name: str):
    return importlib.import_module(f"bl_ext.user_default.splannequin.splannequin_addon.{name}")


def main() -> None:
    shot, out = (Path(name) for name in sys.argv[sys.argv.index("--") + 1 :][:2])
    spec = importlib.util.spec_from_file_location("run_in_bpy", ROOT / "splannequin_addon" / "run_in_bpy.py")
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    package = runner.load_package()
    package.register()
    scene, bake = bpy.context.scene, add_on("bake.insertion")
    scene.splannequin.shot_path = str(shot)
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 56, 42, 100
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
    result = {"said": bake.insert_freeze(scene, shot, "detail")}
    node = add_on("bake.freeze_group").group_node(add_on("compat").compositor_tree(scene))
    scene.frame_set(6)
    for name, mix in (("plate", 0.0), ("frozen", 1.0), ("warp", 1.0)):
        if name == "warp":
            bake.insert_freeze(scene, shot, "detail", warp=True)
        node.inputs["Mix"].default_value = mix
        scene.render.filepath = str(out / f"{name}.exr")
        bpy.ops.render.render(write_still=True)
    (out / "told.json").write_text(json.dumps(result))
    package.unregister()


if __name__ == "__main__":
    main()
    sys.stdout.flush()
