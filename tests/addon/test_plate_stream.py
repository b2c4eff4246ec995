"""The plate's stream in a tree created by a bake belongs to the artist: later bakes keep their changes."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data import make_detail
from tests.addon.data.pixels import set_format

DATA = Path(__file__).resolve().parent / "data"


@pytest.fixture
def bake(addon, scene, shot):
    """bake(): inserts the shot's take into the scene's compositor; returns the tree and the group's node."""

    def bake(take: str = "freeze"):
        bake.said = addon("bake.insertion").insert_freeze(scene, shot, take)
        tree = addon("compat").compositor_tree(scene)
        return tree, addon("bake.freeze_group").group_node(tree)

    return bake


@pytest.fixture
def footage(scene, shot, tmp_path):
    """footage(...): writes a take `detail` of an EXR sequence, with or without a lens map."""
    folder, take = tmp_path / "the plate", make_detail.add_take(shot)
    shutil.copytree(make_detail.FOLDER / "plate", folder)
    scene.render.resolution_x, scene.render.resolution_y = make_detail.WIDTH, make_detail.HEIGHT
    (take / "stmap").mkdir()
    image = bpy.data.images.new("map", make_detail.WIDTH, make_detail.HEIGHT, float_buffer=True, is_data=True)
    mirrored = np.ones((make_detail.HEIGHT, make_detail.WIDTH, 4), np.float32)
    mirrored[..., 0] = 1.0 - (np.arange(make_detail.WIDTH) + 0.5) / make_detail.WIDTH
    mirrored[..., 1] = ((np.arange(make_detail.HEIGHT) + 0.5) / make_detail.HEIGHT)[:, None]
    image.pixels.foreach_set(mirrored.ravel())
    image.filepath_raw, image.file_format = str(take / "stmap" / "undistort.exr"), "OPEN_EXR"
    image.save()
    bpy.data.images.remove(image)

    def write_take(lens: bool = False, reason: str = ""):
        stmap = "stmap/undistort.exr" if lens else ""
        make_detail.write_facts(take, file=str(folder / "000005.exr"), unlike=reason, map=stmap)

    return write_take


def links(tree) -> set:
    return {(k.from_node.name, k.from_socket.identifier, k.to_node.name, k.to_socket.identifier) for k in tree.links}


def named(tree, label: str):
    return next(n for n in tree.nodes if n.label == label)


def file_of(node) -> Path:
    return Path(bpy.path.abspath(node.image.filepath))


def path_into(socket) -> list[str]:
    """Labels (or names) of the nodes upstream of a socket, nearest first."""
    found = []
    while socket.links:
        node = socket.links[0].from_node
        found.append(node.label or node.name)
        socket = node.inputs[0] if len(node.inputs) else None
        if socket is None:
            break
    return found


def test_links_nodes_and_values_of_the_artist_stay_over_a_second_bake(bake, shot, new_take):
    tree, group = bake()
    grade, glare = tree.nodes.new("CompositorNodeBlur"), tree.nodes.new("CompositorNodeGlare")
    tree.links.new(group.inputs["Image"].links[0].from_socket, grade.inputs[0])
    tree.links.new(grade.outputs[0], group.inputs["Image"])
    plate, fit = named(tree, "Plate"), named(tree, "Fit Plate")
    tree.links.new(plate.outputs["Image"], glare.inputs[0])
    plate.location, fit.location, fit.mute = (123.0, 456.0), (-50.0, 7.0), True
    before, nodes = links(tree), [n.name for n in tree.nodes]
    new_take(shot, "second")
    bake("second")
    assert links(tree) == before and [n.name for n in tree.nodes] == nodes
    assert tuple(plate.location) == (123.0, 456.0) and tuple(fit.location) == (-50.0, 7.0) and fit.mute
    assert path_into(group.inputs["Image"]) == [grade.name, "Fit Plate", "Plate"]
    assert [k.from_node.name for k in glare.inputs[0].links] == ["Plate"]


def test_another_plate_is_shown_by_the_same_node(bake, footage):
    tree, group = bake()
    plate = named(tree, "Plate")
    assert file_of(plate).suffix == ".png"
    footage()
    bake("detail")
    assert plate == named(tree, "Plate") and file_of(plate).parent.name == "the plate"
    assert (plate.frame_start, plate.frame_duration, plate.frame_offset) == (5, 2, 4)
    assert not [i.name for i in bpy.data.images if i.filepath.endswith(".png")], "nothing shows it any more"
    assert path_into(group.inputs["Image"]) == ["Fit Plate", "Plate"]


def test_a_lens_comes_between_and_goes_with_the_artists_links(bake, footage):
    footage()
    tree, group = bake("detail")
    glare = tree.nodes.new("CompositorNodeGlare")
    tree.links.new(named(tree, "Plate").outputs["Image"], glare.inputs[0])
    footage(lens=True)
    for _ in range(2):
        bake("detail")
        assert path_into(group.inputs["Image"]) == ["Fit Plate", "Undistort Plate", "Plate"]
        assert path_into(glare.inputs[0]) == ["Undistort Plate", "Plate"], "what it showed was without a lens"
        assert len([g for g in bpy.data.node_groups if "Undistort" in g.name]) == 1
    footage()
    bake("detail")
    assert path_into(group.inputs["Image"]) == ["Fit Plate", "Plate"] and path_into(glare.inputs[0]) == ["Plate"]
    assert not [g for g in bpy.data.node_groups if "Undistort" in g.name]


def test_artist_node_between_plate_and_lens_is_kept(bake, footage):
    footage(lens=True)
    tree, group = bake("detail")
    lens, blur = named(tree, "Undistort Plate"), tree.nodes.new("CompositorNodeBlur")
    tree.links.new(named(tree, "Plate").outputs["Image"], blur.inputs[0])
    tree.links.new(blur.outputs[0], lens.inputs[0])
    bake("detail")
    assert path_into(group.inputs["Image"]) == ["Fit Plate", "Undistort Plate", blur.name, "Plate"]
    footage()
    bake("detail")
    assert path_into(group.inputs["Image"]) == ["Fit Plate", blur.name, "Plate"]


def test_artist_link_into_the_group_is_kept(bake, footage):
    tree, group = bake()
    colour = tree.nodes.new("CompositorNodeRGB")
    tree.links.new(colour.outputs[0], group.inputs["Image"])
    for label in ("Plate", "Fit Plate"):
        tree.nodes.remove(named(tree, label))
    before, nodes = links(tree), len(tree.nodes)
    footage()
    bake("detail")
    assert links(tree) == before and len(tree.nodes) == nodes
    assert not any("is used as the plate" in line for line in bake.said)
    assert not [i.name for i in bpy.data.images if "the plate" in i.filepath], "what is not shown is not kept"
    tree.links.remove(group.inputs["Image"].links[0])
    bake("detail")
    assert path_into(group.inputs["Image"]) == ["Fit Plate", "Plate"], "the socket is free again"


def test_a_picture_of_the_artists_in_our_node_stays(bake):
    tree, _ = bake()
    artists_image = bpy.data.images.new("denoised", 16, 12)
    named(tree, "Plate").image = artists_image
    bake()
    assert named(tree, "Plate").image == artists_image


def test_a_copy_of_our_node_is_the_artists(bake, footage):
    tree, _ = bake()
    first = named(tree, "Plate")
    copy = tree.nodes.new("CompositorNodeImage")
    copy.name, copy.label, copy["splannequin"], copy.image = "a copy", "mine", True, first.image
    footage()
    bake("detail")
    assert file_of(first).parent.name == "the plate" and file_of(copy).suffix == ".png"


def test_how_the_plate_is_fitted_follows_its_shape_and_else_stays_as_set(addon, bake, footage, scene):
    compat = addon("compat")

    def how(node) -> str:
        return str(node.inputs["Frame Type"].default_value if compat.HAS_COMPOSITING_GROUP else node.frame_method)

    footage()
    scene.render.resolution_x, scene.render.resolution_y = 80, 40
    tree, _ = bake("detail")
    fit = named(tree, "Fit Plate")
    assert how(fit).upper() == "CROP"
    compat.set_fit(fit, "Stretch")
    bake("detail")
    assert how(fit).upper() == "STRETCH"
    scene.render.resolution_x = 40
    bake("detail")
    assert how(fit).upper() == "FIT"


def test_stream_moved_to_another_plate_renders_like_a_new_one(addon, bake, footage, scene, tmp_path, pictures):
    def render(name: str) -> np.ndarray:
        _, group = bake("detail")
        group.inputs["Mix"].default_value = 0.0
        set_format(scene, "PNG")
        scene.render.filepath = str(tmp_path / name)
        scene.frame_set(6)
        bpy.ops.render.render(write_still=True)
        return pictures.read(tmp_path / name)

    footage()
    plain = render("plain.png")
    footage(lens=True)
    in_place = render("in place.png")
    assert addon("bake.insertion").remove(scene)
    assert np.array_equal(in_place, render("anew.png"))
    assert np.array_equal(in_place, plain[:, ::-1]), "the map mirrors it"
