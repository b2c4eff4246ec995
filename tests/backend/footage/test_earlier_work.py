"""An import into a shot with earlier work asks for consent, and keeps that work as a separate shot."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest

from torch_backend import cli
from torch_backend.contract import ExitCode, ImportParams, JobError
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.job import new_job, run_job
from torch_backend.motion.mattes import load_motion
from torch_backend.replaced import next_name
from torch_backend.shot import Shot


@pytest.fixture(scope="module")
def prepared(tmp_path_factory, pan, write_video, recorder):
    """Folder with two clips of equal size and length, and a shot of the first with one file of each kind of work."""
    folder = tmp_path_factory.mktemp("prepared")
    for name, seed in (("a", 0), ("b", 1)):
        write_video(folder / f"{name}.mp4", pan(12, seed=seed), rate=10)
    shot = Shot.create(folder / "a.splannequin")
    import_footage(shot, str(folder / "a.mp4"), FootageConfig(), recorder())
    for path in work(shot):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    for path in (shot.painted_matte(3), shot.drawn_masks("people") / "000003.png"):
        cv2.imwrite(str(path), np.full((48, 64), 255, np.uint8))
    return folder


@pytest.fixture
def clips(tmp_path, prepared):
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    return str(tmp_path / "a.mp4"), str(tmp_path / "b.mp4")


@pytest.fixture
def worked_on(tmp_path, clips):
    """Copy of the prepared shot next to copies of the clips."""
    shot = Shot(tmp_path / "a.splannequin")
    shot.update(source=clips[0])
    return shot


def work(shot):
    return [
        shot.cameras, shot.solve_record, shot.run("main") / "checkpoint.safetensors", shot.take("freeze") / "take.json",
        shot.painted_matte(3), shot.drawn_masks("people") / "000003.png", shot.tracking, shot.camera_path("freeze"),
    ]  # fmt: skip


def contents(shot):
    return {str(p.relative_to(shot.root)): p.read_bytes() for p in shot.root.rglob("*") if p.is_file()}


@pytest.mark.parametrize("change", ["clip", "range", "height", "colour"])
def test_import_of_different_frames_into_a_shot_with_work_is_refused(worked_on, clips, recorder, change):
    before = contents(worked_on)
    settings = {"range": {"first": 3}, "height": {"working_height": 24}, "colour": {"levels": "full"}}.get(change, {})
    with pytest.raises(JobError) as refused:
        import_footage(worked_on, clips[change == "clip"], FootageConfig(**settings), recorder())
    assert refused.value.exit_code == ExitCode.USAGE and "--replace" in refused.value.hint
    assert contents(worked_on) == before


def test_each_kind_of_work_is_reason_enough_to_refuse(worked_on, clips, recorder):
    for number, path in enumerate(work(worked_on)):
        if number != 1:  # solve.json without cameras does not count as a solve
            away = {other: other.with_suffix(".away") for other in work(worked_on) if other != path}
            for other, place in away.items():
                other.rename(place)
            with pytest.raises(JobError, match="would replace its frames"):
                import_footage(worked_on, clips[0], FootageConfig(first=3), recorder())
            for other, place in away.items():
                place.rename(other)


def test_with_consent_the_work_is_kept_as_a_shot_and_nothing_of_it_is_used_for_the_new_clip(worked_on, clips, recorder):
    frames = contents(worked_on)
    import_footage(worked_on, clips[1], FootageConfig(replace=True), recorder())
    assert worked_on.info().source == clips[1] and not any(path.exists() for path in work(worked_on))
    assert load_motion(worked_on, 3) is None, "the paint of the other clip"
    kept = Shot.open(worked_on.replaced / "001")
    assert kept.info().source == clips[0] and all(path.is_file() for path in work(kept))
    assert {name: data for name, data in contents(kept).items() if name in frames} == frames
    worked_on.solve.mkdir()
    worked_on.cameras.write_text("{}")
    import_footage(worked_on, clips[0], FootageConfig(replace=True), recorder())
    assert Shot(worked_on.replaced / "001").info().source == clips[0]
    assert Shot(worked_on.replaced / "002").info().source == clips[1] and next_name(worked_on) == "003"


def test_paint_stays_with_frames_that_are_the_same_picture(worked_on, clips, recorder):
    import_footage(worked_on, clips[0], FootageConfig(first=2, replace=True), recorder())
    assert load_motion(worked_on, 3) is not None and (worked_on.drawn_masks("people") / "000003.png").is_file()
    assert not worked_on.cameras.exists() and not worked_on.tracking.exists()
    import_footage(worked_on, clips[0], FootageConfig(first=4, replace=True), recorder())
    assert not worked_on.painted_matte(3).exists(), "the frame is not there any more"
    assert (worked_on.replaced / "002" / "motion_paint" / "000003.png").is_file()


def test_the_same_pictures_by_another_way_replace_nothing(worked_on, clips, tmp_path, recorder):
    """A copied clip, or a range that covers all frames, counts as the same footage."""
    (tmp_path / "moved").mkdir()
    moved = shutil.copy(clips[0], tmp_path / "moved" / "a.mp4")
    os.utime(moved, (1, 1))
    before = {name: data for name, data in contents(worked_on).items() if name != "shot.json"}
    for clip, config in ((str(moved), FootageConfig()), (clips[0], FootageConfig(first=1, last=12, replace=True))):
        import_footage(worked_on, clip, config, recorder())
        assert {name: data for name, data in contents(worked_on).items() if name != "shot.json"} == before
        assert worked_on.info().source == clip


def test_a_listing_of_before_has_no_digests_and_is_compared_by_its_pictures(worked_on, clips, recorder):
    record = load_frames(worked_on)
    for row in record["frames"]:
        del row["digest"]
    worked_on.listing.write_text(json.dumps({k: v for k, v in record.items() if k != "footage"}))
    os.utime(clips[0], (1, 1))
    (worked_on.raw / "000007.png").unlink()
    import_footage(worked_on, clips[0], FootageConfig(), recorder())
    assert worked_on.cameras.exists() and (worked_on.raw / "000007.png").is_file()
    os.replace(clips[1], clips[0])
    with pytest.raises(JobError, match="would replace"):
        import_footage(worked_on, clips[0], FootageConfig(), recorder())


def test_a_failed_import_with_consent_leaves_all_as_it_was(worked_on, tmp_path, pan, write_video, recorder):
    before = contents(worked_on)
    write_video(tmp_path / "cut.mp4", pan(9, seed=3) + pan(9, seed=9))
    with pytest.raises(JobError):
        import_footage(worked_on, str(tmp_path / "cut.mp4"), FootageConfig(replace=True), recorder())
    assert contents(worked_on) == before


def test_a_job_and_the_command_line_refuse(worked_on, clips, capsys):
    code, _ = run_job(new_job(worked_on, "import", ImportParams(clips[1])))
    assert code == ExitCode.USAGE and worked_on.cameras.exists()
    command = ["import", str(worked_on.root), clips[1]]
    assert cli.main(command) == ExitCode.USAGE and worked_on.cameras.exists()
    assert "--replace" in capsys.readouterr().out
    assert cli.main([*command, "--replace"]) == 0 and (worked_on.replaced / "001" / "solve" / "cameras.json").is_file()
