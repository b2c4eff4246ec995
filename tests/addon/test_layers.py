"""Plate-based frames in the compositor: the invented pixels, the splats alone, and the freeze as a warp.

The warp is applied to the artist's own linear plate, with values above white and below black.
"""

import json
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data import make_detail
from tests.addon.data import make_frames as frames
from tests.addon.data.pixels import read, render, set_format

DATA = Path(__file__).resolve().parent / "data"
SIZE = make_detail.WIDTH, make_detail.HEIGHT


@pytest.fixture
def detailed(scene, shot):
    """The shot with a take `detail` of plate-based frames; the scene has their size."""
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    make_detail.add_take(shot)
    return shot


@pytest.fixture
def graded(addon, scene, detailed):
    """Artist's tree: a linear EXR plate, multiplied by 2 with less blue, then the output."""
    folder = detailed.parent / "the plate"
    shutil.copytree(DATA / "detail" / "plate", folder)
    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "Artist")
    plate = tree.nodes.new("CompositorNodeImage")
    plate.image = bpy.data.images.load(str(folder / "000005.exr"))
    plate.image.source = "SEQUENCE"
    compat.set_image_colour(plate.image, "linear")
    addon("scene.sequences").show_sequence(plate, plate.image, 5, 6)
    grade, _, first, second, result = compat.new_mix_node(tree, "MULTIPLY")
    grade.inputs[0].default_value = 1.0
    second.default_value = (2.0, 2.0, 0.5, 1.0)
    tree.links.new(plate.outputs["Image"], first)
    tree.links.new(result, compat.output_socket(tree))
    scene.splannequin.clip = str(folder / "000005.exr")
    return tree


GRADE = np.array([2.0, 2.0, 0.5])


def node_of(addon, scene):
    return addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float((np.abs(found - expected) / np.maximum(np.abs(expected), 0.01)).max())


@pytest.mark.parametrize("frame", [5, 6])
def test_st_map_matte_and_fill_give_the_delivered_frame_back(addon, scene, detailed, graded, tmp_path, frame):
    said = addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    assert any("by the take's warp" in line for line in said)
    node = node_of(addon, scene)
    tree = addon("compat").compositor_tree(scene)
    tree.links.new(node.outputs["Image"], addon("compat").output_socket(tree))
    found = render(scene, tmp_path, frame)
    plate, delivered = make_detail.plate(frame), make_detail.frozen(frame)
    third = make_detail.WIDTH // 3
    assert np.array_equal(found[:, :third, :3], plate[:, :third]), "where nothing moves it is the plate, bit for bit"
    assert delivered.max() > 40 and delivered.min() < -0.1
    assert relative(found[..., :3], delivered) < 1e-3
    node.inputs["As Warp"].default_value = 0.0
    half, take_frame = (
        make_detail.frozen(frame).astype(np.float32).astype(np.float16).astype(np.float32),
        render(scene, tmp_path, frame),
    )
    assert relative(take_frame[..., :3], half) < 1e-3, "the take's own frames"
    assert np.array_equal(take_frame[..., 3], found[..., 3])


def test_the_grade_goes_on_behind_the_warped_plate_and_goes_before_it(addon, scene, detailed, graded, tmp_path):
    compat = addon("compat")
    addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    node = node_of(addon, scene)
    assert node.inputs["Image"].links[0].from_node.bl_idname == "CompositorNodeImage", "as the plate"
    assert relative(render(scene, tmp_path)[..., :3], make_detail.frozen(6) * GRADE) < 1e-3
    scene.splannequin.insert_at = "OUTPUT"
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    node = node_of(addon, scene)
    assert compat.output_socket(graded).links[0].from_node == node and addon("bake.freeze_group").wants_warp(scene)
    moved = make_detail.WIDTH * 2 // 3  # columns from here on are not pure plate, and are not graded
    expected = make_detail.moved(make_detail.plate(6) * GRADE, 6)
    assert relative(render(scene, tmp_path)[:, :moved, :3], expected[:, :moved]) < 1e-3


def test_a_plate_of_another_size_is_brought_to_that_of_the_warp(addon, scene, detailed, graded, tmp_path):
    """Plate and render are half as large as the warp. The plate has one colour, so the whole picture must have it."""
    compat, small = addon("compat"), np.zeros((make_detail.HEIGHT // 2, make_detail.WIDTH // 2, 4), np.float32)
    small[..., 0], small[..., 3] = 40.0, 1.0
    picture = bpy.data.images.new(
        "small", make_detail.WIDTH // 2, make_detail.HEIGHT // 2, float_buffer=True, is_data=True
    )
    picture.pixels.foreach_set(small.ravel())
    addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    node = node_of(addon, scene)
    reader = graded.nodes.new("CompositorNodeImage")
    reader.image = picture
    graded.links.new(reader.outputs["Image"], node.inputs["Image"])
    graded.links.new(node.outputs["Image"], compat.output_socket(graded))
    found = render(scene, tmp_path, size=(make_detail.WIDTH // 2, make_detail.HEIGHT // 2))
    inner = np.s_[2:-2, 2 : make_detail.WIDTH // 6]
    assert np.abs(found[inner][..., 0] - 40.0).max() < 0.01 and np.abs(found[inner][..., 1]).max() < 1e-6


def test_the_warp_is_switched_and_removed_without_a_trace(addon, scene, detailed, graded):
    addon("bake.compositor")
    scene.splannequin.shot_path, scene.splannequin.take_name = str(detailed), "detail"
    images, groups = set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())
    links = {(k.from_socket.path_from_id(), k.to_socket.path_from_id()) for k in graded.links}
    assert bpy.ops.splannequin.freeze_as_warp() == {"FINISHED"}
    node = node_of(addon, scene)
    assert node.inputs["As Warp"].default_value == 1.0 and "Warp detail" in bpy.data.images
    node.inputs["Mix"].default_value = 0.5
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    assert "As Warp" in node.inputs, "an update keeps it"
    assert bpy.ops.splannequin.freeze_as_warp() == {"FINISHED"}
    node = node_of(addon, scene)
    assert "As Warp" not in node.inputs and "Warp detail" not in bpy.data.images
    assert node.inputs["Mix"].default_value == 0.5 and not addon("bake.freeze_group").wants_warp(scene)
    bpy.ops.splannequin.freeze_as_warp()
    assert addon("bake.insertion").remove(scene)
    assert (set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())) == (images, groups)
    assert {(k.from_socket.path_from_id(), k.to_socket.path_from_id()) for k in graded.links} == links


def test_a_take_without_a_warp_is_refused_in_a_sentence(addon, contract, scene, detailed, graded):
    before = [n.name for n in graded.nodes]
    with pytest.raises(contract.JobError, match="'freeze' has no warp, because it was frozen without detail"):
        addon("bake.insertion").insert_freeze(scene, detailed, "freeze", warp=True)
    (detailed / "takes" / "detail" / "warp" / "000006.exr").unlink()
    with pytest.raises(contract.JobError, match="'detail' has no warp"):
        addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    assert [n.name for n in graded.nodes] == before
    scene.splannequin.shot_path, scene.splannequin.take_name = str(detailed), "freeze"
    with pytest.raises(RuntimeError, match="Freeze it again with detail"):
        bpy.ops.splannequin.freeze_as_warp()


def test_warp_of_a_take_with_an_artists_camera_is_refused_readably(addon, contract, scene, detailed, graded):
    file = detailed / "takes" / "detail" / "take.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "camera_path": "/somewhere/path.json"}))
    with pytest.raises(contract.JobError, match="needs other frames of the plate"):
        addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)


def test_bake_without_a_warp_shows_frames_and_warns(addon, scene, detailed, graded):
    addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    said = addon("bake.insertion").insert_freeze(scene, detailed, "freeze")
    assert "The take has no warp: its own frames are shown." in said and "As Warp" not in node_of(addon, scene).inputs
    said = addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    assert "As Warp" in node_of(addon, scene).inputs, "the next take that has one is used as such again"


def test_prefetched_warp_pictures_are_used_on_arrival(addon, scene, detailed, graded):
    bake = addon("bake.insertion")
    addon("bake.insertion").insert_freeze(scene, detailed, "detail", warp=True)
    count = len(bpy.data.images)
    assert len(list(bake.prefetch(scene, detailed, "detail"))) == 2
    bake.insert(scene, detailed, "detail")
    assert len(bpy.data.images) == count and not addon("scene.sequences")._prefetched


@pytest.mark.parametrize("show", [0.0, 0.5, 1.0])
def test_what_is_invented_is_tinted_and_the_rest_is_not(addon, scene, detailed, tmp_path, show):
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    node_of(addon, scene).inputs["Show What Is Invented"].default_value = show
    found = render(scene, tmp_path)
    half = make_detail.frozen(6).astype(np.float32).astype(np.float16).astype(np.float64)
    invented = 0.6 * show * (1.0 - make_detail.matte(6) * make_detail.alpha())[..., None]
    expected = half + invented * (np.array([1.0, 0.0, 0.4]) - half)
    assert relative(found[..., :3], expected) < 1e-3
    third = np.s_[:, : make_detail.WIDTH // 3]
    assert relative(found[third][..., :3], half[third]) < 1e-3, "not tinted"


@pytest.fixture
def with_passes(shot):
    """The shot with a take `passes` of one frame."""
    folder = shot / "takes" / "passes"
    shutil.copytree(DATA / "passes", folder)
    facts = {"version": 1, "take": "passes", "run": "main", "t_star_frame": 6, "query": "nearest", "frames": 1}
    facts |= {"width": frames.WIDTH, "height": frames.HEIGHT, "first": 6, "last": 6, "passes": True}
    (folder / "take.json").write_text(json.dumps(facts))
    return shot


def test_passes_leave_the_group_as_they_are_in_the_file(addon, scene, with_passes, tmp_path):
    compat, size = addon("compat"), (frames.WIDTH, frames.HEIGHT)
    scene.render.resolution_x, scene.render.resolution_y = size
    addon("bake.insertion").insert_freeze(scene, with_passes, "passes")
    tree = compat.compositor_tree(scene)
    node = node_of(addon, scene)
    assert not {"forward", "backward", "Splat"} & set(node.outputs.keys())
    for name in ("Vector", "Normal", "Position"):
        tree.links.new(node.outputs[name], compat.output_socket(tree))
        wanted = frames.passes(6)[name]
        np.testing.assert_array_equal(render(scene, tmp_path, 6, size)[..., : wanted.shape[2]], wanted)
    tree.links.new(node.outputs["Image"], compat.output_socket(tree))
    np.testing.assert_array_equal(render(scene, tmp_path, 6, size)[..., :3], frames.layers(6)["rgba"][..., :3])


def test_outputs_of_passes_come_and_go_with_the_take_and_links_stay(addon, scene, with_passes):
    compat, insert = addon("compat"), addon("bake.insertion").insert_freeze
    passes = {"Vector", "Normal", "Position"}
    insert(scene, with_passes, "freeze")
    tree, node = compat.compositor_tree(scene), node_of(addon, scene)
    assert not passes & set(node.outputs.keys())
    viewer = tree.nodes.new("CompositorNodeViewer")
    tree.links.new(node.outputs["Depth"], viewer.inputs[0])

    def led():
        return viewer.inputs[0].links[0].from_socket.name

    insert(scene, with_passes, "passes")
    assert passes <= set(node.outputs.keys()) and led() == "Depth"
    tree.links.new(node.outputs["Vector"], viewer.inputs[0])
    said = insert(scene, with_passes, "freeze")
    assert passes & set(node.outputs.keys()) == {"Vector"} and led() == "Vector"
    assert any("has no Vector" in line for line in said)
    insert(scene, with_passes, "passes")
    assert passes <= set(node.outputs.keys()) and led() == "Vector"


@pytest.mark.parametrize("output", ["Plate", "Source"])
def test_plate_and_source_leave_the_group_as_they_are_in_the_file(addon, scene, detailed, tmp_path, output):
    compat = addon("compat")
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    tree = compat.compositor_tree(scene)
    tree.links.new(node_of(addon, scene).outputs[output], compat.output_socket(tree))
    expected = make_detail.matte(6) * make_detail.alpha() if output == "Plate" else make_detail.source(6)
    assert np.array_equal(render(scene, tmp_path)[..., 0], expected)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_splat_layer_can_be_mixed_in(addon, scene, detailed, tmp_path, share):
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    node_of(addon, scene).inputs["Splat"].default_value = share
    frame, splat = (
        make_detail.frozen(6).astype(np.float32).astype(np.float16).astype(np.float64),
        make_detail.splat_picture(6) * make_detail.alpha()[..., None],
    )
    assert relative(render(scene, tmp_path)[..., :3], frame + share * (splat - frame)) < 1e-3


def test_take_of_splats_only_reports_missing_layers(addon, scene, shot, layers, tmp_path):
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    node = node_of(addon, scene)
    node.inputs["Show What Is Invented"].default_value = 1.0
    said = addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    assert any("cannot separate plate from splats" in line for line in said)
    assert np.abs(render(scene, tmp_path, size=(16, 12)) - layers(6)["rgba"])[..., :3].max() < 1e-6


def test_group_of_an_older_file_gains_new_sockets_and_keeps_existing_ones(addon, scene, detailed, graded, tmp_path):
    """A group of version 0.5 lacks the sockets; the artist's links and values are kept."""
    compat = addon("compat")
    addon("bake.insertion").insert_freeze(scene, detailed, "freeze")
    node = node_of(addon, scene)
    face = node.node_tree.interface
    for item in [i for i in face.items_tree if i.name in ("Splat", "Show What Is Invented", "Plate", "Source")]:
        face.remove(item)
    del node.node_tree["splannequin_warps"]
    node.inputs["Only Moving"].default_value = 0.25
    addon("bake.insertion").insert_freeze(scene, detailed, "detail")
    node = node_of(addon, scene)
    assert {"Splat", "Show What Is Invented"} <= set(node.inputs.keys()) and node.inputs["Splat"].default_value == 0.0
    assert {"Plate", "Source"} <= set(node.outputs.keys()) and node.inputs["Only Moving"].default_value == 0.25
    node.inputs["Only Moving"].default_value = 0.0
    assert (
        relative(render(scene, tmp_path)[..., :3], make_detail.frozen(6).astype(np.float32).astype(np.float16) * GRADE)
        < 1e-3
    )
    assert addon("bake.freeze_group").group_node(compat.compositor_tree(scene)) == node


def test_the_command_line_bakes_a_warp_into_the_artists_file(addon, scene, detailed, graded, tmp_path, capsys):
    scene.frame_start = scene.frame_end = 6
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *SIZE, 100
    set_format(scene, "OPEN_EXR")
    blend = tmp_path / "artist.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    words = ["bake", "--shot", str(detailed), "--output", str(tmp_path / "out"), "--blend", str(blend), "--as-warp"]
    assert addon("command_line.headless").main([*words, "--take", "freeze", "--first", "6", "--last", "6"]) == 7
    assert "has no warp" in capsys.readouterr().err
    assert addon("command_line.headless").main([*words, "--take", "detail", "--first", "6", "--last", "6"]) == 0
    found = read(tmp_path / "out" / "composited" / "000006.exr")[..., :3]
    assert relative(found, make_detail.frozen(6) * GRADE) < 1e-3
