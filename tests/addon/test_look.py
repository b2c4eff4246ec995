"""Rendered output of the compositor: frozen frame with grain, and the unchanged plate, fully or partly shown."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data import make_grain as grains
from tests.addon.data.pixels import read, set_format


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def linear_of(display: np.ndarray) -> np.ndarray:
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


@pytest.fixture
def grainy(addon, scene, shot):
    """Group over a take with grain, 32-bit EXR output. grainy(factor) renders the two frames as [2, H, W, 4]."""
    folder = shot / "takes" / "grain"
    shutil.copytree(grains.FOLDER, folder)
    compositor = addon("bake.compositor")
    scene.render.resolution_x, scene.render.resolution_y = grains.WIDTH, grains.HEIGHT
    scene.render.resolution_percentage = 100
    compositor.insert(scene, addon("bake.take_files").take_of(folder))
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    scene.frame_start, scene.frame_end = grains.FRAMES
    addon("scene.scene_setup").keep_plate_colours(scene)
    set_format(scene, "OPEN_EXR")

    def render(factor: float) -> np.ndarray:
        node.inputs["Grain"].default_value = factor
        out = shot / f"out{factor}"
        addon("bake.rendering").render(scene, out, png=False)
        return np.stack([read(out / f"{n:06d}.exr") for n in grains.FRAMES])

    return render


def test_grain_at_1_is_the_plates_and_another_one_on_every_frame(grainy):
    clean, with_grain, twice = grainy(0.0), grainy(1.0), grainy(2.0)
    grey = linear_of(np.float64(grains.VALUE))
    half = grains.WIDTH // 2
    np.testing.assert_allclose(clean[:, :, :half, :3], grey, rtol=1e-3)
    np.testing.assert_array_equal(clean[0], clean[1])
    np.testing.assert_array_equal(clean[..., 3], with_grain[..., 3])
    shown = srgb(with_grain[:, :, :half, :3]) - srgb(clean[:, :, :half, :3])
    np.testing.assert_allclose(shown.std(axis=(0, 1, 2)), grains.DEVIATION, rtol=0.06)
    assert np.abs(shown.mean(axis=(0, 1, 2))).max() < 0.3 / 255
    assert abs(np.corrcoef(shown[0].ravel(), shown[1].ravel())[0, 1]) < 0.1
    added, double = with_grain - clean, twice - clean
    np.testing.assert_allclose(double, 2.0 * added, atol=1e-6)
    # Alpha 0.5 halves the grain: it is premultiplied like the picture.
    ratio = added[:, :, half:, :3].std(axis=(0, 1, 2)) / added[:, :, :half, :3].std(axis=(0, 1, 2))
    np.testing.assert_allclose(ratio, 0.5, rtol=0.1)


def test_grain_does_not_hide_the_background(addon, scene, grainy):
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    node.inputs["CG"].default_value = (0.0, 1.0, 0.0, 1.0)  # far behind, visible where the frame's alpha is 0.5
    grey, half = linear_of(np.float64(grains.VALUE)), grains.WIDTH // 2
    mean = grainy(1.0)[:, :, half:, :3].mean(axis=(0, 1, 2))
    np.testing.assert_allclose(mean, [0.5 * grey, 0.5 * grey + 0.5, 0.5 * grey], atol=2e-3)


def test_grain_at_0_leaves_every_bit(addon, scene, grainy, shot):
    """Compared with the same group when its grain node is bypassed."""
    clean = grainy(0.0)
    group = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene)).node_tree
    mix = group.nodes["Grain"]
    clean_picture, _ = [s for s in mix.inputs if s.is_linked and s.type == "RGBA"]
    socket = clean_picture.links[0].from_socket
    for link in [link for link in group.links if link.from_node == mix]:
        group.links.new(socket, link.to_socket)
    np.testing.assert_array_equal(clean, grainy(0.0))
    np.testing.assert_array_equal(clean, grainy(1.0))


def test_a_take_without_grain_still_bakes_and_one_with_it_takes_its_place(addon, scene, shot, tmp_path):
    compositor = addon("bake.compositor")
    compositor.insert(scene, addon("bake.take_files").take_of(shot / "takes" / "freeze"))
    node = addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))
    assert "Grain" not in node.node_tree.nodes and node.inputs["Grain"].default_value == 0.0
    node.inputs["Grain"].default_value = 0.7
    said = compositor.insert(scene, addon("bake.take_files").take_of(shot / "takes" / "freeze"))
    assert any("no grain" in line for line in said)
    shutil.copytree(grains.FOLDER, shot / "takes" / "grain")
    said = compositor.insert(scene, addon("bake.take_files").take_of(shot / "takes" / "grain"))
    assert not any("no grain" in line for line in said)
    assert "Grain" in node.node_tree.nodes and node.inputs["Grain"].default_value == pytest.approx(0.7)


def ramp() -> np.ndarray:
    """[48, 64, 3] uint8: every level of every channel, in varying combinations."""
    level = np.arange(256)
    rows = np.stack([level, level[::-1], (level * 7) % 256], axis=1)
    picture = np.tile(rows, (12, 1)).reshape(48, 64, 3)
    return picture.astype(np.uint8)


SETTINGS = {
    "mix": {"Mix": 0.0},
    "wipe": {"Wipe": 0.0},
    "grain": {"Mix": 0.0, "Grain": 1.0},
}


@pytest.mark.parametrize(
    ("setting", "kind"),
    [("mix", "PNG"), ("wipe", "PNG"), ("grain", "PNG"), ("mix", "OPEN_EXR"), ("mix", "OPEN_EXR_MULTILAYER")],
)
def test_the_plate_passes_through_untouched(addon, scene, shot, pictures, setting, kind):
    """Errors are below 1/255 in an sRGB PNG and 1e-3 in 32-bit linear EXR; the frozen frame differs everywhere."""
    compositor, compat = addon("bake.compositor"), addon("compat")
    source = ramp()
    for n in (5, 6):
        pictures.write(shot / "frames" / f"{n:06d}.png", source)
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 48, 100
    take = shot / "takes" / "grain"
    shutil.copytree(grains.FOLDER, take)
    compositor.insert(scene, addon("bake.take_files").take_of(take), shot / "frames" / "000005.png")
    node = addon("bake.freeze_group").group_node(compat.compositor_tree(scene))
    for name, value in SETTINGS[setting].items():
        node.inputs[name].default_value = value
    scene.frame_start = scene.frame_end = 6
    addon("scene.scene_setup").keep_plate_colours(scene)
    if kind != "PNG":
        set_format(scene, kind)
    out = shot / "out"
    addon("bake.rendering").render(scene, out, png=kind == "PNG")
    expected = source / 255.0
    if kind == "PNG":
        assert np.abs(pictures.read(out / "000006.png") - expected).max() * 255 < 0.5, "the very levels"
        return
    found = read(out / "000006.exr") if kind == "OPEN_EXR" else read_layers(addon, out / "000006.exr", shot)
    assert np.abs(found[..., :3] - linear_of(expected)).max() < 1e-3


def read_layers(addon, path: Path, folder: Path) -> np.ndarray:
    """Picture of a multilayer EXR, rendered through a separate compositor because `Image.pixels` does not give it."""
    scene = bpy.data.scenes.new("reader")
    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "reader")
    node = tree.nodes.new("CompositorNodeImage")
    node.image = bpy.data.images.load(str(path))
    compat.set_image_colour(node.image, "linear")
    tree.links.new(node.outputs["Combined" if "Combined" in node.outputs else 0], compat.output_socket(tree))
    compat.enable_compositor(scene)
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    addon("scene.scene_setup").keep_plate_colours(scene)
    set_format(scene, "OPEN_EXR")
    scene.frame_start = scene.frame_end = 1
    addon("bake.rendering").render(scene, folder / "read", png=False)
    return read(folder / "read" / "000001.exr")


@pytest.mark.parametrize(("movie", "stop_at"), [(True, 2), (False, 3)])
def test_a_render_is_cancelled_between_frames_and_its_file_closed(addon, scene, shot, contract, movie, stop_at):
    compositor = addon("bake.compositor")
    compositor.insert(scene, addon("bake.take_files").take_of(shot / "takes" / "freeze"))
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 48, 100
    scene.frame_start, scene.frame_end = 5, 14
    scene.frame_step = 2
    scene.frame_set(1)
    if movie:
        set_format(scene, "FFMPEG")
        scene.render.ffmpeg.format, scene.render.ffmpeg.codec = "MPEG4", "MPEG4"
    seen = []

    def check() -> None:
        if len(seen) == stop_at:
            raise contract.Cancelled

    with pytest.raises(contract.Cancelled):
        addon("bake.rendering").render(
            scene, shot / "out", not movie, lambda done, total: seen.append((done, total)), check
        )
    assert seen == [(n + 1, 5) for n in range(stop_at)]
    assert (scene.frame_current, scene.frame_start, scene.frame_end, scene.frame_step) == (1, 5, 14, 2)
    assert not bpy.app.handlers.render_write, "ours is gone"
    files = sorted(p.name for p in (shot / "out").iterdir())
    if not movie:
        assert files == [f"{n:06d}.png" for n in range(5, 5 + 2 * stop_at, 2)]
        return
    assert len(files) == 1
    clip = bpy.data.movieclips.load(str(shot / "out" / files[0]))
    assert tuple(clip.size) == (64, 48) and clip.frame_duration == stop_at, "a whole file of what was rendered"
    bpy.data.movieclips.remove(clip)
