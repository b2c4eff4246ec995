"""One writer per shot: real jobs in real processes, stopped, killed, and run at the same time."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from torch_backend import contract, job
from torch_backend.contract import ExitCode, JobError, Writer
from torch_backend.shot import Shot, atomic_path, make_folder, working_on, write_json
from torch_backend.writer import _remove_lock, only_writer, patient_writer

CLIP = Path(__file__).parents[2] / "examples" / "sitting.mp4"
OTHER_COMPUTER = "elsewhere (0a1b2c3d)"


@pytest.fixture
def shot(tmp_path):
    return Shot.create(tmp_path / "a.splannequin")


def lock_of(shot) -> Path:
    return shot.root / contract.WRITER_FILE


def new_import(shot, last: int = 8) -> Path:
    return job.new_job(shot, "import", contract.ImportParams(source=str(CLIP), first=1, last=last))


def begin_import(shot) -> tuple[subprocess.Popen[bytes], Path]:
    folder = new_import(shot, 24)
    command = [sys.executable, "-P", "-m", "torch_backend", "run-job", str(folder)]
    return subprocess.Popen(command, stderr=subprocess.PIPE), folder


def read(path: Path) -> str:
    return path.read_text() if path.exists() else ""


def status_of(folder: Path) -> contract.Status:
    return contract.from_dict(contract.Status, contract.read_json(folder / contract.STATUS_FILE))


def wait_for_lock(shot, child) -> Writer:
    while child.poll() is None:
        writer = contract.read_writer(shot.root)
        if writer is not None:
            return writer
        time.sleep(0.001)
    raise AssertionError("it never held the shot")


def dead_writer() -> Writer:
    ended = subprocess.Popen([sys.executable, "-c", "pass"])
    ended.wait()
    return Writer(contract.computer_name(), ended.pid, 12345.0, "train", "a job", time.time())


def put_lock(shot, writer: Writer) -> None:
    lock_of(shot).write_text(json.dumps(dataclasses.asdict(writer)))


def test_job_started_right_after_another_waits_for_the_lock(shot):
    """The status is written before the lock is released, so a reader may start the next step in between."""
    folder = job.new_job(shot, "import", contract.ImportParams())
    now, pid = time.time(), os.getpid()
    status = contract.Status("import", "running", pid, now, 0.0, now, host=contract.computer_name())
    put_lock(shot, Writer(contract.computer_name(), pid, contract.process_start(pid), "import", folder.name, now))
    write_json(folder / contract.STATUS_FILE, dataclasses.asdict(status))
    with pytest.raises(JobError, match="has been running"), only_writer(shot.root, "solve", "next"):
        pass
    write_json(folder / contract.STATUS_FILE, dataclasses.asdict(dataclasses.replace(status, state="done")))
    threading.Timer(0.3, lock_of(shot).unlink).start()
    with only_writer(shot.root, "solve", "next") as mine:
        assert mine.job == "next"


@pytest.mark.skipif(sys.platform == "win32", reason="SIGSTOP is POSIX")
def test_the_second_job_is_refused_in_words_and_the_first_goes_on(shot):
    first, one = begin_import(shot)
    try:
        writer = wait_for_lock(shot, first)
        os.kill(first.pid, signal.SIGSTOP)  # keeps it working during the checks
        assert (writer.pid, writer.kind, writer.job) == (first.pid, "import", one.name)
        second_job = new_import(shot)
        assert job.run_job(second_job)[0] == ExitCode.USAGE
        status = status_of(second_job)
        assert status.state == "failed" and status.host == contract.computer_name()
        where, since = contract.computer_name().partition(" (")[0], time.strftime("%H:", time.localtime(writer.since))
        assert status.message.startswith(f"The import of a.splannequin has been running on {where} since {since}")
        assert status.hint == "Wait for it or cancel it."
        assert contract.read_writer(shot.root) == writer
    finally:
        os.kill(first.pid, signal.SIGCONT)
        first.communicate()
    assert first.returncode == ExitCode.OK and not lock_of(shot).exists()
    assert len(list(shot.frames.glob("raw/*.png"))) == 24


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
def test_what_a_killed_job_holds_is_taken_over(shot):
    first, _ = begin_import(shot)
    wait_for_lock(shot, first)
    first.kill()
    first.communicate()
    assert lock_of(shot).exists()
    folder = new_import(shot)
    assert job.run_job(folder)[0] == ExitCode.OK, status_of(folder).message
    assert not lock_of(shot).exists() and len(list(shot.frames.glob("raw/*.png"))) == 8


@pytest.mark.parametrize("ends", ["well", "badly", "cancelled"])
def test_the_shot_is_free_again_however_a_job_ends(shot, monkeypatch, ends):
    seen = []

    def station(shot, params, report):
        seen.append(contract.read_writer(shot.root))
        if ends == "badly":
            raise ZeroDivisionError
        if ends == "cancelled":
            raise contract.Cancelled

    monkeypatch.setitem(job.RUNNERS, "import", station)
    folder = job.new_job(shot, "import", contract.ImportParams(source="x"))
    job.run_job(folder)
    assert seen[0].pid == os.getpid() and seen[0].job == folder.name and seen[0].works()
    assert [p.name for p in shot.root.iterdir() if "lock" in p.name] == []


def test_runs_of_one_benchmark_may_be_trained_at_once(shot, monkeypatch):
    monkeypatch.setitem(job.RUNNERS, "train", lambda *_: "trained")
    with only_writer(shot.root, "train", "another"):
        folder = job.new_job(shot, "train", contract.TrainParams(run="mine"))
        assert job.run_job(folder)[0] == ExitCode.USAGE
        assert job.run_job(folder, exclusive=False) == (ExitCode.OK, "trained")


def test_another_computers_lock_is_never_taken_over(shot):
    put_lock(shot, dataclasses.replace(dead_writer(), host=OTHER_COMPUTER, since=1.0))
    with pytest.raises(
        JobError, match="^The training of a.splannequin has been running on elsewhere since 19"
    ) as error:
        with only_writer(shot.root, "import", "mine"):
            raise AssertionError("it was")
    assert str(lock_of(shot)) in error.value.hint and error.value.exit_code == ExitCode.USAGE
    put_lock(shot, dead_writer())
    with only_writer(shot.root, "import", "mine") as writer:
        assert contract.read_writer(shot.root) == writer


@pytest.mark.parametrize("text", ["", "{}", "[" * 5000, '{"host": 1}'])
def test_unreadable_lock_is_kept_and_named(shot, text, monkeypatch):
    monkeypatch.setattr("torch_backend.writer._SECONDS", 0.1)
    lock_of(shot).write_text(text)
    with (
        pytest.raises(JobError, match="Cannot find out whether a step runs") as error,
        only_writer(shot.root, "import", "mine"),
    ):
        raise AssertionError("it was taken")
    assert str(lock_of(shot)) in error.value.hint and lock_of(shot).read_text() == text


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege there")
def test_a_lock_that_is_a_link_is_not_written_through(shot, tmp_path, monkeypatch):
    monkeypatch.setattr("torch_backend.writer._SECONDS", 0.1)
    text = json.dumps(dataclasses.asdict(dead_writer()))
    (tmp_path / "mine").write_text(text)
    lock_of(shot).symlink_to(tmp_path / "mine")
    with pytest.raises(JobError, match="cannot be replaced"), only_writer(shot.root, "import", "mine"):
        raise AssertionError("it was taken")
    assert (tmp_path / "mine").read_text() == text


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege there")
def test_dangling_lock_link_is_named(shot, tmp_path, monkeypatch):
    monkeypatch.setattr("torch_backend.writer._SECONDS", 0.1)
    lock_of(shot).symlink_to(tmp_path / "nowhere")
    with pytest.raises(JobError, match="cannot be created") as error, only_writer(shot.root, "import", "mine"):
        raise AssertionError("it was taken")
    assert str(lock_of(shot)) in error.value.message and not (tmp_path / "nowhere").exists()


def test_job_ends_when_its_shot_was_taken_over(shot, monkeypatch):
    """The job was suspended, or lost its disk, for longer than the heartbeat timeout."""
    monkeypatch.setattr(contract, "HEARTBEAT_SECONDS", 0.02)
    new_owner = dataclasses.replace(dead_writer(), host=OTHER_COMPUTER)

    def station(shot, params, report):
        report.check_cancelled()
        put_lock(shot, new_owner)
        for _ in range(500):
            time.sleep(0.01)
            report.check_cancelled()

    monkeypatch.setitem(job.RUNNERS, "import", station)
    folder = job.new_job(shot, "import", contract.ImportParams(source="x"))
    assert job.run_job(folder)[0] == ExitCode.USAGE
    assert status_of(folder).message.startswith(f"{OTHER_COMPUTER} took over the shot")
    assert contract.read_writer(shot.root) == new_owner


CROWD = """
import dataclasses, json, os, random, sys, time
from pathlib import Path
from torch_backend import contract
from torch_backend.writer import _remove_lock, only_writer, patient_writer

root, dead, mark, seed = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), int(sys.argv[4])
random.seed(seed)
sys.stdin.read()  # all begin at once, and none spins: two that do can keep the fourth from ever being started
held = 0
until = time.monotonic() + 60
while held < 20 and time.monotonic() < until:
    try:
        with only_writer(root, "train", f"{seed}"):
            os.close(os.open(mark, os.O_CREAT | os.O_EXCL))  # fails if two are inside
            time.sleep(random.random() * 0.002)
            os.unlink(mark)
            held += 1
            if random.random() < 0.7:  # it dies here: its lock stays, of a process that is gone
                beside = root / f"{seed}.json"
                beside.write_text(dead)
                os.replace(beside, root / contract.WRITER_FILE)
    except contract.JobError as error:
        assert "has been running" in error.message, error.message
print(held)
"""


def test_of_all_who_take_a_dead_ones_place_one_gets_it(shot, tmp_path):
    dead, mark = json.dumps(dataclasses.asdict(dead_writer())), tmp_path / "inside"
    lock_of(shot).write_text(dead)
    command = [sys.executable, "-c", CROWD, str(shot.root), dead, str(mark)]
    gate, opens = os.pipe()
    crowd = [
        subprocess.Popen([*command, str(n)], stdin=gate, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for n in range(4)
    ]
    os.close(gate)
    os.close(opens)
    outputs = [child.communicate() for child in crowd]
    assert [errors for _, errors in outputs] == [""] * 4 and [printed for printed, _ in outputs] == ["20\n"] * 4


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps a folder that a process works in where it is")
def test_a_shot_that_is_moved_ends_its_training_in_a_sentence(world, tmp_path):
    root, moved = tmp_path / "a.splannequin", tmp_path / "b.splannequin"
    shutil.copytree(world.shot.root, root)
    folder = job.new_job(Shot(root), "train", contract.TrainParams(iterations=100_000, max_gaussians=500, device="cpu"))
    command = [sys.executable, "-P", "-m", "torch_backend", "run-job", str(folder)]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while child.poll() is None and '"stage": "training"' not in read(folder / contract.EVENTS_FILE):
        time.sleep(0.01)
    os.rename(root, moved)
    _, errors = child.communicate()
    assert child.returncode == ExitCode.USAGE
    assert f"The training stopped: the shot folder {root} was moved or deleted in the meantime." in errors
    assert not root.exists(), [str(p) for p in root.rglob("*")]
    events = [json.loads(line) for line in (moved / "jobs" / folder.name / "events.jsonl").read_text().splitlines()]
    assert [e["type"] for e in events[-2:]] == ["error", "done"] and "was moved" in events[-2]["data"]["message"]
    assert not (moved / contract.WRITER_FILE).exists(), "the shot is free where it is now"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps a folder that a process works in where it is")
def test_an_import_into_a_shot_that_goes_leaves_nothing_in_its_place(shot, tmp_path, monkeypatch):
    class Goes(job.JobReporter):
        def progress(self, stage, done, total, message=""):
            if shot.root.exists():
                os.rename(shot.root, tmp_path / "b.splannequin")
            super().progress(stage, done, total, message)

    monkeypatch.setattr(job, "JobReporter", Goes)
    folder, heard = new_import(shot), []
    assert job.run_job(folder, heard.append) == (ExitCode.USAGE, None)
    assert heard[-2].data["message"].startswith("The import stopped: the shot folder") and not shot.root.exists()


def test_locked_shot_creates_folders_only_inside_it(tmp_path):
    root = tmp_path / "a"
    with working_on(root), pytest.raises(FileNotFoundError):
        make_folder(root / "runs" / "main")
    with working_on(root), pytest.raises(FileNotFoundError), atomic_path(root / "shot.json"):
        raise AssertionError("it may be written")
    assert not root.exists()
    root.mkdir()
    with working_on(root):
        make_folder(root / "runs" / "main")
        make_folder(tmp_path / "elsewhere" / "deep")
    make_folder(tmp_path / "b" / "runs")
    assert (root / "runs" / "main").is_dir() and (tmp_path / "b" / "runs").is_dir()


def foreign_job(shot) -> tuple[Writer, Path]:
    """A lock of another computer, and the folder of its job."""
    folder = job.new_job(shot, "train", contract.TrainParams())
    put_lock(shot, Writer(OTHER_COMPUTER, 77, 1.0, "train", folder.name, time.time()))
    return contract.read_writer(shot.root), folder


def beat(folder: Path, at: float) -> None:
    status = contract.Status("train", "running", 77, 1.0, 1.0, at, host=OTHER_COMPUTER)
    write_json(folder / contract.STATUS_FILE, dataclasses.asdict(status))


def test_patient_writer_takes_over_only_from_a_silent_remote_writer(shot):
    """The timeout only uses this computer's clock, because the other clock may be an hour off."""
    _, folder = foreign_job(shot)
    reasons: list[str] = []

    def waiting(why: str) -> None:
        reasons.append(why)
        if len(reasons) < 8:  # it is alive, with heartbeats by another clock
            beat(folder, 1e6 + len(reasons))

    with patient_writer(shot.root, "freeze", "mine", waiting, silence=0.4) as mine:
        assert len(reasons) >= 8 and "The training of a.splannequin has been running on elsewhere" in reasons[0]
        assert contract.read_writer(shot.root) == mine
    assert not lock_of(shot).exists() and not list(shot.root.glob(".lock*"))


def test_patient_writer_waits_for_a_silent_local_writer(shot):
    pid = os.getpid()
    put_lock(shot, Writer(contract.computer_name(), pid, contract.process_start(pid), "train", "silent", time.time()))
    reasons: list[str] = []

    def waiting(why: str) -> None:
        reasons.append(why)
        if len(reasons) == 6:
            lock_of(shot).unlink()

    with patient_writer(shot.root, "train", "mine", waiting, silence=0.05) as mine:
        assert len(reasons) >= 6 and mine.job == "mine"


def test_a_lock_that_changed_hands_is_not_taken_for_the_dead_ones(shot):
    dead, _ = foreign_job(shot)
    put_lock(shot, dataclasses.replace(dead, job="another"))
    _remove_lock(shot.root, dead)
    assert contract.read_writer(shot.root).job == "another"
    assert [p.name for p in shot.root.glob(".lock*")] == []


def test_a_patient_job_says_for_whom_it_waits_and_can_be_cancelled(shot):
    _, before = foreign_job(shot)
    folder = job.new_job(shot, "solve", contract.SolveParams())
    heard: list[contract.Event] = []

    def listen(event: contract.Event) -> None:
        heard.append(event)
        beat(before, time.time())
        (folder / contract.CANCEL_FILE).touch()

    assert job.run_job(folder, listen, patient=True) == (ExitCode.CANCELLED, None)
    assert heard[0].data["stage"] == "waiting" and "has been running on elsewhere" in heard[0].data["message"]
