"""The shot folder that belongs to a clip."""

import pytest

from torch_backend.contract import (
    JobError,
    default_shot_folder,
    is_imported_from,
    readable_stem,
    write_json,
)
from torch_backend.contract.clip_shot import check_same_clip


def imported(folder, source, relative_path=None):
    write_json(folder / "shot.json", {"version": 1, "name": "a", "source": str(source)})
    write_json(folder / "frames" / "frames.json", {} if relative_path is None else {"beside": relative_path})


def test_clips_with_one_stem_get_separate_shots(tmp_path):
    clips = [tmp_path / name for name in ("a.mov", "a.mp4", "a.mp4.avi", "a.avi")]
    (tmp_path / "a.mp4.splannequin").mkdir()
    found = {}
    for clip in clips:
        clip.touch()
        found[clip] = default_shot_folder(clip)
        imported(found[clip], clip, f"../{clip.name}")
    assert len(set(found.values())) == len(clips) and found[clips[0]] == tmp_path / "a.splannequin"
    assert {clip: default_shot_folder(clip) for clip in reversed(clips)} == {c: found[c] for c in clips}
    imported(tmp_path / "a.mov.splannequin", tmp_path / "elsewhere.mov")
    imported(tmp_path / "a.splannequin", clips[1], "../a.mp4")
    assert default_shot_folder(clips[0]) not in [tmp_path / "a.splannequin", tmp_path / "a.mov.splannequin"]


def test_moved_shot_matches_its_clip_but_not_a_namesake(tmp_path):
    shot, clip = tmp_path / "here" / "a.splannequin", tmp_path / "here" / "a.mp4"
    imported(shot, tmp_path / "gone" / "a.mp4")
    clip.touch()
    assert is_imported_from(shot, clip)
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "a.mp4").touch()
    assert is_imported_from(shot, clip) is False
    imported(shot, tmp_path / "gone" / "a.mp4", "../a.mp4")
    assert is_imported_from(shot, clip)
    assert is_imported_from(tmp_path / "none.splannequin", clip) is None


def test_a_shot_of_another_clip_is_refused_in_words(tmp_path):
    imported(tmp_path / "shot.splannequin", tmp_path / "a.mp4")
    (tmp_path / "a.mp4").touch()
    check_same_clip(tmp_path / "shot.splannequin", tmp_path / "a.mp4")
    check_same_clip(tmp_path / "none.splannequin", tmp_path / "a.mp4")
    with pytest.raises(JobError, match="is the shot folder of another clip: .*a.mp4"):
        check_same_clip(tmp_path / "shot.splannequin", tmp_path / "b.mp4")


@pytest.mark.parametrize(
    ("name", "is_numbered", "stem"),
    [
        ("plate.v001.mp4", False, "plate.v001"),
        ("kitchen.0001.png", True, "kitchen"),
        ("kitchen_0001.png", True, "kitchen"),
        ("kitchen-v2-0001.exr", True, "kitchen-v2"),
        ("0001.png", True, "0001"),
        (".hidden", False, ".hidden"),
        ("take2.mov", False, "take2"),
    ],
)
def test_what_a_clip_is_called(name, is_numbered, stem):
    assert readable_stem(name, is_numbered) == stem
