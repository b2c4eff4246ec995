"""examples/make_example.py on a tiny shot writes a small file that works after its folder is moved."""

import importlib.util
import os
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest


@pytest.fixture
def example(root):
    spec = importlib.util.spec_from_file_location("make_example", root / "examples" / "make_example.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def absolute(path: str) -> Path:
    return Path(os.path.abspath(bpy.path.abspath(path)))


def test_the_example_shows_its_pictures_from_another_place(example, addon, shot, tmp_path, layers, pictures):
    copy = tmp_path / "made é"
    copy.mkdir()
    shutil.move(str(shot), copy / "shot.splannequin")
    (copy / "blends").mkdir()
    example.make(copy / "shot.splannequin", "freeze", copy / "blends" / "x.blend")
    assert [p.name for p in (copy / "blends").iterdir()] == ["x.blend"]
    moved = copy.rename(tmp_path / "elsewhere")

    bpy.ops.wm.open_mainfile(filepath=str(moved / "blends" / "x.blend"))
    scene = bpy.context.scene
    assert scene.splannequin.shot_path.startswith("//")
    assert absolute(scene.splannequin.shot_path) == moved / "shot.splannequin"
    files = [i.filepath for i in bpy.data.images if i.source == "SEQUENCE"]
    assert len(files) >= 2
    for file in files:
        assert file.startswith("//") and absolute(file).is_file(), file
    assert (scene.frame_start, scene.frame_end, scene.splannequin.t_star) == (5, 7, 6)
    assert scene.camera is not None and scene.camera.animation_data.action is not None
    assert "python3 splannequin.py demo" in bpy.data.texts["Read me"].as_string()

    scene.frame_set(6)
    scene.render.filepath = str(tmp_path / "out.png")
    addon("compat").set_png(scene.render.image_settings)
    bpy.ops.render.render(write_still=True)
    got = pictures.read(tmp_path / "out.png")
    assert np.abs(got - pictures.srgb(layers(6)["rgba"][..., :3])).max() < 0.01


def test_no_shot_is_said_in_a_sentence(example, tmp_path):
    with pytest.raises(ValueError, match="holds no take 'freeze'"):
        example.make(tmp_path / "none.splannequin", "freeze", tmp_path / "x.blend")
    assert not (tmp_path / "x.blend").exists()


def test_the_shipped_example_opens_and_names_its_frames_relative_to_itself(root, addon):
    bpy.ops.wm.open_mainfile(filepath=str(root / "examples" / "sitting_frozen.blend"))
    scene = bpy.context.scene
    demo = root / "output" / "demo" / "shot.splannequin"
    assert absolute(scene.splannequin.shot_path) == demo
    for image in bpy.data.images:
        if image.source == "SEQUENCE":
            assert image.filepath.startswith("//") and demo in absolute(image.filepath).parents
    assert addon("solve.cameras").find(scene, demo, "CAMERA") == scene.camera
    assert len(addon("solve.cameras").find(scene, demo, "MESH").data.vertices) > 1000
    assert addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene)) is not None
    assert (scene.frame_start, scene.frame_end) == (1, 74)
