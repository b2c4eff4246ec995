"""Frame files of a folder, found by number."""


def test_numbers_ascend_and_unrelated_files_are_skipped(addon, tmp_path):
    for name in ("000010.exr", "000002.exr", "-00003.exr", "000004.png", "take.json", "frame_7.exr"):
        (tmp_path / name).touch()
    numbered = addon("scene.numbered")
    assert numbered.frame_numbers(tmp_path) == [-3, 2, 10]
    assert numbered.frame_numbers(tmp_path, ".png") == [4]
    assert [numbered.frame_path(tmp_path, n).is_file() for n in (-3, 2, 5)] == [True, True, False]


def test_missing_folder_has_no_frames(addon, tmp_path):
    assert addon("scene.numbered").frame_numbers(tmp_path / "none") == []
