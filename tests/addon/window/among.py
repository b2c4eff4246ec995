"""Suzanne, a second one and a chrome ball among the frozen people, with shadows on desk and people: a picture of it.

    SPLANNEQUIN_BACKEND_PYTHON=.venv/bin/python .venv-bpy-5.0/bin/python tests/addon/window/among.py SHOT.splannequin

SHOT is a solved and trained shot of the bundled clip. Its take "among" is frozen at frame 50 and its surface made if
they are not there. Real Blenders run it as `blender --background --python among.py -- SHOT`; without --background it
draws its window, too, and quits. Writes docs/images/cg-among-frozen.jpg (`--output FILE` for another place). Where
things stand, is taken from the take's own depth.
"""

import argparse
import importlib.util
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

_SPEC = importlib.util.spec_from_file_location("cube", Path(__file__).with_name("cube.py"))
cube = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(cube)

cube.TAKE, cube.FRAME = "among", 50
DESK = ((0.33, 0.73), (0.60, 0.735), (0.42, 0.685), (0.55, 0.70))
"""Places on the desk, 0 to 1 from the upper left of frame 50."""
SUZANNE, BEHIND, BALL = (0.475, 0.735), (0.285, 0.715), (0.625, 0.735)
"""Where on the desk the three stand: between the men, behind the left man's hand, before the right man's keyboard."""
TALL, SMALL, ROUND = 0.13, 0.11, 0.09
"""How large they are to be seen, in shares of the frame's width."""


class Eye:
    """Places in the scene of places in the frame."""

    def __init__(self, depth: np.ndarray) -> None:
        self.depth = depth
        camera = bpy.context.scene.camera
        corners = [camera.matrix_world @ c for c in camera.data.view_frame(scene=bpy.context.scene)]
        self.corner, self.right, self.down = corners[3], corners[0] - corners[3], corners[1] - corners[0]
        self.place = camera.matrix_world.translation.copy()
        self.axis = camera.matrix_world.to_3x3() @ Vector((0.0, 0.0, -1.0))

    def at(self, place: tuple[float, float]) -> Vector:
        """The frozen surface that is seen at a place of the frame."""
        ray = self.corner + place[0] * self.right + place[1] * self.down - self.place
        return self.place + ray * (cube.at(self.depth, place) / ray.dot(self.axis))

    def size(self, where: Vector, share: float) -> float:
        """Length in the scene of a share of the frame's width, at a point's distance."""
        away = (where - self.place).dot(self.axis)
        return share * self.right.length * away / (self.corner - self.place).dot(self.axis)


def plane_of(points: list[Vector], towards: Vector) -> tuple[Vector, Vector]:
    """(a point of the plane through points, its normal on the side of a point)."""
    middle = sum(points, Vector()) / len(points)
    normal = Vector(np.linalg.svd(np.array([p - middle for p in points]))[2][2])
    return middle, normal if normal.dot(towards - middle) > 0 else -normal


def material_of(name: str, colour: tuple[float, ...], metal: float, rough: float) -> bpy.types.Material:
    """A material of the Principled shader."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = metal, rough
    return material


def put(eye: Eye) -> None:
    """Suzannes and ball on the desk, in the light of the shot and of a lamp."""
    scene = bpy.context.scene
    middle, up = plane_of([eye.at(place) for place in DESK], eye.place)

    def on_desk(place: tuple[float, float]) -> Vector:
        where = eye.at(place)
        return where - up * (where - middle).dot(up)

    front = (eye.place - middle).normalized()
    front = (front - up * front.dot(up)).normalized()
    turn = Matrix((up.cross(front), -front, up)).transposed()  # Suzanne looks along her -Y
    for name, place, share, colour in (
        ("Suzanne", SUZANNE, TALL, (0.8, 0.25, 0.05)), ("Behind", BEHIND, SMALL, (0.05, 0.35, 0.7)),
    ):  # fmt: skip
        bpy.ops.mesh.primitive_monkey_add(size=1.0)
        monkey = bpy.context.object
        where = on_desk(place)
        wide = eye.size(where, share)
        middle_of = where + up * 0.36 * wide
        monkey.matrix_world = Matrix.LocRotScale(middle_of, turn.to_quaternion(), Vector((wide / 1.35,) * 3))
        monkey.data.materials.append(material_of(name, colour, 0.0, 0.4))
        bpy.ops.object.shade_smooth()
    where = on_desk(BALL)
    radius = 0.5 * eye.size(where, ROUND)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=radius, location=where + up * radius)
    ball = bpy.context.object
    ball.data.materials.append(material_of("Chrome", (0.9, 0.9, 0.9), 1.0, 0.02))
    bpy.ops.object.shade_smooth()
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN"))
    lamp.data.energy, lamp.data.angle = 2.0, 0.1
    lamp.rotation_mode = "QUATERNION"
    lamp.rotation_quaternion = (up + 0.35 * front - 0.5 * up.cross(front)).to_track_quat("Z", "Y")
    scene.collection.objects.link(lamp)
    scene.cursor.location = middle + up * radius
    scene.splannequin.take_name = cube.TAKE
    assert bpy.ops.splannequin.add_light() == {"FINISHED"}
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device, scene.cycles.seed = 64, False, "CPU", 0


def check(picture: np.ndarray, frozen: np.ndarray, cg: np.ndarray) -> str:
    """How many pixels of CG and its shadows are as Cycles made them over the frozen frame, where no man is near."""
    covered = cg[..., 3] > 0.01
    covered[:, : int(0.36 * covered.shape[1])] = covered[:, int(0.72 * covered.shape[1]) :] = False
    over = cg[..., :3] + (1.0 - cg[..., 3:]) * frozen[..., :3]
    off = np.abs(display(picture[..., :3]) - display(over)).max(-1)
    assert covered.sum() > 2000, f"things should be seen, {covered.sum()} pixels of them are"
    solid, rims = covered & (cg[..., 3] >= 0.99), covered & (cg[..., 3] < 0.99)
    parts = {"solid": solid, "rims and shadows": rims}
    return ", ".join(f"{n}: {of.sum()} px, {100 * (off[of] <= 1).mean():.1f} % within 1" for n, of in parts.items())


def display(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of scene-linear values, not rounded."""
    linear = np.clip(linear, 0.0, 1.0)
    return 255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def main() -> None:
    """Bakes, adds the surface, puts things, renders, says what is seen."""
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description="CG among the frozen people.")
    parser.add_argument("shot", type=Path, help="solved and trained shot folder; a take is added to it")
    parser.add_argument("--output", type=Path, default=cube.ROOT / "docs" / "images" / "cg-among-frozen.jpg")
    args = parser.parse_args(words)
    cube.start()
    shot = args.shot.absolute()
    cube.bake(shot)
    scene = bpy.context.scene
    contract = sys.modules["bl_ext.user_default.splannequin.torch_backend.contract"]
    surfaces = cube.add_on("freeze.surfaces")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tree = cube.add_on("compat").compositor_tree(scene)
        group = cube.add_on("bake.freeze_group").group_node(tree)
        layers = next(n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers")
        depth = cube.see(group.outputs["Depth"], folder, "depth")[..., 0]
        frozen = cube.see(group.outputs["Image"], folder, "frozen")
        if not surfaces.is_made(shot, cube.TAKE):
            cube.add_on("process.begin").run(scene, "freeze", contract.SurfaceParams(take=cube.TAKE))
        print(*surfaces.add(scene, shot, cube.TAKE), sep="\n")
        put(Eye(depth))
        picture = cube.see(group.outputs["Image"], folder, "picture")
        cg = cube.see(layers.outputs["Image"], folder, "cg")
        print(check(picture, frozen, cg))
        cube.keep(args.output, folder)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
