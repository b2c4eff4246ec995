"""A host of a render farm: messages to the engine when it enters a job's environment, and the start of a task."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from launcher import farm

ROOT = Path(__file__).resolve().parents[2]


def printed_variables(capsys) -> dict[str, str]:
    lines = [line.removeprefix("openjd_env: ") for line in capsys.readouterr().out.splitlines()]
    return dict(line.split("=", 1) for line in lines)


def test_farm_host_with_python_and_blender_needs_no_set_up(tmp_path, capsys, monkeypatch):
    # the host sets it in this process; monkeypatch restores it for later tests
    monkeypatch.setenv("SPLANNEQUIN_HOME", "")
    blender = tmp_path / "my blender"
    blender.touch()
    home = tmp_path / "home"
    words = ["--python", sys.executable, "--home", str(home), "--blender", str(blender), "--bake"]
    assert farm.host(words) == 0
    said = printed_variables(capsys)
    assert said["SPLANNEQUIN_BACKEND_PYTHON"] == sys.executable and said["SPLANNEQUIN_HOME"] == str(home)
    assert json.loads(said["SPLANNEQUIN_BLENDER_COMMAND"])[:2] == [str(blender), "--background"]
    assert not home.exists()


def test_empty_parameters_of_a_template_are_none(capsys):
    assert farm.host(["--python", sys.executable, "--home", ""]) == 0
    assert set(printed_variables(capsys)) == {"SPLANNEQUIN_BACKEND_PYTHON"}


@pytest.mark.parametrize(("flag", "name"), [("--python", "BackendPython"), ("--blender", "Blender")])
def test_what_a_host_lacks_is_named_by_the_jobs_parameter(tmp_path, capsys, flag, name):
    words = [] if flag == "--python" else ["--python", sys.executable]
    assert farm.host([*words, flag, str(tmp_path / "absent")]) != 0
    said = capsys.readouterr().out
    assert said.startswith("openjd_fail: There is no ") and f"the job's parameter {name}." in said


def test_a_task_without_a_backend_tells_the_engine(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(farm.PYTHON_VARIABLE, str(tmp_path / "absent"))
    assert farm.task("farm-task", ["open"]) == 9
    assert capsys.readouterr().out.startswith("openjd_fail: There is no backend at ")


@pytest.mark.skipif(os.name == "nt", reason="a process of its own there, tied to ours")
def test_the_engines_signals_reach_the_task_itself(tmp_path):
    """The engine kills the task directly: no launcher process is in between that could leave it behind."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$$ $@"\nexec sleep 30\n')
    python.chmod(0o755)
    started = subprocess.Popen(
        [sys.executable, str(ROOT / "splannequin.py"), "farm-task", "open", "--shot", "a b"],
        stdout=subprocess.PIPE, text=True, env={**os.environ, farm.PYTHON_VARIABLE: str(python)},
    )  # fmt: skip
    try:
        assert started.stdout is not None
        pid, _, words = started.stdout.readline().strip().partition(" ")
        assert int(pid) == started.pid and words == "-P -m torch_backend farm-task open --shot a b"
        started.send_signal(signal.SIGKILL)
        assert started.wait(20) == -signal.SIGKILL
        until = time.monotonic() + 20
        while time.monotonic() < until and Path(f"/proc/{pid}").exists():
            time.sleep(0.01)
    finally:
        started.kill()
        started.stdout.close()
