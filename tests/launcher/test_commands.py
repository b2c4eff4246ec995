"""The launcher's commands as a newcomer runs them: `python splannequin.py ...` in a process of its own."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import splannequin
from torch_backend.cards import Card

LAUNCHER = Path(splannequin.__file__)


def launch(*arguments: str | Path, python: str = sys.executable, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [python, str(LAUNCHER), *map(str, arguments)], capture_output=True, text=True, env={**os.environ, **environ}
    )


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_doctor_before_set_up_says_so(tmp_path: Path):
    ran = launch("doctor", "--output", tmp_path, SPLANNEQUIN_HOME=str(tmp_path / "nothing here yet"))
    assert "not made yet: `python3 splannequin.py setup`" in ran.stdout
    found = summary(tmp_path)
    assert found["exit_code"] == ran.returncode
    assert found["findings"]["backend"]["state"] == "note"
    assert not (tmp_path / "nothing here yet").exists()


def test_a_clip_that_is_not_there_is_one_sentence_and_sets_nothing_up(tmp_path: Path):
    ran = launch(
        "freeze", tmp_path / "absent.mp4", "--output", tmp_path / "out", SPLANNEQUIN_HOME=str(tmp_path / "home")
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith("Error: There is no clip at") and ran.stderr.count("\n") == 1
    assert summary(tmp_path / "out")["exit_code"] == 2
    assert not (tmp_path / "home").exists()


def test_figures_of_an_earlier_run_do_not_pass_for_this_one(tmp_path: Path):
    (tmp_path / "summary.json").write_text('{"heldout_psnr_db": 99}')
    launch("freeze", tmp_path / "absent.mp4", "--output", tmp_path)
    assert "heldout_psnr_db" not in summary(tmp_path)


def test_a_benchmark_of_ones_own_scenes_needs_no_blender():
    assert splannequin._own_scenes(["--truth", "folder"]) and splannequin._own_scenes(["--shot=x", "--seeds", "2"])
    assert not splannequin._own_scenes(["--quick"]) and not splannequin._own_scenes(["--shot", "x", "--size=tiny"])


def test_benchs_help_is_the_benchmarks_own():
    if not splannequin.backend_environment().ready():
        pytest.skip("the backend's environment is not set up by the launcher")
    ran = launch("bench", "--help")
    assert ran.returncode == 0 and "--reference" in ran.stdout and "--jobs" in ran.stdout


def test_an_output_that_cannot_be_a_folder_is_one_sentence(tmp_path: Path):
    (tmp_path / "file").touch()
    ran = launch("doctor", "--output", tmp_path / "file" / "out")
    assert ran.returncode == 2
    assert "Choose another --output folder" in ran.stderr and "Traceback" not in ran.stderr


def test_unknown_options_of_the_launchers_own_commands_are_refused(tmp_path: Path):
    assert launch("doctor", "--bogus", "--output", tmp_path).returncode == 2


def test_the_file_parses_under_python_3_8():
    ast.parse(LAUNCHER.read_text(encoding="utf-8"), feature_version=(3, 8))


def test_an_old_python_says_which_one_is_needed(tmp_path: Path):
    old = splannequin.find_python(lambda version: (3, 8) <= version < (3, 11), ("python3.8", "python3.9", "python3.10"))
    if old is None:
        pytest.skip("this machine has no Python from 3.8 to 3.10")
    hidden = str(tmp_path)
    ran = launch("doctor", python=old, PATH=hidden, PYENV_ROOT=hidden)
    assert ran.returncode == 9
    assert ran.stderr.startswith("Error: Splannequin needs Python 3.11 or newer") and ran.stderr.count("\n") == 1

    found = launch("doctor", "--output", tmp_path, python=old, PATH=str(Path(sys.executable).parent), PYENV_ROOT=hidden)
    assert found.returncode in (0, 9)
    assert "python" in summary(tmp_path)["findings"]


def test_counts_come_from_pytests_own_report(tmp_path: Path):
    (tmp_path / "test_few.py").write_text(
        "import pytest\n"
        "def test_a(): pass\n"
        "def test_b(): assert False\n"
        "@pytest.mark.skip\n"
        "def test_c(): pass\n"
        "@pytest.fixture\n"
        "def broken(): raise OSError\n"
        "def test_d(broken): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "test_few.py")]
    leg = splannequin.Leg("few", command, tmp_path / "report.xml")
    leg.run(sys.executable)
    assert (leg.passed, leg.failed, leg.skipped) == (1, 2, 1)


def test_a_test_run_that_leaves_no_report_counts_as_failed(tmp_path: Path):
    leg = splannequin.Leg("none", [sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "report.xml")
    leg.run(sys.executable)
    assert (leg.passed, leg.failed) == (0, 1)


@pytest.mark.parametrize(
    ("driver", "compute", "state", "says"),
    [
        ("580.65.06", "9.0", "ok", "driver 580.65.06"),
        ("610.10", "7.5", "ok", "compute capability 7.5"),
        ("575.57.08", "8.9", "note", "R580"),
        ("580.65.06", "7.0", "note", "7.5 (Turing) or newer"),
        ("[N/A]", "8.9", "note", "not understood"),
    ],
)
def test_cards_are_held_against_what_warp_needs(driver: str, compute: str, state: str, says: str):
    finding = splannequin.gpu_finding(Card("Some card", driver, compute))
    assert finding.state == state
    assert says in finding.text
