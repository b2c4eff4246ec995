"""Motion matte in Blender: shown as a sequence, painted on a copy, and saved to the shot completely or not at all."""

import json
import os
import struct
import zlib

import bpy
import numpy as np
import pytest

WIDTH, HEIGHT = 16, 12


def unpacked(data: bytes) -> np.ndarray:
    """Decode a PNG with row filter 0 to [H, W, C] uint8."""
    width, height, depth, kind = struct.unpack(">IIBB", data[16:26])
    start = data.index(b"IDAT")
    size = struct.unpack(">I", data[start - 4 : start])[0]
    rows = np.frombuffer(zlib.decompress(data[start + 4 : start + 4 + size]), np.uint8).reshape(height, -1)
    assert depth == 8 and not rows[:, 0].any()
    return rows[:, 1:].reshape(height, width, {0: 1, 4: 2}[kind])


def labels(frame: int) -> np.ndarray:
    """Matte of a still frame with a mover at the top left; the mover's size depends on the frame."""
    found = np.zeros((HEIGHT, WIDTH), np.uint8)
    found[:frame, :4] = 255
    found[-2:, -2:] = 128
    return found


@pytest.fixture
def matted(scene, shot, pictures):
    """The shot with mattes, chosen in the scene."""
    (shot / "solve" / "motion").mkdir()
    for frame in (5, 6, 7):
        pictures.write(shot / "solve" / "motion" / f"{frame:06d}.png", labels(frame))
    scene.splannequin.shot_path = str(shot)
    scene.frame_set(6)
    return shot


def values(image) -> np.ndarray:
    """[H, W] uint8, top row first."""
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    width, height = image.size
    return np.rint(pixels.reshape(height, width, -1)[::-1, :, 0] * 255).astype(np.uint8)


def paint_below(image, value: float, channels=slice(0, 3)) -> None:
    """Set channels of the three lowest rows."""
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    pixels.reshape(HEIGHT, WIDTH, 4)[:3, :, channels] = value
    image.pixels.foreach_set(pixels)
    image.update()


def reopen(folder) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))


def test_the_mattes_are_shown_as_a_sequence(matted):
    assert bpy.ops.splannequin.show_motion() == {"FINISHED"}
    (image,) = [i for i in bpy.data.images if i.source == "SEQUENCE"]
    assert os.path.abspath(bpy.path.abspath(image.filepath)) == str(matted / "solve" / "motion" / "000005.png")


def test_paint_is_saved_only_in_the_shot(matted, addon):
    mattes = addon("solve.mattes")
    found = {p: p.read_bytes() for p in (matted / "solve" / "motion").iterdir()}
    assert bpy.ops.splannequin.paint_motion() == {"FINISHED"}
    image = mattes.find_image(matted, 6)
    assert (values(image) == labels(6)).all()
    paint_below(image, 1.0)
    assert bpy.ops.splannequin.save_motion() == {"FINISHED"}
    wanted = labels(6)
    wanted[-3:] = 255
    assert (unpacked((matted / "motion_paint" / "000006.png").read_bytes())[..., 0] == wanted).all()
    assert [p.name for p in (matted / "motion_paint").iterdir()] == ["000006.png"]
    assert {p: p.read_bytes() for p in (matted / "solve" / "motion").iterdir()} == found
    assert not image.is_dirty and (values(image) == wanted).all()


def test_painting_goes_on_where_it_was_saved(matted, addon, pictures):
    mattes = addon("solve.mattes")
    (matted / "motion_paint").mkdir()
    painted = np.full((HEIGHT, WIDTH, 2), 255, np.uint8)
    painted[:, 8:, 1] = 0  # nothing is painted in columns from 8 on
    pictures.write(matted / "motion_paint" / "000006.png", painted)
    image = mattes.paint_image(matted, 6)
    assert (values(image)[:, :8] == 255).all() and (values(image)[:, 8:] == labels(6)[:, 8:]).all()
    assert mattes.paint_image(matted, 6) == image, "one image per frame"
    assert mattes.paint_image(matted, 7) != image


def test_transparent_paint_stays_transparent(addon):
    pixels = np.ones((HEIGHT, WIDTH, 4), np.float32)
    pixels[:, 8:, 3] = 0.25
    data = unpacked(addon("solve.mattes").packed(pixels))
    assert data.shape == (HEIGHT, WIDTH, 2)
    assert (data[:, :8, 1] == 255).all() and (data[:, 8:, 1] == 64).all()


def test_clear_takes_the_painted_matte_from_the_shot(matted, addon):
    mattes = addon("solve.mattes")
    bpy.ops.splannequin.paint_motion()
    bpy.ops.splannequin.save_motion()
    assert mattes.painted_file(matted, 6).is_file()
    assert bpy.ops.splannequin.clear_motion() == {"FINISHED"}
    assert not mattes.painted_file(matted, 6).exists() and mattes.found_file(matted, 6).is_file()
    with pytest.raises(RuntimeError, match=r"Nothing is painted on frame 6"):
        bpy.ops.splannequin.clear_motion()


def test_refusals_are_sentences(matted, scene):
    with pytest.raises(RuntimeError, match=r"Nothing is painted on frame 6\. Press Paint Motion first"):
        bpy.ops.splannequin.save_motion()
    scene.frame_set(99)
    with pytest.raises(RuntimeError, match=r"Frame 99 of my shot é has no motion matte"):
        bpy.ops.splannequin.paint_motion()
    for path in (matted / "solve" / "motion").iterdir():
        path.unlink()
    with pytest.raises(RuntimeError, match=r"my shot é has no motion matte"):
        bpy.ops.splannequin.show_motion()


def test_oversized_paint_is_not_loaded(matted, pictures):
    content = bytearray(pictures.png(np.zeros((4, 4), np.uint8)))
    content[16:24] = struct.pack(">II", 16000, 16000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (matted / "motion_paint").mkdir()
    (matted / "motion_paint" / "000006.png").write_bytes(content)
    with pytest.raises(RuntimeError, match=r"000006\.png has 16000 x 16000 pixels"):
        bpy.ops.splannequin.paint_motion()


def test_buttons_are_disabled_without_a_solve(scene, tmp_path):
    assert not bpy.ops.splannequin.paint_motion.poll()


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_nothing_is_written_through_a_link(matted, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (matted / "motion_paint").symlink_to(tmp_path / "elsewhere")
    bpy.ops.splannequin.paint_motion()
    with pytest.raises(RuntimeError, match=r"Cannot write to .*its folder is a link"):
        bpy.ops.splannequin.save_motion()
    assert not list((tmp_path / "elsewhere").iterdir())


def test_paint_is_found_after_the_file_was_saved_and_opened(matted, addon, tmp_path):
    """The image stores its shot's path relative to the .blend file."""
    mattes = addon("solve.mattes")
    bpy.ops.splannequin.paint_motion()
    bpy.ops.splannequin.save_motion()
    image = mattes.find_image(matted, 6)
    image.use_fake_user = True
    reopen(matted.parent)
    image = mattes.find_image(matted, 6)
    assert image is not None and (values(image) == labels(6)).all()


@pytest.mark.parametrize("saved", [False, True])
def test_paint_that_was_not_saved_yet_is_kept_by_the_blend(matted, addon, saved):
    """This holds with and without an earlier save to the shot. Save Paint then writes the paint and unpacks the
    image."""
    mattes = addon("solve.mattes")
    bpy.ops.splannequin.paint_motion()
    image = mattes.find_image(matted, 6)
    image.use_fake_user = True  # an Image Editor that shows it does the same
    if saved:
        paint_below(image, 0.0)
        bpy.ops.splannequin.save_motion()
    paint_below(image, 1.0)
    wanted = labels(6)
    wanted[-3:] = 255
    reopen(matted.parent)
    image = mattes.find_image(matted, 6)
    assert (values(image) == wanted).all()
    assert mattes.paint_image(matted, 6) == image
    assert bpy.ops.splannequin.save_motion() == {"FINISHED"}
    assert (unpacked(mattes.painted_file(matted, 6).read_bytes())[..., 0] == wanted).all()
    assert (values(image) == wanted).all() and image.packed_file is None
    assert os.path.abspath(bpy.path.abspath(image.filepath)) == str(mattes.painted_file(matted, 6))
    paint_below(image, 0.0)
    bpy.ops.splannequin.save_motion()
    wanted[-3:] = 0
    assert (values(image) == wanted).all(), "what is saved next is not hidden by the copy of before"


def test_what_was_rubbed_out_and_not_saved_stays_rubbed_out(matted, addon):
    mattes = addon("solve.mattes")
    image = mattes.paint_image(matted, 6)
    image.use_fake_user = True
    paint_below(image, 0.0, 3)
    reopen(matted.parent)
    mattes.save_paint(mattes.find_image(matted, 6))
    written = unpacked(mattes.painted_file(matted, 6).read_bytes())
    assert not written[-3:, :, 1].any() and (written[:-3, :, 1] == 255).all()


def unpacked_image(shot):
    """Image for painting frame 6 as stored by older versions, without packed pixels: Blender opens it black."""
    image = bpy.data.images.new("Motion", WIDTH, HEIGHT)
    image["splannequin_matte"], image["splannequin_matte_shot"] = 6, str(shot)
    image.use_fake_user = True
    return image


def test_the_black_image_of_an_older_file_is_the_matte_again(matted, addon):
    mattes = addon("solve.mattes")
    unpacked_image(matted)
    reopen(matted.parent)
    image = mattes.find_image(matted, 6)
    assert image.name == "Motion" and (values(image) == labels(6)).all()
    reopen(matted.parent)
    assert (values(mattes.find_image(matted, 6)) == labels(6)).all()


def test_a_black_image_is_never_taken_for_paint(matted, addon):
    """An image from another file can be black. Save refuses it; Paint fills it with the matte."""
    mattes = addon("solve.mattes")
    image = unpacked_image(matted)
    with pytest.raises(RuntimeError, match=r"Nothing is painted on frame 6"):
        bpy.ops.splannequin.save_motion()
    assert not mattes.painted_file(matted, 6).exists()
    bpy.ops.splannequin.paint_motion()
    assert mattes.find_image(matted, 6) == image and (values(image) == labels(6)).all()


def test_an_image_whose_file_is_gone_is_filled_anew(matted, addon):
    mattes = addon("solve.mattes")
    bpy.ops.splannequin.paint_motion()
    bpy.ops.splannequin.save_motion()
    mattes.find_image(matted, 6).use_fake_user = True
    mattes.clear_paint(matted, 6)
    reopen(matted.parent)
    bpy.ops.splannequin.paint_motion()
    assert (values(mattes.find_image(matted, 6)) == labels(6)).all()
    assert len([i for i in bpy.data.images if i.get("splannequin_matte") == 6]) == 1


def test_paint_that_a_blend_file_keeps_is_not_offered_for_another_clip(matted, addon):
    mattes, listing = addon("solve.mattes"), matted / "frames" / "frames.json"
    record = json.loads(listing.read_text())

    def imported(digest):
        rows = [{**row, "digest": digest} for row in record["frames"]]
        listing.write_text(json.dumps({**record, "frames": rows}))
        os.utime(listing, ns=(1, hash(digest) % 10**15))

    imported("one")
    bpy.ops.splannequin.paint_motion()
    image = mattes.find_image(matted, 6)
    image.pixels.foreach_set(np.ones(len(image.pixels), np.float32))
    imported("two")
    assert mattes.find_image(matted, 6) is None
    with pytest.raises(RuntimeError, match="Nothing is painted on frame 6"):
        bpy.ops.splannequin.save_motion()
    bpy.ops.splannequin.paint_motion()
    assert (values(mattes.find_image(matted, 6)) == labels(6)).all(), "the matte that was found, not the other paint"
    imported("one")
    assert mattes.find_image(matted, 6) == image
