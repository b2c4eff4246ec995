"""Motion blur of a camera move, compared with Cycles' motion blur.

Cycles renders the scene at the sub-frame poses at which the backend composites.
"""

import json
import os
import subprocess
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from tests.addon.data.pixels import read, set_format

DATA = Path(__file__).resolve().parent / "data"
SIZE, LENS, DEPTH, MIDDLE = (64, 48), 30.0, 5.0, 4
FLIP = Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))


def picture(scene, folder: Path) -> np.ndarray:
    """[H, W, 3] scene-linear: render of the scene."""
    scene.render.filepath = str(folder / "one.exr")
    bpy.ops.render.render(write_still=True)
    return read(scene.render.filepath)[::-1, :, :3].astype(np.float64)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.square(a - b).mean()))


@pytest.fixture
def wall(scene):
    """Emissive chequered wall and a camera that moves and turns along curves, rendered by Cycles."""
    for one in list(scene.objects):
        bpy.data.objects.remove(one)
    scene.world = None
    tiles = np.random.default_rng(1).uniform(0.0, 1.0, (24, 24, 3)).repeat(3, axis=0).repeat(3, axis=1)
    image = bpy.data.images.new("tiles", 72, 72, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.concatenate([tiles, np.ones((72, 72, 1))], axis=2).astype(np.float32).ravel())
    image.update()
    material = bpy.data.materials.new("glow")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    read, glow, out = (tree.nodes.new(f"ShaderNode{n}") for n in ("TexImage", "Emission", "OutputMaterial"))
    read.image = image
    tree.links.new(read.outputs[0], glow.inputs[0])
    tree.links.new(glow.outputs[0], out.inputs[0])
    bpy.ops.mesh.primitive_plane_add(size=14.0)
    bpy.context.object.data.materials.append(material)
    camera = bpy.data.objects.new("moves", bpy.data.cameras.new("moves"))
    camera.data.lens = LENS
    scene.collection.objects.link(camera)
    scene.camera = camera
    for frame, place, turn in ((1, (-0.6, -0.2, 5.0), 0.08), (6, (0.5, 0.3, 4.8), -0.1), (11, (0.1, -0.1, 5.2), 0.0)):
        camera.location, camera.rotation_euler = place, (0.02, turn, 0.5 * turn)
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 32, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *SIZE, 100
    set_format(scene, "OPEN_EXR")
    return camera


def test_mean_over_the_shutter_matches_cycles_motion_blur(scene, wall, root, tmp_path):
    python = os.environ.get("SPLANNEQUIN_BACKEND_PYTHON")
    if not python:
        pytest.skip("no backend to ask: SPLANNEQUIN_BACKEND_PYTHON names its Python")
    focal, frames = SIZE[0] * LENS / wall.data.sensor_width, []
    for number in range(MIDDLE - 1, MIDDLE + 2):
        scene.frame_set(number)
        seen = wall.evaluated_get(bpy.context.evaluated_depsgraph_get())
        viewmat = [value for row in FLIP @ seen.matrix_world.inverted() for value in row]
        frames.append({"frame": number, "viewmat": viewmat, "K": [focal, focal, SIZE[0] / 2, SIZE[1] / 2]})
    camera_path = {"version": 1, "width": SIZE[0], "height": SIZE[1], "frames": frames}
    path, out = tmp_path / "path.json", tmp_path / "poses.json"
    path.write_text(json.dumps(camera_path))
    words = [python, str(DATA / "sub_poses.py"), str(root), str(path), str(MIDDLE), str(DEPTH), str(out)]
    subprocess.run(words, check=True, timeout=300)
    scene.frame_set(MIDDLE)
    sharp = picture(scene, tmp_path)
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 0.5
    scene.render.motion_blur_position = "CENTER"
    cycles = picture(scene, tmp_path)
    scene.render.use_motion_blur = False
    wall.animation_data_clear()
    pictures = []
    for seed, pose in enumerate(json.loads(out.read_text())):
        wall.matrix_world = (FLIP @ Matrix([pose[n : n + 4] for n in range(0, 16, 4)])).inverted()
        scene.cycles.seed = seed + 1
        pictures.append(picture(scene, tmp_path))
    mean = np.mean(pictures, axis=0)
    found, without = psnr(mean, cycles), psnr(sharp, cycles)
    assert found > 36.0 and found > without + 6.0, "42.4 and 30.8 dB when it was made"
