# pyright: reportMissingModuleSource=false
"""Writes an animated camera as Alembic or USD with Blender's exporters: `python write_camera_bpy.py JSON FILE...`.

Runs inside a bpy wheel's Python. JSON is a file with `width`, `height`, `fps`, `K` ([3, 3] px, pixel centres at +0.5)
and `frames`, a list of [frame number, world_to_camera ([4, 4], OpenCV axes, metres)]. The ending of each FILE, .abc,
.usd, .usda or .usdc, chooses the exporter.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

FILM_MM = 36.0
"""Width of the film back in mm; its height follows from the aspect ratio of the pictures, for square pixels."""


def main(source: Path, files: list[Path]) -> None:
    """Creates the camera in an empty scene and exports it to each of the files."""
    record = json.loads(source.read_text(encoding="utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene: Any = bpy.context.scene
    numbers = [number for number, _ in record["frames"]]
    scene.frame_start, scene.frame_end = min(numbers), max(numbers)
    scene.render.fps = max(1, round(record["fps"]))
    scene.render.fps_base = scene.render.fps / record["fps"]
    scene.render.resolution_x, scene.render.resolution_y = record["width"], record["height"]
    camera = _camera(record)
    scene.collection.objects.link(camera)
    scene.camera = camera
    for number, view in record["frames"]:
        camera.matrix_world = Matrix((np.linalg.inv(view) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())
        for path in ("location", "rotation_quaternion"):
            camera.keyframe_insert(path, frame=number)
    for file in files:
        if file.suffix == ".abc":
            span = {"start": scene.frame_start, "end": scene.frame_end}
            bpy.ops.wm.alembic_export(filepath=str(file), as_background_job=False, **span)
        else:
            bpy.ops.wm.usd_export(filepath=str(file), export_animation=True)


def _camera(record: dict[str, Any]) -> Any:
    """A camera with the pictures' lens; its principal point becomes Blender's shift, in units of the film's width."""
    (fx, _, cx), (_, _, cy), _ = record["K"]
    width, height = record["width"], record["height"]
    data = bpy.data.cameras.new("matchmove")
    data.sensor_fit, data.sensor_width, data.sensor_height = "HORIZONTAL", FILM_MM, FILM_MM * height / width
    data.lens = fx / width * FILM_MM
    data.shift_x, data.shift_y = 0.5 - cx / width, (cy - 0.5 * height) / width
    camera = bpy.data.objects.new("matchmove", data)
    camera.rotation_mode = "QUATERNION"
    return camera


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
