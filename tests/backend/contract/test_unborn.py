"""A failed import takes away the shot that it was to begin, and nothing that took anybody's work."""

import pytest

from torch_backend.contract import discard_unborn
from torch_backend.shot import Shot


@pytest.fixture
def shot(tmp_path):
    """As an import finds it that fails at once."""
    begun = Shot.create(tmp_path / "a.splannequin")
    begun.raw.mkdir(parents=True)
    return begun


def test_a_shot_that_was_only_begun_goes(shot):
    assert discard_unborn(shot.root)
    assert not shot.root.exists()


@pytest.mark.parametrize("file", ["frames/raw/000001.png", "notes.txt", "solve/solve.json", "runs/main/config.json"])
def test_a_shot_with_work_in_it_or_a_file_of_others_stays(shot, file):
    kept = shot.root / file
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text("{}")
    discard_unborn(shot.root)
    assert kept.is_file()


def test_a_folder_that_is_not_there_is_nothing_to_take(tmp_path):
    assert not discard_unborn(tmp_path / "none.splannequin")
