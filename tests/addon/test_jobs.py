"""Jobs in the add-on, on real backend processes: followed, cancelled, reopened, and noticed when their process dies."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def python(addon) -> str:
    """Path of the backend's Python. These tests need one: without a backend they fail instead of being skipped."""
    return addon("process.backend").python()


@pytest.fixture
def empty_shot(addon, tmp_path: Path) -> Path:
    folder = tmp_path / "ünï shot.splannequin"
    addon("shot.inventory").create(folder)
    return folder


@pytest.fixture
def start_import(addon, contract, empty_shot, python, root):
    """start_import(source, first, last): starts an import job and returns it."""
    started = []

    def start(source: Path, first: int | None = None, last: int | None = None):
        jobs = addon("process.jobs")
        job = jobs.new_job(empty_shot, "import", contract.ImportParams(str(source), first, last))
        jobs.start(job, python, root)
        started.append(job)
        return job

    yield start
    for job in started:
        if job.process is not None and job.process.poll() is None:
            job.process.kill()
        if job.process is not None:
            job.process.wait()


def test_a_job_is_followed_to_its_end_and_found_by_another_blender(addon, start_import, clip):
    jobs = addon("process.jobs")
    job = start_import(clip, 3, 10)
    if sys.platform != "win32":
        assert os.getpgid(job.process.pid) == job.process.pid != os.getpgid(0), "a process group of its own"
    seen = []
    while not seen and not job.ended:
        seen = jobs.poll(job, 0.5)
        time.sleep(0.02)
    found = jobs.latest(job.shot)["import"]
    assert found.folder == job.folder and found.process is None
    assert not found.ended and jobs.is_alive(found, found.status)
    result = jobs.wait(job, seen.append)
    assert job.state == "done" and result is not None and jobs.wait(found) == result
    assert [e.seq for e in seen] == list(range(len(seen))), "every event once, in order"
    assert seen[-1].type == "done" and {e.type for e in seen} >= {"progress", "done"}
    state = addon("shot.inventory").read(job.shot)
    assert (state.frames, state.frame_range) == (8, (3, 10))


def test_a_failure_keeps_its_sentence_and_exit_code(addon, contract, start_import, tmp_path):
    wrong = tmp_path / "note.mp4"
    wrong.write_text("this is no video")
    job = start_import(wrong)
    with pytest.raises(contract.JobError) as caught:
        addon("process.jobs").wait(job)
    assert caught.value.exit_code == contract.ExitCode.FOOTAGE
    assert "note.mp4" in caught.value.message and caught.value.message.count("\n") == 0
    assert job.state == "failed" and not (job.shot / "frames" / "frames.json").exists()


def test_cancel_ends_a_job(addon, contract, start_import, clip):
    jobs = addon("process.jobs")
    job = start_import(clip)
    jobs.cancel(job)
    with pytest.raises(contract.Cancelled):
        jobs.wait(job)
    assert job.status.exit_code == contract.ExitCode.CANCELLED


def wait_for_events(jobs, job) -> None:
    while jobs.poll(job, 0.5) == [] and not job.ended:
        time.sleep(0.02)


def test_a_killed_child_leaves_a_status_that_says_so(addon, contract, start_import, clip):
    if sys.platform == "win32":
        pytest.skip("SIGKILL is POSIX")
    jobs = addon("process.jobs")
    job = start_import(clip)
    wait_for_events(jobs, job)
    os.kill(job.process.pid, signal.SIGKILL)
    with pytest.raises(contract.JobError, match="stopped unexpectedly"):
        jobs.wait(job)
    status = json.loads((job.folder / "status.json").read_text())
    assert status["state"] == "failed" and "memory" in status["hint"]
    again = jobs.open_job(job.folder)
    jobs.poll(again)
    assert again.state == "failed", "another Blender reads the same"


def test_a_job_of_a_dead_machine_is_not_believed(addon, contract, empty_shot):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    ended = subprocess.Popen([sys.executable, "-c", "pass"])
    ended.wait()
    now = time.time()
    status = contract.Status("train", "running", ended.pid, now - 900, 12345.0, now - 600, stage="training")
    contract.write_json(job.folder / "status.json", dataclasses.asdict(status))
    (job.folder / "log.txt").write_text("first\nMemoryError: no room\n")
    found = jobs.latest(empty_shot)["train"]
    assert found.state == "failed"
    assert "during training" in found.status.message and "MemoryError: no room" in found.status.message
    assert str(job.folder / "log.txt") in found.status.hint


def test_events_half_written_are_read_later(addon, contract, empty_shot):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    event = contract.Event("metric", 0, time.time(), {"stage": "train", "values": {"psnr_db": 20.5}})
    line = json.dumps(dataclasses.asdict(event)) + "\n"
    events = job.folder / "events.jsonl"
    events.write_text(line[:30])
    assert jobs.poll(job) == []
    events.write_text(line)
    assert [e.type for e in jobs.poll(job)] == ["metric"]
    assert job.metrics == {"psnr_db": 20.5} and jobs.poll(job) == []


def test_poll_keeps_its_budget_and_loses_nothing(addon, contract, empty_shot):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    event = contract.Event("warning", 0, 0.0, {"message": "m", "hint": ""})
    lines = [json.dumps({**dataclasses.asdict(event), "seq": n}) for n in range(5000)]
    (job.folder / "events.jsonl").write_text("\n".join(lines) + "\n")
    first = jobs.poll(job, 0.0)
    assert len(first) == 1, "at least one event per turn, and no more than the budget allows"
    rest = []
    while len(first) + len(rest) < 5000:
        rest += jobs.poll(job, 0.01)
    assert [e.seq for e in first + rest] == list(range(5000)) and len(job.warnings) == 5000


def test_the_childs_environment_is_free_of_blenders_python(addon, monkeypatch, root):
    monkeypatch.setenv("PYTHONHOME", "/of/blender")
    monkeypatch.setenv("PYTHONPATH", "/of/blender")
    environ = addon("process.children").backend_environ(root)
    assert "PYTHONHOME" not in environ and environ["PYTHONPATH"] == str(root)


def test_answer_larger_than_a_pipe_is_read_while_written(addon, tmp_path):
    """An unread pipe holds 64 KB on Linux and 4 KB on Windows; the traceback of a library that fails to load is
    longer."""
    (tmp_path / "torch_backend").mkdir()
    words = "import sys; sys.stderr.write('x' * 300000); sys.stdout.write('y' * 300000)"
    (tmp_path / "torch_backend" / "__main__.py").write_text(f"{words}; sys.stdout.buffer.write(bytes([255]))")
    question = addon("process.children").ask(sys.executable, tmp_path, "doctor")
    until = time.monotonic() + 30.0
    while not question.ended and time.monotonic() < until:  # like the timer, which never blocks
        time.sleep(0.05)
    try:
        assert question.ended and question.answer("{}") == "y" * 300000 + "\N{REPLACEMENT CHARACTER}"
    finally:
        question.process.kill()


def test_a_python_that_does_not_start_is_an_environment_error(addon, contract, empty_shot, root):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "import", contract.ImportParams("x.mp4"))
    with pytest.raises(contract.JobError) as caught:
        jobs.start(job, str(root / "no" / "python"), root)
    assert caught.value.exit_code == contract.ExitCode.ENVIRONMENT and "no/python" in caught.value.message.replace(
        "\\", "/"
    )


def test_new_job_refuses_the_parameters_of_another_kind(addon, contract, empty_shot):
    with pytest.raises(ValueError, match="a train job takes TrainParams, not SolveParams"):
        addon("process.jobs").new_job(empty_shot, "train", contract.SolveParams())


def test_second_cancel_does_not_delay_the_kill(addon, contract, empty_shot):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    jobs.cancel(job)
    os.utime(job.folder / "cancel", (time.time() - 5, time.time() - 5))
    since = (job.folder / "cancel").stat().st_mtime
    jobs.cancel(job)
    assert (job.folder / "cancel").stat().st_mtime == since


def test_a_job_with_broken_files_is_passed_over(addon, contract, empty_shot):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    (job.folder / "status.json").write_text("{ half")
    assert jobs.latest(empty_shot) == {}


@pytest.fixture
def sleeper():
    """sleeper(*words): starts a process that waits for a minute, with these words in its command line."""
    started = []

    def start(*words: str) -> subprocess.Popen:
        command = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)", *words]
        started.append(subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE))
        started[-1].stdout.readline()  # until then, the system may list the process without its command line
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def believed_running(jobs, contract, shot, pid: int, started: float, host: str):
    """Train job whose status names the process `pid`, and that was cancelled a minute ago."""
    job = jobs.new_job(shot, "train", contract.TrainParams())
    now = time.time()
    job.status = contract.Status("train", "running", pid, now - 900, started, now - 600, host=host)
    contract.write_json(job.folder / "status.json", dataclasses.asdict(job.status))
    jobs.cancel(job)
    os.utime(job.folder / "cancel", (now - 60, now - 60))
    return job


@pytest.mark.parametrize(
    "words", [(), ("-m", "torch_backend", "run-job", sys.prefix), ("-m", "torch_backend", "run-job")]
)
def test_cancel_ends_no_process_on_a_files_word(addon, contract, empty_shot, sleeper, words):
    jobs, innocent = addon("process.jobs"), sleeper(*words)
    for host in ("", contract.computer_name()):
        job = believed_running(jobs, contract, empty_shot, innocent.pid, contract.process_start(innocent.pid), host)
        with pytest.raises(contract.JobError, match="could not be identified"):
            jobs.cancel(job)
        assert innocent.poll() is None


def test_cancel_ends_no_process_that_has_another_start(addon, contract, empty_shot, sleeper):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    innocent = sleeper("-m", "torch_backend", "run-job", str(job.folder))
    started = contract.process_start(innocent.pid)
    assert started and contract.runs_job(innocent.pid, started, job.folder)
    assert not contract.runs_job(innocent.pid, started + 1, job.folder)
    assert not contract.runs_job(innocent.pid, 0.0, job.folder)
    assert not contract.runs_job(innocent.pid, started, empty_shot)
    for pid in (1, 0, -1, -innocent.pid, 10**30):
        assert not contract.runs_job(pid, contract.process_start(pid), job.folder)


def test_a_job_of_another_computer_is_neither_dead_nor_ended(addon, contract, empty_shot, sleeper):
    jobs, innocent = addon("process.jobs"), sleeper()
    job = believed_running(jobs, contract, empty_shot, innocent.pid, 1.0, "elsewhere (0a1b2c3d)")
    assert jobs.is_alive(job, job.status)
    with pytest.raises(contract.JobError, match="runs on elsewhere and can only be ended there"):
        jobs.cancel(job)
    before = (job.folder / "status.json").read_bytes()
    writer = contract.Writer("elsewhere (0a1b2c3d)", innocent.pid, 1.0, "train", job.folder.name, time.time())
    contract.write_json(empty_shot / "lock.json", dataclasses.asdict(writer))
    for beat in (None, (job.status.heartbeat, time.monotonic() - 600)):
        job.beat = beat
        jobs.poll(job)
        assert job.state == "running" and (job.folder / "status.json").read_bytes() == before
    (empty_shot / "lock.json").unlink()  # the artist is told to delete it by hand if that computer is gone
    job.beat = (job.status.heartbeat, time.monotonic() - 600)
    jobs.poll(job)
    assert job.state == "failed" and (job.folder / "status.json").read_bytes() == before, "what it wrote stays its own"


def test_a_step_is_refused_while_another_process_writes_into_the_shot(
    addon, contract, empty_shot, scene, clip, sleeper
):
    jobs, worker = addon("process.jobs"), sleeper()
    scene.splannequin.clip, scene.splannequin.shot_path = str(clip), str(empty_shot)
    started = contract.process_start(worker.pid)
    writer = contract.Writer(
        contract.computer_name(), worker.pid, started, "train", "from a terminal", time.time() - 90000
    )
    contract.write_json(empty_shot / "lock.json", dataclasses.asdict(writer))
    with pytest.raises(contract.JobError) as refused:
        addon("process.begin").begin(scene, "import")
    assert refused.value.exit_code == contract.ExitCode.USAGE and refused.value.hint == "Wait for it or cancel it."
    since = time.strftime("%Y-%m-%d %H:%M", time.localtime(writer.since))
    where = contract.computer_name().partition(" (")[0]
    assert refused.value.message == f"The training of {empty_shot.name} has been running on {where} since {since}."
    german = addon("translations").translate(refused.value.message, "de_DE")
    assert german == f"Das Training von {empty_shot.name} läuft seit {since} auf {where}."
    assert not (empty_shot / "jobs").exists(), "nothing was written"
    contract.write_json(empty_shot / "lock.json", dataclasses.asdict(dataclasses.replace(writer, host="elsewhere")))
    with pytest.raises(contract.JobError, match="on elsewhere since") as refused:
        addon("process.begin").begin(scene, "import")
    assert str(empty_shot / "lock.json") in refused.value.hint
    ending = jobs.new_job(empty_shot, "train", contract.TrainParams())
    contract.write_json(
        empty_shot / "lock.json", dataclasses.asdict(dataclasses.replace(writer, job=ending.folder.name))
    )
    ended = contract.Status("train", "done", worker.pid, 0.0, started, 0.0, exit_code=0, host=contract.computer_name())
    contract.write_json(ending.folder / "status.json", dataclasses.asdict(ended))
    jobs.refuse_second_writer(empty_shot)  # the process that reported its end will release the lock soon
    (empty_shot / "lock.json").unlink()
    running = dataclasses.replace(ended, state="running", started=writer.since, exit_code=None)
    contract.write_json(ending.folder / "status.json", dataclasses.asdict(running))
    with pytest.raises(contract.JobError) as refused:
        jobs.refuse_second_writer(empty_shot)  # a local job that does not hold the lock yet is named, too
    assert refused.value.message == f"The training of {empty_shot.name} has been running on {where} since {since}."
    worker.kill()
    worker.wait()
    contract.write_json(empty_shot / "lock.json", dataclasses.asdict(writer))
    job = addon("process.begin").begin(scene, "import", contract.ImportParams(str(clip), 1, 8))
    job.process.kill()
    job.process.wait()


def test_a_job_that_is_stopped_is_alive_and_can_be_ended_by_another_blender(addon, contract, start_import, clip):
    if sys.platform == "win32":
        pytest.skip("SIGSTOP is POSIX")
    jobs = addon("process.jobs")
    job = start_import(clip)
    wait_for_events(jobs, job)
    os.kill(job.process.pid, signal.SIGSTOP)
    status = json.loads((job.folder / "status.json").read_text())
    contract.write_json(job.folder / "status.json", {**status, "heartbeat": time.time() - 600})
    found = jobs.latest(job.shot)["import"]
    assert found.process is None and not found.ended, "it has only slept"
    jobs.cancel(found)
    os.utime(job.folder / "cancel", (time.time() - 60, time.time() - 60))
    jobs.cancel(found)
    assert job.process.wait(timeout=20) == -signal.SIGKILL
    jobs.poll(found)
    assert found.state == "failed"


@pytest.mark.skipif(os.name == "nt", reason="a link needs a privilege there")
@pytest.mark.parametrize("what", ["the folder", "one job"])
def test_jobs_behind_a_link_are_not_looked_at(addon, contract, empty_shot, tmp_path, what):
    """The add-on writes an end status into a dead job's folder. Behind a link, this could be another shot's folder."""
    jobs = addon("process.jobs")
    folder = jobs.new_job(empty_shot, "train", contract.TrainParams()).folder
    os.utime(folder / "request.json", (1, 1))
    place = folder.parent if what == "the folder" else folder
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    before = sorted(tmp_path.rglob("*.json"))
    assert jobs.latest(empty_shot) == {} and sorted(tmp_path.rglob("*.json")) == before
    if what == "the folder":
        with pytest.raises(contract.JobError, match="is a link to"):
            jobs.new_job(empty_shot, "train", contract.TrainParams())


def test_cancel_follows_no_link(addon, contract, empty_shot, tmp_path):
    jobs = addon("process.jobs")
    job = jobs.new_job(empty_shot, "train", contract.TrainParams())
    (job.folder / "cancel").symlink_to(tmp_path / "elsewhere")
    jobs.cancel(job)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("is_moved", [True, False])
def test_a_job_whose_shot_goes_ends_in_a_sentence_and_makes_nothing(
    addon, contract, empty_shot, start_import, clip, is_moved
):
    if sys.platform == "win32":
        pytest.skip("Windows keeps a folder that a process works in where it is")
    jobs, moved = addon("process.jobs"), empty_shot.with_name("away.splannequin")
    job = start_import(clip)
    wait_for_events(jobs, job)
    empty_shot.rename(moved)
    if not is_moved:
        job.process.kill()
    with pytest.raises(contract.JobError, match="^The import stopped: the shot folder .* was moved") as caught:
        jobs.wait(job)
    assert caught.value.exit_code == contract.ExitCode.USAGE and "new location" in caught.value.hint
    assert not empty_shot.exists()
    with pytest.raises(FileNotFoundError):
        jobs.new_job(empty_shot, "import", contract.ImportParams())
    found = jobs.latest(moved)["import"]
    assert found.state == "failed" and ("was moved or deleted" in found.status.message) == is_moved
