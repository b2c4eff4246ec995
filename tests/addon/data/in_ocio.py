"""Runs in a separate Blender with another colour configuration; tests/addon/test_ocio.py starts it.

    OCIO=config.ocio PYTHON tests/addon/data/in_ocio.py -- SHOT FOLDER      (or BLENDER --python ...)

Builds the camera, inserts the take, renders frame 6 twice (plate, frozen) into FOLDER, and writes FOLDER/told.json.
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


def file_state(scene) -> dict:
    """Everything that a step could change in the file."""
    kinds = ("objects", "cameras", "meshes", "collections", "node_groups", "actions", "images", "textures")
    render, view = scene.render, scene.view_settings
    return {
        **{kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds},
        "camera": scene.camera.name if scene.camera else None,
        "size": [render.resolution_x, render.resolution_y, render.fps, scene.frame_start, scene.frame_end],
        "colours": [view.view_transform, view.look, round(render.dither_intensity, 3), render.use_compositing],
        "markers": [marker.name for marker in scene.timeline_markers],
        "made": [one.name for one in scene.splannequin.made],
        "own": sorted(key for key in scene.keys() if key.startswith("splannequin_")),  # noqa: SIM118
    }


def tried(scene, change) -> dict:
    """Run a change; return its message or error, and the part of the file that it changed."""
    before = file_state(scene)
    try:
        said = {"said": change()}
    except Exception as error:
        said = {"error": f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()}
    after = file_state(scene)
    return said | {"changed": {k: (before[k], after[k]) for k in before if before[k] != after[k]}}


def main() -> None:
    shot, out = (Path(name) for name in sys.argv[sys.argv.index("--") + 1 :][:2])
    spec = importlib.util.spec_from_file_location("run_in_bpy", ROOT / "splannequin_addon" / "run_in_bpy.py")
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    package = runner.load_package()
    package.register()
    scene, compat = bpy.context.scene, add_on("compat")
    scene.splannequin.shot_path = str(shot)
    result = {"blender": bpy.app.version_string}
    result["first"] = tried(scene, lambda: add_on("solve.arrival").load_camera(scene, shot))
    # without a plate no colour space is needed, so the camera is built; the next try must not remove it
    if "error" in result["first"]:
        (shot / "frames").rename(shot / "away")
        result["without a plate"] = tried(scene, lambda: add_on("solve.arrival").load_camera(scene, shot))
        (shot / "away").rename(shot / "frames")
        result["again"] = tried(scene, lambda: add_on("solve.arrival").load_camera(scene, shot))
    result["freeze"] = tried(scene, lambda: add_on("bake.insertion").insert_freeze(scene, shot, "freeze"))
    if "error" in result["freeze"]:
        scene.splannequin.keep_colours = False
        result["as they come"] = tried(scene, lambda: add_on("bake.insertion").insert_freeze(scene, shot, "freeze"))
    else:
        result["combined"] = tried(scene, lambda: add_on("bake.insertion").combine_cg(scene, shot))
        node = add_on("bake.freeze_group").group_node(compat.compositor_tree(scene))
        node.inputs["CG"].links[0].from_node.mute = True
        scene.frame_start = scene.frame_end = 6
        for name, mix in (("plate", 0.0), ("frozen", 1.0)):
            node.inputs["Mix"].default_value = mix
            add_on("bake.rendering").render(scene, out / name)
    result["removed"] = tried(scene, lambda: add_on("process.begin").remove_all(scene, shot))
    result["end"] = file_state(scene)
    (out / "told.json").write_text(json.dumps(result))
    package.unregister()


if __name__ == "__main__":
    main()
    sys.stdout.flush()
