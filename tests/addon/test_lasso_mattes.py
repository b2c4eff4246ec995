"""Mattes from a mask in Blender: its polygons, the backend's job, the panel's list, and the node that selects one."""

import json
import sys

import bpy
import numpy as np
import pytest

from tests.addon.data.pixels import read

WIDTH, HEIGHT = 64, 48


def mask_of(name, corners, width=WIDTH, height=HEIGHT, handle="VECTOR"):
    """Mask with a closed spline through pixel positions, counted from the top left."""
    mask = bpy.data.masks.new(name)
    spline = mask.layers.new(name="one").splines.new()
    spline.use_cyclic = True
    spline.points.add(len(corners) - 1)
    longest = max(width, height)
    for point, (x, y) in zip(spline.points, corners, strict=True):
        point.co = (x - width / 2) / longest + 0.5, 0.5 - (y - height / 2) / longest
        point.handle_type = handle
    return mask


def filled(polygon, width, height):
    """[H, W] bool: pixels whose centres lie inside the polygon, by counting edge crossings."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inside = np.zeros((height, width), bool)
    for (ax, ay), (bx, by) in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        crosses = (ay > y) != (by > y)
        inside ^= crosses & (x < (bx - ax) * (y - ay) / np.where(by == ay, 1e-9, by - ay) + ax)
    return inside


@pytest.mark.parametrize("handle", ["VECTOR", "AUTO"])
@pytest.mark.parametrize("size", [(160, 90), (90, 160)])
def test_polygons_are_what_blender_renders_of_a_mask(addon, shot, handle, size):
    width, height = size
    corners = [(30.0, 20.0), (70.0, 25.0), (80.0, 70.0), (25.0, 60.0)]
    mask = mask_of("thing", corners, width, height, handle)
    listing = shot / "frames" / "frames.json"
    polygons = json.loads(listing.read_text())
    listing.write_text(json.dumps({**polygons, "width": width, "height": height}))
    file = addon("solve.drawn_masks").render(mask, shot, "people") / "000006.png"
    rendered = read(file)[..., 0] > 0.5
    (polygon,) = addon("freeze.mattes").polygons(mask, width, height)
    drawn = filled(polygon, width, height)
    # Blender blurs a mask's edge outwards by one pixel.
    assert (drawn & rendered).sum() / drawn.sum() > 0.995
    for axis in (0, 1):
        ends = [np.flatnonzero(one.any(axis))[[0, -1]] for one in (drawn, rendered)]
        assert np.abs(ends[0] - ends[1]).max() <= 1
    mask.layers[0].hide = True
    assert addon("freeze.mattes").polygons(mask, width, height) == []


@pytest.fixture(scope="module")
def world(frozen_world):
    """A frozen take of the backend's tiny world: (shot folder, masks by frame, outline at frame 107)."""
    truth = json.loads((frozen_world / "truth.json").read_text())
    masks = {int(frame): np.array(mask, bool) for frame, mask in truth["masks"].items()}
    return frozen_world / "tiny.splannequin", masks, truth["outline"]


@pytest.fixture
def chosen(scene, world):
    """Scene settings with the world's shot chosen, at the frame of the outline."""
    props = scene.splannequin
    props.shot_path, props.take_name = str(world[0]), "freeze"
    scene.frame_set(107)
    return props


def test_a_mask_becomes_a_matte_of_every_frame_which_a_node_picks(addon, scene, chosen, world, tmp_path, stand_in):
    shot, masks, outline = world
    chosen.matte_mask = mask_of("red patch", outline)
    assert bpy.ops.splannequin.matte_from_mask() == {"FINISHED"}
    single = shot / "takes" / "freeze" / "mattes" / "single" / "red patch"
    found = []
    for frame, mask in masks.items():
        matte = read(single / f"{frame:06d}.exr")[..., 0] > 0.5
        found.append((matte & mask).sum() / (matte | mask).sum())
    assert np.mean(found) > 0.8
    state = addon("process.job_timer").watch_of(shot)
    addon("process.job_timer").refresh(state)
    assert state.state.takes["freeze"]["mattes"] == {"red patch": [107]}

    scene.frame_set(109)  # a lasso on another frame is added to the existing matte
    addon("freeze.mattes").params_of(scene, shot)
    drawn = json.loads(addon("freeze.mattes").take_of(shot, "freeze").drawn_lassos.read_text())["mattes"]
    assert [(row["name"], row["frame"]) for row in drawn] == [("red patch", 107), ("red patch", 109)]

    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "Comp")
    assert bpy.ops.splannequin.insert_matte(name="red patch") == {"FINISHED"}
    assert bpy.ops.splannequin.insert_matte(name="red patch") == {"FINISHED"}
    (node,) = [n for n in tree.nodes if n.bl_idname == "CompositorNodeCryptomatteV2"]
    tree.links.new(node.outputs["Matte"], compat.output_socket(tree))
    compat.enable_compositor(scene)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = WIDTH, HEIGHT, 100
    compat.set_png(render.image_settings)
    scene.view_settings.view_transform = "Raw"
    render.dither_intensity = 0.0
    scene.frame_set(106)
    render.filepath = str(tmp_path / "picked.png")
    bpy.ops.render.render(write_still=True)
    picked = read(render.filepath)[..., 0]
    assert np.abs(picked - read(single / "000106.exr")[..., 0]).max() < 0.01
    assert (picked > 0.5).any()

    stand_in("exit 3")
    with pytest.raises(RuntimeError, match="stopped unexpectedly"):
        bpy.ops.splannequin.remove_matte(name="red patch")
    assert addon("process.job_timer").watch_of(shot).jobs["freeze"].params["remove"] == "red patch"


def test_uncreatable_paths_give_a_readable_error(addon, chosen, world):
    mattes, scene = addon("freeze.mattes"), bpy.context.scene
    with pytest.raises(addon("freeze.mattes").contract.JobError, match="No mask"):
        mattes.params_of(scene, world[0])
    chosen.matte_mask = bpy.data.masks.new("empty")
    with pytest.raises(mattes.contract.JobError, match="Nothing is drawn"):
        mattes.params_of(scene, world[0])
    chosen.matte_mask = mask_of("patch", world[2])
    scene.frame_set(300)
    with pytest.raises(mattes.contract.JobError, match="no frame 300"):
        mattes.params_of(scene, world[0])
    with pytest.raises(mattes.contract.JobError, match="no matte"):
        addon("bake.matte_node").insert(scene, world[0], "freeze", "nobody")


def test_drawing_begins_with_a_mask_and_is_undone(addon, chosen, world):
    before = len(bpy.data.masks)
    assert bpy.ops.splannequin.draw_matte() == {"FINISHED"}
    assert chosen.matte_mask is not None and len(bpy.data.masks) == before + 1
    image, first, last = addon("freeze.mattes").frozen_sequence(world[0], "freeze")
    assert (first, last) == (104, 110) and image.source == "SEQUENCE"


def test_untrusted_lasso_files_are_validated(addon, contract, shot):
    record = contract.TakeFolder(shot / "takes" / "freeze").mattes_record
    record.parent.mkdir(parents=True)
    rows = [{"name": "../x", "frame": 1, "polygon": []}, {"name": "ok", "frame": True, "polygon": []}, 7]
    record.write_text(json.dumps({"version": 1, "mattes": [*rows, {"name": "ok", "frame": 3, "polygon": []}]}))
    assert addon("shot.inventory").mattes(contract.TakeFolder(shot / "takes" / "freeze")) == {"ok": [3]}
    record.write_text("[" * sys.getrecursionlimit())
    assert addon("shot.inventory").mattes(contract.TakeFolder(shot / "takes" / "freeze")) == {}
