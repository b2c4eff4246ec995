"""Setting up the backend from the preferences, with a real launcher that fails without a network, and removal."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import bpy
import pytest


def run_out(environment, setup, seconds=180.0):
    until = time.monotonic() + seconds
    while setup.running and time.monotonic() < until:
        environment.poll(setup)
        time.sleep(0.1)
    assert not setup.running


def test_a_set_up_without_packages_says_which_step_failed_and_retry_goes_on(
    addon, root, tmp_path, monkeypatch, hostile
):
    environment = addon("process.environment")
    # modules in folders where a child process could run; none may be imported
    trap = hostile(tmp_path, tmp_path / "bäckend")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    folder = tmp_path / "bäckend"
    setup = environment.start(folder, sys.executable, root)
    run_out(environment, setup)
    assert "failed at installing packages" in setup.failure, setup.output
    assert str(folder) in setup.failure
    created = (folder / ".venv" / "pyvenv.cfg").stat().st_mtime
    again = environment.start(folder, sys.executable, root)
    run_out(environment, again)
    assert "failed at installing packages" in again.failure
    assert not trap.exists(), trap.read_text()
    assert (folder / ".venv" / "pyvenv.cfg").stat().st_mtime == created, "the retry went on in the same environment"
    assert environment.remove(folder)
    assert not (folder / ".venv").exists()
    assert not environment.remove(folder)


def test_a_cancelled_set_up_ends(addon, root, tmp_path):
    environment = addon("process.environment")
    setup = environment.start(tmp_path / "b", sys.executable, root)
    environment.cancel(setup)
    run_out(environment, setup)
    assert setup.failure


def test_a_folder_that_cannot_be_is_named(addon, contract, root, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(contract.JobError, match="cannot be set up in"):
        addon("process.environment").start(tmp_path / "file" / "b", sys.executable, root)


def test_what_is_not_ours_is_not_removed(addon, tmp_path):
    (tmp_path / ".venv").mkdir()
    with pytest.raises(ValueError, match="was not created by Splannequin"):
        addon("process.environment").remove(tmp_path)
    assert (tmp_path / ".venv").is_dir()


@pytest.fixture
def existing_environment(addon, tmp_path, monkeypatch):
    """Folder with an environment of ours, at the place where Set Up Backend would create it."""
    folder = tmp_path / "backend"
    (folder / ".venv" / ".splannequin").mkdir(parents=True)
    (folder / ".venv" / "package.py").touch()
    monkeypatch.setattr(addon("process.backend"), "folder", lambda: folder)
    return folder


def test_removal_does_not_wait_for_the_files(addon, existing_environment):
    """Deletion of gigabytes runs in a thread, so that Blender stays responsive. Remains of earlier removals are deleted
    too."""
    environment = addon("process.environment")
    (existing_environment / ".venv-removed-before").mkdir()
    deleted_by: set[str] = set()

    def note(frame, event, _) -> None:
        if event == "call" and "rmtree" in frame.f_code.co_name:
            deleted_by.add(threading.current_thread().name)

    threading.setprofile(note)
    try:
        assert environment.remove(existing_environment)
    finally:
        threading.setprofile(None)
    assert not (existing_environment / ".venv").exists()
    for thread in threading.enumerate():
        if thread.name == "removed backend":
            thread.join(60.0)
    assert deleted_by == {"removed backend"} and not list(existing_environment.iterdir())


def test_what_a_job_works_with_is_not_removed(addon, contract, existing_environment, shot):
    supervisor, jobs = addon("process.job_timer"), addon("process.jobs")
    job = jobs.new_job(shot, "train", contract.TrainParams())
    supervisor.follow("train", job)
    with pytest.raises(RuntimeError, match=f"a step of {shot.name} is running"):
        bpy.ops.splannequin.remove_backend()
    assert (existing_environment / ".venv" / "package.py").exists()
    job.status = contract.Status("train", "done", 0, 0.0, 1.0, 0.0)
    assert bpy.ops.splannequin.remove_backend() == {"FINISHED"}
    assert not list(existing_environment.iterdir()), "headless, it is gone when the button says so"


def at_work(folder) -> subprocess.Popen[bytes]:
    """Start a process from the environment in `folder`, and wait until it runs.

    The process is a shell. `sys.executable` of Debian's Blender may be pyenv's script, which replaces itself with
    another program whose command line does not name the environment.
    """
    shell = folder / ".venv" / "bin" / "sh"
    if not shell.exists():
        shell.parent.mkdir()
        shell.symlink_to("/bin/sh")
    process = subprocess.Popen([shell, "-c", "echo begun; read until_killed"], stdin=-1, stdout=-1)
    assert process.stdout is not None and process.stdout.readline().strip() == b"begun", "no command line before that"
    return process


@pytest.mark.skipif(sys.platform == "win32", reason="Windows moves no folder of which a program runs")
def test_environment_in_use_by_another_process_is_not_removed(addon, existing_environment):
    """A job of another Blender or of a command line is unknown to this Blender."""
    with at_work(existing_environment) as process:
        try:
            with pytest.raises(RuntimeError, match=rf"not removed, because another Blender.*\(process {process.pid}\)"):
                bpy.ops.splannequin.remove_backend()
            assert process.poll() is None and (existing_environment / ".venv" / "package.py").exists()
        finally:
            process.kill()
    assert bpy.ops.splannequin.remove_backend() == {"FINISHED"} and not list(existing_environment.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows moves no folder of which a program runs")
def test_what_a_process_begins_with_while_it_is_being_removed_is_put_back(addon, existing_environment, monkeypatch):
    environment, begun, replace = addon("process.environment"), [], os.replace

    def after_somebody_began(source, target):
        if not begun:
            begun.append(at_work(existing_environment))
        replace(source, target)

    monkeypatch.setattr(environment.os, "replace", after_somebody_began)
    try:
        with pytest.raises(environment.AtWork, match="runs in it"):
            environment.remove(existing_environment)
        assert [path.name for path in existing_environment.iterdir()] == [".venv"] and (
            existing_environment / ".venv" / "package.py"
        ).exists()
    finally:
        for process in begun:
            with process:
                process.kill()
    assert environment.remove(existing_environment, wait=True) and not list(existing_environment.iterdir())


@pytest.fixture
def system(addon, tmp_path, monkeypatch):
    """Blender's system preferences with online access off. The environment's folder is temporary, and pip finds no
    packages."""
    monkeypatch.setattr(addon("process.backend"), "folder", lambda: tmp_path / "backend")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    system = bpy.context.preferences.system
    before = system.use_online_access
    system.use_online_access = False
    yield system
    system.use_online_access = before


@pytest.mark.skipif(bpy.app.online_access_override, reason="this Blender was started online or offline for good")
def test_offline_button_leaves_online_access_to_the_artist(system, tmp_path):
    assert bpy.ops.splannequin.set_up.poll(), "a grey button offers nothing"
    with pytest.raises(RuntimeError, match="online access is turned off"):
        bpy.ops.splannequin.set_up()
    assert not system.use_online_access and not (tmp_path / "backend").exists()


@pytest.mark.skipif(bpy.app.online_access_override, reason="this Blender was started online or offline for good")
def test_from_a_folder_of_wheels_the_button_works_offline(addon, system, tmp_path, monkeypatch):
    wheels = tmp_path / "whéels"
    monkeypatch.setattr(addon("ui.preferences"), "_wheels", lambda: wheels)
    with pytest.raises(RuntimeError, match=r"no wheels .* in .*whéels"):
        bpy.ops.splannequin.set_up()
    wheels.mkdir()
    (wheels / "other-1.0-py3-none-any.whl").touch()
    with pytest.raises(RuntimeError, match="whéels has no wheel of"):
        bpy.ops.splannequin.set_up()
    assert not bpy.app.online_access


def test_a_backend_that_was_changed_since_its_set_up_is_not_started(addon, contract, tmp_path, monkeypatch):
    backend, environment = addon("process.backend"), addon("process.environment")
    venv = tmp_path / ".venv"
    python, site = backend.venv_python(venv), venv / "lib" / "python3.11" / "site-packages"
    for package in ("one", "two"):
        (site / f"{package}-1.0.dist-info").mkdir(parents=True)
        (site / f"{package}.py").write_text("value = 1")
        (site / f"{package}-1.0.dist-info" / "RECORD").write_text(f"{package}.py,sha256=abc,9\n")
    python.parent.mkdir()
    python.touch()
    (venv / contract.SETUP_NOTES).mkdir()
    stamp = {"packages": contract.record_packages(venv, ["one", "two"])}
    contract.write_json(venv / contract.SETUP_NOTES / contract.SETUP_STAMP, stamp)
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(python))
    assert backend.python() == str(python)
    (site / "two.py").unlink()
    environment._seen.clear()  # clears the cache, as after a start of Blender
    with pytest.raises(contract.JobError, match="changed since it was set up: two") as refused:
        backend.python()
    assert "Press Repair" in refused.value.hint


def test_check_says_what_the_backend_can_do(addon):
    """Check Backend shows the findings of the real backend's doctor as text."""
    assert bpy.ops.splannequin.check_backend() == {"FINISHED"}
    lines = addon("ui.preferences")._findings
    assert "torch 2." in lines[0]
    assert lines[1].startswith("Trains on")


def test_the_folder_is_short(addon):
    assert len(str(addon("process.environment").default_folder())) < len(str(Path.home())) + 20
