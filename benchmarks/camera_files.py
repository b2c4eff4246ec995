"""Writes the true camera of a scene of benchmarks/synthetic as a matchmove would: Alembic and USD, by Blender.

    .venv-bpy-5.0/bin/python -P benchmarks/camera_files.py SCENE DIR

DIR gets camera.abc and camera.usdc. What they are worth against our own solve, with the clip's frames in SCENE/frames:

    python -m torch_backend import SHOT SCENE/frames/000001.png --fps F
    .venv-bpy-5.0/bin/python -P splannequin_addon/run_in_bpy.py solve --shot SHOT --cameras DIR/camera.abc
    python -m torch_backend train SHOT --holdout 8

`solve/cameras.json` has the reprojection error, `runs/main/summary.json` the held-out dB.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

SENSOR = 36.0
"""Width of the film back in mm; any would do."""


def main() -> int:
    folder, out = (Path(word) for word in sys.argv[-2:])
    told = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    (fx, _, cx), (_, _, cy), _ = told["K"]
    width, height = told["width"], told["height"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.fps = width, height, round(told["fps"])
    data = bpy.data.cameras.new("matchmove")
    data.sensor_fit, data.sensor_width, data.sensor_height = "HORIZONTAL", SENSOR, SENSOR * height / width
    data.lens, data.shift_x, data.shift_y = fx * SENSOR / width, 0.5 - cx / width, (cy - 0.5 * height) / width
    camera = bpy.data.objects.new("matchmove", data)
    scene.collection.objects.link(camera)
    camera.rotation_mode = "QUATERNION"
    for one in told["cameras"]:
        camera.matrix_world = Matrix(one["world_to_camera"]).inverted() @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
        for path in ("location", "rotation_quaternion"):
            camera.keyframe_insert(path, frame=one["frame"])
    scene.frame_start, scene.frame_end = told["cameras"][0]["frame"], told["cameras"][-1]["frame"]
    first, last = scene.frame_start, scene.frame_end
    bpy.ops.wm.alembic_export(filepath=str(out / "camera.abc"), start=first, end=last, as_background_job=False)
    bpy.ops.wm.usd_export(filepath=str(out / "camera.usdc"), export_animation=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
