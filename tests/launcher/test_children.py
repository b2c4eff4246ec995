"""Child processes of the launcher: exit codes passed on, Ctrl-C forwarded once, no process left running."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from launcher import blender, children, environments, errors

ROOT = Path(__file__).resolve().parents[2]


def test_exit_code_is_passed_on():
    assert children.run_child([sys.executable, "-c", "raise SystemExit(4)"]) == 4


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
@pytest.mark.parametrize(("name", "code"), [("SIGKILL", 1), ("SIGTERM", 130)])
def test_a_killed_child_has_a_documented_exit_code(name: str, code: int):
    source = f"import os, signal; os.kill(os.getpid(), signal.{name})"
    assert children.run_child([sys.executable, "-c", source]) == code


def test_a_child_sees_this_checkout_and_no_foreign_python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PYTHONHOME", str(tmp_path))
    environ = children.child_environ(SPLANNEQUIN_BACKEND_PYTHON="x")
    assert environ["PYTHONPATH"] == str(ROOT)
    assert "PYTHONHOME" not in environ
    assert environ["SPLANNEQUIN_BACKEND_PYTHON"] == "x"


def test_a_program_that_cannot_be_started_is_a_sentence(tmp_path: Path):
    with pytest.raises(errors.LauncherError, match="Cannot start"):
        children.run_child([str(tmp_path / "absent")])


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
import sys
from launcher import children
try:
    children.run_child([sys.executable, "-c", sys.argv[1], sys.argv[2]])
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_ctrl_c_lets_the_child_finish_its_checkpoint(tmp_path: Path):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(tmp_path)], cwd=ROOT, stdout=subprocess.DEVNULL)
    wait_for(tmp_path / "started")
    time.sleep(0.2)  # while the child sleeps
    parent.send_signal(signal.SIGINT)
    assert parent.wait(60) == 130
    assert (tmp_path / "checkpoint").read_text() == "whole"


@pytest.mark.skipif(os.name == "nt", reason="reads POSIX process groups")
def test_child_ignoring_ctrl_c_is_killed_with_its_children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(children, "GRACE_SECONDS", 0.5)
    grandchild = "import time; time.sleep(60)"
    stubborn = (
        "import pathlib, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        f"p = subprocess.Popen([sys.executable, '-c', {grandchild!r}])\n"
        "pathlib.Path(sys.argv[1], 'grandchild.tmp').write_text(str(p.pid))\n"
        "pathlib.Path(sys.argv[1], 'grandchild.tmp').rename(pathlib.Path(sys.argv[1], 'grandchild'))\n"
        "time.sleep(60)"
    )
    child = children.start_child([sys.executable, "-c", stubborn, str(tmp_path)], children.child_environ())
    wait_for(tmp_path / "grandchild")
    children.stop_child(child)
    assert child.returncode == -signal.SIGKILL
    assert gone(int((tmp_path / "grandchild").read_text()))


def test_blender_output_goes_only_to_the_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    lines = [
        "00:01.3  render | Saved: 'x.png'",
        "  baking  4%",
        "Info: Saved as x",
        "Fra:1 Mem:2M",
        "Error: no. Do so.",
    ]
    code = children.run_blender([sys.executable, "-c", f"print({chr(10).join(lines)!r})"], tmp_path / "blender.log")
    out, err = capfd.readouterr()
    assert code == 0
    assert out.splitlines() == ["  baking  4%"]
    assert err.splitlines() == ["Error: no. Do so."]
    assert (tmp_path / "blender.log").read_text().splitlines() == lines


SAVED = '    print("Saved\\n" * 30000, flush=True)\n    (folder / "checkpoint")'
BAKING = CHILD.replace('    (folder / "checkpoint")', SAVED)
BAKER = """
import pathlib, sys
from launcher import children
folder = pathlib.Path(sys.argv[2])
children.run_blender([sys.executable, "-c", sys.argv[1], str(folder)], folder / "blender.log")
"""


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_a_bake_that_has_much_to_say_on_ctrl_c_comes_to_its_end(tmp_path: Path, parent):
    """Nobody reads the output then, but a full pipe (4 KB on Windows) must not block the bake."""
    launcher = parent(BAKER, BAKING, tmp_path)
    wait_for(tmp_path / "started")
    launcher.send_signal(signal.SIGINT)
    wait_for(tmp_path / "checkpoint")


@pytest.fixture
def parent(tmp_path: Path):
    """parent(source, *words): starts a Python that can import the launcher; it is killed at the end of the test."""
    started = []

    def start(source: str, *words: str | Path, **environ: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-P", "-c", source, *map(str, words)]
        where = {**os.environ, "PYTHONPATH": str(ROOT), **environ}
        with open(tmp_path / "parent.log", "wb") as log:
            started.append(subprocess.Popen(command, env=where, stdout=log, stderr=log))
        return started[-1]

    yield start
    for child in started:
        child.kill()
        child.wait()


PATIENT = """
import pathlib, sys, time
from torch_backend.contract import end_with_starter
end_with_starter()
folder = pathlib.Path(sys.argv[1])
try:
    (folder / "started").touch()
    time.sleep(600)
except KeyboardInterrupt:
    (folder / "checkpoint").write_text("whole")
"""
STUBBORN = """
import pathlib, signal, subprocess, sys, time
from torch_backend.contract import end_with_starter
end_with_starter(1.0)
signal.signal(signal.SIGINT, signal.SIG_IGN)
child = subprocess.Popen([sys.executable, "-P", "-c", "import time; time.sleep(600)"])
pathlib.Path(sys.argv[1], "pid.tmp").write_text(f"{child.pid}")
pathlib.Path(sys.argv[1], "pid.tmp").rename(pathlib.Path(sys.argv[1], "started"))
time.sleep(600)
"""
TIED_SOURCE = """
import sys
from launcher import children
children.run_child([sys.executable, "-P", "-c", *sys.argv[1:]], tied=True)
"""
LAUNCHER = "import sys; from launcher.main import main; sys.exit(main())"


def gone(pid: int) -> bool:
    """Wait until a process has ended or is a zombie; False after 30 seconds."""
    for _ in range(600):
        try:
            os.kill(pid, 0)
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


def test_a_killed_launcher_leaves_time_for_a_checkpoint_and_nothing_at_work(tmp_path: Path, parent):
    launcher = parent(TIED_SOURCE, PATIENT, tmp_path)
    wait_for(tmp_path / "started")
    launcher.kill()
    wait_for(tmp_path / "checkpoint")


@pytest.mark.skipif(os.name == "nt", reason="reads POSIX process groups")
def test_what_does_not_end_with_a_killed_launcher_is_ended_with_its_children(tmp_path: Path, parent):
    launcher = parent(TIED_SOURCE, STUBBORN, tmp_path)
    wait_for(tmp_path / "started")
    launcher.kill()
    assert gone(int((tmp_path / "started").read_text()))


def test_a_killed_launcher_leaves_no_backend_at_work(tmp_path: Path, parent):
    """A whole freeze, killed during the import: it is cancelled as by Ctrl-C, which leaves no empty shot."""
    wheels = [environments.bpy_environment(series) for series, _ in blender.choose_wheels()[:1]]
    if not all(environment.ready() for environment in (environments.backend_environment(), *wheels)):
        pytest.skip("the environments are not set up by the launcher")
    clip = ROOT / "examples" / "sitting.mp4"
    launcher = parent(LAUNCHER, "freeze", clip, "--output", tmp_path / "out")
    folders = tmp_path / "out" / "shot.splannequin" / "jobs"
    for _ in range(600):
        running = [path for path in folders.glob("*/status.json") if json.loads(path.read_text())["fraction"] > 0]
        if running:
            break
        time.sleep(0.05)
    backend = json.loads(running[0].read_text())["pid"]
    launcher.kill()
    assert gone(backend)
    assert not folders.parent.exists()


SETTING_UP = """
import pathlib, sys
from launcher import environments
environments.REQUIREMENTS = pathlib.Path(sys.argv[1])
environments.set_up(environments.Environment("x", pathlib.Path(sys.argv[2]), ("small",), "", 0.01), sys.executable)
"""


def test_a_killed_launcher_leaves_no_pip_at_work(tmp_path: Path, requirements: Path, parent, environment):
    """pip waits for an index that does not answer; the index measures when pip hangs up."""
    (requirements / "small.lock").write_text(f"there-is-no-such-package==1.0 --hash=sha256:{'0' * 64}\n")
    with socket.create_server(("127.0.0.1", 0)) as index:
        index.settimeout(120)
        address = f"http://127.0.0.1:{index.getsockname()[1]}/simple"
        pip_settings = {"PIP_INDEX_URL": address, "PIP_TIMEOUT": "600", "PIP_NO_INDEX": "0", "NO_PROXY": "*"}
        launcher = parent(SETTING_UP, requirements, environment.folder, **pip_settings)
        pip, _ = index.accept()
        with pip:
            pip.settimeout(60)
            assert pip.recv(1 << 16)
            launcher.kill()
            assert pip.recv(1 << 16) == b"", "pip has hung up"
