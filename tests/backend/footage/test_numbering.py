"""`--start`: the shot numbers its frames from another start, and the footage's frames are found by these numbers."""

import json

import numpy as np
import pytest

from tests.backend.footage.test_plates import solved
from tests.backend.pictures import write
from torch_backend.cameras import imported
from torch_backend.contract import MASK_ALPHA, JobError
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.masks import read_masks
from torch_backend.footage.pairing import Counted
from torch_backend.footage.plates import Plates
from torch_backend.shot import Shot

COUNT = 14


@pytest.fixture
def pictures(pan):
    return pan(COUNT, 96, 128)


@pytest.fixture
def footage(request, tmp_path, pictures, write_video):
    """A video, a sequence from 0, or one with numbers too large for Blender, each with its first frame number."""
    kind, first = request.param
    if kind == "video":
        write_video(tmp_path / "clip.mp4", pictures)
        return tmp_path / "clip.mp4", first
    (tmp_path / "clip").mkdir()
    for n, pixels in enumerate(pictures, first):
        write_png(tmp_path / "clip" / f"a.{n:04d}.png", pixels)
    return tmp_path / "clip" / f"a.{first:04d}.png", first


COUNTED = [("video", 1), ("files", 0)]


@pytest.mark.parametrize("footage", [*COUNTED, ("files", 20240101)], indirect=True)
@pytest.mark.parametrize("skipped", [0, 3])
def test_shot_is_numbered_from_its_start_frame(tmp_path, footage, pictures, recorder, skipped):
    """Plates have full height although working frames have a quarter: plates are read from the footage."""
    source, file_numbers = footage
    shot = Shot.create(tmp_path / "a.splannequin")
    config = FootageConfig(start=1001, first=file_numbers + skipped if skipped else None, working_height=24)
    import_footage(shot, str(source), config, recorder())
    numbers = [row["frame"] for row in load_frames(shot)["frames"]]
    assert numbers == list(range(1001, 1001 + COUNT - skipped))
    assert (shot.info().first, shot.info().last) == (numbers[0], numbers[-1])
    assert read_png(shot.raw / "001001.png").shape == (24, 32, 3)
    plates = Plates(solved(shot))
    assert plates.note == "" and plates.frames == numbers and (plates.width, plates.height) == (128, 96)
    for number in (numbers[-1], numbers[0], numbers[5]):
        expected = pictures[number - 1001 + skipped].astype(np.float32) / 255
        assert np.abs(plates.display(number).numpy() - expected).max() < 0.02


@pytest.mark.parametrize("footage", COUNTED, indirect=True)
def test_import_stays_finished_if_the_start_equals_the_footage_start(tmp_path, footage, recorder):
    source, file_numbers = footage
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(source), FootageConfig(), recorder())
    before = json.loads(shot.listing.read_text())
    assert "shift" not in before
    shot.solve.mkdir()
    for start in (None, file_numbers):
        import_footage(shot, str(source), FootageConfig(start=start), recorder())
        assert shot.solve.is_dir() and json.loads(shot.listing.read_text()) == before
    import_footage(shot, str(source), FootageConfig(start=file_numbers + 1), recorder())
    assert not shot.solve.exists()


def test_gaps_of_a_sequence_stay_gaps(tmp_path, pictures, recorder):
    folder = tmp_path / "clip"
    folder.mkdir()
    for n, pixels in enumerate(pictures, 1):
        write_png(folder / f"a.{n:04d}.png", pixels)
    (folder / "a.0001.png").unlink()
    (folder / "a.0006.png").unlink()
    shot, report = Shot.create(tmp_path / "a.splannequin"), recorder()
    import_footage(shot, str(folder), FootageConfig(start=100), report)
    expected = [100 + n - 2 for n in range(2, COUNT + 1) if n != 6]
    assert [row["frame"] for row in load_frames(shot)["frames"]] == expected
    # The first file of the sequence is lost after the import: the other frames keep their numbers.
    (folder / "a.0002.png").unlink()
    plates = Plates(solved(shot), size=(128, 96))
    assert np.abs(plates.display(110).numpy() - pictures[11].astype(np.float32) / 255).max() < 0.02


def test_cut_is_reported_in_footage_numbers(tmp_path, pan, write_video, recorder):
    write_video(tmp_path / "clip.mp4", pan(12, seed=1) + pan(16, seed=2))
    shot = Shot.create(tmp_path / "a.splannequin")
    with pytest.raises(JobError) as refused:
        import_footage(shot, str(tmp_path / "clip.mp4"), FootageConfig(start=1001), recorder())
    assert "frame 13" in refused.value.message and "--first 13 --last 28" in refused.value.hint
    import_footage(shot, str(tmp_path / "clip.mp4"), FootageConfig(start=1001, first=13, last=28), recorder())
    assert shot.info().first == 1001 and shot.info().last == 1016


def test_footage_alpha_belongs_to_the_same_frame(tmp_path, pictures, recorder):
    folder = tmp_path / "clip"
    folder.mkdir()
    for n, pixels in enumerate(pictures, 1):
        alpha = np.full((96, 128, 1), 255, np.uint8)
        alpha[: 4 * n] = 0
        write(folder / f"a.{n:04d}.png", np.concatenate([pixels, alpha], 2), oiio__UnassociatedAlpha=1)
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(folder), FootageConfig(start=1001), recorder())
    mask = read_masks(shot, {"ignore": MASK_ALPHA}, recorder())["ignore"]
    assert [int(mask.of(1000 + n).all(1).sum()) for n in (1, 7, 14)] == [4, 28, 56]


@pytest.mark.parametrize("counted_from", [1, 1001])
def test_masks_may_be_numbered_as_the_footage_or_as_the_shot(tmp_path, pictures, write_video, recorder, counted_from):
    """There are more masks than frames: masks exist for the whole clip, the shot is a part of it."""
    write_video(tmp_path / "clip.mp4", pictures)
    folder = tmp_path / "mask"
    folder.mkdir()
    for n in range(COUNT + 4):
        picture = np.zeros((96, 128, 3), np.uint8)
        picture[: 4 * (n + 1)] = 255
        write_png(folder / f"m.{n + counted_from:04d}.png", picture)
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(tmp_path / "clip.mp4"), FootageConfig(start=1001, first=3), recorder())
    mask = read_masks(shot, {"ignore": str(folder / f"m.{counted_from:04d}.png")}, recorder())["ignore"]
    rows = [int(mask.of(n).all(1).sum()) for n in (1001, 1012)]
    assert rows == ([12, 56] if counted_from == 1 else [4, 48])


@pytest.mark.parametrize(("counted_from", "shift"), [(1, 1000), (1001, 0)])
def test_cameras_may_be_numbered_as_the_footage_or_as_the_shot(tmp_path, counted_from, shift):
    """There are more cameras than frames."""
    lens = imported.Lens("PINHOLE", 128, 96, (100.0, 100.0, 64.0, 48.0))
    names = [f"f_{n:04d}.png" for n in range(counted_from, counted_from + 30)]
    cameras = [imported.ImportedCamera(name, np.eye(4)[:3], 0) for name in names]
    solve = imported.ImportedSolve(tmp_path, "COLMAP model", [lens], cameras)
    matched = imported.match(solve, Counted(list(range(1003, 1023)), shift=1000), (128, 96))
    assert not matched.missing
    assert matched.cameras[1003].name == f"f_{1003 - shift:04d}.png"
