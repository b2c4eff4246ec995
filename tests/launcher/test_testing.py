"""The legs of `test`: their counts, their output when they run in parallel, and Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from launcher.testing import Leg, progress, run_legs

ROOT = Path(__file__).resolve().parents[2]


def test_counts_come_from_the_pytest_report(tmp_path: Path):
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
    leg = Leg("few", command, tmp_path / "report.xml")
    leg.run(sys.executable)
    assert (leg.passed, leg.failed, leg.skipped) == (1, 2, 1)


def test_a_test_run_that_leaves_no_report_counts_as_failed(tmp_path: Path):
    leg = Leg("none", [sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "report.xml")
    leg.run(sys.executable)
    assert (leg.passed, leg.failed) == (0, 1)


MEETING = """
import pathlib, sys, time
mine, other = map(pathlib.Path, sys.argv[1:])
print("begins", mine.name, flush=True)
mine.touch()
for _ in range(600):
    if other.exists():
        break
    time.sleep(0.05)
print("ends", mine.name, other.exists(), flush=True)
"""


def test_two_legs_run_concurrently_with_separate_output(tmp_path: Path, capfd):
    pair = [tmp_path / "one", tmp_path / "two"]
    legs = [Leg(a.name, [sys.executable, "-c", MEETING, str(a), str(b)]) for a, b in (pair, pair[::-1])]
    single_leg = Leg(
        "Three", [sys.executable, "-c", "import os; raise SystemExit(os.environ['OMP_NUM_THREADS'] == '')"]
    )
    run_legs([*legs, single_leg], sys.executable, tmp_path, parallel=2)
    out = capfd.readouterr().out
    for name in ("one", "two"):
        assert f"begins {name}\nends {name} True\n\n=== {name}: 1 passed, 0 failed" in out
        assert (tmp_path / f"{name}.log").read_text() == f"begins {name}\nends {name} True\n"
    assert [leg.passed for leg in (*legs, single_leg)] == [1, 1, 1]


def test_one_leg_at_a_time_prints_as_it_goes(tmp_path: Path, capfd):
    legs = [Leg(name, [sys.executable, "-c", f"print({name!r})"]) for name in ("first", "second")]
    run_legs(legs, sys.executable, tmp_path, parallel=1)
    out = capfd.readouterr().out
    assert out.index("\nfirst\n") < out.index("=== first: 1 passed") < out.index("=== second\n")
    assert not list(tmp_path.glob("*.log"))


def test_how_far_a_leg_is_comes_from_what_pytest_prints(tmp_path: Path):
    log = tmp_path / "backend.log"
    log.write_text("collected 3 items\n")
    assert progress(log) == "running"
    log.write_text("tests/a.py ..  [  3%]\ntests/b.py .  [ 34%]\ntests/c.py .")
    assert progress(log) == "34%"


INTERRUPTED = """
import pathlib, sys
from launcher.testing import Leg, run_legs
folder = pathlib.Path(sys.argv[2])
legs = [Leg(name, [sys.executable, "-c", sys.argv[1], str(folder / name)]) for name in ("one", "two", "three")]
try:
    run_legs(legs, sys.executable, folder, parallel=2)
except KeyboardInterrupt:
    sys.exit(130)
"""
WAITING = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
folder.mkdir()
try:
    (folder / "started").touch()
    time.sleep(600)
except KeyboardInterrupt:
    (folder / "interrupted").touch()
"""


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_ctrl_c_stops_every_leg_and_starts_none(tmp_path: Path):
    command = [sys.executable, "-P", "-c", INTERRUPTED, WAITING, str(tmp_path)]
    parent = subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    names = ("one", "two")
    for _ in range(600):
        if all((tmp_path / name / "started").exists() for name in names):
            break
        time.sleep(0.05)
    time.sleep(0.2)  # while they sleep
    parent.send_signal(signal.SIGINT)
    out, err = parent.communicate(timeout=60)
    assert parent.returncode == 130, err.decode()
    assert b"Cancelling" in out and not err
    assert all((tmp_path / name / "interrupted").exists() for name in names)
    assert not (tmp_path / "three").exists()
