"""Jobs: ordered events, correct status, cancellation, error messages. Real files, real processes."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torch_backend import contract, job
from torch_backend.contract import ExitCode, JobError
from torch_backend.shot import Shot


@pytest.fixture
def shot(tmp_path):
    return Shot.create(tmp_path / "a.splannequin")


def events_of(folder):
    return [json.loads(line) for line in (folder / contract.EVENTS_FILE).read_text().splitlines()]


def status_of(folder):
    return contract.from_dict(contract.Status, contract.read_json(folder / contract.STATUS_FILE))


def run_with(shot, monkeypatch, station):
    """Run an import job with `station` as its station, to test the job machinery."""
    monkeypatch.setitem(job.RUNNERS, "import", station)
    folder = job.new_job(shot, "import", contract.ImportParams(source="x"))
    return folder, job.run_job(folder)


def test_done_is_last_and_status_is_true(shot, monkeypatch):
    def station(shot, params, report):
        report.progress("one", 1, 2, "half")
        report.metric("one", {"psnr_db": 20.0})
        report.warning("careful", "look")
        return {"frames": 3}

    folder, (code, result) = run_with(shot, monkeypatch, station)
    assert (code, result) == (ExitCode.OK, {"frames": 3})
    events = events_of(folder)
    assert [e["type"] for e in events] == ["progress", "metric", "warning", "done"]
    assert [e["seq"] for e in events] == [0, 1, 2, 3]
    assert events[-1]["data"] == {"state": "done", "result": {"frames": 3}}
    assert status_of(folder).state == "done"


def test_what_a_station_foretells_is_what_is_left(shot, monkeypatch):
    seconds_left = []

    def station(shot, params, report):
        for stage, done in (("one", 0), ("one", 1), ("other", 1)):
            report.progress(stage, done, 1000, "")
            seconds_left.append(report.status.eta_seconds)
            report.metric(contract.FORECAST, {"of": "one", "seconds_left": 5000.0})
        report.progress("one", 2, 1000, "")
        report.metric(contract.FORECAST, {"of": "one", "seconds_left": 0.0})
        seconds_left.append(report.status.eta_seconds)
        report.progress("one", 3, 1000, "")
        seconds_left.append(report.status.eta_seconds)

    run_with(shot, monkeypatch, station)
    before, first, second_stage, again, overdue = seconds_left
    assert before is second_stage is overdue is None and 4000 < first <= 5000 and 4000 < again <= 5000


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (JobError("No people.", "Film some.", ExitCode.FOOTAGE), ExitCode.FOOTAGE, "No people."),
        (contract.UserError("The width is -1."), ExitCode.USAGE, "The width is -1."),
        (contract.MissingError("There is no clip."), ExitCode.USAGE, "There is no clip."),
        (ValueError("operands could not be broadcast\n  together"), ExitCode.INTERNAL, "step failed: ValueError"),
        (FileNotFoundError("libx.so"), ExitCode.INTERNAL, "import step failed: FileNotFoundError"),
        (KeyError("frames"), ExitCode.INTERNAL, "import step failed"),
        (OSError(28, "No space left on device"), ExitCode.DISK, "No space left"),
        (ZeroDivisionError("oops"), ExitCode.INTERNAL, "import step failed"),
        (RuntimeError("CUDA out of memory"), ExitCode.INTERNAL, "Out of memory"),
        (ModuleNotFoundError("No module named 'torch_backend.x'", name="torch_backend.x"), ExitCode.INTERNAL, "failed"),
    ],
)
def test_errors_become_a_sentence(shot, monkeypatch, error, code, word):
    def station(shot, params, report):
        raise error

    folder, (got, _) = run_with(shot, monkeypatch, station)
    assert got == code
    status = status_of(folder)
    assert status.state == "failed"
    assert word in status.message
    assert [e["type"] for e in events_of(folder)] == ["error", "done"]
    assert "Traceback" not in status.message + status.hint and "\n" not in status.message
    if got == ExitCode.INTERNAL:
        log = (folder / contract.LOG_FILE).read_text()
        assert "Traceback" in log and type(error).__name__ in log
        assert "failed" not in word or str(folder / contract.LOG_FILE) in status.hint


def test_what_a_user_can_put_right_is_a_value_error_to_whoever_tries(shot):
    """Readers of settings catch ValueError; jobs and commands show the message to the user."""
    with pytest.raises(ValueError, match="no field"):
        contract.from_dict(contract.ImportParams, {"sauce": "x"})
    with pytest.raises(FileNotFoundError, match=r"no shot\.json") as missing:
        Shot.open(shot.root.parent / "elsewhere")
    assert isinstance(missing.value, JobError) and missing.value.exit_code == ExitCode.USAGE


def test_undecodable_name_is_printed_escaped(shot, monkeypatch):
    """File names on Linux are bytes: a clip from an old camera may have one in Latin-1."""

    def station(shot, params, report):
        raise JobError(f"There is nothing in {os.fsdecode(bytes([99, 97, 102, 233]))}.mp4.", "", ExitCode.FOOTAGE)

    folder, (code, _) = run_with(shot, monkeypatch, station)
    assert code == ExitCode.FOOTAGE and status_of(folder).state == "failed"
    assert "caf" in (folder / contract.LOG_FILE).read_text() and events_of(folder)[-1]["type"] == "done"


@pytest.mark.parametrize(("error", "state"), [(BrokenPipeError(), "cancelled"), (OSError(28, "No space"), "done")])
def test_who_listens_no_more_ends_no_job_without_its_end(shot, monkeypatch, error, state):
    def station(shot, params, report):
        report.warning("careful")
        report.check_cancelled()
        return {"frames": 3}

    def listener(event):
        raise error

    monkeypatch.setitem(job.RUNNERS, "import", station)
    folder = job.new_job(shot, "import", contract.ImportParams(source="x"))
    job.run_job(folder, listener)
    assert status_of(folder).state == state
    assert [event["type"] for event in events_of(folder)] == ["warning", "done"]


def test_a_package_that_the_environment_lacks_is_no_bug(shot, monkeypatch):
    """The set-up is incomplete, or someone removed the package."""

    def station(shot, params, report):
        import a_package_that_is_not_there  # noqa: F401  # pyright: ignore

    folder, (code, _) = run_with(shot, monkeypatch, station)
    status = status_of(folder)
    assert code == ExitCode.ENVIRONMENT and "bug" not in status.message + status.hint
    assert status.message == ("The backend's environment is incomplete: No module named 'a_package_that_is_not_there'.")
    assert "Press Repair" in status.hint and "a_package" in (folder / contract.LOG_FILE).read_text()


def test_unloadable_package_is_not_reported_as_a_bug(shot, monkeypatch, tmp_path):
    """A system library is missing, or another package has the wrong version."""
    (tmp_path / "a_broken_package.py").write_text("raise ImportError('libx.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)

    def broken(shot, params, report):
        import a_broken_package  # noqa: F401  # pyright: ignore

    def ours(shot, params, report):
        from torch_backend.contract import a_name_that_we_forgot  # noqa: F401  # pyright: ignore

    folder, (code, _) = run_with(shot, monkeypatch, broken)
    said = status_of(folder)
    assert code == ExitCode.ENVIRONMENT and "Press Repair" in said.hint
    assert said.message == "The backend's environment is incomplete: libx.so.1: cannot open shared object file."
    folder, (code, _) = run_with(shot, monkeypatch, ours)
    assert code == ExitCode.INTERNAL and "This is a bug" in status_of(folder).hint


def test_cancel_file_stops_a_job(shot, monkeypatch):
    def station(shot, params, report):
        folder = next(shot.jobs.iterdir())
        (folder / contract.CANCEL_FILE).touch()
        for _ in range(200):
            time.sleep(0.02)
            report.check_cancelled()
        raise AssertionError("never noticed")

    folder, (code, _) = run_with(shot, monkeypatch, station)
    assert code == ExitCode.CANCELLED
    assert status_of(folder).state == "cancelled"


def test_wrong_parameter_is_named(shot):
    folder = job.new_job(shot, "train", {"preset": 3})
    assert job.run_job(folder)[0] == ExitCode.USAGE
    assert "preset" in status_of(folder).message


def test_child_process_reports_an_unreadable_clip(shot, tmp_path):
    """The command that Blender starts, with a file that is not a video: exit code, one sentence, no traceback."""
    clip = tmp_path / "notes.mp4"
    clip.write_text("not a video")
    folder = job.new_job(shot, "import", contract.ImportParams(source=str(clip)))
    command = contract.python_child(sys.executable, "torch_backend", "run-job", str(folder))
    environ = {**os.environ, "PYTHONPATH": str(Path(contract.__file__).parents[2])}
    done = subprocess.run(**command, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.FOOTAGE
    assert "Traceback" not in done.stdout + done.stderr
    assert "notes.mp4" in status_of(folder).message
    assert not list(shot.root.glob("frames/**/*.png"))


def test_status_prints_no_escape_codes_and_goes_on_after_a_damaged_job(shot, capsys):
    from torch_backend.cli import main

    texts = {"a-import-\x1b[31m": {"state": "done", "message": "\x1b]0;title\x07 here\nand there"}, "b-import-1": {}}
    for name, expected in texts.items():
        folder = shot.jobs / name
        folder.mkdir(parents=True)
        status = {"kind": "import", "pid": 1, "started": 1.0, "process_started": 1.0, "heartbeat": 1.0, **expected}
        (folder / contract.STATUS_FILE).write_text(json.dumps(status))
    assert main(["status", str(shot.root)]) == ExitCode.OK
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) == 2 and all(line.isprintable() for line in printed.splitlines())
    assert "here and there" in printed and "damaged" in printed and "Status has no state" in printed
