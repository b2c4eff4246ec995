"""Pairs are matched by several processes, and the database does not depend on their number."""

import json
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from torch_backend.contract import REQUEST_FILE, child_environment

MATCH = """
import sys
from pathlib import Path
from torch_backend.sfm import pairs
from torch_backend.sfm.matching import extract, match
from torch_backend.sfm.request import Request

request, least, python = Request(Path(sys.argv[1])), int(sys.argv[2]), sys.argv[3]
pairs.LEAST_PAIRS, sys.executable = least, python
if not request.database.is_file():
    extract(request, request.solved, None)
match(request)
"""


def matched(folder: Path, least: int, python: str = sys.executable) -> list:
    """All matches in the database after `folder`'s request was processed, with at least `least` pairs per process."""
    command = [sys.executable, "-P", "-c", MATCH, str(folder / REQUEST_FILE), str(least), python]
    root = Path(__file__).resolve().parents[3]
    subprocess.run(command, env=child_environment(root), check=True, stdout=subprocess.DEVNULL)
    assert not [path for path in folder.iterdir() if path.is_dir()], "what helpers wrote is gone"
    with sqlite3.connect(folder / "database.db") as database:
        tables = "select * from matches", "select * from two_view_geometries", "select * from images"
        return [sorted(database.execute(rows)) for rows in tables]


@pytest.fixture(scope="module")
def one_process(solved, tmp_path_factory):
    """(folder with a request, database contents of one process)."""
    folder = tmp_path_factory.mktemp("alone")
    names = sorted(path.name for path in solved.shot.raw.glob("*.png"))[:8]
    request = {
        "images": str(solved.shot.raw), "solved": names, "others": [], "camera_model": "SIMPLE_RADIAL", "overlap": 15,
        "features": 500, "neighbours": 2, "threads": 3,
    }  # fmt: skip
    (folder / REQUEST_FILE).write_text(json.dumps(request))
    return folder, matched(folder, least=1000)


def unmatched(folder: Path, into: Path) -> Path:
    """Copy of a folder whose database has only features."""
    shutil.copytree(folder, into)
    with sqlite3.connect(into / "database.db") as database:
        database.execute("delete from matches")
        database.execute("delete from two_view_geometries")
    return into


def test_several_processes_leave_the_same_database(one_process, tmp_path):
    folder, expected = one_process
    assert len(expected[0]) == 7 + 6 + 4, "1, 2 and 4 frames apart"
    assert matched(unmatched(folder, tmp_path / "three"), least=5) == expected


def test_the_pairs_of_a_process_that_breaks_are_matched_all_the_same(one_process, tmp_path):
    folder, expected = one_process
    broken = shutil.which("false")
    if broken is None:
        pytest.skip("no program that always fails")
    assert matched(unmatched(folder, tmp_path / "broken"), 5, broken) == expected
