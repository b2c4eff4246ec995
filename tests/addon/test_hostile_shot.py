"""A shot with Python modules in its folders: no button runs them. Real backends run in the shot and outside."""

import os
import time

import pytest


@pytest.fixture
def trap(hostile, shot, tmp_path, monkeypatch):
    """Adds modules to every folder of the shot where a child could run; returns the file that they write when
    imported."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return hostile(shot, tmp_path / "temporary", shot / "jobs", shot / "frames", shot / "solve", shot / "runs" / "main")


def ended(job, jobs):
    until = time.monotonic() + 120
    while not job.ended and time.monotonic() < until:
        jobs.poll(job)
        time.sleep(0.05)
    return job.status


def test_scrubbing(addon, trap, shot, root):
    session = addon("freeze.live").open_session(shot, "nothing", addon("process.backend").python(), root)
    until = time.monotonic() + 120
    while session.open and time.monotonic() < until:
        time.sleep(0.05)
    assert "'nothing'" in session.failure[0], "it is our backend that answered"
    assert session.failure[1] == "Run the training step first." and session._process.wait(20) != 0
    assert not trap.exists(), trap.read_text()


def test_st_maps(addon, contract, trap, shot):
    question = addon("solve.stmaps").begin(shot)
    question.wait()
    with pytest.raises(contract.JobError):  # the shot has no lens distortion
        addon("solve.stmaps").answer(question)
    assert not trap.exists(), trap.read_text()


def test_exported_cameras(addon, contract, trap, shot):
    solves = addon("solve.exchange")
    words = contract.ExportWords(shot=str(shot), format="nerfstudio", output=str(shot / "out"))
    question = solves.begin_export(words)
    assert str(shot / "out") in solves.exported(question, shot / "out")
    assert (shot / "out" / "transforms.json").is_file()
    assert not trap.exists(), trap.read_text()


def test_a_job(addon, contract, trap, hostile, shot, root):
    jobs = addon("process.jobs")
    job = jobs.new_job(shot, "import", contract.ImportParams(str(shot / "no clip.mp4")))
    hostile(job.folder, shot)
    jobs.start(job, addon("process.backend").python(), root)
    status = ended(job, jobs)
    assert (status.state, status.exit_code) == ("failed", contract.ExitCode.FOOTAGE)
    assert not trap.exists(), trap.read_text()


def test_child_runs_in_the_folder_of_its_interpreter(addon, contract):
    """Windows loads libraries from the working folder, and locks that folder against moving."""
    python = addon("process.backend").python()
    child = contract.python_child(python, "torch_backend", "doctor")
    assert child["cwd"] == os.path.dirname(os.path.abspath(python))


def test_programs_next_to_the_blend_file_are_not_on_the_path(contract, tmp_path, monkeypatch):
    fake = tmp_path / "nvidia-smi"
    fake.write_text("#!/bin/sh\n")
    fake.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join([".", ""]))
    assert contract.program("nvidia-smi") is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert contract.program("nvidia-smi") == str(fake)
