"""Data that crosses the wall between add-on and backend: versions, types, camera paths."""

import dataclasses
import gc
import math
import os
import subprocess
import sys
import time

import pytest

from torch_backend import contract


def test_request_round_trip_keeps_types():
    params = contract.FreezeParams(t_star=12, t_star_per_frame={"3": 4.5})
    request = contract.JobRequest("freeze", "somewhere", dataclasses.asdict(params))
    back = contract.from_dict(contract.JobRequest, dataclasses.asdict(request))
    assert back.typed_params() == params


@pytest.mark.parametrize(
    ("params", "word"),
    [({"iterations": "many"}, "iterations"), ({"iterations": True}, "iterations"), ({"speed": 1}, "speed")],
)
def test_wrong_params_are_named(params, word):
    with pytest.raises(ValueError, match=word):
        contract.JobRequest("train", "x", params).typed_params()


def test_unknown_kind_is_named():
    with pytest.raises(ValueError, match="dance"):
        contract.JobRequest("dance", "x").typed_params()


def test_newer_version_is_refused_in_words():
    with pytest.raises(ValueError, match="update the add-on"):
        contract.check_version({"version": contract.CONTRACT_VERSION + 1}, "camera path")


def test_camera_path_round_trip(tmp_path):
    frame = contract.CameraFrame(7, [float(i) for i in range(16)], [500.0, 501.0, 160.0, 90.0], "localised")
    path = contract.CameraPath(320, 180, [frame])
    assert contract.CameraPath.from_json(path.to_json()) == path


@pytest.mark.parametrize("bad", [[0.0] * 15, [math.nan] * 16])
def test_camera_frame_refuses_bad_matrices(bad):
    with pytest.raises(ValueError, match="camera frame 3"):
        contract.CameraFrame(3, bad, [1.0, 1.0, 0.0, 0.0])


def test_json_error_names_the_file(tmp_path):
    path = tmp_path / "broken.json"
    path.write_text("{ not json", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.json"):
        contract.read_json(path)


def child_process() -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)", "a word"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()  # until then, the system may list the process without its command line
    return child


def test_an_interrupt_while_a_file_is_opened_closes_it_once(tmp_path):
    """Ctrl-C between the call of `open` and its return was reported as a disk error: "Bad file descriptor"."""
    path = tmp_path / "shot.json"
    path.write_text("{}")

    def press(frame, event: str, called) -> None:
        if event == "c_return" and called is open:
            sys.setprofile(None)
            raise KeyboardInterrupt

    before = os.listdir("/dev/fd") if os.path.isdir("/dev/fd") else []
    sys.setprofile(press)
    try:
        with pytest.raises(KeyboardInterrupt):
            contract.read_json(path)
    finally:
        sys.setprofile(None)
    gc.collect()
    assert before == (os.listdir("/dev/fd") if os.path.isdir("/dev/fd") else [])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_what_is_no_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(ValueError, match="is not a file: replace or remove it"):
            contract.open_regular(path)


def test_a_process_is_known_by_its_start_and_command():
    child = child_process()
    try:
        found = contract.process(child.pid)
        assert found is not None and found.started and found.command.endswith("sleep(60) a word")
        assert contract.process(child.pid) == found and contract.runs_still(child.pid, found.started)
        assert not contract.runs_still(child.pid, found.started + 1)
    finally:
        child.kill()
    while contract.process(child.pid) is not None:  # ended, but its exit code has not been read yet
        time.sleep(0.01)
    child.communicate()
    for pid in (child.pid, 0, -1, 10**30):
        assert contract.process(pid) is None and not contract.runs_still(pid, 0.0)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows moves no folder of which a program runs")
def test_process_is_identified_by_its_command(tmp_path):
    folder = tmp_path.resolve()
    (folder / "bin").mkdir()
    (folder / "link").symlink_to(folder / "bin")
    (folder / "bin" / "python").symlink_to(os.path.realpath(sys.executable))
    words = [folder / "bin" / "python", "-S", "-c", "print('begun', flush=True); input()"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline().strip() == b"begun", "no command line before that"
        assert contract.run_from(folder) == contract.run_from(folder / "link") == [child.pid]
        assert contract.run_from(folder / "bi") == [] and child.pid in contract.commands_of_ps()
        assert contract.commands_of_ps()[child.pid].startswith(str(folder / "bin" / "python"))
        child.kill()
    assert contract.run_from(folder) == []


READER = """
import os, subprocess, sys
from torch_backend.contract import detach_standard_input
taken = detach_standard_input()
child = subprocess.run([sys.executable, "-c", "import os; print(os.read(0, 3))"], stdout=subprocess.PIPE, text=True)
print(os.read(0, 3), child.stdout.strip(), os.read(taken, 3))
"""


def test_private_input_is_not_visible_to_other_processes():
    """On Windows, a child process or a loading library would block while a thread of ours reads the same input."""
    ran = subprocess.run([sys.executable, "-c", READER], input="abc", capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["b''", "b''", "b'abc'"]


@pytest.mark.skipif(sys.platform == "win32", reason="ps is POSIX")
def test_ps_tells_the_same_as_proc():
    """macOS uses `ps`; the `ps` of Linux prints the same format."""
    before = time.time()
    child = child_process()
    try:
        by_ps, by_proc = contract.process_of_ps(child.pid), contract.process(child.pid)
        assert by_ps is not None and by_proc is not None and by_ps.command == by_proc.command
        assert before - 5.0 < by_ps.started < time.time() + 5.0
    finally:
        child.kill()
        child.communicate()
