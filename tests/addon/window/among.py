"""Renders Suzanne, a second one and a chrome ball among the frozen people, with shadows on desk and lap.

    SPLANNEQUIN_BACKEND_PYTHON=.venv/bin/python .venv-bpy-5.0/bin/python tests/addon/window/among.py SHOT.splannequin
    python tests/addon/window/among.py SHOT.splannequin --blender BLENDER [--pictures DIR]

SHOT is a solved and trained shot of the bundled clip. If they are missing, its take "among" is frozen at frame 50 and
its surface is made. Objects are placed by the take's depth and surface.

The first command needs no window and writes docs/images/cg-among-frozen.jpg, or `--output FILE`. A Blender without the
extension runs it as `blender -b --factory-startup --python among.py -- SHOT`. The second command presses the panel's
buttons in a real window, on a copy of the shot, whose take must exist; press_steps.py lists what it needs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

with contextlib.suppress(ImportError):  # the process that controls a window has no bpy
    import bpy
    import cube
    from mathutils import Matrix, Vector

    cube.TAKE, cube.FRAME = "among", 50

DESK = (0.31, 0.77, 0.70, 0.75)
"""Part of frame 50 that shows the desk: left, right, top, bottom, from 0 to 1, counted from the upper left."""
SUZANNE, BEHIND, BALL = (0.46, 0.708), (0.275, 0.735), (0.60, 0.735)
"""Frame positions on the desk: between the men, behind the left man's hand, and left of the right man's keyboard."""
TALL, SMALL, ROUND = 0.15, 0.12, 0.09
"""Widths of the three objects as fractions of the frame's width."""
LAP = (0.36, 0.86)
"""Frame position on the left man's lap where the shadow of Suzanne's forehead falls; it gives the lamp's direction."""
SHADOWS = {"desk": (0.43, 0.46, 0.735, 0.745), "lap": (0.34, 0.40, 0.86, 0.88)}
"""Areas in Suzanne's shadow: left, right, top, bottom."""
HAND, ABOVE_HAND = (0.25, 0.285, 0.73, 0.755), (0.25, 0.285, 0.66, 0.70)
"""Area of the left man's hand in front of the second Suzanne, and area of that Suzanne above the hand."""


class Eye:
    """Maps positions in the frame to the scene."""

    def __init__(self, depth: np.ndarray) -> None:
        self.depth = depth
        camera = bpy.context.scene.camera
        corners = [camera.matrix_world @ c for c in camera.data.view_frame(scene=bpy.context.scene)]
        self.corner, self.right, self.down = corners[3], corners[0] - corners[3], corners[1] - corners[0]
        self.place = camera.matrix_world.translation.copy()
        self.axis = camera.matrix_world.to_3x3() @ Vector((0.0, 0.0, -1.0))

    def at(self, place: tuple[float, float]) -> Vector:
        """Point of the frozen surface at a frame position."""
        ray = self.ray(place)
        return self.place + ray * (cube.at(self.depth, place) / ray.dot(self.axis))

    def ray(self, place: tuple[float, float]) -> Vector:
        """Ray from the camera through a frame position (not normalised)."""
        return self.corner + place[0] * self.right + place[1] * self.down - self.place

    def size(self, where: Vector, share: float) -> float:
        """Length in the scene, at the distance of `where`, that spans `share` of the frame's width."""
        distance = (where - self.place).dot(self.axis)
        return share * self.right.length * distance / (self.corner - self.place).dot(self.axis)


def plane_of(points: np.ndarray, towards: Vector) -> tuple[Vector, Vector]:
    """(point, normal) of the plane through most of the points [N, 3]; the normal points towards `towards`.

    Objects on the desk must not tilt the plane. Each round keeps points no farther from it than twice the median
    distance.
    """
    kept = points
    for _ in range(20):
        middle = kept.mean(0)
        normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
        distance = np.abs((points - middle) @ normal)
        kept = points[distance <= 2.0 * np.median(distance)]
    middle, normal = Vector(middle), Vector(normal)
    return middle, normal if normal.dot(towards - middle) > 0 else -normal


def material_of(name: str, colour: tuple[float, ...], metal: float, rough: float) -> bpy.types.Material:
    """New material with a Principled shader."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = metal, rough
    return material


def put(eye: Eye) -> None:
    """Add two Suzannes and a ball on the desk, and a lamp; the shot's light stays on."""
    scene = bpy.context.scene
    left, right, top, bottom = DESK
    columns, rows = np.linspace(left, right, 60).tolist(), np.linspace(top, bottom, 20).tolist()
    middle, up = plane_of(np.array([eye.at((x, y)) for x in columns for y in rows]), eye.place)
    graph = bpy.context.evaluated_depsgraph_get()

    def on_desk(place: tuple[float, float]) -> Vector:
        """Intersection of a position's ray with the desk's plane, moved onto the surface along the normal."""
        ray = eye.ray(place)
        where = eye.place + ray * ((middle - eye.place).dot(up) / ray.dot(up))
        is_hit, found, *_ = scene.ray_cast(graph, where + up, -up, distance=2.0)
        return found if is_hit else where

    front = (eye.place - middle).normalized()
    front = (front - up * front.dot(up)).normalized()
    turn = Matrix((up.cross(front), -front, up)).transposed()  # Suzanne faces -Y
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
        monkey.modifiers.new("Round", "SUBSURF").render_levels = 2
        if name == "Suzanne":
            forehead = middle_of + 0.2 * wide * up
    where = on_desk(BALL)
    radius = 0.5 * eye.size(where, ROUND)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=radius, location=where + up * radius)
    ball = bpy.context.object
    ball.data.materials.append(material_of("Chrome", (0.9, 0.9, 0.9), 1.0, 0.02))
    bpy.ops.object.shade_smooth()
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN"))
    lamp.data.energy, lamp.data.angle = 2.0, 0.1
    lamp.rotation_mode = "QUATERNION"
    lamp.rotation_quaternion = (forehead - eye.at(LAP)).to_track_quat("Z", "Y")
    scene.collection.objects.link(lamp)
    scene.cursor.location = middle + up * radius
    scene.splannequin.take_name = cube.TAKE
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device, scene.cycles.seed = 64, False, "CPU", 0


def check(picture: np.ndarray, frozen: np.ndarray, cg: np.ndarray) -> dict[str, float]:
    """Compare CG and shadows of a picture with CG composited over the frozen frame, away from the men; return the
    figures.

    Figures include the darkness of the shadows. Raises AssertionError if CG, a shadow or the hand in front is missing.
    """
    covered = cg[..., 3] > 0.01
    covered[:, : int(0.36 * covered.shape[1])] = covered[:, int(0.72 * covered.shape[1]) :] = False
    over = cg[..., :3] + (1.0 - cg[..., 3:]) * frozen[..., :3]
    error = np.abs(display(picture[..., :3]) - display(over)).max(-1)
    assert covered.sum() > 2000, f"things should be seen, {covered.sum()} pixels of them are"
    solid, rims = covered & (cg[..., 3] >= 0.99), covered & (cg[..., 3] < 0.99)
    figures: dict[str, float] = {}
    for name, part in {"solid": solid, "rims and shadows": rims}.items():
        figures[f"{name}, px"] = int(part.sum())
        figures[f"{name}, % within 1/255"] = round(100.0 * float((error[part] <= 1).mean()), 2)
        figures[f"{name}, 99.9 % within"] = round(float(np.quantile(error[part], 0.999)), 1)
    for name, place in SHADOWS.items():
        dark = 1.0 - cut(picture, place)[..., :3].mean() / cut(frozen, place)[..., :3].mean()
        figures[f"shadow on the {name}, % darker"] = round(100.0 * float(dark), 1)
    stays = np.abs(display(cut(picture, HAND)) - display(cut(frozen, HAND)))[..., :3].max(-1) <= 1
    figures["hand in front, % as frozen"] = round(100.0 * float(stays.mean()), 1)
    figures["second one above the hand, px"] = int((cut(cg, ABOVE_HAND)[..., 3] > 0.99).sum())
    print(json.dumps(figures, indent=1))
    assert all(figures[f"shadow on the {name}, % darker"] > 10.0 for name in SHADOWS), "shadows should fall on both"
    assert stays.mean() > 0.5 and figures["second one above the hand, px"] > 50, "the hand should be in front"
    return figures


def cut(picture: np.ndarray, place: tuple[float, float, float, float]) -> np.ndarray:
    """Part of a picture; `place` is left, right, top, bottom in 0 to 1."""
    height, width = picture.shape[:2]
    left, right, top, bottom = place
    return picture[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]


def display(linear: np.ndarray) -> np.ndarray:
    """Scene-linear values as 8-bit sRGB, not rounded."""
    linear = np.clip(linear, 0.0, 1.0)
    return 255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def save(picture: np.ndarray, path: Path) -> None:
    """Save a scene-linear picture as an sRGB JPEG."""
    height, width = picture.shape[:2]
    image = bpy.data.images.new("among", width, height)
    shown = np.concatenate([display(picture[..., :3]) / 255.0, np.ones_like(picture[..., :1])], -1)
    image.pixels.foreach_set(np.ascontiguousarray(shown[::-1], np.float32).ravel())
    path.parent.mkdir(parents=True, exist_ok=True)
    image.file_format = "JPEG"
    image.save(filepath=str(path), quality=92)
    bpy.data.images.remove(image)


class Sockets:
    """Renders sockets of the compositor."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        tree = cube.add_on("compat").compositor_tree(bpy.context.scene)
        self.group = cube.add_on("bake.freeze_group").group_node(tree)
        self.layers = next(n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers")

    def of_group(self, output: str) -> np.ndarray:
        """[H, W, 4]: an output of the freeze's group."""
        return cube.see(self.group.outputs[output], self.folder, output)

    def cg(self) -> np.ndarray:
        """[H, W, 4]: the scene's own render."""
        return cube.see(self.layers.outputs["Image"], self.folder, "CG")


def headless(shot: Path, output: Path, samples: int) -> None:
    """Bake, add the surface, place the objects, render, and print the figures."""
    cube.start()
    scene, shot = bpy.context.scene, shot.absolute()
    scene.splannequin.shot_path = str(shot)
    contract = sys.modules["bl_ext.user_default.splannequin.torch_backend.contract"]
    begin, surfaces = cube.add_on("process.begin"), cube.add_on("freeze.surfaces")
    whole = contract.FreezeParams(take=cube.TAKE, t_star=cube.FRAME, only_missing=True)
    if not cube.add_on("freeze.takes").complete(shot, cube.TAKE, [cube.FRAME]):
        begin.run(scene, "freeze", whole)
    cube.bake(shot)
    scene = bpy.context.scene
    with tempfile.TemporaryDirectory() as name:
        sockets = Sockets(Path(name))
        depth, frozen = sockets.of_group("Depth")[..., 0], sockets.of_group("Image")
        if not surfaces.has_surface(shot, cube.TAKE):
            begin.run(scene, "freeze", contract.SurfaceParams(take=cube.TAKE))
        print(*surfaces.add(scene, shot, cube.TAKE), sep="\n")
        put(Eye(depth))
        assert bpy.ops.splannequin.add_light() == {"FINISHED"}
        scene.cycles.samples = samples
        picture = sockets.of_group("Image")
        save(picture, output)
        print(bpy.app.version_string)
        check(picture, frozen, sockets.cg())


# ------------------------------------------------------------------------------------------------- in a window


def play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    """Play the artist in a window: surface, light, CG and bake by the panel's buttons."""
    work = Path(plan["work"])
    shot = work / "sitting.splannequin"
    shutil.copytree(plan["shot"], shot, ignore=shutil.ignore_patterns("jobs", "lock.json"))
    panel = press.addon_module("ui.step_panel")
    sub_panel = panel.sub_panel
    unfolded = ("takes", "freeze_more", "bake_more")
    panel.sub_panel = lambda layout, name, label, folded=True: sub_panel(layout, name, label, name not in unfolded)
    yield from press._arrange()
    scene = bpy.context.scene
    scene.splannequin.shot_path, scene.splannequin.take_name = str(shot), cube.TAKE
    for item in scene.objects:
        item.hide_render = item.type != "CAMERA"
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.splannequin.load_camera()
    yield 2.0
    scene.splannequin.choose_t_star, scene.splannequin.t_star = True, cube.FRAME
    scene.frame_start = scene.frame_end = cube.FRAME
    scene.frame_set(cube.FRAME)
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    yield from _press(shot, "add_surface", results, lambda: _entry().surfaces)
    yield from press._shoot(work, "12-surface")
    yield from _press(shot, "insert_freeze", results, _group)
    yield from _press(shot, "combine_cg", results, lambda: _group().inputs["CG"].is_linked)
    yield from press._shoot(work, "12-combined")
    sockets = Sockets(work)
    depth, frozen = sockets.of_group("Depth")[..., 0], sockets.of_group("Image")
    put(Eye(depth))
    yield 1.0
    yield from _press(shot, "add_light", results, lambda: _entry().light)
    yield from press._shoot(work, "12-light")
    scene = _scene()
    scene.cycles.samples = plan["samples"]
    scene.render.filepath = str(work / "baked" / "######")
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    yield from _press(shot, "bake", results)
    picture = cube.pixels_of(next((work / "baked").glob("*.exr")))
    save(picture, Path(plan["output"]))
    results.update(check(picture, frozen, Sockets(work).cg()))
    yield from _show_render(work)


def _scene() -> Any:
    """The window's scene. Undo replaces the scene object, so it is looked up each time."""
    return bpy.context.window_manager.windows[0].scene


def _entry() -> Any:
    """The shot's entry in the scene's record of created objects."""
    return _scene().splannequin.made[0]


def _group() -> Any:
    """Node of the freeze's group, or None."""
    tree = cube.add_on("compat").compositor_tree(_scene())
    return None if tree is None else cube.add_on("bake.freeze_group").group_node(tree)


def _press(shot: Path, operator: str, results: dict[str, Any], has: Callable[[], Any] | None = None) -> Iterator[float]:
    """Click a button of the panel and wait until its job has ended.

    With `has`, which finds the added object, also undo and redo the step.
    """
    watch = press._supervisor().watch_of(shot)
    window = bpy.context.window_manager.windows[0]
    with bpy.context.temp_override(window=window):
        bpy.ops.ed.undo_push(message="Before")
    for _ in range(8):  # all of these buttons are at the end of the sidebar
        yield from press._scroll_down()
    began = time.monotonic()
    yield from press._click(f"splannequin.{operator}")
    yield 1.0
    while watch.running() is not None:
        yield 0.3
    yield 1.5
    failed = [sentence for sentence, _ in watch.failures.values()]
    assert not failed, f"{operator}: {failed}"
    results.setdefault("pressed", {})[operator] = round(time.monotonic() - began)
    if has is None:
        return
    for step, should_be in (("nothing", True), ("undo", False), ("redo", True)):
        if step != "nothing":
            with bpy.context.temp_override(window=window):
                getattr(bpy.ops.ed, step)()
            yield 1.0
        assert bool(has()) == should_be, f"{operator} after {step}"
    results.setdefault("undone and redone", []).append(operator)


def _show_render(work: Path) -> Iterator[float]:
    """Take a picture of the window with the baked frame."""
    window = bpy.context.window_manager.windows[0]
    window.workspace = bpy.data.workspaces["Rendering"]
    yield 2.0
    yield from press._shoot(work, "12-baked")


def main() -> int:
    """Run the command line, in any of the three ways."""
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description="CG among the frozen people.")
    parser.add_argument("shot", type=Path, help="solved and trained shot folder; a take is added to it")
    picture = Path(__file__).resolve().parents[3] / "docs" / "images" / "cg-among-frozen.jpg"
    parser.add_argument("--output", type=Path, default=picture, help="JPEG of what is rendered")
    parser.add_argument("--samples", type=int, default=64, help="samples of Cycles")
    parser.add_argument("--blender", help="Blender with the extension installed, to run in a window of it")
    parser.add_argument("--pictures", default="docs/images", help="folder for pictures of the window")
    parser.add_argument("--display", default=":94", help="X display to open")
    parser.add_argument("--limit", type=float, default=1500.0, help="seconds until Blender is ended")
    args = parser.parse_args(words)
    if args.blender is None:
        headless(args.shot, args.output, args.samples)
        return 0
    host = argparse.Namespace(output=args.pictures, display=args.display, blender=args.blender, limit=args.limit)
    plan = {"shot": str(args.shot.absolute()), "output": str(args.output.absolute()), "samples": args.samples}
    return 1 if "error" in press._host(__file__, plan, host) else 0


if __name__ == "__main__":
    if press.PLAN in os.environ and "bpy" in sys.modules:
        facts = json.loads(os.environ[press.PLAN])
        seen: dict[str, Any] = {"blender": bpy.app.version_string}
        press.act(play(facts, seen), Path(facts["work"]), seen)
    else:
        status = main()
        sys.stdout.flush()
        if "bpy" not in sys.modules:
            sys.exit(status)
