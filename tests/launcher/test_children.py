"""Children of the launcher: exit codes passed on, Ctrl-C handed on once, nothing left running."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import splannequin

ROOT = Path(__file__).resolve().parents[2]


def test_exit_code_is_passed_on():
    assert splannequin.run_child([sys.executable, "-c", "raise SystemExit(4)"]) == 4


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
@pytest.mark.parametrize(("name", "code"), [("SIGKILL", 1), ("SIGTERM", 130)])
def test_a_killed_child_has_a_documented_exit_code(name: str, code: int):
    source = f"import os, signal; os.kill(os.getpid(), signal.{name})"
    assert splannequin.run_child([sys.executable, "-c", source]) == code


def test_a_child_sees_this_checkout_and_no_foreign_python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PYTHONHOME", str(tmp_path))
    environ = splannequin.child_environ(SPLANNEQUIN_BACKEND_PYTHON="x")
    assert environ["PYTHONPATH"] == str(ROOT)
    assert "PYTHONHOME" not in environ
    assert environ["SPLANNEQUIN_BACKEND_PYTHON"] == "x"


def test_a_program_that_cannot_be_started_is_a_sentence(tmp_path: Path):
    with pytest.raises(splannequin.LauncherError, match="Cannot start"):
        splannequin.run_child([str(tmp_path / "absent")])


def wait_for(path: Path) -> None:
    for _ in range(600):
        if path.exists():
            return
        time.sleep(0.05)
    raise AssertionError(f"{path} never appeared")


CHILD = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
try:
    (folder / "started").touch()
    time.sleep(60)
except KeyboardInterrupt:
    (folder / "checkpoint").write_text("whole")
    sys.exit(130)
"""

PARENT = """
import sys, splannequin
try:
    splannequin.run_child([sys.executable, "-c", sys.argv[1], sys.argv[2]])
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
@pytest.mark.parametrize("sent", [signal.SIGINT])
def test_ctrl_c_lets_the_child_finish_its_checkpoint(tmp_path: Path, sent: signal.Signals):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(tmp_path)], cwd=ROOT, stdout=subprocess.DEVNULL)
    wait_for(tmp_path / "started")
    time.sleep(0.2)  # into the child's sleep
    parent.send_signal(sent)
    assert parent.wait(60) == 130
    assert (tmp_path / "checkpoint").read_text() == "whole"


@pytest.mark.skipif(os.name == "nt", reason="reads POSIX process groups")
def test_a_child_that_ignores_ctrl_c_is_ended_with_its_own_children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(splannequin, "GRACE_SECONDS", 0.5)
    grandchild = "import time; time.sleep(60)"
    stubborn = (
        "import pathlib, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        f"p = subprocess.Popen([sys.executable, '-c', {grandchild!r}])\n"
        "pathlib.Path(sys.argv[1], 'grandchild.tmp').write_text(str(p.pid))\n"
        "pathlib.Path(sys.argv[1], 'grandchild.tmp').rename(pathlib.Path(sys.argv[1], 'grandchild'))\n"
        "time.sleep(60)"
    )
    child = splannequin.start_child([sys.executable, "-c", stubborn, str(tmp_path)], splannequin.child_environ())
    wait_for(tmp_path / "grandchild")
    splannequin.stop_child(child)
    assert child.returncode == -signal.SIGKILL
    pid = int((tmp_path / "grandchild").read_text())
    for _ in range(100):
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError("the grandchild lives on")


def test_blenders_own_lines_go_to_the_log_alone(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    lines = [
        "00:01.3  render | Saved: 'x.png'",
        "  baking  4%",
        "Info: Saved as x",
        "Fra:1 Mem:2M",
        "Error: no. Do so.",
    ]
    code = splannequin.run_blender([sys.executable, "-c", f"print({chr(10).join(lines)!r})"], tmp_path / "blender.log")
    out, err = capfd.readouterr()
    assert code == 0
    assert out.splitlines() == ["  baking  4%"]
    assert err.splitlines() == ["Error: no. Do so."]
    assert (tmp_path / "blender.log").read_text().splitlines() == lines


TIED = """
import os, pathlib, sys
folder = pathlib.Path(sys.argv[1])
(folder / "started").touch()
os.read(0, 1)
(folder / "checkpoint").write_text("whole")
"""


def test_a_tied_child_learns_that_the_launcher_was_killed(tmp_path: Path):
    tied = PARENT.replace("sys.argv[2]])", "sys.argv[2]], tied=True)")
    parent = subprocess.Popen([sys.executable, "-c", tied, TIED, str(tmp_path)], cwd=ROOT, stdin=subprocess.PIPE)
    wait_for(tmp_path / "started")
    assert not (tmp_path / "checkpoint").exists()
    parent.kill()
    parent.wait()
    wait_for(tmp_path / "checkpoint")
