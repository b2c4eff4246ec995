"""The freeze in the scene's compositor: artists' nodes stay unchanged, and the pixels equal the backend's."""

import struct
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector

from tests.addon.data.pixels import glow
from tests.addon.data.pixels import render as float_picture


@pytest.fixture
def take(addon, shot):
    return addon("bake.take_files").take_of(shot / "takes" / "freeze")


@pytest.fixture
def artists_tree(addon, scene):
    """Artist's tree with nodes, links and values; its output shows a blurred constant colour."""
    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "Artist")
    colour = tree.nodes.new("CompositorNodeRGB")
    colour.outputs[0].default_value = (0.25, 0.5, 0.75, 1.0)
    blur = tree.nodes.new("CompositorNodeBlur")
    multiply = compat.new_math_node(tree)
    multiply.inputs[1].default_value = 0.125
    tree.links.new(colour.outputs[0], blur.inputs["Image"])
    tree.links.new(blur.outputs["Image"], compat.output_socket(tree))
    tree.links.new(colour.outputs[0], multiply.inputs[0])
    return tree


def snapshot(tree, without: str = "") -> tuple[dict, set]:
    """Nodes of a tree with locations and unlinked values, and its links; one node can be left out."""
    nodes = {}
    for node in tree.nodes:
        if node.name == without:
            continue
        values = [_plain(s.default_value) for s in node.inputs if hasattr(s, "default_value") and not s.is_linked]
        nodes[node.name] = (node.bl_idname, tuple(node.location), node.mute, node.label, tuple(values))
    links = set()
    for link in tree.links:
        if without not in (link.from_node.name, link.to_node.name):
            ends = (link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
            links.add(ends)
    return nodes, links


def _plain(value):
    return tuple(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


def test_artists_nodes_and_links_stay_identical(addon, scene, artists_tree, take):
    compositor = addon("bake.compositor")
    nodes, links = snapshot(artists_tree)
    compositor.insert(scene, take)
    after_nodes, after_links = snapshot(artists_tree, addon("bake.node_names").GROUP_NAME)
    output = addon("compat").output_socket(artists_tree)
    lost = {link for link in links if link[2:] == (output.node.name, output.identifier)}
    assert after_nodes == nodes
    assert after_links == links - lost and len(lost) == 1
    group = addon("bake.freeze_group").group_node(artists_tree)
    assert group.inputs["Image"].links[0].from_node.bl_idname == "CompositorNodeBlur"
    assert output.links[0].from_socket == group.outputs["Image"]


def test_second_bake_updates_the_group(addon, scene, artists_tree, take, shot, new_take):
    compositor = addon("bake.compositor")
    compositor.insert(scene, take)
    group = addon("bake.freeze_group").group_node(artists_tree)
    group.inputs["Mix"].default_value = 0.25
    before = snapshot(artists_tree)
    counts = len(bpy.data.node_groups), len(bpy.data.images)
    second_take = addon("bake.take_files").take_of(new_take(shot, "second"), depth_scale=3.0)
    said = compositor.insert(scene, second_take)
    assert snapshot(artists_tree) == before, "Mix and every link around the group stay"
    assert (len(bpy.data.node_groups), len(bpy.data.images)) == counts
    frozen = addon("bake.freeze_group").group_node(artists_tree).node_tree.nodes["Frozen"]
    assert Path(bpy.path.abspath(frozen.image.filepath)).parent == second_take.folder
    assert (
        addon("bake.freeze_group")
        .group_node(artists_tree)
        .node_tree.nodes["Depth in scene units"]
        .inputs[1]
        .default_value
        == 3.0
    )
    assert said == [f'The node group "{addon("bake.node_names").GROUP_NAME}" was updated.']


def test_removal_restores_the_tree(addon, scene, artists_tree, take):
    before = snapshot(artists_tree)
    images, groups = set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())
    addon("bake.compositor").insert(scene, take)
    assert addon("bake.compositor").remove(scene)
    assert snapshot(artists_tree) == before
    assert (set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())) == (images, groups)
    assert not addon("bake.compositor").remove(scene)


def test_scene_without_a_tree_gets_a_minimal_one_and_loses_it_again(addon, scene, take, shot):
    compositor, compat = addon("bake.compositor"), addon("compat")
    plate = shot / "frames" / "000005.png"
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    said = compositor.insert(scene, take, plate)
    tree = compat.compositor_tree(scene)
    assert compat.compositor_enabled(scene)
    assert "minimal one was created" in said[0]
    assert sorted(
        n.bl_idname for n in tree.nodes if "Output" not in n.bl_idname and "Composite" not in n.bl_idname[-9:]
    ) == [
        "CompositorNodeGroup",
        "CompositorNodeImage",
        "CompositorNodeScale",
    ]
    compositor.insert(scene, take, plate)
    assert len([n for n in tree.nodes if n.bl_idname == "CompositorNodeImage"]) == 1
    compositor.remove(scene)
    assert not compat.compositor_enabled(scene)
    assert not bpy.data.node_groups and not [i for i in bpy.data.images if i.source == "SEQUENCE"]


def test_prefetched_pictures_are_used_on_arrival(addon, scene, artists_tree, shot):
    bake = addon("bake.insertion")
    images, groups = set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())
    assert len(list(bake.prefetch(scene, shot, "freeze"))) == 1, "the artist's tree shows no plate of ours"
    assert set(bpy.data.node_groups.keys()) == groups
    bake.insert(scene, shot, "freeze")
    assert len(bpy.data.images) == len(images) + 1 + (not addon("compat").HAS_TEXTURE_NODE)
    bake.remove(scene)
    assert (set(bpy.data.images.keys()), set(bpy.data.node_groups.keys())) == (images, groups)


def test_prefetched_pictures_are_read_again_for_the_next_bake(addon, scene, shot, tmp_path, pictures):
    bake, plate = addon("bake.insertion"), shot / "frames" / "000005.png"
    for value in (40, 200):  # stands for a first bake that ended before insertion
        pictures.write(plate, np.full((12, 16, 3), value, np.uint8))
        assert len(list(bake.prefetch(scene, shot, "freeze"))) == 2
    image = next(i for i in bpy.data.images if i.filepath.endswith(".png"))
    assert round(255 * image.pixels[0]) == 200
    bake.insert(scene, shot, "freeze")
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    node.inputs["Mix"].default_value = 0.0
    render(addon, scene, tmp_path / "out")
    assert np.abs(pictures.read(tmp_path / "out" / "000005.png") * 255 - 200).max() < 0.6


def test_enabling_the_compositor_is_reported_and_undone(addon, scene, artists_tree, take):
    compat = addon("compat")
    switches = {name: False for name in compat.compositor_switches(scene)}
    compat.restore_compositor_switches(scene, switches)
    said = addon("bake.compositor").insert(scene, take)
    assert compat.compositor_enabled(scene) and "The compositor was switched on." in said
    addon("bake.compositor").remove(scene)
    assert not compat.compositor_enabled(scene)
    assert compat.compositor_switches(scene) == switches, "each switch, not just one of them"


def test_removal_leaves_a_group_that_another_scene_shows(addon, scene, artists_tree, take):
    compat, compositor = addon("compat"), addon("bake.compositor")
    compositor.insert(scene, take)
    group = addon("bake.freeze_group").group_node(compat.compositor_tree(scene)).node_tree
    second_scene = bpy.data.scenes.new("other")
    compat.new_compositor_tree(second_scene, "other").nodes.new("CompositorNodeGroup").node_tree = group
    assert compositor.remove(scene)
    shown = addon("bake.freeze_group").group_node(compat.compositor_tree(second_scene))
    assert shown is not None and "Frozen" in shown.node_tree.nodes and shown.node_tree.nodes["Frozen"].image
    assert compositor.remove(second_scene) and not any(g.get("splannequin") for g in bpy.data.node_groups)


def test_group_offers_what_a_compositor_needs(addon, scene, take, contract):
    addon("bake.compositor").insert(scene, take)
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    assert [s.name for s in node.inputs] == [
        "Image", "Mix", "Wipe", "Only Supported", "Only Moving", "Splat", "Show What Is Invented", "Grain", "CG",
        "CG Depth", "CG Softness",
    ]  # fmt: skip
    always = [layer.output for layer in contract.FRAME_LAYERS if layer.output and layer.part != "passes"]
    assert [s.name for s in node.outputs] == always
    assert {"Image", "Depth", "Support", "Motion", "Plate", "Source"} <= {s.name for s in node.outputs}
    assert node.inputs["Mix"].default_value == 1.0


def test_take_without_frames_is_refused_in_words(addon, scene, shot, contract):
    (shot / "takes" / "empty").mkdir()
    with pytest.raises(contract.JobError, match=r"'empty' .* has no frozen frames"):
        addon("bake.insertion").insert(scene, shot, "empty")


def test_a_compositor_of_another_file_is_refused_in_words_and_stays(addon, contract, scene, shot, tmp_path):
    compat, bake = addon("compat"), addon("bake.insertion")
    if not compat.HAS_COMPOSITING_GROUP:
        pytest.skip("until 5.0 a compositor is the scene's own")
    studio = compat.new_compositor_tree(scene, "Studio Comp")
    bpy.data.libraries.write(str(tmp_path / "studio.blend"), {studio})
    scene.compositing_node_group = None
    bpy.data.node_groups.remove(studio)
    with bpy.data.libraries.load(str(tmp_path / "studio.blend"), link=True) as (_, wanted):
        wanted.node_groups = ["Studio Comp"]
    scene.compositing_node_group = bpy.data.node_groups["Studio Comp"]
    before, view = snapshot(scene.compositing_node_group), scene.view_settings.view_transform
    with pytest.raises(contract.JobError, match=r"This compositor is linked from studio\.blend\."):
        bake.insert_freeze(scene, shot, "freeze")
    with pytest.raises(contract.JobError, match=r"This compositor is linked from studio\.blend\."):
        bake.combine_cg(scene, shot)
    assert snapshot(scene.compositing_node_group) == before and scene.view_settings.view_transform == view


def test_size_comes_from_the_exr_header(addon, shot, tmp_path):
    addon("bake.compositor")
    assert addon("bake.take_files").exr_windows(shot / "takes" / "freeze" / "000006.exr")[0] == (16, 12)
    wrong = tmp_path / "wrong.exr"
    wrong.write_bytes(b"no picture")
    with pytest.raises(ValueError, match="not an OpenEXR file"):
        addon("bake.take_files").exr_windows(wrong)


def render(addon, scene, folder: Path) -> None:
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 16, 12, 100
    scene.frame_start, scene.frame_end = 5, 7
    addon("scene.scene_setup").keep_plate_colours(scene)
    addon("bake.rendering").render(scene, folder)


def test_rendered_frames_equal_the_exr_within_one_of_255(addon, scene, take, tmp_path, layers, pictures):
    addon("bake.compositor").insert(scene, take)
    render(addon, scene, tmp_path / "out")
    render(addon, scene, tmp_path / "out")  # the second render finds files and settings of the first
    for frame in (5, 6, 7):
        expected = pictures.srgb(layers(frame)["rgba"][..., :3])
        found = pictures.read(tmp_path / "out" / f"{frame:06d}.png")
        assert np.abs(found - expected).max() * 255 < 0.6, f"frame {frame}: rounding to 8 bits and nothing else"


def test_mix_fades_between_plate_and_freeze(addon, scene, take, shot, tmp_path, layers, pictures):
    plate = shot / "frames" / "000005.png"
    addon("bake.compositor").insert(scene, take, plate)
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    node.inputs["Mix"].default_value = 0.0
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    render(addon, scene, tmp_path / "plate")
    for frame in (5, 6, 7):
        found = pictures.read(tmp_path / "plate" / f"{frame:06d}.png")
        source = pictures.read(shot / "frames" / f"{frame:06d}.png")
        assert np.abs(found - source).max() * 255 < 0.6, "the plate leaves as it came in"


@pytest.mark.parametrize("output", ["Depth", "Support", "Motion"])
def test_data_layers_arrive_on_the_groups_outputs(addon, scene, take, tmp_path, layers, pictures, output):
    compositor, compat = addon("bake.compositor"), addon("compat")
    scaled = addon("bake.take_files").take_of(take.folder, depth_scale=1.0 / 32.0)
    compositor.insert(scene, scaled)
    tree = compat.compositor_tree(scene)
    target = compat.output_socket(tree)
    tree.links.new(addon("bake.freeze_group").group_node(tree).outputs[output], target)
    render(addon, scene, tmp_path)
    for frame in (5, 7):
        value = layers(frame)[output.lower()]
        expected = value / 32.0 if output == "Depth" else value
        found = pictures.read(tmp_path / f"{frame:06d}.png")[..., 0]
        np.testing.assert_allclose(found, pictures.srgb(expected), atol=0.6 / 255)


@pytest.mark.parametrize("mix", [0.0, 1.0])
def test_frames_of_another_size_are_fitted(addon, scene, take, shot, tmp_path, layers, pictures, mix):
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 32, 24, 100
    addon("scene.scene_setup").keep_plate_colours(scene)
    addon("bake.compositor").insert(scene, take, shot / "frames" / "000005.png")
    tree = addon("compat").compositor_tree(scene)
    addon("bake.freeze_group").group_node(tree).inputs["Mix"].default_value = mix
    scene.frame_start = scene.frame_end = 6
    addon("bake.rendering").render(scene, tmp_path)
    found = pictures.read(tmp_path / "000006.png")
    assert found.shape == (24, 32, 3)
    plate = pictures.read(shot / "frames" / "000006.png")
    assert_quarters(found, pictures.srgb(layers(6)["rgba"][..., :3]) if mix else plate)


def assert_quarters(found: np.ndarray, small: np.ndarray) -> None:
    """Check that each quarter of a 32 x 24 picture has the mean colour of the same quarter of a 16 x 12 picture."""
    quarters = [picture.reshape(2, -1, 2, picture.shape[1] // 2, 3).mean((1, 3, 4)) for picture in (found, small)]
    np.testing.assert_allclose(*quarters, atol=0.06)


@pytest.fixture
def graded(addon, scene, shot):
    """graded(file): builds an artist's tree that shows a sequence two stops brighter, and also blurs it elsewhere."""

    def build(file: Path, kind: str = "CompositorNodeImage"):
        compat = addon("compat")
        tree = compat.new_compositor_tree(scene, "Artist")
        plate = tree.nodes.new(kind)
        if kind == "CompositorNodeImage":
            plate.image = bpy.data.images.load(str(file))
            plate.image.source = "SEQUENCE"
            addon("scene.sequences").show_sequence(plate, plate.image, 5, 7)
        else:
            plate.clip = bpy.data.movieclips.load(str(file))
        brighter = tree.nodes.new("CompositorNodeExposure")
        brighter.inputs["Exposure"].default_value = 2.0
        blur = tree.nodes.new("CompositorNodeBlur")
        tree.links.new(plate.outputs["Image"], brighter.inputs["Image"])
        tree.links.new(plate.outputs["Image"], blur.inputs["Image"])
        tree.links.new(brighter.outputs["Image"], compat.output_socket(tree))
        return tree, plate

    return build


def test_behind_a_plate_the_grade_goes_on_from_the_frozen_frame(addon, scene, shot, graded, tmp_path, layers, pictures):
    tree, plate = graded(shot / "frames" / "000005.png")
    before = snapshot(tree)
    said = addon("bake.insertion").insert(scene, shot, "freeze")
    assert "in place of the plate" in said[0]
    compositor = addon("bake.compositor")
    node = addon("bake.freeze_group").group_node(tree)
    nodes, links = snapshot(tree, addon("bake.node_names").GROUP_NAME)
    assert nodes == before[0] and len(before[1] - links) == 2 and not links - before[1]
    assert [link.to_node for link in plate.outputs["Image"].links] == [node]
    kinds = {link.to_node.bl_idname for link in node.outputs["Image"].links}
    assert kinds == {"CompositorNodeExposure", "CompositorNodeBlur"}
    assert compositor.insert(scene, addon("bake.take_files").take_of(shot / "takes" / "freeze"))[0].endswith(
        "was updated."
    )
    assert [link.to_node for link in plate.outputs["Image"].links] == [node]
    render(addon, scene, tmp_path / "out")
    found = pictures.read(tmp_path / "out" / "000006.png")
    assert np.abs(found - pictures.srgb(4.0 * layers(6)["rgba"][..., :3])).max() * 255 < 1.1
    assert addon("bake.insertion").remove(scene) and snapshot(tree) == before, "the links too"


@pytest.mark.parametrize(
    ("name", "kind", "behind"),
    [
        ("clip.####.png", "CompositorNodeImage", True),
        ("clip.####.png", "CompositorNodeMovieClip", True),
        ("other.####.png", "CompositorNodeImage", False),
    ],
)
def test_a_plate_is_known_by_the_clips_file(addon, scene, shot, graded, tmp_path, pictures, name, kind, behind):
    for n in (5, 6, 7):
        pictures.write(tmp_path / name.replace("####", f"{n:04d}"), np.zeros((12, 16, 3), np.uint8))
    tree, plate = graded(tmp_path / name.replace("####", "0005"), kind)
    scene.splannequin.clip = str(tmp_path / "clip.####.png")
    addon("bake.insertion").insert(scene, shot, "freeze")
    node = addon("bake.freeze_group").group_node(tree)
    assert (plate.outputs["Image"].links[0].to_node == node) == behind
    assert (addon("compat").output_socket(tree).links[0].from_node == node) != behind


def test_where_the_freeze_goes_can_be_chosen_and_changed(addon, contract, scene, shot, graded, tmp_path, pictures):
    pictures.write(tmp_path / "a 0005.png", np.zeros((12, 16, 3), np.uint8))
    tree, plate = graded(tmp_path / "a 0005.png")
    before, bake, props = snapshot(tree), addon("bake.insertion"), scene.splannequin
    output = addon("compat").output_socket(tree)
    image_node = tree.nodes.new("CompositorNodeImage")
    over = tree.nodes.new("CompositorNodeAlphaOver")
    tree.links.new(image_node.outputs["Image"], over.inputs[2])
    with_image_node = snapshot(tree)
    tree.nodes.active = None
    props.insert_at = "PLATE"
    bake.insert(scene, shot, "freeze")
    node = addon("bake.freeze_group").group_node(tree)
    assert plate.outputs["Image"].links[0].to_node == node, "the only one that gets to the output"
    props.insert_at, node.inputs["Mix"].default_value = "OUTPUT", 0.25
    assert any("was moved" in line for line in bake.insert(scene, shot, "freeze"))
    node = addon("bake.freeze_group").group_node(tree)
    assert output.links[0].from_node == node and node.inputs["Mix"].default_value == 0.25
    assert not [link for link in plate.outputs["Image"].links if link.to_node == node]
    bake.remove(scene)
    assert snapshot(tree) == with_image_node
    tree.nodes.remove(image_node)
    tree.nodes.remove(over)
    assert snapshot(tree) == before
    tree.nodes.remove(plate)
    props.insert_at, bare = "PLATE", snapshot(tree)
    with pytest.raises(contract.JobError, match="No node of this compositor shows the plate"):
        bake.insert(scene, shot, "freeze")
    assert snapshot(tree) == bare and addon("bake.freeze_group").group_node(tree) is None


def test_a_plate_of_another_size_is_taken_where_it_has_the_renders(addon, scene, shot, graded):
    compat = addon("compat")
    tree, plate = graded(shot / "frames" / "000005.png")
    targets = [link.to_socket for link in plate.outputs["Image"].links]
    fit = compat.new_fit_node(tree)
    tree.links.new(plate.outputs["Image"], fit.inputs[0])
    for target in targets:
        tree.links.new(fit.outputs[0], target)
    before = snapshot(tree)
    scene.render.resolution_x, scene.render.resolution_y = 32, 24
    addon("bake.insertion").insert(scene, shot, "freeze")
    node = addon("bake.freeze_group").group_node(tree)
    assert [link.to_node for link in fit.outputs[0].links] == [node] and len(node.outputs["Image"].links) == 2
    addon("bake.insertion").remove(scene)
    assert snapshot(tree) == before
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    addon("bake.insertion").insert(scene, shot, "freeze")
    node = addon("bake.freeze_group").group_node(tree)
    assert plate.outputs["Image"].links[0].to_node == node, "a scale that the artist wants, of the frozen frame too"


@pytest.mark.parametrize("mix", [0.0, 1.0])
@pytest.mark.parametrize(("baked", "rendered"), [(50, 100), (100, 50), (25, 100)])
def test_a_take_fills_the_frame_at_any_percentage(
    addon, scene, take, shot, tmp_path, layers, pictures, mix, baked, rendered
):
    """The take is inserted at one percentage and rendered at another: exact at half of 32 x 24, filled to the border at
    full."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 32, 24, baked
    addon("scene.scene_setup").keep_plate_colours(scene)
    addon("bake.compositor").insert(scene, take, shot / "frames" / "000005.png")
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    node.inputs["Mix"].default_value = mix
    render.resolution_percentage = rendered
    scene.frame_start = scene.frame_end = 6
    addon("bake.rendering").render(scene, tmp_path)
    found = pictures.read(tmp_path / "000006.png")
    plate = pictures.read(shot / "frames" / "000006.png")
    expected = pictures.srgb(layers(6)["rgba"][..., :3]) if mix else plate
    if rendered == 50:
        assert np.abs(found - expected).max() * 255 < 0.6
        return
    assert found.shape == (24, 32, 3)
    assert_quarters(found, expected)
    if mix:  # at Mix 0 the plate's border fades where Blender cannot scale otherwise
        border = np.concatenate([found[0, 2:], found[-1, 2:]])
        inner = np.concatenate([expected[0, 1:], expected[-1, 1:]])
        assert border.mean() == pytest.approx(inner.mean(), abs=0.03), "as strong as the rest"


@pytest.mark.parametrize(("width", "height"), [(30, 10), (33, 19), (25, 18), (20, 20)])
def test_a_take_of_another_shape_fits_the_width_as_the_camera_sees_it(
    addon, scene, take, shot, tmp_path, layers, pictures, width, height
):
    """A wider frame cuts the take above and below; a higher one adds bars. Compared with the nearest pixels."""
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    addon("scene.scene_setup").keep_plate_colours(scene)
    addon("bake.compositor").insert(scene, take, shot / "frames" / "000005.png")
    scene.frame_start = scene.frame_end = 6
    addon("bake.rendering").render(scene, tmp_path)
    found = pictures.read(tmp_path / "000006.png")
    scale = width / 16.0
    y = (np.arange(height) + 0.5 - height / 2) / scale + 6.0
    rows = np.nonzero((y > 0.5) & (y < 11.5))[0]
    columns = np.clip(((np.arange(width) + 0.5) / scale).astype(int), 0, 15)
    expected = pictures.srgb(layers(6)["rgba"][..., :3])[y[rows].astype(int)][:, columns]
    middle = slice(2 * width // 16, width - 1)
    assert np.abs(found[rows] - expected)[1:-1, middle].mean() < 0.13
    if height / width < 0.74 and addon("compat").CROPS_WHOLE:
        assert (found[[0, -1]][:, middle].max(axis=2) > 0.05).mean() > 0.9, "to the border"


def test_only_moving_leaves_cg_where_nothing_moves(addon, scene, take, shot, tmp_path, layers, pictures):
    compositor, compat = addon("bake.compositor"), addon("compat")
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    compositor.insert(scene, take, shot / "frames" / "000005.png")
    node = addon("bake.freeze_group").group_node(compat.compositor_tree(scene))
    green = np.array([0.0, 1.0, 0.0, 1.0])
    node.inputs["CG"].default_value, node.inputs["CG Depth"].default_value = tuple(green), 12.0
    data = layers(6)
    plate = pictures.read(shot / "frames" / "000006.png")
    linear = light_of(plate)
    nearer = in_front(12.0, data["depth"])
    frozen = nearer * green + (1.0 - nearer) * over(data["rgba"], np.broadcast_to(green, data["rgba"].shape))
    mixed = nearer * green[:3] + (1.0 - nearer) * linear
    for name, share in (("Only Moving", data["motion"]), ("Only Supported", data["support"]), ("Mix", 0.0)):
        before = node.inputs[name].default_value
        node.inputs[name].default_value = 0.0 if name == "Mix" else 1.0
        render(addon, scene, tmp_path / name)
        node.inputs[name].default_value = before
        expected = mixed + np.broadcast_to(share, (12, 16))[..., None] * (frozen[..., :3] - mixed)
        found = pictures.read(tmp_path / name / "000006.png")
        assert np.abs(found - pictures.srgb(expected)).max() * 255 < 1.1, name


def light_of(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def over(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    return front + (1.0 - front[..., 3:]) * back


def in_front(cg: float | np.ndarray, frozen: np.ndarray, softness: float = 0.0) -> np.ndarray:
    """[H, W, 1]: 1 for CG up to 0.5 % behind the frozen depth, 0 from 1.5 % behind; `softness` widens the ramp at both
    ends."""
    begin, end = 1.005 * frozen - softness, 1.015 * frozen + softness
    t = np.clip((end - cg) / (end - begin), 0.0, 1.0)
    return (t * t * (3.0 - 2.0 * t))[..., None]


@pytest.mark.parametrize(
    ("alpha", "softness", "bright"), [(1.0, 0.0, 1.0), (0.5, 0.0, 1.0), (0.5, 6.0, 1.0), (0.5, 0.0, 0.0)]
)
def test_cg_stands_in_front_and_behind_by_depth(
    addon, scene, take, tmp_path, layers, pictures, alpha, softness, bright
):
    """CG is a wall at depth 12, the frozen depth grows downwards: at each pixel, the nearer of the two is in front.

    Black CG is a caught shadow, which also falls on surfaces up to 5 % nearer.
    """
    compositor, compat = addon("bake.compositor"), addon("compat")
    compositor.insert(scene, addon("bake.take_files").take_of(take.folder, depth_scale=2.0))
    node = addon("bake.freeze_group").group_node(compat.compositor_tree(scene))
    wall = np.array([0.5 * bright, 0.25 * bright, 0.0, 1.0], np.float32) * alpha
    node.inputs["CG"].default_value, node.inputs["CG Depth"].default_value = tuple(wall), 24.0
    node.inputs["CG Softness"].default_value = softness
    render(addon, scene, tmp_path / "out")
    for frame in (5, 7):
        data = layers(frame)
        cg = np.broadcast_to(wall, data["rgba"].shape)
        nearer = in_front(24.0 if bright else 0.95 * 24.0, 2.0 * data["depth"], softness)
        assert 0.1 < nearer.mean() < 0.9
        expected = nearer * over(cg, data["rgba"]) + (1.0 - nearer) * over(data["rgba"], cg)
        found = pictures.read(tmp_path / "out" / f"{frame:06d}.png")
        assert np.abs(found - pictures.srgb(expected[..., :3])).max() * 255 < 1.1


def test_cg_softness_0_changes_no_bit(addon, scene, take, tmp_path):
    """Float pictures with CG Softness at 0 equal those of the same group without its softness nodes."""
    addon("bake.compositor").insert(scene, take)
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    node.inputs["CG"].default_value = (0.25, 0.125, 0.0, 0.5)

    def shown(softness):
        node.inputs["CG Softness"].default_value = softness
        for depth in (12.25, 12.5, 12.53, 12.56):
            node.inputs["CG Depth"].default_value = depth
            yield float_picture(scene, tmp_path, size=(16, 12))

    hard_edge, soft = np.stack([*shown(0.0)]), np.stack([*shown(0.25)])
    (smooth,) = (n for n in node.node_tree.nodes if n.label == "CG is nearer")
    slope = smooth.inputs[1].links[0].from_node
    eased = slope.inputs[0].links[0].from_node
    raised = eased.inputs[0].links[0].from_node
    node.node_tree.links.new(raised.inputs[2].links[0].from_socket, eased.inputs[0])
    node.node_tree.links.remove(eased.inputs[1].links[0])
    eased.inputs[1].default_value = 1.0
    hard = np.stack([*shown(0.25)])
    assert np.array_equal(hard_edge, hard) and not np.array_equal(soft, hard)
    assert len(np.unique((hard_edge - hard_edge[0])[1:, :, 1:, 0])) > 5, "pixels that CG is half behind are among them"


def test_wipe_and_mattes_let_the_plate_through(addon, scene, take, shot, tmp_path, layers, pictures):
    compositor, compat = addon("bake.compositor"), addon("compat")
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    compositor.insert(scene, take, shot / "frames" / "000005.png")
    node = addon("bake.freeze_group").group_node(compat.compositor_tree(scene))
    frozen, support = layers(6)["rgba"], layers(6)["support"]
    plate = pictures.read(shot / "frames" / "000006.png")
    linear = light_of(plate)
    for name, value, share in (
        ("Wipe", 0.5, (np.arange(16) < 8)[None, :, None].astype(np.float32)),
        ("Wipe", 0.0, np.zeros((1, 1, 1), np.float32)),
        ("Only Supported", 1.0, support[..., None]),
        ("Only Supported", 0.5, 0.5 + 0.5 * support[..., None]),
        ("Only Moving", 1.0, layers(6)["motion"][..., None]),
    ):
        before = node.inputs[name].default_value
        node.inputs[name].default_value = value
        render(addon, scene, tmp_path / name)
        node.inputs[name].default_value = before
        expected = linear + share * (frozen[..., :3] - linear)
        found = pictures.read(tmp_path / name / "000006.png")
        difference = np.abs(found - pictures.srgb(expected)) * 255
        assert difference.max() < 1.1, f"{name} {value}: columns {np.nonzero((difference > 1.1).any((0, 2)))[0]}"


def with_a_wall(addon, scene, tmp_path, pictures, place: tuple[float, float, float], samples: int) -> np.ndarray:
    """Render frame 6 with a green wall of 400 x 400 facing the camera, centred at `place` in camera space."""
    scene.frame_set(6)
    for mesh in [o for o in scene.objects if o.type == "MESH" and not o.hide_render]:
        bpy.data.objects.remove(mesh)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device = samples, False, "CPU"
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type = "BOX"
    bpy.ops.mesh.primitive_plane_add(size=400.0)
    wall = bpy.context.object
    wall.data.materials.append(glow((0.0, 1.0, 0.0, 1.0)))
    camera = scene.camera.matrix_world
    wall.rotation_mode = "QUATERNION"
    wall.rotation_quaternion = camera.to_quaternion()
    wall.location = camera @ Vector(place)
    scene.frame_start = scene.frame_end = 6
    addon("bake.rendering").render(scene, tmp_path / "out")
    return pictures.read(tmp_path / "out" / "000006.png")


def test_a_cube_is_hidden_by_what_is_nearer_and_hides_what_is_farther(addon, scene, take, shot, tmp_path, pictures):
    """The scene's render and depth pass are used, from the solved camera."""
    compat = addon("compat")
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    settings = scene.render.film_transparent, scene.view_layers[0].use_pass_z
    tree = compat.compositor_tree(scene)
    nodes = len(tree.nodes)
    said = addon("bake.insertion").combine_cg(scene, shot)
    assert "by depth" in said[0] and len(tree.nodes) == nodes + 1
    with pytest.raises(Exception, match="already"):
        addon("bake.insertion").combine_cg(scene, shot)
    found = with_a_wall(addon, scene, tmp_path, pictures, (0.0, 0.0, -12.0), samples=1)
    depth = make_depth(6)
    green = (found[..., 1] > 0.99) & (found[..., 0] < 0.01)
    sure = np.abs(depth - 12.0) > 0.2  # pixels where the wall is entirely in front or behind
    assert (green == (depth > 12.0))[sure & (np.arange(16) > 0)[None, :]].all()
    assert 10 < green.sum() < 150
    addon("process.begin").remove_all(scene, shot)
    assert (scene.render.film_transparent, scene.view_layers[0].use_pass_z) == settings


EDGE = 7.7
"""Column at which the rendered wall begins; the wall covers 0.3 of each pixel in column 7."""


@pytest.mark.parametrize("far", [3.0, 12.0, 60.0])
def test_a_half_covered_edge_of_cg_is_blended_by_its_coverage(addon, scene, shot, tmp_path, pictures, layers, far):
    """A wall in front of all frozen depths, among them and behind them, compared with the computed composite."""
    cameras = addon("solve.cameras")
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    addon("bake.insertion").combine_cg(scene, shot)
    place = (EDGE - 9.0) / 20.0 * far + 200.0, 0.0, -far  # focal length 20, principal point x 9
    found = with_a_wall(addon, scene, tmp_path, pictures, place, samples=256)
    covered = np.clip(np.arange(16) + 1.0 - EDGE, 0.0, 1.0)[None, :, None]
    frozen, nearer = layers(6)["rgba"], in_front(far, layers(6)["depth"])
    cg = np.broadcast_to(covered * np.array([0.0, 1.0, 0.0, 1.0]), frozen.shape)
    expected = nearer * over(cg, frozen) + (1.0 - nearer) * over(frozen, cg)
    sure = np.abs(layers(6)["depth"] / far - 1.005) > 0.015  # elsewhere a millimetre decides which is in front
    assert np.abs(light_of(found) - expected[..., :3])[sure & (np.arange(16) > 0)].max() < 0.04
    assert cameras.find(scene, shot, "CAMERA") == scene.camera


def make_depth(frame: int) -> np.ndarray:
    y, x = np.mgrid[0:12, 0:16]
    return frame + x / 16.0 + y


def depth_only_exr(path: Path) -> None:
    """An EXR whose only channel is a depth pass, as renderers write utility passes: 16 x 12, uncompressed."""
    width, height = 16, 12

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    channels = b"View.Depth.Z\0" + struct.pack("<iiii", 2, 0, 1, 1) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    head += attribute("channels", "chlist", channels) + attribute("compression", "compression", b"\0")
    head += attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
    head += attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    head += attribute("screenWindowCenter", "v2f", bytes(8)) + attribute("screenWindowWidth", "float", bytes(4))
    head += b"\0"
    first = len(head) + 8 * height
    rows = [struct.pack("<ii", y, 4 * width) + np.full(width, 2.0, "<f4").tobytes() for y in range(height)]
    offsets = b"".join(struct.pack("<q", first + y * len(rows[0])) for y in range(height))
    path.write_bytes(head + offsets + b"".join(rows))


@pytest.mark.parametrize("where", ["AUTO", "PLATE"])
def test_an_image_node_without_colours_is_not_the_plate(addon, scene, shot, graded, tmp_path, where):
    tree, plate = graded(shot / "frames" / "000005.png")
    depth_only_exr(tmp_path / "depth.exr")
    depth = tree.nodes.new("CompositorNodeImage")
    depth.image = bpy.data.images.load(str(tmp_path / "depth.exr"))
    assert [s.name for s in depth.outputs if s.enabled] == ["Depth"]
    grade = plate.outputs["Image"].links[0].to_node
    tree.links.new(depth.outputs["Depth"], grade.inputs["Exposure"])
    scene.splannequin.insert_at, scene.splannequin.shot_path = where, str(shot)
    assert bpy.ops.splannequin.insert_freeze() == {"FINISHED"}
    assert [link.to_node for link in plate.outputs["Image"].links] == [addon("bake.freeze_group").group_node(tree)]
