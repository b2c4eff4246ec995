"""Overscan in the compositor, pixel by pixel; undistortion and redistortion by Blender's own Map UV node."""

import json
import shutil
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

DATA = Path(__file__).resolve().parent / "data"
MARGIN = (2, 1)


def inside(values: np.ndarray) -> np.ndarray:
    return values[MARGIN[1] : -MARGIN[1], MARGIN[0] : -MARGIN[0]]


@pytest.fixture
def take(addon, shot):
    """Take of one frame, 6: 12 x 10 pixels in a picture of 16 x 12."""
    folder = shot / "takes" / "over"
    folder.mkdir()
    shutil.copy(DATA / "overscan" / "000006.exr", folder)
    facts = {"version": 1, "take": "over", "run": "main", "t_star_frame": 6, "query": "nearest", "frames": 1}
    facts |= {"width": 12, "height": 10, "first": 6, "last": 6, "overscan": -1.0, "margin": list(MARGIN)}
    (folder / "take.json").write_text(json.dumps(facts))
    return addon("bake.take_files").take_of(folder)


def render(addon, scene, folder: Path, size=(12, 10)) -> Path:
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    scene.frame_start = scene.frame_end = 6
    addon("scene.scene_setup").keep_plate_colours(scene)
    addon("bake.rendering").render(scene, folder)
    return folder / "000006.png"


def test_frame_and_margin_come_from_the_exr_header(addon, take, shot, tmp_path):
    addon("bake.compositor")
    assert (take.size, take.margin) == ((12, 10), MARGIN)
    assert addon("bake.take_files").exr_windows(shot / "takes" / "freeze" / "000006.exr") == ((16, 12), (0, 0))
    file = tmp_path / "aside.exr"
    header = bytearray((DATA / "overscan" / "000006.exr").read_bytes())
    at = header.find(b"displayWindow\0box2i\0") + len(b"displayWindow\0box2i\0") + 4
    header[at + 8 : at + 12] = (12).to_bytes(4, "little")  # extends the display window by one pixel to the right
    file.write_bytes(header)
    with pytest.raises(ValueError, match="different overscan on opposite sides"):
        addon("bake.take_files").exr_windows(file)


def test_the_scene_takes_the_size_of_the_frame(addon, scene, shot, take):
    scene.splannequin.set_up_scene = True
    addon("bake.insertion").fit_take(scene, shot, "over")
    assert (scene.render.resolution_x, scene.render.resolution_y) == (1920, 1080), "never smaller"
    addon("bake.insertion").fit_take(scene, shot, "over", new=True)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (12, 10), "of another shape than the plate"


@pytest.mark.parametrize("output", ["Image", "Depth", "Support", "Motion"])
def test_every_layer_stands_over_the_plate_pixel_by_pixel(addon, scene, take, tmp_path, layers, pictures, output):
    compositor, compat = addon("bake.compositor"), addon("compat")
    take.depth_scale = 1.0 / 32.0
    compositor.insert(scene, take)
    tree = compat.compositor_tree(scene)
    tree.links.new(addon("bake.freeze_group").group_node(tree).outputs[output], compat.output_socket(tree))
    found = pictures.read(render(addon, scene, tmp_path))
    assert found.shape == (10, 12, 3)
    data = {"Image": layers(6)["rgba"][..., :3], "Depth": layers(6)["depth"] / 32.0}
    expected = inside(data.get(output, layers(6).get(output.lower())))
    expected = expected if expected.ndim == 3 else np.repeat(expected[..., None], 3, axis=2)
    assert np.abs(found - pictures.srgb(expected)).max() * 255 < 1.1


def test_the_artists_stream_and_the_mattes_fall_on_the_same_pixels(addon, scene, take, tmp_path, layers, pictures):
    compositor, compat = addon("bake.compositor"), addon("compat")
    tree = compat.new_compositor_tree(scene, "Artist")
    stream = tree.nodes.new("CompositorNodeImage")
    stream.image = bpy.data.images.new("stream", 12, 10, float_buffer=True, is_data=True)
    painted = np.random.default_rng(5).uniform(0.1, 0.9, (10, 12, 4)).astype(np.float32)
    painted[..., 3] = 1.0
    stream.image.pixels.foreach_set(painted[::-1].ravel())
    tree.links.new(stream.outputs["Image"], compat.output_socket(tree))
    compositor.insert(scene, take)
    group = addon("bake.freeze_group").group_node(tree)
    group.inputs["Only Supported"].default_value = 1.0
    group.inputs["Wipe"].default_value = 0.5
    found = pictures.read(render(addon, scene, tmp_path))
    share = inside(layers(6)["support"])[..., None] * (np.arange(12) < 6)[None, :, None]
    expected = painted[..., :3] + share * (inside(layers(6)["rgba"])[..., :3] - painted[..., :3])
    assert np.abs(found - pictures.srgb(expected)).max() * 255 < 1.1


def test_at_another_render_size_the_frame_still_fills_the_picture(addon, scene, take, tmp_path, layers, pictures):
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 24, 20, 100
    addon("bake.compositor").insert(scene, take)
    found = pictures.read(render(addon, scene, tmp_path, (24, 20)))
    expected = pictures.srgb(inside(layers(6)["rgba"])[..., :3])
    for rows in (slice(2, 10), slice(10, 18)):
        for columns in (slice(2, 12), slice(12, 22)):
            small = expected[rows.start // 2 : rows.stop // 2, columns.start // 2 : columns.stop // 2]
            assert found[rows, columns].mean() == pytest.approx(small.mean(), abs=0.04)


def test_the_panels_choice_reaches_the_backend_and_a_bake_keeps_the_takes(addon, scene, shot, take):
    steps = addon("process.steps")
    scene.splannequin.shot_path = str(shot)
    assert steps.STEPS["freeze"].params(scene).overscan == 0.0
    scene.splannequin.overscan = "LENS"
    assert steps.STEPS["freeze"].params(scene).overscan == -1.0
    scene.splannequin.overscan = "OFF"
    assert (
        addon("freeze.takes").take_params(shot, "over").overscan == -1.0
        and addon("freeze.takes").take_params(shot, "freeze").overscan == 0.0
    )
    scene.splannequin.take_name = "over"
    assert steps.STEPS["bake"].params(scene).overscan == -1.0
    view = addon("process.steps").STEPS["freeze"].view(scene, addon("shot.inventory").read(shot))
    assert "Overscan: 2 pixels on each side, 1 above and below" in view.state


# ------------------------------------------------------------------------------------------------- ST maps

WIDTH, HEIGHT = 160, 120


@pytest.fixture
def lens_shot(shot):
    """Shot through a barrel lens (k1 = -0.2) at 160 x 120, undistorted to the widest view without black borders."""
    path = json.loads((shot / "solve" / "cameras.json").read_text())
    path |= {"width": WIDTH, "height": HEIGHT}
    for frame in path["frames"]:
        frame["K"] = [135.0, 135.0, 80.0, 60.0]
    (shot / "solve" / "cameras.json").write_text(json.dumps(path))
    solve = json.loads((shot / "solve" / "solve.json").read_text())
    solve |= {"camera_model": "SIMPLE_RADIAL", "distortion": [-0.2], "focal_px": 141.0}
    (shot / "solve" / "solve.json").write_text(json.dumps(solve))
    return shot


def image_of(name: str, rgb: np.ndarray):
    image = bpy.data.images.new(name, rgb.shape[1], rgb.shape[0], float_buffer=True, is_data=True)
    pixels = np.concatenate([rgb, np.ones((*rgb.shape[:2], 1))], axis=2).astype(np.float32)
    image.pixels.foreach_set(pixels[::-1].ravel())
    return image


def mapped(tree, picture, path: Path):
    """Output socket of a picture that is mapped by an ST map, as described in the manual."""
    source = tree.nodes.new("CompositorNodeImage")
    source.image = bpy.data.images.load(str(path))
    source.image.colorspace_settings.name = "Non-Color"
    node = tree.nodes.new("CompositorNodeMapUV")
    tree.links.new(picture, node.inputs["Image"])
    tree.links.new(source.outputs["Image"], node.inputs["UV"])
    return node.outputs["Image"]


def test_blenders_map_uv_undistorts_and_gives_the_original_back(addon, scene, lens_shot, tmp_path, pictures):
    scene.splannequin.shot_path = str(lens_shot)
    assert bpy.ops.splannequin.write_stmaps() == {"FINISHED"}
    notes = addon("process.job_timer").watch_of(lens_shot).notes["solve"]
    assert "stmap_undistort.exr and stmap_redistort.exr are in" in notes[0] and "overscan" in notes[1]
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    original = np.stack([0.5 + 0.4 * np.sin(x / 11.0), 0.5 + 0.4 * np.cos(y / 9.0), (x + y) / 300.0], axis=2)
    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "Lens")
    clip = tree.nodes.new("CompositorNodeImage")
    clip.image = image_of("clip", original)
    plate = mapped(tree, clip.outputs["Image"], lens_shot / "solve" / "stmap_undistort.exr")
    back = mapped(tree, plate, lens_shot / "solve" / "stmap_redistort.exr")
    tree.links.new(plate, compat.output_socket(tree))
    undistorted = pictures.read(render(addon, scene, tmp_path / "plate", (WIDTH, HEIGHT)))
    # Position in the original of each pixel of the plate, by the lens model.
    ideal = np.stack([x + 0.5 - 80.0, y + 0.5 - 60.0], axis=2) / 135.0
    at = 141.0 * ideal * (1 - 0.2 * (ideal**2).sum(2, keepdims=True)) + [80.0, 60.0] - 0.5
    expected = np.stack(
        [0.5 + 0.4 * np.sin(at[..., 0] / 11.0), 0.5 + 0.4 * np.cos(at[..., 1] / 9.0), at.sum(2) / 300.0], axis=2
    )
    middle = np.s_[3:-3, 3:-3]
    # Before 5.0 the only smooth filter of the node has errors up to 0.2 pixels.
    least = 45.0 if compat.HAS_COMPOSITING_GROUP else 38.0
    assert psnr(undistorted[middle], pictures.srgb(expected)[middle]) > least
    tree.links.new(back, compat.output_socket(tree))
    found = pictures.read(render(addon, scene, tmp_path / "back", (WIDTH, HEIGHT)))
    seen = (np.abs(x - 79.5) < 70) & (np.abs(y - 59.5) < 50)  # leaves out the corners, which the plate lacks
    assert psnr(found[seen], pictures.srgb(original)[seen]) > least - 3.0
    assert found[0, 0].max() < 0.01, "beyond the plate there is nothing"


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


def test_a_lens_that_folds_over_is_said_on_the_panel(addon, scene, lens_shot):
    solve = json.loads((lens_shot / "solve" / "solve.json").read_text())
    (lens_shot / "solve" / "solve.json").write_text(json.dumps({**solve, "distortion": [-0.9]}))
    scene.splannequin.shot_path = str(lens_shot)
    with pytest.raises(RuntimeError, match="folds over"):
        bpy.ops.splannequin.write_stmaps()
    assert "folds over" in addon("process.job_timer").watch_of(lens_shot).failures["solve"][0]
    assert not list((lens_shot / "solve").glob("*.exr"))


def test_in_a_window_the_timer_takes_the_answer_in_and_ends(addon, scene, lens_shot):
    operators, supervisor = addon("solve.operators"), addon("process.job_timer")
    watch = supervisor.watch_of(lens_shot)
    scene.splannequin.shot_path = str(lens_shot)
    question = addon("solve.stmaps").begin(lens_shot)
    operators.follow_stmaps(lens_shot, question)
    assert not bpy.ops.splannequin.write_stmaps.poll(), "one at a time"
    question.process.wait(60)
    for _ in range(100):  # a turn has a time budget, and a thread reads the process's output
        supervisor.tick()
        if not operators.writing:
            break
        time.sleep(0.02)
    assert not operators.writing and not supervisor._callbacks
    assert "stmap_redistort.exr" in watch.notes["solve"][0]
    assert bpy.ops.splannequin.write_stmaps.poll()


def test_overscan_button_is_disabled_without_a_solve(addon, scene, tmp_path):
    scene.splannequin.shot_path = str(tmp_path / "none.splannequin")
    assert not bpy.ops.splannequin.write_stmaps.poll()


def test_the_command_line_writes_maps_of_any_width(addon, lens_shot, tmp_path, capsys):
    headless = addon("command_line.headless")
    assert headless.main(["stmaps", str(lens_shot), "--json", "--width", "320"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["width"], facts["height"]) == (320, 240)
    assert addon("bake.take_files").exr_windows(Path(facts["redistort"]))[0] == (320, 240)
    assert headless.main(["stmaps", str(lens_shot), "--width", "7"]) == 2
    assert "cannot be 7 pixels wide" in capsys.readouterr().err
    assert headless.main(["stmaps", str(tmp_path)]) == 2
    assert "not a shot folder" in capsys.readouterr().err
