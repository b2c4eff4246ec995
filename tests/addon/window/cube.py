"""Places a cube among the frozen people, renders it through the compositor, checks it and saves a picture.

    SPLANNEQUIN_BACKEND_PYTHON=.venv/bin/python .venv-bpy-5.0/bin/python tests/addon/window/cube.py SHOT.splannequin

SHOT is a solved and trained shot of the bundled clip. Its take "cube" is frozen at the plate's size if it is missing.
No window is needed. Writes docs/images/cube-among-frozen.jpg (`--output FILE` for another place). The cube stands on
the desk behind the man on the right and in front of a screen. Its place comes from the take's depth.
"""

import argparse
import importlib
import importlib.util
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Vector

ROOT = Path(__file__).resolve().parents[3]
TAKE, FRAME = "cube", 48
MAN, SCREEN = (0.835, 0.47), (0.70, 0.50)
"""Frame positions of the right man's head and of the screen behind him, 0 to 1 from the upper left."""
MIDDLE, SIDE = (0.752, 0.5), 0.13
"""Frame position of the cube's centre, and its width as a fraction of the frame's width."""
NEAR = 0.03
"""Relative depth difference below which the check does not decide whether surface or cube is in front."""


def add_on(name: str):
    """Module of the add-on."""
    return importlib.import_module(f"bl_ext.user_default.splannequin.splannequin_addon.{name}")


def start() -> None:
    """Register the package as an installed extension."""
    spec = importlib.util.spec_from_file_location("run_in_bpy", ROOT / "splannequin_addon" / "run_in_bpy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.load_package().register()


def bake(shot: Path) -> None:
    """Insert the frozen frame into the compositor of a new scene with the solved camera."""
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.splannequin.shot_path, scene.splannequin.set_up_scene = str(shot), True
    for line in add_on("solve.arrival").load_camera(scene, shot):
        print(line)
    scene.frame_start = scene.frame_end = FRAME
    contract = importlib.import_module("bl_ext.user_default.splannequin.torch_backend.contract")
    params = contract.FreezeParams(
        take=TAKE, t_star=FRAME, width=scene.render.resolution_x, first=FRAME, last=FRAME, only_missing=True
    )
    if not add_on("freeze.takes").complete(shot, TAKE, [FRAME]):
        add_on("process.begin").run(scene, "freeze", params)
    for line in [
        *add_on("bake.insertion").insert_freeze(scene, shot, TAKE),
        *add_on("bake.insertion").combine_cg(scene, shot),
    ]:
        print(line)
    scene.frame_set(FRAME)
    for item in scene.objects:
        item.hide_render = item.type != "CAMERA"


def see(socket, folder: Path, name: str) -> np.ndarray:
    """[H, W, 4] scene-linear, top row first: a socket of the compositor, rendered."""
    scene, compat = bpy.context.scene, add_on("compat")
    tree = compat.compositor_tree(scene)
    target = compat.output_socket(tree)
    kept = target.links[0].from_socket
    tree.links.new(socket, target)
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    add_on("bake.rendering").render(scene, folder / name, png=False)
    tree.links.new(kept, target)
    return pixels_of(folder / name / f"{FRAME:06d}.exr")


def pixels_of(path: Path) -> np.ndarray:
    """[H, W, 4] float32: stored values of a picture file, top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def at(layer: np.ndarray, place: tuple[float, float]) -> float:
    """Median of a layer [H, W] around a frame position."""
    row, column = int(place[1] * layer.shape[0]), int(place[0] * layer.shape[1])
    return float(np.median(layer[row - 4 : row + 5, column - 4 : column + 5]))


def put_cube(depth: np.ndarray) -> float:
    """Add a chequered cube between man and screen, lit like the hall; return its distance along the camera's axis."""
    scene = bpy.context.scene
    man, screen = at(depth, MAN), at(depth, SCREEN)
    assert man < 0.9 * screen, f"the man at {man:.2f} should be well in front of the screen at {screen:.2f}"
    along = 0.5 * (man + screen)
    camera = scene.camera
    # top right, bottom right, bottom left
    corners = [camera.matrix_world @ c for c in camera.data.view_frame(scene=scene)]
    right, down = corners[0] - corners[3], corners[1] - corners[0]
    eye = camera.matrix_world.translation
    ray = corners[3] + MIDDLE[0] * right + MIDDLE[1] * down - eye
    axis = camera.matrix_world.to_3x3() @ Vector((0.0, 0.0, -1.0))
    place = eye + ray * (along / ray.dot(axis))
    wide = SIDE * right.length * along / (corners[3] - eye).dot(axis)
    bpy.ops.mesh.primitive_cube_add(size=0.8 * wide, location=place)
    cube = bpy.context.object
    cube.rotation_mode = "QUATERNION"
    # Aligned with the camera, then turned to show two sides and the top.
    turn = camera.matrix_world.to_quaternion()
    cube.rotation_quaternion = turn @ Euler((0.35, 0.6, 0.0)).to_quaternion()
    material = bpy.data.materials.new("Chequers")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    chequers, shader = nodes.new("ShaderNodeTexChecker"), nodes["Principled BSDF"]
    chequers.inputs["Color1"].default_value, chequers.inputs["Color2"].default_value = (0.8, 0.08, 0.02, 1), (0.9,) * 4
    chequers.inputs["Scale"].default_value = 4.001
    place_in = nodes.new("ShaderNodeTexCoord")
    links.new(place_in.outputs["Generated"], chequers.inputs["Vector"])
    links.new(chequers.outputs["Color"], shader.inputs["Base Color"])
    cube.data.materials.append(material)
    scene.world = bpy.data.worlds.new("Hall")
    scene.world.use_nodes = True
    sky = scene.world.node_tree.nodes.get("Background") or scene.world.node_tree.nodes.new("ShaderNodeBackground")
    sky.inputs["Color"].default_value, sky.inputs["Strength"].default_value = (0.9, 0.95, 1.0, 1.0), 0.7
    sun = bpy.data.objects.new("Lamps", bpy.data.lights.new("Lamps", "SUN"))
    sun.data.energy = 2.0
    sun.rotation_mode = "QUATERNION"
    sun.rotation_quaternion = turn @ Euler((-0.9, 0.3, 0.0)).to_quaternion()
    scene.collection.objects.link(sun)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device, scene.cycles.seed = 64, False, "CPU", 0
    return along


def check(picture: np.ndarray, frozen: np.ndarray, depth: np.ndarray, cube: np.ndarray, far: np.ndarray) -> str:
    """Check every pixel that the cube may cover, except its edge and nearly equal depths; return a line of figures."""
    inside = cube[..., 3] > 0.999
    outside = cube[..., 3] == 0.0
    nearer = inside & (far < depth * (1.0 - NEAR))
    hidden = inside & (far > depth * (1.0 + NEAR)) & (depth < 1e9)
    assert nearer.sum() > 1000, f"the cube should be seen, {nearer.sum()} pixels of it are"
    assert hidden.sum() > 300, f"the man should hide a part of the cube, he hides {hidden.sum()} pixels"
    np.testing.assert_allclose(picture[nearer][:, :3], cube[nearer][:, :3], atol=1e-4)
    # Splats let up to a percent of the background through.
    np.testing.assert_allclose(picture[hidden][:, :3], frozen[hidden][:, :3], atol=0.01)
    np.testing.assert_allclose(picture[outside][:, :3], frozen[outside][:, :3], atol=1e-4)
    undecided = inside & ~nearer & ~hidden
    return f"cube seen on {nearer.sum()} px, hidden on {hidden.sum()} px, undecided {undecided.sum()} px"


def keep(picture: Path, folder: Path) -> None:
    """Save the rendered picture as a JPEG of at most 150 kB."""
    scene = bpy.context.scene
    settings = scene.render.image_settings
    for quality in (92, 85, 75, 60):
        settings.file_format, settings.quality, settings.color_mode = "JPEG", quality, "RGB"
        add_on("bake.rendering").render(scene, folder / "jpeg", png=False)
        data = (folder / "jpeg" / f"{FRAME:06d}.jpg").read_bytes()
        if len(data) <= 150_000:
            break
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(data)
    print(f"{picture}: {len(data) / 1000:.0f} kB, quality {quality}")


def main() -> None:
    """Bake, place the cube, check, and write the picture."""
    parser = argparse.ArgumentParser(description="A cube among the frozen people.")
    parser.add_argument("shot", type=Path, help="solved and trained shot folder; a take is added to it")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "images" / "cube-among-frozen.jpg")
    args = parser.parse_args()
    start()
    bake(args.shot.absolute())
    scene = bpy.context.scene
    compat = add_on("compat")
    tree = compat.compositor_tree(scene)
    group = add_on("bake.freeze_group").group_node(tree)
    layers = next(n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        depth = see(group.outputs["Depth"], folder, "depth")[..., 0]
        frozen = see(group.outputs["Image"], folder, "frozen")
        put_cube(depth)
        picture = see(group.outputs["Image"], folder, "picture")
        cube = see(layers.outputs["Image"], folder, "cube")
        far = see(layers.outputs["Depth"], folder, "far")[..., 0]
        print(check(picture, frozen, depth, cube, far))
        keep(args.output, folder)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
