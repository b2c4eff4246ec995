"""Checks what a bake leaves in an artist's comp, in a real Blender window: sizes, CG, a grade, removal.

    python tests/addon/window/comp.py --blender BLENDER --shot SHOT.splannequin [--output docs/images]

BLENDER has the extension installed, as for press_steps.py. The shot is of the bundled clip and has a take "freeze" with
frame 48 (`freeze examples/sitting.mp4`, any preset). Takes pictures. Exit status is 0 if

- the take, inserted at 50 %, fills the frame at 100 %;
- the cube is kept where Only Moving shows the plate, its edge is soft, and no hand is shown twice;
- a grade behind the plate is kept;
- the scene keeps its size, and has its camera back at the end.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

FRAME, SIZE = 48, (1280, 720)
GOOD = (
    "size_kept", "filled", "cube_kept", "moved_once", "edge_soft", "as_plate", "grade_kept", "frozen", "links_back",
    "camera_back",
)  # fmt: skip


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    import bpy

    work = Path(plan["work"])
    shot = work / "comp.splannequin"
    shutil.copytree(plan["shot"], shot, ignore=shutil.ignore_patterns("jobs", "runs"))
    yield from press._arrange()
    scene = bpy.context.scene
    camera_name, render = scene.camera.name, scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *SIZE, 50
    scene.frame_start = scene.frame_end = FRAME
    scene.frame_set(FRAME)
    scene.splannequin.shot_path = str(shot)
    for light in [o for o in scene.objects if o.type == "LIGHT"]:
        bpy.data.objects.remove(light)
    for operator in ("load_camera", "insert_freeze"):
        results[operator] = str(_press(operator))
        yield 1.0
    results["size_kept"] = (render.resolution_x, render.resolution_y, render.resolution_percentage) == (*SIZE, 50)
    yield from _cg(work, results)
    yield from _grade(work, shot, results)
    results["removed"] = str(_press("remove_shot"))
    results["camera_back"] = scene.camera is not None and scene.camera.name == camera_name
    bpy.context.window_manager.windows[0].workspace = bpy.data.workspaces["Layout"]
    yield 2.0
    yield from press._shoot(work, "11-removed")


def _cg(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """Insert at 50 % and render at 100 %: alone, with a cube, and with Only Moving."""
    import bpy
    import cube
    import numpy as np

    scene, compat = bpy.context.scene, press.addon_module("compat")
    scene.render.resolution_percentage = 100
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    clean = _render(work, "half-at-full")
    border = np.concatenate([clean[:, :60].reshape(-1, 3), clean[:, -60:].reshape(-1, 3)])
    results["filled"] = bool((border.max(axis=1) > 0.02).mean() > 0.9)
    yield from _show(work, "11-half-at-full", "Rendering")
    _press("combine_cg")
    node = press.addon_module("bake.freeze_group").group_node(compat.compositor_tree(scene))
    depth = cube.see(node.outputs["Depth"], work, "depth")[..., 0]
    cube.put_cube(depth)
    scene.cycles.samples = 12
    layers = next(n for n in compat.compositor_tree(scene).nodes if n.bl_idname == "CompositorNodeRLayers")
    cube_picture = cube.see(layers.outputs["Image"], work, "cube")
    compat.set_png(scene.render.image_settings)
    yield 0.5
    among = _render(work, "cube")
    yield from _crop(work, among, cube_picture[..., 3])
    edge = (cube_picture[..., 3] > 0.3) & (cube_picture[..., 3] < 0.7)
    solid = cube_picture[..., 3] > 0.999
    changed = np.abs(among - clean).max(axis=2)
    seen = changed > 0.1
    results["edge_soft"] = bool(edge.sum() > 50 and changed[edge & _dilated(seen & solid)].mean() > 0.03)
    node.inputs["Only Moving"].default_value = 1.0
    moving = _render(work, "only-moving")
    results["cube_kept"] = bool(np.abs(moving - among)[solid & seen].max(axis=1).mean() < 0.05)
    results["only_moving_differs"] = round(float((np.abs(moving - among).max(axis=2) > 0.2).mean()), 4)
    results["moved_once"] = results["only_moving_differs"] < 0.003  # 0.01 if the plate shows a hand a second time
    yield from _show(work, "11-only-moving", "Rendering")
    bpy.data.objects.remove(next(o for o in scene.objects if o.type == "MESH" and not o.hide_render))
    _press("remove_shot")


def _dilated(mask: Any) -> Any:
    """Mask dilated by two pixels."""
    import numpy as np

    found = mask.copy()
    for rows in range(-2, 3):
        for columns in range(-2, 3):
            found |= np.roll(mask, (rows, columns), (0, 1))
    return found


def _grade(work: Path, shot: Path, results: dict[str, Any]) -> Iterator[float]:
    """Artist's comp that removes the plate's colours: insert the freeze between the nodes, and remove it."""
    import bpy
    import numpy as np

    scene, compositor, compat = bpy.context.scene, press.addon_module("bake.compositor"), press.addon_module("compat")
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        tree = compat.new_compositor_tree(scene, "Comp")
    compat.enable_compositor(scene)
    plate, fit, grade = (tree.nodes.new(f"CompositorNode{n}") for n in ("Image", "Scale", "HueSat"))
    tree.nodes.remove(fit)
    fit = compat.new_fit_node(tree, "Crop")
    plate.image = bpy.data.images.load(
        str(press.addon_module("scene.numbered").frame_path(shot / "frames", FRAME, ".png"))
    )
    plate.image.source = "SEQUENCE"
    press.addon_module("scene.sequences").show_sequence(plate, plate.image, 1, 74)
    grade.inputs["Saturation"].default_value = 0.0
    plate.label, grade.label = "My plate", "My grade: no colour"
    end = compat.output_socket(tree) or compat.new_output_node(tree)
    for source, target in ((plate, fit), (fit, grade)):
        tree.links.new(source.outputs["Image"], target.inputs["Image"])
    tree.links.new(grade.outputs["Image"], end)
    for column, node in enumerate((plate, fit, grade, end.node)):
        node.location = (-600.0 + 300.0 * column, 0.0)
    links = sorted((k.from_node.name, k.to_node.name) for k in tree.links)
    mine = _render(work, "plate")
    _press("load_camera")
    _press("insert_freeze")
    node = press.addon_module("bake.freeze_group").group_node(tree)
    results["as_plate"] = grade.inputs["Image"].links[0].from_node == node
    graded = _render(work, "graded")
    results["grade_kept"] = bool(np.ptp(graded, axis=2).max() < 0.02)
    results["frozen"] = bool(np.abs(graded - mine).mean() > 0.005)
    window = bpy.context.window_manager.windows[0]
    window.workspace = bpy.data.workspaces["Compositing"]
    yield 2.0
    area = next(a for a in window.screen.areas if a.type == "NODE_EDITOR")
    region = next(r for r in area.regions if r.type == "WINDOW")
    if compat.HAS_COMPOSITING_GROUP:
        area.spaces.active.node_tree = tree
        area.spaces.active.show_region_asset_shelf = False  # it would cover the nodes
        yield 1.0
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.node.view_all()
    yield from _show(work, "11-as-plate", "Compositing")
    compositor.remove(scene)
    results["links_back"] = sorted((k.from_node.name, k.to_node.name) for k in tree.links) == links


def _press(operator: str) -> set[str]:
    """Run an operator of the extension as its button does."""
    import bpy

    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        return getattr(bpy.ops.splannequin, operator)()


def _render(work: Path, name: str) -> Any:
    """[H, W, 3] in 0..1: the frame rendered through the compositor, display-referred, top row first."""
    import bpy
    import numpy as np

    scene = bpy.context.scene
    press.addon_module("compat").set_png(scene.render.image_settings)
    scene.render.filepath = str(work / f"{name}.png")
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(work / f"{name}.png"))
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def _crop(work: Path, picture: Any, alpha: Any) -> Iterator[float]:
    """Take a picture of the frame around the cube's left edge, magnified four times."""
    import bpy
    import numpy as np

    rows, columns = np.nonzero(alpha > 0.5)
    top, left = max(int(rows.min()) - 20, 0), max(int(columns.min()) - 20, 0)
    part = picture[top : top + 200, left : left + 320].repeat(4, axis=0).repeat(4, axis=1)
    image = bpy.data.images.new("Edges at 400 %", part.shape[1], part.shape[0])
    whole = np.concatenate([part, np.ones_like(part[..., :1])], axis=2)
    image.pixels.foreach_set(np.ascontiguousarray(whole[::-1]).ravel())
    yield from _show(work, "11-edges", "Rendering", image)


def _show(work: Path, name: str, workspace: str, image: Any = None) -> Iterator[float]:
    """Take a picture of the window in a workspace; an image editor shows `image`, or the render."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    window.workspace = bpy.data.workspaces[workspace]
    yield 2.0
    for area in [a for a in window.screen.areas if a.type == "IMAGE_EDITOR"]:
        area.spaces.active.image = image or bpy.data.images["Render Result"]
        region = next(r for r in area.regions if r.type == "WINDOW")
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.image.view_all(fit_view=True)
    yield 0.5
    yield from press._shoot(work, name)


if __name__ == "__main__":
    needs = "shot of the bundled clip with a take"
    code = press.on_a_shot(__file__, __doc__ or "", _play, needs, ":91", lambda results: all(map(results.get, GOOD)))
    if "bpy" not in sys.modules:
        sys.exit(code)
