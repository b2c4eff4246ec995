"""A failed import removes the shot that it began, and nothing that holds work."""

import pytest

from torch_backend.contract import JobError, discard_unborn
from torch_backend.shot import Shot


@pytest.fixture
def shot(tmp_path):
    """Shot folder as an import that fails at once leaves it."""
    begun = Shot.create(tmp_path / "a.splannequin")
    begun.raw.mkdir(parents=True)
    return begun


def test_a_shot_that_was_only_begun_goes(shot):
    assert discard_unborn(shot.root)
    assert not shot.root.exists()


@pytest.mark.parametrize("file", ["frames/raw/000001.png", "notes.txt", "solve/solve.json", "runs/main/config.json"])
def test_shot_with_work_or_foreign_files_is_kept(shot, file):
    kept = shot.root / file
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text("{}")
    discard_unborn(shot.root)
    assert kept.is_file()


def test_missing_folder_is_not_removed(tmp_path):
    assert not discard_unborn(tmp_path / "none.splannequin")


def test_a_folder_of_somebody_elses_is_not_filled(tmp_path):
    (tmp_path / "scene.blend").write_bytes(b"BLENDER")
    (tmp_path / "textures").mkdir()
    with pytest.raises(JobError, match=r"contains other files \(scene\.blend and 1 more\)"):
        Shot.create(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.blend", "textures"]


@pytest.mark.parametrize("left", [[], [".DS_Store"], ["jobs", "frames", ".frames.new"], ["masks", "solve"]])
def test_shot_is_created_only_in_an_empty_place(tmp_path, left):
    for name in left:
        (tmp_path / name).mkdir()
    assert Shot.create(tmp_path).info_path.is_file()
