"""A bake on a full disk (a small file system): an error message, exit code 8, and all earlier pictures stay."""

import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from tests.addon.data.pixels import set_format


@pytest.fixture
def small_disk(tmp_path: Path):
    """A file system of 8 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(disk)], capture_output=True)
    if sys.platform != "linux" or mounted.returncode:
        pytest.skip("mounting needs Linux and root")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def fill(disk: Path, left: int) -> None:
    """Fill a disk up to `left` bytes."""
    found = os.statvfs(disk)
    (disk / "filler").write_bytes(bytes(max(found.f_bavail * found.f_frsize - left, 0)))


@pytest.fixture
def artists_file(scene, tmp_path):
    """artists_file(format): saves a file whose pictures have about 100 kB each."""

    def make(kind: str) -> Path:
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 480, 360, 100
        scene.frame_start, scene.frame_end = 5, 7
        scene.render.image_settings.file_format = kind
        if kind == "OPEN_EXR":
            scene.render.image_settings.color_depth = "32"
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "artist.blend"))
        return tmp_path / "artist.blend"

    return make


@pytest.mark.parametrize(("kind", "part"), [("PNG", "all"), ("OPEN_EXR", "frames"), ("DPX", "frames")])
def test_a_full_disk_is_said_and_earlier_frames_stay(addon, shot, small_disk, artists_file, capfd, kind, part):
    bake = ["bake", "--shot", shot, "--output", small_disk, "--blend", artists_file(kind), "--part", part]
    bake = [str(word) for word in bake]
    main = addon("command_line.headless").main
    assert main(bake) == 0
    folder = small_disk / "composited"
    good = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert len(good) == 3
    fill(small_disk, min(map(len, good.values())) // 2)
    capfd.readouterr()
    assert main(bake) == 8
    said = capfd.readouterr().err.splitlines()[-1]  # Blender and its libraries may print lines before
    assert said.startswith(f"Error: No space left in {folder}: ")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == good
    next(folder.iterdir()).write_bytes(b"")
    (small_disk / "filler").unlink()
    assert main([*bake[:-1], "file"]) == 7, "a picture of nothing is none"


def test_full_disk_is_reported_and_keeps_the_previous_file(addon, shot, small_disk, artists_file, capfd):
    """Blender 5.2 reports a truncated compressed file as saved."""
    bpy.context.preferences.filepaths.use_file_compression = True
    bake = ["bake", "--shot", shot, "--output", small_disk, "--blend", artists_file("PNG")]
    bake = [str(word) for word in bake]
    main = addon("command_line.headless").main
    assert main(bake) == 0
    blend = small_disk / "shot.blend"
    good, size = blend.read_bytes(), sum(path.stat().st_size for path in (small_disk / "composited").iterdir())
    fill(small_disk, size + len(good) // 2)
    capfd.readouterr()
    assert main(bake) == 8
    assert "shot.blend could not be saved" in capfd.readouterr().err.splitlines()[-1]
    assert blend.read_bytes() == good and not list(small_disk.glob(".*"))
    (small_disk / "filler").unlink()
    assert main(bake) == 0
    assert (small_disk / "shot.blend1").read_bytes() == good


def test_the_buttons_render_says_a_full_disk_and_earlier_frames_stay(addon, scene, shot, small_disk):
    scene.splannequin.shot_path = str(shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 480, 360, 100
    scene.frame_start, scene.frame_end = 5, 7
    scene.render.filepath = str(small_disk / "mine_##")
    scene.render.use_file_extension = False
    scene.render.image_settings.file_format = "TIFF"
    assert bpy.ops.splannequin.render("EXEC_DEFAULT") == {"FINISHED"}
    good = {path.name: path.read_bytes() for path in small_disk.iterdir()}
    assert sorted(good) == ["mine_05", "mine_06", "mine_07"]
    fill(small_disk, 30_000)
    with pytest.raises(RuntimeError, match="No space left"):
        bpy.ops.splannequin.render("EXEC_DEFAULT")
    (small_disk / "filler").unlink()
    assert {path.name: path.read_bytes() for path in small_disk.iterdir()} == good
    assert scene.render.filepath == str(small_disk / "mine_##") and not scene.render.use_file_extension


def test_a_movie_that_does_not_fit_leaves_the_one_before(addon, scene, shot, small_disk, contract):
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    set_format(scene, "FFMPEG")
    scene.render.ffmpeg.format, scene.render.ffmpeg.codec = "MKV", "FFV1"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 480, 360, 100
    scene.frame_start, scene.frame_end = 5, 7
    render = addon("bake.rendering").render
    render(scene, small_disk, png=False)
    (movie,) = small_disk.iterdir()
    good = movie.read_bytes()
    fill(small_disk, 20_000)
    with pytest.raises(contract.JobError) as failure:
        render(scene, small_disk, png=False)
    assert failure.value.exit_code == 8
    assert movie.read_bytes() == good and {p.name for p in small_disk.iterdir()} == {"filler", movie.name}
