"""The launcher, started in a folder that holds Python modules, imports none of them."""

import subprocess
import sys
from pathlib import Path

import pytest

from launcher import children, places


@pytest.fixture
def trap(hostile, tmp_path: Path) -> Path:
    return hostile(tmp_path / "clips", tmp_path / "home", tmp_path)


def test_the_backend_runs_without_it(trap: Path, tmp_path: Path, capfd):
    """It runs in the user's current folder, which relative paths refer to."""
    command = [sys.executable, "-P", "-m", "torch_backend", "freeze", "absent.mp4", "--output", "out"]
    assert children.run_child(command, cwd=places.WORKING_FOLDER) == 3
    assert f"{tmp_path / 'clips' / 'absent.mp4'} does not exist" in "".join(capfd.readouterr())
    assert not trap.exists(), trap.read_text()


def test_what_a_child_starts_in_turn_is_safe_too(trap: Path):
    grandchild = f"import subprocess; raise SystemExit(subprocess.call([{sys.executable!r}, '-m', 'json.tool', '-h']))"
    assert children.run_child([sys.executable, "-P", "-c", grandchild], cwd=places.WORKING_FOLDER) == 0
    assert not trap.exists(), trap.read_text()


@pytest.mark.parametrize("flags", [[], ["-P"]])
def test_the_launcher_itself_runs_without_it(trap: Path, tmp_path: Path, flags: list[str], monkeypatch):
    """Also under -P, which leaves the script's own folder off the path."""
    monkeypatch.setenv("SPLANNEQUIN_HOME", str(tmp_path / "nothing yet"))
    command = [sys.executable, *flags, places.ROOT / "splannequin.py", "doctor", "--output", str(tmp_path / "told")]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert "Traceback" not in ran.stderr and (tmp_path / "told" / "summary.json").is_file(), ran.stderr
    assert not trap.exists(), trap.read_text()
