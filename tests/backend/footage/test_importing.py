"""The whole import: the folder it writes, refusals, and the state after an interruption."""

import dataclasses
import json
import os
import shutil
import signal

import numpy as np
import pytest

from torch_backend.contract import Cancelled, ExitCode, JobError, TrainParams
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.analysis import looks_like_log, measure
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.importing import import_key
from torch_backend.footage.opening import open_source
from torch_backend.footage.sources import SourceInfo
from torch_backend.job import new_job, run_job
from torch_backend.shot import Shot, content_key


@pytest.fixture
def shot(tmp_path):
    return Shot.create(tmp_path / "a.splannequin")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory, pan, write_video, recorder):
    """(folder with a clip and a shot of its ten frames, result of the import)."""
    folder = tmp_path_factory.mktemp("prepared")
    write_video(folder / "clip.mp4", pan(10), rate=10)
    shot = Shot.create(folder / "a.splannequin")
    return folder, import_footage(shot, str(folder / "clip.mp4"), FootageConfig(), recorder())


@pytest.fixture
def clip(tmp_path, prepared):
    return str(shutil.copy2(prepared[0] / "clip.mp4", tmp_path / "clip.mp4"))


@pytest.fixture
def imported(tmp_path, prepared, clip):
    """Copy of the prepared shot next to a copy of the clip."""
    shot = Shot(shutil.copytree(prepared[0] / "a.splannequin", tmp_path / "a.splannequin"))
    shot.update(source=clip)
    return shot


def files(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_every_frame_is_imported_and_step_affects_only_the_solve(shot, tmp_path, pan, write_video, recorder):
    clip = str(tmp_path / "clip.mp4")
    write_video(clip, pan(18), rate=10)
    result = import_footage(shot, clip, FootageConfig(first=2, last=17, step=2, working_height=24), recorder())
    record = load_frames(shot)
    assert [f["frame"] for f in record["frames"]] == list(range(2, 18))
    assert [f["frame"] for f in record["frames"] if f["solve"]] == [2, 4, 6, 8, 10, 12, 14, 16, 17]
    assert np.allclose([f["seconds"] for f in record["frames"]], np.arange(16) / 10)
    assert all((shot.frames / f["file"]).is_file() for f in record["frames"])
    assert read_png(shot.frames / "raw/000002.png").shape == (24, 32, 3), "reduced to the working height"
    assert (result["frames"], result["solved_frames"], result["step"]) == (16, 9, 2)
    info = shot.info()
    assert (info.first, info.last, info.step, info.fps, info.width, info.height) == (2, 17, 2, 10.0, 32, 24)
    assert (info.source, info.colour) == (clip, "srgb")


def test_settings_without_effect_are_reported(shot, clip, recorder):
    report = recorder()
    assert import_footage(shot, clip, FootageConfig(working_height=96, fps=50.0, layer="rgba"), report)["fps"] == 10.0
    assert load_frames(shot)["height"] == 48
    assert sorted(report.warnings) == [
        "The clip is 48 pixels high: the working frames stay that high.",
        "The layer 'rgba' is ignored: a video has only one.",
        "The rate 50.0 is ignored: a video has its own, 10 frames per second.",
    ]
    assert report.steps[-1] == ("import", 10, 10)


def test_a_second_import_of_the_same_does_nothing(imported, prepared, clip, recorder):
    before = {p: p.stat().st_mtime_ns for p in imported.frames.rglob("*.png")}
    again = import_footage(imported, clip, FootageConfig(), recorder())
    assert {**again, "source": ""} == {**prepared[1], "source": ""}
    assert {p: p.stat().st_mtime_ns for p in imported.frames.rglob("*.png")} == before


def test_new_import_replaces_frames_and_their_solve(imported, clip, recorder):
    imported.solve.mkdir()
    (imported.solve / "solve.json").write_text("{}")
    shutil.copy(imported.frames / "raw/000001.png", imported.frames / "000001.png")
    import_footage(imported, clip, FootageConfig(first=2, last=9), recorder())
    expected = ["frames.json", *(f"raw/{n:06d}.png" for n in range(2, 10))]
    assert files(imported.frames) == sorted(expected)
    assert not imported.solve.exists()


def test_files_of_the_artist_in_the_frames_folder_outlive_an_import(shot, clip, recorder):
    import_footage(shot, clip, FootageConfig(last=8), recorder())
    theirs = {"notes.png": b"a", "000009.png": b"b", "raw/000010.png": b"c", "ours/000002.png": b"d"}
    for name, content in theirs.items():
        (shot.frames / name).parent.mkdir(exist_ok=True)
        (shot.frames / name).write_bytes(content)
    import_footage(shot, clip, FootageConfig(last=8, working_height=24), recorder())
    expected = ["frames.json", *(f"raw/{n:06d}.png" for n in range(1, 9))]
    assert files(shot.frames) == sorted([*expected, *theirs])
    import_footage(shot, clip, FootageConfig(), recorder())
    kept = {"notes.png": b"a", "000009.kept.png": b"b", "raw/000010.kept.png": b"c", "ours/000002.png": b"d"}
    expected = ["frames.json", *(f"raw/{n:06d}.png" for n in range(1, 11))]
    assert files(shot.frames) == sorted([*expected, *kept])
    assert all((shot.frames / name).read_bytes() == content for name, content in kept.items())


@pytest.mark.parametrize("linked", ["frames", "frames/raw", "solve"])
def test_nothing_is_removed_through_a_link(imported, clip, tmp_path, recorder, linked):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "000001.png").write_bytes(b"mine")
    shutil.rmtree(imported.root / linked, ignore_errors=True)
    (imported.root / linked).symlink_to(theirs, target_is_directory=True)
    with pytest.raises(JobError, match="is a link to .*theirs") as error:
        import_footage(imported, clip, FootageConfig(first=2), recorder())
    assert (error.value.exit_code, bool(error.value.hint)) == (ExitCode.USAGE, True)
    assert files(theirs) == ["000001.png"]


def test_killed_import_keeps_the_previous_import(imported, clip, recorder):
    """The import dies when the old frames are moved away and the new ones are not yet in place."""
    before = files(imported.frames)
    imported.frames.rename(imported.root / ".frames.old")
    report = recorder()
    import_footage(imported, clip, FootageConfig(), report)
    assert report.steps == [("import", 1, 1)]
    assert files(imported.frames) == before


def test_a_lost_frame_is_imported_again(imported, clip, recorder):
    (imported.frames / "raw/000007.png").unlink()
    import_footage(imported, clip, FootageConfig(), recorder())
    assert (imported.frames / "raw/000007.png").is_file()


def test_cancelled_import_keeps_the_previous_import(imported, clip, recorder):
    before = files(imported.root)
    with pytest.raises(Cancelled):
        import_footage(imported, clip, FootageConfig(first=2), recorder(cancel_after=5))
    assert files(imported.root) == before
    assert load_frames(imported)["frames"][0]["frame"] == 1


def test_repeated_and_blank_frames_are_kept_but_not_solved(shot, tmp_path, pan, write_video, recorder):
    frames = pan(11)
    frames[3] = frames[2]
    frames[7] = np.zeros_like(frames[0])
    write_video(tmp_path / "b.mp4", frames)
    report = recorder()
    import_footage(shot, str(tmp_path / "b.mp4"), FootageConfig(step=1), report)
    record = {f["frame"]: f for f in load_frames(shot)["frames"]}
    assert len(record) == 11
    assert (record[4]["flags"], record[8]["flags"]) == (["duplicate"], ["blank"])
    assert [n for n, f in record.items() if not f["solve"]] == [4, 8]
    assert report.warnings == [
        "Not used for the solve and the training because they are repeats: frame 4.",
        "Not used for the solve and the training because they are blank: frame 8.",
    ]


def test_changing_exposure_is_said(shot, tmp_path, pan, write_video, recorder):
    frames = [np.rint(f * (1.0 if i < 5 else 0.55)).astype(np.uint8) for i, f in enumerate(pan(10))]
    write_video(tmp_path / "b.mp4", frames)
    report = recorder()
    import_footage(shot, str(tmp_path / "b.mp4"), FootageConfig(), report)
    assert any(w.startswith("The exposure changes by 1.") for w in report.warnings)


def refused(shot, recorder, source, config=None):
    before = files(shot.root)
    with pytest.raises(JobError) as error:
        import_footage(shot, str(source), config or FootageConfig(), recorder())
    assert files(shot.root) == before
    return error.value


def test_a_hard_cut_is_refused_with_the_ranges_to_choose(shot, tmp_path, pan, write_video, recorder):
    write_video(tmp_path / "b.mp4", pan(9, seed=1) + pan(8, seed=2))
    error = refused(shot, recorder, tmp_path / "b.mp4")
    assert error.message == "The clip has a hard cut at frame 10: a freeze needs one continuous take."
    assert "1 to 9, 10 to 17" in error.hint and "--first 1 --last 9" in error.hint
    assert error.exit_code == ExitCode.FOOTAGE
    import_footage(shot, str(tmp_path / "b.mp4"), FootageConfig(first=10), recorder())


def test_three_frames_are_refused(shot, tmp_path, pan, write_video, recorder):
    write_video(tmp_path / "b.mp4", pan(3))
    error = refused(shot, recorder, tmp_path / "b.mp4")
    assert error.message == "The clip has only 3 frames: a freeze needs at least 8."
    assert error.exit_code == ExitCode.FOOTAGE


def test_a_still_is_refused(shot, tmp_path, pan, write_video, recorder):
    write_video(tmp_path / "b.mp4", pan(1) * 9)
    assert refused(shot, recorder, tmp_path / "b.mp4").message == (
        "The picture does not change in 8 of 9 frames: the camera stands still."
    )


def test_a_range_outside_of_the_clip_is_refused(shot, clip, recorder):
    error = refused(shot, recorder, clip, FootageConfig(first=30, last=60))
    assert error.message == "Frames 30 to 60 lie outside the clip, which has 1 to 10."


def test_a_range_of_too_few_frames_is_refused(shot, clip, recorder):
    assert "too few" in refused(shot, recorder, clip, FootageConfig(first=4, last=9)).message
    assert "only 3 frames" in refused(shot, recorder, clip, FootageConfig(first=8)).message


def test_a_step_that_leaves_too_few_is_refused(shot, clip, recorder):
    error = refused(shot, recorder, clip, FootageConfig(step=10))
    assert error.message == "A step of 10 leaves 2 frames to solve, at least 8 are needed."


@pytest.fixture
def sequence(tmp_path, pan):
    """sequence(first): nine numbered PNG files of a pan, starting at this number, alone in their folder."""

    def make(first):
        folder = tmp_path / f"from_{first}"
        folder.mkdir()
        for i, pixels in enumerate(pan(9)):
            write_png(folder / f"shot.{first + i:04d}.png", pixels)
        return folder

    return make


def test_numbers_beyond_blenders_last_frame_are_refused(shot, sequence, recorder):
    error = refused(shot, recorder, sequence(86_400_000))
    assert error.message == "The frames are numbered 86400000 to 86400008: Blender's frames end at 1048574."
    assert (error.exit_code, bool(error.hint)) == (ExitCode.FOOTAGE, True)
    last = sequence(1_048_567)
    assert "1048567 to 1048575" in refused(shot, recorder, last).message
    import_footage(shot, str(last), FootageConfig(last=1_048_574, step=1), recorder())
    assert shot.info().last == 1_048_574


def test_a_shot_of_before_whose_frames_count_backwards_is_to_be_imported_again(shot, sequence, recorder):
    import_footage(shot, str(sequence(1)), FootageConfig(step=1), recorder())
    record = json.loads(shot.listing.read_text())
    for row in record["frames"]:
        row["frame"] -= 20
    shot.listing.write_text(json.dumps(record))
    with pytest.raises(JobError, match="numbered -19 to -11: Blender's go from 0 to 1048574"):
        load_frames(shot)


def test_sequence_has_the_requested_rate(shot, sequence, recorder):
    folder = str(sequence(1))
    assert import_footage(shot, folder, FootageConfig(step=1), recorder())["fps"] == 24.0
    report = recorder()
    assert import_footage(shot, folder, FootageConfig(step=1, fps=12.5), report)["fps"] == 12.5
    assert [f["seconds"] for f in load_frames(shot)["frames"]] == pytest.approx(np.arange(9) / 12.5)
    assert report.warnings == []


@pytest.mark.parametrize("fps", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_rate_that_is_none_is_refused(shot, clip, recorder, fps):
    with pytest.raises(ValueError, match="fps is"):
        import_footage(shot, clip, FootageConfig(fps=fps), recorder())


def test_an_import_says_how_it_read_the_footage_and_what_it_assumed(imported, prepared, clip, sequence, recorder):
    record, result = load_frames(imported), prepared[1]
    assert record["read_as"] == result["read_as"] == [
        "Read as 64 x 48, square pixels, 10 fps, 8 bits, video, Rec.709, matrix BT.601, video levels, no alpha.",
        "Assumed, because the footage does not state it: pixel aspect, colour space, matrix, levels.",
    ]  # fmt: skip
    reading = record["reading"]
    assert result["reading"] == reading
    assert (reading["colour"], reading["colour_told"]) == ("video, Rec.709", False)
    assert (reading["matrix"], reading["matrix_told"], reading["range"]) == ("ITU601", False, "video")
    chosen = FootageConfig(step=1, matrix="bt709", levels="full", pixel_aspect=2.0)
    assert import_footage(imported, clip, chosen, recorder())["read_as"] == [
        "Read as 128 x 48, pixels 2 times as wide, 10 fps, 8 bits, video, Rec.709, matrix BT.709, full levels, "
        "no alpha.",
        "Assumed, because the footage does not state it: colour space.",
    ]
    report = recorder()
    said = import_footage(imported, str(sequence(1)), chosen, report)["read_as"]
    assert said == [
        "Read as 128 x 48, pixels 2 times as wide, 24 fps, 8 bits, sRGB, Rec.709, no alpha.",
        "Frames 1 to 9 are read from shot.####.png.",
        "Assumed, because the footage does not state it: rate.",
    ]
    assert "The matrix 'bt709' is ignored: pictures already store RGB." in report.warnings
    reading = load_frames(imported)["reading"]
    assert (reading["colour"], reading["layers"], reading["alpha"], reading["fps_told"]) == (
        "sRGB, Rec.709", [""], False, False,
    )  # fmt: skip


def test_missing_disk_space_is_reported_before_the_work(shot, clip, recorder, monkeypatch):
    usage = shutil.disk_usage(shot.root)._replace(free=1 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    error = refused(shot, recorder, clip)
    assert error.exit_code == ExitCode.DISK
    assert error.message.startswith("No space left in")


def test_a_shot_without_frames_says_to_import(shot):
    with pytest.raises(JobError, match="has no frames yet"):
        load_frames(shot)


def test_frames_json_is_plain(imported):
    record = json.loads((imported.frames / "frames.json").read_text())
    assert record["version"] == 1
    assert set(record["frames"][0]) == {"frame", "seconds", "file", "solve", "sharpness", "exposure", "flags", "digest"}


def test_an_import_is_known_by_what_version_0_2_noted_of_it(shot, clip, recorder):
    info = open_source(clip).info
    settings = {"first": 2, "last": 9, "step": 1, "working_height": 96, "fps": 0.0}
    config = FootageConfig(source=clip, **settings)
    assert import_key(info, config) == content_key(1, info.key, settings)
    named = FootageConfig(source=clip, layer="left", **settings)
    assert import_key(info, named) == content_key(1, info.key, {**settings, "layer": "left"})
    import_footage(shot, clip, config, recorder())
    noted = json.loads(shot.listing.read_text())
    assert noted["config"].items() >= {**settings, "layer": ""}.items() and noted["key"] == import_key(info, config)


@pytest.mark.parametrize("kind", ["video", "sequence"])
def test_a_copy_of_the_footage_is_the_same_footage(imported, clip, sequence, tmp_path, recorder, kind):
    """A copy as made by `cp -r`, with another folder, name and times, keeps the solve."""
    copied = tmp_path / "copied"
    copied.mkdir()
    if kind == "video":
        copy = shutil.copyfile(clip, copied / "other.mp4")
    else:
        import_footage(imported, str(sequence(1)), FootageConfig(), recorder())
        for n in range(1, 10):
            shutil.copyfile(tmp_path / "from_1" / f"shot.{n:04d}.png", copied / f"q.{n:04d}.png")
        copy = copied / "q.0001.png"
    for file in copied.iterdir():
        os.utime(file, (1, 1))
    imported.solve.mkdir()
    import_footage(imported, str(copy), FootageConfig(), recorder())
    assert imported.solve.is_dir(), "it is not imported again"
    assert imported.info().source == str(copy), "it is looked for there from now on"
    if kind == "sequence":
        import_footage(imported, str(sequence(1001)), FootageConfig(), recorder())
        assert not imported.solve.exists(), "the same pictures with other numbers are other frames"


def test_an_import_that_an_earlier_version_knew_by_times_stays_while_they_are_the_same(imported, clip, recorder):
    record, source = json.loads(imported.listing.read_text()), os.stat(clip)
    settings = {n: record["config"][n] for n in ("first", "last", "step", "working_height", "fps")}
    old = content_key(1, ["clip.mp4", source.st_size, source.st_mtime_ns], settings)
    imported.listing.write_text(json.dumps({**record, "key": old}))
    import_footage(imported, clip, FootageConfig(), recorder())
    assert load_frames(imported)["key"] == old, "it is not imported again"
    os.utime(clip, (1, 1))
    import_footage(imported, clip, FootageConfig(), recorder())
    assert load_frames(imported)["key"] == record["key"] != old


def test_new_option_keeps_finished_imports_valid():
    """A new option changes the key of an import only if it differs from its default."""
    old = FootageConfig(first=1, step=2)
    info = SourceInfo(64, 48, 24.0, 1, 9, False, False, "srgb", ["clip"])

    @dataclasses.dataclass
    class Later(FootageConfig):
        flop: bool = False

    assert import_key(info, Later(first=1, step=2)) == import_key(info, old)
    assert import_key(info, Later(first=1, step=2, flop=True)) != import_key(info, old)


@pytest.mark.skipif(os.name == "nt", reason="Windows does not fork")
@pytest.mark.parametrize("station", ["the same import", "another job"])
def test_an_import_killed_between_its_frames_and_shot_json_is_ended_by_the_next_job(imported, clip, recorder, station):
    imported.solve.mkdir()
    imported.cameras.write_text("{}")
    child = os.fork()
    if not child:
        Shot.save = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[method-assign]
        import_footage(imported, clip, FootageConfig(first=3, replace=True), recorder())
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert load_frames(imported)["frames"][0]["frame"] == 3 and imported.info().first == 1
    if station == "the same import":
        import_footage(imported, clip, FootageConfig(first=3), recorder())
    else:
        run_job(new_job(imported, "train", TrainParams()))
    info = imported.info()
    assert (info.first, info.last, info.source, info.fps, info.width) == (3, 10, clip, 10.0, 64)
    assert not imported.cameras.exists(), "cameras of other frames"
    kept = Shot(imported.replaced / "001")
    assert kept.cameras.exists() and kept.info().last == 10 and load_frames(kept)["frames"][-1]["frame"] == 10
    assert files(imported.frames)[0] == "frames.json" and "unpublished.json" not in files(imported.frames)
    imported.solve.mkdir(exist_ok=True)
    imported.cameras.write_text("{}")
    import_footage(imported, clip, FootageConfig(first=3), recorder())
    assert imported.cameras.exists(), "once is enough"


@pytest.mark.parametrize(
    ("black", "white", "is_flat"), [(0.093, 0.6, True), (0.125, 0.85, True), (0.0, 0.6, False), (0.1, 1.0, False)]
)
def test_log_like_clip_is_reported(shot, tmp_path, pan, write_video, recorder, black, white, is_flat):
    grey = [np.repeat(f.mean(2, keepdims=True), 3, axis=2) for f in pan(8)]
    grey = [(f - f.min()) / np.ptp(f) for f in grey]
    frames = [np.rint(255 * (black + f * (white - black))).astype(np.uint8) for f in grey]
    assert bool(looks_like_log([measure(n, pixels) for n, pixels in enumerate(frames)])) == is_flat
    if (black, white) == (0.093, 0.6):
        write_video(tmp_path / "a.mp4", frames)
        report = recorder()
        import_footage(shot, str(tmp_path / "a.mp4"), FootageConfig(), report)
        assert any("as flat as log" in message for message in report.warnings)
