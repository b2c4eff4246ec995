"""A file with everything that a freeze adds to a scene: undone step by step, moved, and opened without the add-on."""

import importlib.util
import json
import shutil
import types
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector

from tests.addon.data.pixels import read


def load_sibling(name: str) -> types.ModuleType:
    """Import a test file of this folder by path for its helpers; a plain import does not work inside Blender."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


test_lights, test_splats, test_surfaces = (load_sibling(f"test_{name}") for name in ("lights", "splats", "surfaces"))


@pytest.fixture
def full(scene, shot, addon, contract):
    """Shot in the scene, with splats, a surface and a light of its take written for its placement."""
    scene.splannequin.shot_path = str(shot)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    fill(scene, shot, addon, contract)
    return shot


def fill(scene, shot, addon, contract):
    placed = test_splats.placed_take(shot, addon, scene)
    test_surfaces.write_surface(shot, contract)
    test_lights.write_light(shot, contract, placed)
    addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)


def bring_in(scene, shot, addon):
    assert bpy.ops.splannequin.add_splats() == {"FINISHED"}
    assert bpy.ops.splannequin.add_surface() == {"FINISHED"}
    test_lights.add(addon, scene, shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    addon("bake.insertion").combine_cg(scene, shot)


def rendered(path):
    """[H, W, 3]: frame 6 of the scene, rendered through its compositor."""
    scene = bpy.context.scene
    scene.frame_set(6)
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read(path)[..., :3]


def test_moved_and_without_the_addon_it_renders_as_before(full, scene, addon, package, tmp_path):
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 4
    scene.cycles.use_denoising = False  # Debian's Blender is built without it
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    scene.render.image_settings.file_format = "OPEN_EXR"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "artist.blend"))
    bring_in(scene, full, addon)
    scene.world.cycles.sampling_method = "NONE"  # makes no map for samples towards the light
    target = scene.camera.matrix_world @ Vector((0.0, 0.0, -2.0))
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=target)
    addon("bake.freeze_group").cg_softness(scene).default_value = 0.5
    before = rendered(tmp_path / "before.exr")
    bpy.ops.wm.save_mainfile()
    moved = tmp_path.with_name(tmp_path.name + "-moved")
    tmp_path.rename(moved)
    package.unregister()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(moved / "artist.blend"))
        after = rendered(moved / "after.exr")
    finally:
        package.register()
    assert before.std() > 0.01
    np.testing.assert_allclose(after, before, atol=1e-4)


@pytest.mark.parametrize("button", ["add_splats", "add_surface"])
def test_what_a_button_brought_in_is_undone_and_done_again(full, scene, addon, button):
    def counts():
        return {name: len(getattr(bpy.data, name)) for name in ("objects", "meshes", "node_groups")} | {
            "nodes": [len(group.nodes) for group in bpy.data.node_groups]
        }

    bpy.ops.ed.undo_push(message="before")
    before = counts()
    assert getattr(bpy.ops.splannequin, button)() == {"FINISHED"}
    after = counts()
    assert after != before
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert counts() == before
    bpy.ops.ed.redo()
    assert counts() == after


@pytest.mark.parametrize(("button", "module"), [("add_splats", "splats"), ("add_surface", "surfaces")])
def test_two_shots_of_a_file_have_separate_ones(full, scene, addon, contract, tmp_path, button, module):
    second_shot = tmp_path / "other.splannequin"
    found = {}
    for shot in (full, second_shot):
        if shot != full:
            shutil.copytree(full, shot)
            scene.splannequin.shot_path = str(shot)
            assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
            fill(scene, shot, addon, contract)
        assert getattr(bpy.ops.splannequin, button)() == {"FINISHED"}
        found[shot] = objects(addon(f"freeze.{module}"), scene, shot)
    assert found[full] and found[second_shot] and not found[full] & found[second_shot]
    addon("process.begin").remove_all(scene, second_shot)
    assert objects(addon(f"freeze.{module}"), scene, full) == found[full]
    assert not objects(addon(f"freeze.{module}"), scene, second_shot)


def objects(module, scene, shot) -> set:
    found = module.find(scene, shot, "freeze")
    return set(found if isinstance(found, (list, tuple)) else [found]) - {None}


def add_matte(shot, contract, name):
    """Write a take's files for one matte: its lasso, and frames in place of its Cryptomattes; return their folder."""
    take = contract.TakeFolder(shot / "takes" / "freeze")
    take.cryptomattes.mkdir(parents=True)
    for frame in (5, 6, 7):
        shutil.copy(take.frame(frame), take.cryptomatte(frame))
    lasso = {"name": name, "frame": 6, "polygon": [[1.0, 1.0], [9.0, 1.0], [9.0, 9.0]]}
    take.mattes_record.write_text(json.dumps({"version": 1, "mattes": [lasso]}))
    return str(take.cryptomattes)


def matte_nodes(addon):
    """(name, folder, first frame) of each Cryptomatte node in the scene."""
    nodes = addon("compat").compositor_tree(bpy.context.scene).nodes
    return {
        (node.matte_id, str(Path(bpy.path.abspath(node.image.filepath)).resolve().parent), node.frame_start)
        for node in nodes
        if node.bl_idname == "CompositorNodeCryptomatteV2"
    }


def test_two_shots_of_a_file_have_separate_mattes(full, scene, addon, contract, tmp_path):
    """The mattes and the takes have equal names. A second insertion reuses the existing node."""
    second_shot = tmp_path / "other.splannequin"
    shutil.copytree(full, second_shot)
    folders = {shot: add_matte(shot, contract, "him") for shot in (full, second_shot)}
    assert bpy.ops.splannequin.insert_freeze() == {"FINISHED"}
    for shot in (full, second_shot, full, second_shot):
        scene.splannequin.shot_path = str(shot)
        assert bpy.ops.splannequin.insert_matte(name="him") == {"FINISHED"}
    assert matte_nodes(addon) == {("him", folder, 5) for folder in folders.values()}
    nodes = [n for n in addon("compat").compositor_tree(scene).nodes if n.bl_idname == "CompositorNodeCryptomatteV2"]
    assert len(nodes) == 2 and nodes[0].image != nodes[1].image
