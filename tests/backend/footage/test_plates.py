"""Plates: the source's pixels, found by frame number in real files and undistorted."""

import os
from fractions import Fraction

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.backend.pictures import write
from torch_backend.contract import CameraFrame, CameraPath, JobError, frame_file, read_json
from torch_backend.footage import FootageConfig, import_footage, load_frames, plate_encoding
from torch_backend.footage.display import ROLLED, display_of
from torch_backend.footage.images import read_png, resize_float, write_png
from torch_backend.footage.opening import open_source
from torch_backend.footage.plates import Plates
from torch_backend.footage.sources import Known
from torch_backend.lens.plate_lens import load_plate_lenses
from torch_backend.lens.undistort import Undistorter, of_frames
from torch_backend.shot import Shot, write_json


def solved(shot, radial=0.0, **facts):
    """Write a solve with one radial lens for `shot`, and undistort its frames as the solve does."""
    record = load_frames(shot)
    width, height = record["width"], record["height"]
    zoom = 0.97 if radial else 1.0
    K = [width * zoom, width * zoom, width / 2, height / 2]
    cameras = [CameraFrame(f["frame"], np.eye(4).ravel().tolist(), K, "registered") for f in record["frames"]]
    shot.solve.mkdir(exist_ok=True)
    write_json(shot.solve / "cameras.json", CameraPath(width, height, cameras).to_json())
    record_of_solve = {"version": 1, "key": f"k{radial}", "camera_model": "SIMPLE_RADIAL", "distortion": [radial]}
    write_json(shot.solve / "solve.json", {**record_of_solve, "focal_px": float(width), **facts})
    if "camera_model" not in facts:
        where = load_plate_lenses(shot)[cameras[0].frame].where(width, height)
        undistort = of_frames(Undistorter(where), where, display_of(record))
        for row in record["frames"]:
            raw = read_png(shot.frames / row["file"])
            write_png(shot.frames / frame_file(row["frame"], ".png"), undistort(raw))
    return shot


@pytest.fixture
def shot_of(tmp_path, recorder):
    def make(source, radial=0.0, **config):
        shot = Shot.create(tmp_path / "a.splannequin")
        import_footage(shot, str(source), FootageConfig(**config), recorder())
        return solved(shot, radial)

    return make


def write_sequence(folder, pictures, suffix="png"):
    folder.mkdir()
    for n, pixels in enumerate(pictures, start=1001):
        (write_png if suffix == "png" else write)(folder / f"a.{n}.{suffix}", pixels)
    return folder


def working_of(shot, frame, folder=""):
    return plate_encoding.display(read_png(shot.frames / folder / frame_file(frame, ".png")))


def test_a_clip_of_the_working_size_is_the_undistorted_frames(tmp_path, shot_of, pan, write_video):
    write_video(tmp_path / "a.mp4", pan(8))
    shot = shot_of(tmp_path / "a.mp4", radial=-0.1)
    os.remove(tmp_path / "a.mp4")  # the clip is not needed at the working size
    plates = Plates(shot)
    assert (plates.width, plates.height, plates.note, plates.deep) == (64, 48, "", False)
    assert plates.frames == list(range(1, 9))
    for frame in (1, 7):
        stored = read_png(shot.frames / frame_file(frame, ".png"))
        assert plates.display(frame).dtype.is_floating_point and plates.display(frame).shape == (48, 64, 3)
        assert ((plates.display(frame) * 255).round().numpy() == stored).all()
    half = Plates(shot, size=(32, 24))
    assert half.display(3).shape == (24, 32, 3) and half.key != plates.key


def test_larger_clip_is_read_at_full_size(tmp_path, shot_of, pan, write_video):
    frames = pan(12, height=96, width=128)
    write_video(tmp_path / "a.mp4", frames)
    shot = shot_of(tmp_path / "a.mp4", working_height=48, first=3)
    plates = Plates(shot)
    assert (plates.width, plates.height, plates.note, plates.frames[0]) == (128, 96, "", 3)
    want = {f.number: f.pixels for f in open_source(str(tmp_path / "a.mp4")).frames(None, None)}
    for frame in (12, 3, 8):
        assert ((plates.display(frame) * 255).round().numpy() == want[frame]).all()
        small = resize_float(plates.display(frame).numpy(), 64, 48)
        assert np.abs(small - working_of(shot, frame)).mean() < 1 / 255
    assert (plates.linear(8, slice(20, 90)) == plates.linear(8)[20:90]).all()
    with pytest.raises(ValueError, match="no frame 2"):
        plates.display(2)
    at_working = Plates(shot, size=(64, 48))
    assert (at_working.display(5).numpy() == working_of(shot, 5)).all()


def test_sixteen_bits_come_through_exactly(tmp_path, shot_of):
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.random((48, 100, 3)), (2, 2, 0))
    pictures = [np.rint(65535 * smooth[:, 2 * n : 2 * n + 64]).astype(np.uint16) for n in range(9)]
    shot = shot_of(write_sequence(tmp_path / "f", pictures), working_height=24)
    plates = Plates(shot)
    assert not plates.deep
    assert (np.rint(plates.display(1004).double().numpy() * 65535) == pictures[3]).all()


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_light_beyond_white_and_below_black_passes(tmp_path, shot_of, kind):
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.random((48, 100, 3)), (2, 2, 0))
    pictures = [smooth[:, 2 * n : 2 * n + 64].astype(kind) for n in range(9)]
    for picture in pictures:
        picture[10:20, 10:20], picture[30:36, 30:36] = 50.0, -0.01
        picture[0, 0] = np.nan
    shot = shot_of(write_sequence(tmp_path / "f", pictures, "exr"))  # size of the working frames, which are rounded
    plates = Plates(shot)
    assert plates.deep and plates.note == ""
    got, want = plates.linear(1003).numpy(), np.nan_to_num(pictures[2].astype(np.float32))
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-7)
    assert got.max() == pytest.approx(50.0, rel=1e-3) and got.min() == pytest.approx(-0.01, rel=1e-3)
    shown = plates.display(1003).numpy()
    np.testing.assert_allclose(shown, ROLLED.from_light(got))
    assert 0.98 < shown.max() < 1.0 and shown.min() < -0.09
    assert np.abs(np.clip(shown, 0, 1) - working_of(shot, 1003)).max() < 1 / 65535


def test_the_lens_is_taken_out_at_the_sources_size_as_at_the_working_size(tmp_path, shot_of):
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.random((192, 300, 3)), (5, 5, 0))
    smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min())
    pictures = [np.rint(65535 * smooth[:, 2 * n : 2 * n + 256]).astype(np.uint16) for n in range(9)]
    shot = shot_of(write_sequence(tmp_path / "f", pictures), radial=-0.15, working_height=96)
    plates = Plates(shot)
    assert (plates.width, plates.height) == (256, 192)
    small, working = resize_float(plates.display(1002).numpy(), 128, 96), working_of(shot, 1002)
    assert np.abs(small - working)[2:-2, 2:-2].max() < 1 / 255
    assert np.abs(small - working_of(shot, 1002, "raw"))[2:-2, 2:-2].max() > 10 / 255
    # As sharp as the solve's own undistortion at that size.
    where = load_plate_lenses(shot)[1002].where(256, 192)
    whole = Undistorter(where)(pictures[1])
    assert np.abs(plates.display(1002).numpy() - plate_encoding.display(whole)).max() < 1e-4


def test_a_lamp_wears_no_black_ring(tmp_path, shot_of):
    wall = np.random.default_rng(0).uniform(0.2, 0.3, (48, 100, 3))
    pictures = [wall[:, 4 * n : 4 * n + 64].astype(np.float16) for n in range(9)]
    for n, picture in enumerate(pictures):
        picture[20:28, 50 - 4 * n : 58 - 4 * n] = 50.0
    shot = shot_of(write_sequence(tmp_path / "f", pictures, "exr"), radial=-0.1)
    for plates in (Plates(shot), Plates(shot, size=(32, 24)), Plates(shot, size=(128, 96))):
        assert plates.linear(1004).max() > 45
        assert plates.linear(1004).min() > 0.12


# ------------------------------------------------------------------------------------------------- seeking


def every_frame(path, order, first=None, start_known=True):
    """(whether each frame of `order` equals the sequential decode, whether the reader could seek)."""
    source = open_source(str(path))
    want = {f.number: f for f in source.frames(first, None)}
    begin = want[min(want)].seconds
    known = Known(
        {n: round(f.seconds - begin, 6) for n, f in want.items()},
        begin if start_known else None,
        lambda n, pixels: bool((pixels == want[n].pixels).all()),
    )
    reader = source.plates(known)
    same = [bool((reader.plate(n) == want[n].pixels).all()) for n in order(list(want))]
    sought = reader._can_seek
    reader.close()
    return all(same), sought


def at_random(numbers):
    return np.random.default_rng(1).permutation(numbers).tolist()


def as_frozen(numbers):
    requested = (m for n in numbers for m in (n, n - 2, n + 2, n - 4, n + 4, numbers[len(numbers) // 2]))
    return [m for m in requested if m in numbers]


VIDEOS = {
    "long groups.mp4": {"g": "250", "bf": "3"},
    "open groups.mp4": {"x264-params": "open-gop=1:keyint=12:bframes=4:b-pyramid=2"},
    "refreshed.mp4": {"x264-params": "intra-refresh=1:keyint=20"},
    "short.mkv": {"g": "12", "bf": "2"},
    "stream.ts": {"g": "15", "bf": "3"},
    "bare.h264": {"g": "15", "bf": "2"},
}


@pytest.mark.parametrize("name", VIDEOS)
def test_every_frame_is_the_one_that_import_counted(tmp_path, pan, write_video, name):
    write_video(tmp_path / name, pan(50, speed=4), crf="20", preset="veryfast", pix_fmt="yuv420p", **VIDEOS[name])
    right, sought = every_frame(tmp_path / name, lambda numbers: at_random(numbers) + as_frozen(numbers)[::5])
    assert right and sought == (name != "bare.h264")  # this file has no times, so frames are counted


def test_a_varying_rate_and_a_range_whose_start_was_not_kept(tmp_path, pan, write_video):
    at = np.cumsum(np.random.default_rng(0).integers(20, 90, 60)).tolist()
    write_video(tmp_path / "a.mp4", pan(60), milliseconds=at, g="10")
    for known in (True, False):
        assert every_frame(tmp_path / "a.mp4", at_random, 20, known) == (True, True)


def test_what_a_seek_gets_wrong_is_counted_instead(tmp_path, pan, write_video):
    """Times are one frame off, as in a container that rewrites them; the pixel comparison detects this."""
    write_video(tmp_path / "a.mp4", pan(60), g="10")
    source = open_source(str(tmp_path / "a.mp4"))
    want = {f.number: f.pixels for f in source.frames(None, None)}
    known = Known({n: (n - 1) / 24 for n in want}, 1 / 24, lambda n, pixels: bool((pixels == want[n]).all()))
    reader = source.plates(known)
    assert all((reader.plate(n) == want[n]).all() for n in (50, 3, 41))


def test_rotated_and_anamorphic_plates_are_upright_and_square(tmp_path, pan, write_video, shot_of):
    write_video(tmp_path / "a.mp4", pan(8, height=64, width=96), rotation=90, aspect=Fraction(2, 1))
    shot = shot_of(tmp_path / "a.mp4", working_height=96)
    plates = Plates(shot)
    assert (plates.width, plates.height) == (64, 192)
    small = resize_float(plates.display(4).numpy(), 32, 96)
    assert np.abs(small - working_of(shot, 4)).mean() < 1 / 255


# ------------------------------------------------------------------------------------------------- what is missing


def test_footage_that_is_gone_is_said_and_the_working_frames_serve(tmp_path, pan, write_video, shot_of):
    write_video(tmp_path / "a.mp4", pan(8, height=96, width=128))
    shot = shot_of(tmp_path / "a.mp4", working_height=48)
    before = Plates(shot).key
    os.rename(tmp_path / "a.mp4", tmp_path / "b.mp4")
    plates = Plates(shot)
    assert (plates.width, plates.height) == (64, 48) and plates.key != before
    assert "a.mp4 cannot be read" in plates.note and plates.note.endswith(".")
    assert (plates.display(4).numpy() == working_of(shot, 4)).all()


def test_moved_footage_is_found_and_different_footage_refused(tmp_path, pan, write_video, shot_of):
    clip = tmp_path / "clips" / "a.mp4"
    clip.parent.mkdir()
    write_video(clip, pan(8, height=96, width=128))
    shot = shot_of(clip, working_height=48)
    old = tmp_path / "moved"
    old.mkdir()
    os.rename(tmp_path / "clips", old / "clips")
    os.rename(shot.root, old / shot.root.name)
    shot = Shot.open(old / shot.root.name)
    os.utime(old / "clips" / "a.mp4", (1, 1))  # a copy has another modification time
    assert (Plates(shot).width, Plates(shot).note) == (128, "")
    write_video(old / "clips" / "a.mp4", pan(8, height=96, width=128, seed=5))
    assert "has changed since the import" in Plates(shot).note


def test_an_import_whose_chroma_was_scaled_up_otherwise_is_known_again(tmp_path, write_video, shot_of):
    """An earlier version moved colour edges but not brightness, and used another key."""
    rng = np.random.default_rng(0)
    wide = gaussian_filter(rng.random((64, 140, 3)), (1.5, 1.5, 0))
    wide = (255 * (wide - wide.min()) / (wide.max() - wide.min())).astype(np.uint8)
    clip = tmp_path / "a.mp4"
    write_video(clip, [np.ascontiguousarray(wide[:, 3 * n : 3 * n + 96]) for n in range(9)])
    shot = shot_of(clip, working_height=32)
    largest = 0.0
    for file in sorted(shot.raw.iterdir()):
        picture = read_png(file).astype(np.float32)
        luma = (picture @ np.array([0.2126, 0.7152, 0.0722], np.float32))[..., None]
        chroma = picture - luma
        blended = np.clip(np.rint(luma + 0.5 * (chroma + np.roll(chroma, 1, axis=1))), 0, 255).astype(np.uint8)
        largest = max(largest, float(np.abs(blended - picture).max()))
        write_png(file, blended)
    assert largest > 12.0, "else nothing differs"
    write_json(shot.listing, {**read_json(shot.listing), "key": "of an earlier version"})
    assert Plates(shot).note == ""
    files = sorted(shot.raw.iterdir())
    for file, picture in zip(files, [read_png(f) for f in (*files[1:], files[0])], strict=True):
        write_png(file, picture)
    assert "has changed since the import" in Plates(shot).note, "the next frame is another one"


def test_a_file_that_breaks_meanwhile_is_named(tmp_path, shot_of):
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.random((48, 100, 3)), (2, 2, 0))
    pictures = [np.rint(255 * smooth[:, 2 * n : 2 * n + 64]).astype(np.uint8) for n in range(9)]
    plates = Plates(shot_of(write_sequence(tmp_path / "f", pictures), working_height=24))
    (tmp_path / "f" / "a.1005.png").write_bytes(b"no picture")
    with pytest.raises(JobError, match="Frame 1005 of the footage can no longer be read"):
        plates.display(1005)


def test_missing_lens_is_reported(tmp_path, pan, write_video, shot_of):
    write_video(tmp_path / "a.mp4", pan(8, height=96, width=128))
    shot = shot_of(tmp_path / "a.mp4", working_height=48)
    solved(shot, camera_model="OPENCV_FISHEYE", distortion=[0.1, 0.0, 0.0, 0.0])
    plates = Plates(shot)
    assert plates.width == 64 and "OPENCV_FISHEYE" in plates.note


def test_plate_cache_is_bounded_and_keeps_recent_plates(tmp_path, pan, write_video, shot_of):
    write_video(tmp_path / "a.mp4", pan(12, height=96, width=128))
    shot = shot_of(tmp_path / "a.mp4", working_height=48)
    plates = Plates(shot, keep=3)
    for frame in (1, 2, 3, 1, 4):
        plates.display(frame)
        assert plates.kept <= 3
    assert list(plates._cache) == [3, 1, 4]
    read = []
    plain, plates = Plates._read, Plates(shot)
    plates._read = lambda frame: read.append(frame) or plain(plates, frame)
    for frame in as_frozen(list(range(1, 13))):
        plates.display(frame)
    assert sorted(read) == list(range(1, 13))  # each frame is read once, in the order of a freeze
    plates.close()
    assert plates.kept == 0 and plates.display(5).shape == (96, 128, 3)
