# pyright: reportMissingModuleSource=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportArgumentType=false
# As in synthetic/render_bpy.py: nodes, lights and meshes are more to Blender than their types say.
"""A rendered fisheye, solved: a lens of another formula than the solve's, against the cameras it was rendered from.

    BPY_PYTHON -m benchmarks.fisheye render OUT             # Cycles: OUT/clip/NNNN.png and OUT/truth.json
    python -m benchmarks.fisheye solve OUT [--camera-model OPENCV_FISHEYE]

The lens is equisolid, r = 2 f sin(angle / 2), as photographic fisheyes are; `OPENCV_FISHEYE` has r = f angle (1 + k1
angle^2 + ...), whose first terms of it are k1 = -1/24 and k2 = 1/1920. A room with things in it, a camera that is
carried through it by hand. Nobody tells the solve the focal length.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT, FRAMES, SAMPLES = 320, 240, 30, 12
LENS_MM, SENSOR_MM = 16.75, 36.0
"""130 degrees along the width, 169 over the diagonal."""
FOCAL_PX = LENS_MM / SENSOR_MM * WIDTH


def render(out: Path, samples: int) -> None:
    """Writes the clip and its truth; frames that are there are left alone. Runs in a Python that has bpy."""
    import bpy

    (out / "clip").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", samples, True
    scene.cycles.max_bounces = 2
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.6, 0.6, 0.6, 1.0)

    def surface(name: str) -> Any:
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        tree = material.node_tree
        shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
        picture = bpy.data.images.new(name, 512, 512)
        picture.pixels.foreach_set(_texture(rng).ravel())
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = picture
        tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
        shader.inputs["Roughness"].default_value = 1.0
        return material

    def box(centre: Any, size: Any, turn: float, inward: bool = False) -> None:
        bpy.ops.mesh.primitive_cube_add(size=1.0, location=centre, rotation=(0.0, 0.0, turn))
        thing = bpy.context.object
        thing.scale = size
        mesh = thing.data
        for side in range(6):
            mesh.materials.append(surface(f"{len(bpy.data.objects)} {side}"))
            mesh.polygons[side].material_index = side
            for corner, loop in enumerate(mesh.polygons[side].loop_indices):  # each side has the whole picture
                mesh.uv_layers[0].data[loop].uv = ((0, 0), (1, 0), (1, 1), (0, 1))[corner]
        if inward:
            mesh.flip_normals()

    box((0.0, 0.0, 1.5), (7.0, 6.0, 3.0), 0.0, inward=True)
    for _ in range(14):
        angle, away = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(1.7, 2.6)
        size = rng.uniform(0.3, 0.8, 3)
        box((away * math.cos(angle), away * math.sin(angle), 0.5 * size[2]), size, rng.uniform(0.0, 3.0))
    for x, y in ((-1.5, 1.0), (1.5, -1.0), (0.0, 0.0)):
        light = bpy.data.lights.new("lamp", "AREA")
        light.energy, light.size = 60.0, 1.5
        lamp = bpy.data.objects.new("lamp", light)
        lamp.location = (x, y, 2.95)
        scene.collection.objects.link(lamp)

    data = bpy.data.cameras.new("camera")
    data.type, data.sensor_width, data.sensor_fit = "PANO", SENSOR_MM, "HORIZONTAL"
    lens = data if hasattr(data, "panorama_type") else data.cycles  # Blender's own since 5.0
    lens.panorama_type, lens.fisheye_lens, lens.fisheye_fov = "FISHEYE_EQUISOLID", LENS_MM, math.pi
    data.clip_start = 0.01
    camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    truth = []
    for n in range(FRAMES):
        s = n / (FRAMES - 1)
        camera.location = (-0.7 + 1.3 * s, -0.9 + 0.25 * math.sin(3.0 * s), 1.45 + 0.04 * math.sin(11.0 * s))
        camera.rotation_euler = (
            math.radians(88.0 + 2.0 * math.sin(7.0 * s)),
            math.radians(1.5 * math.sin(5.0 * s)),
            math.radians(14.0 - 30.0 * s + 1.5 * math.sin(9.0 * s)),
        )
        bpy.context.view_layer.update()
        truth.append([list(row) for row in camera.matrix_world])
        file = out / "clip" / f"{n + 1:04d}.png"
        if not file.exists():
            scene.render.filepath = str(file)
            bpy.ops.render.render(write_still=True)
    text = json.dumps({"focal_px": FOCAL_PX, "camera_to_world": truth}, indent=1)
    (out / "truth.json").write_text(text + "\n", encoding="utf-8")


def _texture(rng: np.random.Generator) -> np.ndarray:
    """[512, 512, 4] float32: patches of all sizes, for features at every distance."""
    picture = np.empty((512, 512, 4), np.float32)
    picture[...] = (*rng.uniform(0.3, 0.7, 3), 1.0)
    for size in (160, 90, 50, 28, 16, 9):
        for _ in range(int(30000 / size**1.6)):
            x, y = rng.integers(0, 512, 2)
            w, h = rng.integers(size // 2, size + 1, 2)
            picture[y : y + h, x : x + w, :3] = rng.uniform(0.05, 0.9, 3)
    return picture


def solve(out: Path, model: str) -> dict[str, Any]:
    """Imports and solves the clip; how far that is from the truth."""
    import tempfile

    from benchmarks.solve import Stopwatch, align, rotation_degrees
    from torch_backend.cameras.poses import camera_centre
    from torch_backend.contract import CameraPath, read_json
    from torch_backend.footage import FootageConfig, import_footage
    from torch_backend.sfm.solving import SolveConfig, solve_shot
    from torch_backend.shot import Shot

    truth = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        shot, watch = Shot.create(Path(folder) / "fisheye.splannequin"), Stopwatch()
        import_footage(shot, str(out / "clip" / "0001.png"), FootageConfig(step=1), watch)
        began = time.process_time()
        wall = time.perf_counter()
        result = solve_shot(shot, SolveConfig(camera_model=model), watch)
        seconds = time.perf_counter() - wall, time.process_time() - began
        record = read_json(shot.solve_record)
        path = CameraPath.load(shot.solve / "cameras.json")
    poses = np.array([np.reshape(frame.viewmat, (4, 4)) for frame in path.frames])
    # Blender's camera looks along -z with y up, COLMAP's along z with y down.
    given = np.array([np.linalg.inv(np.array(m) @ np.diag([1.0, -1.0, -1.0, 1.0])) for m in truth["camera_to_world"]])
    centres, wanted = (np.array([camera_centre(p) for p in group]) for group in (poses, given))
    scale, rotation, shift = align(centres, wanted)
    off = np.linalg.norm(scale * centres @ rotation.T + shift - wanted, axis=1)
    length = float(np.linalg.norm(np.diff(wanted, axis=0), axis=1).sum())
    # Places on a line say nothing of how the path is turned about it: rotations are aligned by themselves.
    u, _, vt = np.linalg.svd(sum(p[:3, :3].T @ q[:3, :3] for p, q in zip(poses, given, strict=True)))
    turned = [p[:3, :3] @ u @ vt for p in poses]
    degrees = [rotation_degrees(a, b[:3, :3]) for a, b in zip(turned, given, strict=True)]
    return {
        "camera_model": record["camera_model"],
        "registered": result["registered"],
        "frames": result["frames"],
        "reprojection_error_px": result["reprojection_error_px"],
        "points": result["points"],
        "rotation_median_deg": round(float(np.median(degrees)), 4),
        "rotation_max_deg": round(float(np.max(degrees)), 4),
        "position_median_percent_of_path": round(100.0 * float(np.median(off)) / length, 4),
        "position_max_percent_of_path": round(100.0 * float(off.max()) / length, 4),
        "focal_px": round(record["focal_px"], 3),
        "focal_off_percent": round(100.0 * (record["focal_px"] / truth["focal_px"] - 1.0), 3),
        "distortion": [round(value, 5) for value in record["distortion"]],
        "tries": record["tries"],
        "seconds": round(seconds[0], 1),
        "warnings": watch.warnings,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("render", "solve"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--camera-model", default="OPENCV_FISHEYE")
    args = parser.parse_args()
    if args.what == "render":
        render(args.out.absolute(), args.samples)
    else:
        json.dump(solve(args.out.absolute(), args.camera_model), sys.stdout, indent=1)
        print()


if __name__ == "__main__":
    main()
