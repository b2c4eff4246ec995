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
import shutil, sys
from pathlib import Path
from torch_backend.sfm import pairs
from torch_backend.sfm.matching import extract, match
from torch_backend.sfm.request import Request

one, several, broken = (Path(folder) / "request.json" for folder in sys.argv[1:4])
extract(Request(one), Request(one).solved, None)
for file in (several, broken):
    shutil.copytree(one.parent, file.parent)
for file, least, python in ((one, 1000, sys.executable), (several, 5, sys.executable), (broken, 5, sys.argv[4])):
    pairs.LEAST_PAIRS, sys.executable = least, python
    match(Request(file))
"""


@pytest.fixture(scope="module")
def databases(solved, tmp_path_factory):
    """Contents of the databases of one process, of several, and of several that break."""
    root = tmp_path_factory.mktemp("pairs")
    folders = [root / name for name in ("one", "several", "broken")]
    names = sorted(path.name for path in solved.shot.raw.glob("*.png"))[:8]
    request = {
        "images": str(solved.shot.raw), "solved": names, "others": [], "camera_model": "SIMPLE_RADIAL", "overlap": 15,
        "features": 300, "neighbours": 2, "threads": 3,
    }  # fmt: skip
    folders[0].mkdir()
    (folders[0] / REQUEST_FILE).write_text(json.dumps(request))
    command = [sys.executable, "-P", "-c", MATCH, *map(str, folders), shutil.which("false") or "false"]
    subprocess.run(
        command, env=child_environment(Path(__file__).resolve().parents[3]), check=True, stdout=subprocess.DEVNULL
    )
    assert not [path for folder in folders for path in folder.iterdir() if path.is_dir()], "what helpers wrote is gone"
    return [contents(folder / "database.db") for folder in folders]


def contents(file: Path) -> list:
    with sqlite3.connect(file) as database:
        tables = "select * from matches", "select * from two_view_geometries", "select * from images"
        return [sorted(database.execute(rows)) for rows in tables]


def test_several_processes_leave_the_same_database(databases):
    one, several, _ = databases
    assert len(one[0]) == 7 + 6 + 4, "1, 2 and 4 frames apart"
    assert several == one


@pytest.mark.skipif(shutil.which("false") is None, reason="no program that always fails")
def test_the_pairs_of_a_process_that_breaks_are_matched_all_the_same(databases):
    assert databases[2] == databases[0]
