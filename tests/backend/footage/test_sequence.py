"""Image sequences: real EXR and PNG files, their numbers, bit depth and colour."""

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from tests.backend.pictures import spec_of, write
from torch_backend.contract import ExitCode, JobError
from torch_backend.footage.color import srgb_to_linear
from torch_backend.footage.opening import open_source


def write_parts(path, parts):
    """Write a multi-part file; `parts`: (name of the part, names of its channels, pixels)."""
    specs = [spec_of(pixels, names, oiio__subimagename=part) for part, names, pixels in parts]
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), specs), out.geterror()
    for i, (_, _, pixels) in enumerate(parts):
        assert i == 0 or out.open(str(path), specs[i], "AppendSubimage"), out.geterror()
        assert out.write_image(pixels), out.geterror()
    assert out.close()


def flat(*values, kind=np.float32):
    return np.tile(np.array(values, kind), (8, 8, 1))


def first_of(folder, **options):
    """(source of `folder` after reading all frames, linear light of the first frame's centre pixel)."""
    source = open_source(str(folder), **options)
    frames = list(source.frames(None, None))
    return source, light(frames[0].pixels[4, 4])


def light(pixels):
    """Linear light of a source's pixels."""
    if pixels.dtype == np.float16:
        return pixels.astype(np.float32)
    return srgb_to_linear(pixels / np.iinfo(pixels.dtype).max)


def said(source):
    return [message for message, _ in source.warnings]


@pytest.fixture
def exrs(tmp_path):
    """Frames 1001 to 1010 of scene-linear half floats: a ramp that gets brighter with every frame."""
    ramp = np.linspace(0.0, 0.9, 64, dtype=np.float32)
    for i in range(10):
        pixels = np.tile((ramp * (0.5 + 0.05 * i))[None, :, None], (48, 1, 3)).astype(np.float16)
        write(tmp_path / f"shot.{1001 + i}.exr", pixels)
    return tmp_path


@pytest.mark.parametrize("name", ["", "shot.1004.exr", "shot.####.exr", "shot.%04d.exr", "shot.@@@@.exr"])
def test_folder_file_and_patterns_mean_the_same_sequence(exrs, name):
    source = open_source(str(exrs / name) if name else str(exrs))
    frames = list(source.frames(1003, 1006))
    assert [f.number for f in frames] == [1003, 1004, 1005, 1006]
    assert (source.info.first, source.info.last, source.info.width, source.info.height) == (1001, 1010, 64, 48)


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("*.exr", (1001, 1010)), ("shot.100?.exr", (1001, 1009)), ("shot.####", (1001, 1010)), ("s*.####", (1001, 1010))],
)
def test_a_wildcard_chooses_among_the_files(exrs, name, numbers):
    write(exrs / "other.png", np.zeros((8, 8, 3), np.uint8))
    info = open_source(str(exrs / name)).info
    assert (info.first, info.last) == numbers


def test_a_pattern_that_matches_nothing_says_how_one_is_written(exrs):
    with pytest.raises(JobError, match="No pictures match") as error:
        open_source(str(exrs / "none.*.exr"))
    assert "# or %04d stands for the frame number" in error.value.hint


def write_shades(folder, names):
    """Write pictures, each brighter than the one before."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, name in enumerate(names):
        write(folder / name, flat(*[10 * n + 5] * 3, kind=np.uint8))


def shades_of(source):
    return [(f.number, int(f.pixels[4, 4, 0]) // 10) for f in source.frames(None, None)]


@pytest.mark.parametrize(
    "template",
    ["frame-{:04d}.png", "2026-11-28-{:04d}.png", "clip_v02-{:04d}.png", "photo ({}).png", "f_{:04d}_left.png"],
)
@pytest.mark.parametrize("how", ["folder", "file", "pattern"])
def test_frames_are_ordered_by_number_for_any_name_pattern(tmp_path, template, how):
    folder = tmp_path / "#1 [a]{b}+(c) 50%"
    write_shades(folder, [template.format(n) for n in range(5, 15)])
    pattern = template.replace("{:04d}", "####").replace("{}", "#")
    path = {"folder": folder, "file": folder / template.format(9), "pattern": folder / pattern}[how]
    source = open_source(str(path))
    assert shades_of(source) == [(n + 5, n) for n in range(10)]
    assert (source.info.reading["files"], source.warnings, source.info.mismatch) == (pattern, [], "")


@pytest.mark.parametrize(
    ("template", "former"),
    [
        ("a.{:04d}.png", "a.3-6#.png"),
        ("a{:03d}.png", "a3-6@@@.png"),
        ("a{}.png", "a3-6@.png"),
        ("a{:08d}.png", "a3-6##.png"),
    ],
)
def test_an_import_of_before_is_known_by_the_name_that_its_sequence_had(tmp_path, template, former):
    write_shades(tmp_path, [template.format(n) for n in range(3, 7)])
    assert open_source(str(tmp_path)).info.former_key[0] == former


def test_endings_of_one_format_are_one_sequence_that_blender_does_not_find(tmp_path):
    write_shades(tmp_path, [f"f_{n:04d}.{'tif' if n % 2 else 'TIFF'}" for n in range(10)])
    source = open_source(str(tmp_path))
    assert shades_of(source) == [(n, n) for n in range(10)]
    assert source.info.mismatch


@pytest.mark.parametrize(("first", "second"), [("left_{:04d}", "right_{:04d}"), ("s_v1_{:04d}", "s_v2_{:04d}")])
def test_two_sequences_are_named_and_either_can_be_chosen(tmp_path, first, second):
    write_shades(tmp_path, [f"{template}.png".format(n) for template in (first, second) for n in range(8)])
    words = [template.replace("{:04d}", "####") + ".png" for template in (first, second)]
    with pytest.raises(JobError) as error:
        open_source(str(tmp_path))
    assert f"contains 2 image sequences ({words[0]}, {words[1]})." in error.value.message
    for chosen in (words[1], f"{second}.png".format(3)):
        assert shades_of(open_source(str(tmp_path / chosen))) == [(n, n + 8) for n in range(8)]


def test_second_varying_number_is_reported_and_blocks_the_plate(tmp_path):
    write_shades(tmp_path, [f"f_{n:04d}_t{n * 41}.png" for n in range(1, 9)])
    source = open_source(str(tmp_path))
    assert shades_of(source) == [(n + 1, n) for n in range(8)]
    assert "read where # stands in f_####_t*.png." in said(source)[0] and source.info.mismatch


def test_numbers_of_which_either_may_count_the_frames_are_refused(tmp_path):
    write_shades(tmp_path, [f"a{n}_b{10 - n}.png" for n in range(1, 10)])
    for path in (tmp_path, tmp_path / "a3_b7.png"):
        with pytest.raises(JobError, match=r"2 image sequences \(a#_b\*\.png, a\*_b#\.png\)"):
            open_source(str(path))
    assert shades_of(open_source(str(tmp_path / "a*_b#.png")))[0] == (1, 8)


def test_one_number_twice_is_refused(tmp_path):
    write_shades(tmp_path, [*(f"f_{n}.png" for n in range(1, 9)), "f_003.png"])
    with pytest.raises(JobError, match=r"f_003\.png and f_3\.png have the same frame number"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("suffix", ["jxl", "ppm", "sgi", "webp"])
def test_whatever_openimageio_reads_is_a_sequence(tmp_path, pan, suffix):
    pictures = pan(3)
    for n, pixels in enumerate(pictures):
        write(tmp_path / f"f.{n}.{suffix}", pixels)
    for path in (tmp_path, tmp_path / f"f.1.{suffix}"):
        frames = list(open_source(str(path)).frames(None, None))
        assert [f.number for f in frames] == [0, 1, 2]
        errors = [np.abs(f.pixels.astype(int) - pixels).mean() for f, pixels in zip(frames, pictures)]
        assert max(errors) < 3
    assert bool(open_source(str(tmp_path)).info.mismatch) == (suffix != "webp")


def test_pictures_that_are_not_read_are_named_with_what_to_do(tmp_path, pan):
    """QOI behaves like AVIF: OpenImageIO does not know the format, and FFmpeg reads the picture as a short video."""
    qoi = av.CodecContext.create("qoi", "w")
    qoi.width, qoi.height, qoi.pix_fmt = 64, 48, "rgb24"
    picture = bytes(qoi.encode(av.VideoFrame.from_ndarray(pan(1)[0], "rgb24"))[0])
    for n in range(1, 10):
        (tmp_path / f"f_{n:04d}.qoi").write_bytes(picture)
        (tmp_path / f"raw-{n:04d}.dng").write_bytes(b"II*\0not a picture that FFmpeg opens")
    for path, pattern in (("f_0004.qoi", "f_####.qoi"), ("raw-0004.dng", "raw-####.dng"), ("", "f_####.qoi")):
        with pytest.raises(JobError) as error:
            open_source(str(tmp_path / path))
        assert error.value.message.startswith(f"{pattern} cannot be read") and "PNG" in error.value.hint
    folder = tmp_path / "alone"
    folder.mkdir()
    (folder / "f.qoi").write_bytes(picture)
    with pytest.raises(JobError, match=r"f\.qoi is a single picture"):
        open_source(str(folder / "f.qoi"))


def test_a_damaged_video_among_numbered_ones_is_not_called_a_picture(tmp_path, pan, write_video):
    for n in range(1, 10):
        write_video(tmp_path / f"take_{n}.mp4", pan(3))
    (tmp_path / "take_4.mp4").write_bytes(b"damaged")
    with pytest.raises(JobError, match=r"take_4\.mp4"):
        open_source(str(tmp_path / "take_4.mp4"))


def write_animation(path, pictures):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(path.suffix[1:], rate=10)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "rgb24" if path.suffix == ".apng" else "rgb8"
        for pixels in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


@pytest.mark.parametrize("suffix", ["apng", "gif"])
def test_animated_pictures_are_clips(tmp_path, pan, suffix):
    write_animation(tmp_path / f"a1.{suffix}", pan(6))
    write_animation(tmp_path / f"a2.{suffix}", pan(6))
    if suffix == "apng":
        (tmp_path / "a1.apng").rename(tmp_path / "a1.png")
        write(tmp_path / "a2.png", flat(1, 2, 3, kind=np.uint8))
    source = open_source(str(tmp_path / f"a1.{suffix[-3:]}"))
    assert source.info.mismatch
    assert [f.number for f in source.frames(None, None)] == [1, 2, 3, 4, 5, 6]


def test_linear_pictures_are_read_as_the_light_that_they_hold(exrs):
    source = open_source(str(exrs))
    frame = next(iter(source.frames(None, None)))
    assert (source.info.colour, source.info.deep, frame.pixels.dtype) == ("linear", True, np.float16)
    expected = (np.linspace(0.0, 0.9, 64) * 0.5).astype(np.float16)
    assert (frame.pixels[10, :, 0] == expected).all()


def test_times_count_frames_at_the_files_rate(tmp_path):
    for i in range(1, 10):
        write(tmp_path / f"a.{i:03d}.exr", np.zeros((8, 8, 3), np.float16), FramesPerSecond=30.0)
    source = open_source(str(tmp_path))
    assert source.info.fps == 30.0
    assert [f.seconds for f in source.frames(4, 6)] == pytest.approx([3 / 30, 4 / 30, 5 / 30])
    assert open_source(str(tmp_path), fps=12.0).info.fps == 12.0


def test_bright_and_negative_values_pass_and_broken_ones_are_black(tmp_path):
    pixels = np.full((8, 8, 3), 0.25, np.float32)
    pixels[0, :4] = [4.0, 0.1, 0.1]
    pixels[1, 0] = np.nan
    pixels[1, 1] = -1.0
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", pixels)
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    assert (frame.pixels[0, 0, 0], frame.pixels[1, 1, 0]) == (4.0, -1.0)
    assert (frame.pixels[1, 0] == 0).all()


def test_channels_are_found_by_name_and_layer(tmp_path):
    pixels = np.stack([np.full((8, 8), v, np.float32) for v in (0.9, 0.1, 0.2, 0.3)], axis=-1)
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", pixels, names=("depth.Z", "view.B", "view.G", "view.R"))
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    assert frame.pixels[0, 0] == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)


def test_a_data_window_is_placed_in_its_picture(tmp_path):
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", np.full((4, 4, 3), 1.0, np.float32), window=(2, 3), full=(0, 0, 10, 8))
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    expected = np.zeros((8, 10), bool)
    expected[3:7, 2:6] = True
    assert frame.pixels.shape == (8, 10, 3)
    assert ((frame.pixels[..., 0] == 1.0) == expected).all()


def test_eight_bit_pictures_stay_as_they_are(tmp_path):
    rng = np.random.default_rng(0)
    stored = [rng.integers(0, 256, (9, 7, 4), dtype=np.uint8) for _ in range(3)]
    for i, pixels in enumerate(stored):
        pixels[..., 3] = 255
        write(tmp_path / f"a{i + 7:04d}.png", pixels)
    frames = list(open_source(str(tmp_path)).frames(None, None))
    assert [f.number for f in frames] == [7, 8, 9]
    assert all((f.pixels == pixels[..., :3]).all() for f, pixels in zip(frames, stored))


def test_gaps_and_unreadable_files_are_named(exrs):
    (exrs / "shot.1003.exr").unlink()
    (exrs / "shot.1005.exr").write_bytes((exrs / "shot.1005.exr").read_bytes()[:200])
    source = open_source(str(exrs))
    numbers = [f.number for f in source.frames(None, None)]
    assert numbers == [1001, 1002, 1004, 1006, 1007, 1008, 1009, 1010]
    assert [w[0] for w in source.warnings] == [
        "The sequence lacks frame 1003.",
        "Frame 1005 cannot be read: left out of the shot.",
    ]


def test_pictures_of_two_sizes_are_refused(exrs):
    write(exrs / "shot.1006.exr", np.zeros((20, 30, 3), np.float16))
    with pytest.raises(JobError, match=r"shot\.1006\.exr is 30x20, but the sequence starts with 64x48\."):
        list(open_source(str(exrs)).frames(None, None))


@pytest.mark.parametrize("name", ["", "single.png", "none.####.exr", "gone.png", "gone.mp4"])
def test_what_is_no_sequence_is_refused(tmp_path, name):
    write(tmp_path / "single.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(JobError) as error:
        open_source(str(tmp_path / name) if name else str(tmp_path))
    assert error.value.exit_code == ExitCode.FOOTAGE
    assert error.value.message.count(".") <= 3
    assert error.value.hint


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (("depth.Z", "ViewLayer.DiffCol.R", "ViewLayer.DiffCol.G", "ViewLayer.DiffCol.B", "ViewLayer.Combined.R",
          "ViewLayer.Combined.G", "ViewLayer.Combined.B"), "ViewLayer.Combined"),
        (("N.X", "diffuse.R", "diffuse.G", "diffuse.B", "R", "G", "B"), "RGB without a name"),
        (("a.Z", "spec.R", "spec.G", "spec.B", "rgba.R", "rgba.G", "rgba.B"), "rgba"),
    ],
)  # fmt: skip
def test_the_picture_itself_is_found_among_layers_and_named(tmp_path, names, taken):
    values = [0.9] * (len(names) - 3) + [0.3, 0.2, 0.1]
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(*values), names=names)
    source, pixel = first_of(tmp_path)
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)
    assert said(source) == [f"The pictures have 3 layers: {taken} is used."]
    assert source.info.reading["layer"] == ("" if taken.startswith("RGB") else taken)


def test_a_part_with_depth_before_the_picture_is_not_taken_for_it(tmp_path):
    for i in range(3):
        parts = [("depth", ("Z",), flat(7.0)), ("beauty", ("R", "G", "B", "A"), flat(0.3, 0.2, 0.1, 1.0))]
        write_parts(tmp_path / f"a.{i}.exr", parts)
    source, pixel = first_of(tmp_path)
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)
    assert said(source) == ["The pictures have 2 layers: beauty is used."]


def test_layers_of_which_none_is_surely_the_picture_are_listed_and_can_be_chosen(tmp_path):
    names = ("left.R", "left.G", "left.B", "right.R", "right.G", "right.B")
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(0.9, 0.9, 0.9, 0.3, 0.2, 0.1), names=names)
    with pytest.raises(JobError, match=r"none is recognised as the picture itself: left, right\.") as error:
        open_source(str(tmp_path))
    assert error.value.exit_code == ExitCode.FOOTAGE and "--layer" in error.value.hint
    source, pixel = first_of(tmp_path, layer="Right")
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)
    assert said(source) == []
    with pytest.raises(JobError, match="has no colour layer 'middle'"):
        open_source(str(tmp_path), layer="middle")


def test_passes_without_a_picture_are_refused(tmp_path):
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(1.0, 0.5), names=("depth.Z", "motion.X"))
    with pytest.raises(JobError, match="no layer with red, green and blue: it has depth, motion"):
        open_source(str(tmp_path))


def test_layer_is_found_in_any_part_or_refused(tmp_path):
    names = ("rgba.R", "rgba.G", "rgba.B", "spec.R", "spec.G", "spec.B")
    write(tmp_path / "a.0.exr", flat(0.3, 0.2, 0.1, 0.9, 0.9, 0.9), names=names)
    write(tmp_path / "a.1.exr", flat(0.9, 0.9, 0.9, 0.3, 0.2, 0.1), names=names[3:] + names[:3])
    frames = list(open_source(str(tmp_path)).frames(None, None))
    assert (frames[0].pixels == frames[1].pixels).all()
    write(tmp_path / "a.2.exr", flat(0.3, 0.2, 0.1), names=("spec.R", "spec.G", "spec.B"))
    with pytest.raises(JobError, match=r"a\.2\.exr has no layer rgba|has no colour layer 'rgba'"):
        list(open_source(str(tmp_path)).frames(None, None))


def test_transparent_pictures_keep_their_colour_and_say_that_alpha_is_not_taken(tmp_path):
    pixels = flat(0.3, 0.2, 0.1, 1.0)
    pixels[4] = [0.15, 0.1, 0.05, 0.5]  # the same colour, alpha 0.5
    pixels[5] = [0.2, 0.1, 0.0, 0.0]  # emission with alpha 0
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", pixels)
    source, pixel = first_of(tmp_path)
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)
    glow = next(iter(source.frames(None, None))).pixels[5, 0]
    assert glow == pytest.approx([0.2, 0.1, 0.0], abs=1e-4)
    assert said(source)[0] == "The pictures are transparent in places: their colour is used, their alpha is ignored."


@pytest.mark.parametrize(("suffix", "associated"), [("png", False), ("tif", False), ("tif", True)])
def test_eight_bit_alpha_does_not_darken_either(tmp_path, suffix, associated):
    stored = flat(100, 50, 25, 128, kind=np.uint8) if associated else flat(200, 100, 50, 128, kind=np.uint8)
    for i in range(3):
        write(tmp_path / f"a.{i}.{suffix}", stored, oiio__UnassociatedAlpha=0 if associated else 1)
    source = open_source(str(tmp_path))
    got = next(iter(source.frames(None, None))).pixels[4, 4]
    expected = np.array([200, 100, 50])
    if suffix == "png":  # OpenImageIO unpremultiplies when it writes a PNG
        expected = oiio.ImageInput.open(str(tmp_path / "a.0.png"), spec_of(stored, oiio__UnassociatedAlpha=1))
        expected = expected.read_image(oiio.UINT8)[4, 4, :3]
    assert np.abs(got.astype(int) - expected).max() <= 1


def test_opaque_pictures_say_nothing_of_alpha(tmp_path):
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(0.3, 0.2, 0.1, 1.0))
    assert said(first_of(tmp_path)[0]) == []


@pytest.mark.parametrize(("aspect", "size"), [(2.0, (16, 8)), (0.5, (8, 16))])
def test_non_square_pixels_are_resampled(tmp_path, aspect, size):
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(0.3, 0.2, 0.1), PixelAspectRatio=aspect)
    source, pixel = first_of(tmp_path)
    assert (source.info.width, source.info.height) == size
    assert next(iter(source.frames(None, None))).pixels.shape == (size[1], size[0], 3)
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)
    assert said(source)[0].startswith(f"The pictures have pixels {aspect:g} times as wide as high: 8x8 becomes")


def test_crop_window_is_reported(tmp_path):
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(1.0, 1.0, 1.0, 1.0), window=(-2, 3), full=(0, 0, 20, 20))
    source, _ = first_of(tmp_path)
    assert said(source) == ["Pictures fill only a part of their frame: the rest of it is black."]
    row = next(iter(source.frames(None, None))).pixels[5, :, 0]
    assert (row == np.where(np.arange(20) < 6, 1.0, 0.0)).all()


def test_damaged_headers_leave_their_frames_out(exrs):
    """OpenImageIO's error message contains the damaged bytes, which are not valid text."""
    for number, name in ((1006, b"channels"), (1007, b"chlist")):
        file = exrs / f"shot.{number}.exr"
        content = file.read_bytes()
        file.write_bytes(content.replace(name, b"\xff\xfe" + name[2:], 1))
    source = open_source(str(exrs))
    assert [f.number for f in source.frames(None, None)] == [1001, 1002, 1003, 1004, 1005, 1008, 1009, 1010]
    assert said(source) == ["Frames 1006-1007 cannot be read: left out of the shot."]
