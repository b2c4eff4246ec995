"""Runs one station as a job, with typed events, cancellation, and a status that stays correct after a crash.

The same code serves Blender, the command line and tests. Blender starts a child process, `python -m torch_backend
run-job DIR`. The command line runs a job in its own process, with the console as the listener.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

from . import contract
from .contract import Cancelled, Event, ExitCode, JobError, JobRequest, Reporter, Status, Writer, unexpected
from .contract import new_job as new_job
from .shot import Shot, disk_error, is_disk_full, path_error, working_on, write_json
from .writer import only_writer, patient_writer

_CANCEL_POLL_SECONDS = 0.2
_PROGRESS_SECONDS = 0.1
_MISSED_BEATS = 3
"""A job ends after this many heartbeats in a row without its folder. A network disk may be missing for a moment."""

Listener = Callable[[Event], None]


class JobReporter:
    """Reporter of a job folder: appends events, updates status.json, notices the cancel file and Ctrl-C."""

    def __init__(self, folder: Path, kind: str, listener: Listener | None = None) -> None:
        self.folder = folder
        self._listener = listener
        self._lock = threading.RLock()
        self._seq = 0
        self._cancelled = False
        self._last_poll = 0.0
        self._missed = 0
        self._writer: Writer | None = None
        self._new_writer: Writer | None = None
        self._last_progress = ("", 0.0)
        self._stage_started = ("", 0.0, 0.0)
        self.is_fresh_start = False
        """True if the job's first stage began at its start, so the job reused no earlier work."""
        self._foretold = ("", 0.0)
        now = time.time()
        pid, host = os.getpid(), contract.computer_name()
        self.status = Status(kind, "running", pid, now, contract.process_start(pid), now, host=host)
        self._events = open(folder / contract.EVENTS_FILE, "a", encoding="utf-8")  # noqa: SIM115 - lives as long as the job
        self._stop = threading.Event()
        self._write_status()
        self._beat = threading.Thread(target=self._heartbeat, name="heartbeat", daemon=True)
        self._beat.start()

    # -- what stations call

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        now = time.time()
        fraction = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        with self._lock:
            if stage != self._stage_started[0]:
                self._stage_started = (stage, now, fraction)
                self.is_fresh_start |= stage == contract.BEGINS_WITH.get(self.status.kind) and fraction < 0.05
            eta = self._eta(now, fraction)
            self.status.stage, self.status.fraction = stage, fraction
            self.status.message, self.status.eta_seconds = message, eta
            last_stage, last_time = self._last_progress
            if stage == last_stage and fraction < 1.0 and now - last_time < _PROGRESS_SECONDS:
                return
            self._last_progress = (stage, now)
        self._emit("progress", stage=stage, done=done, total=total, message=message, eta_seconds=eta)

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        if stage == contract.FORECAST:
            with self._lock:
                self._foretold = (str(values["of"]), time.time() + float(values["seconds_left"]))
        self._emit("metric", stage=stage, values=dict(values))

    def image(self, label: str, path: str | Path) -> None:
        self._emit("image", label=label, path=str(path))

    def warning(self, message: str, hint: str = "") -> None:
        self._emit("warning", message=message, hint=hint)

    def check_cancelled(self) -> None:
        if self._missed >= _MISSED_BEATS:
            raise contract.MissingError(f"{self.folder} is gone")
        if self._new_writer is not None:  # another job owns the shot now, so this one writes no more
            message = f"{self._new_writer.host} took over the shot, because this computer stopped responding."
            raise JobError(message, "The work continues there.", ExitCode.USAGE)
        now = time.monotonic()
        if not self._cancelled and now - self._last_poll >= _CANCEL_POLL_SECONDS:
            self._last_poll = now
            self._cancelled = (self.folder / contract.CANCEL_FILE).exists()
        if self._cancelled:
            raise Cancelled

    def waiting(self, why: str) -> None:
        """Reports that the job waits for its turn. Raises `Cancelled` as `check_cancelled` does."""
        self.progress("waiting", 0, 1, why)
        self.check_cancelled()

    def holds(self, writer: Writer) -> None:
        """Notes that the shot's lock contains `writer`. The job ends if the lock later names another writer."""
        self._writer = writer

    @property
    def has_listener(self) -> bool:
        """True if a listener receives the events."""
        return self._listener is not None

    # -- end of the job

    def cancel(self) -> None:
        """Asks the job to stop at its next `check_cancelled`. Safe in a signal handler."""
        self._cancelled = True

    def finish(self, state: str, exit_code: int, message: str = "", hint: str = "", result: Any = None) -> None:
        """Writes the last event and the last status."""
        self._stop.set()
        self._beat.join(timeout=5.0)
        with self._lock:
            self.status.state, self.status.exit_code = state, exit_code
            self.status.eta_seconds = None
            if state == "done":
                self.status.fraction = 1.0
            else:
                self.status.message, self.status.hint = message, hint
        if state == "failed":
            self._emit("error", message=message, hint=hint, exit_code=exit_code)
        self._emit("done", state=state, result=result)
        self._write_status()
        with contextlib.suppress(OSError):
            self._events.close()

    # -- internal

    def _eta(self, now: float, fraction: float) -> float | None:
        stage, since, at_fraction = self._stage_started
        of, end = self._foretold
        if of == stage and now < end and fraction < 1.0:  # the station's forecast, while it lasts
            return round(end - now, 1)
        gained = fraction - at_fraction
        if gained <= 0.02 or now - since < 1.0:
            return None
        return round((now - since) * (1.0 - fraction) / gained, 1)

    def _emit(self, kind: str, **data: Any) -> None:
        with self._lock:
            event = Event(kind, self._seq, time.time(), data)
            self._seq += 1
            # With a full disk, the job still reports the error in its status and to its listener.
            with contextlib.suppress(OSError):
                if not self._events.closed:
                    self._events.write(json.dumps(dataclasses.asdict(event)) + "\n")
                    self._events.flush()
        if self._listener:
            try:
                self._listener(event)
            except OSError as error:  # the terminal is closed or the disk is full: the job goes on
                self._listener = None
                if isinstance(error, BrokenPipeError):  # the reader closed the pipe, as `| head` does
                    self.cancel()

    def _heartbeat(self) -> None:
        while not self._stop.wait(contract.HEARTBEAT_SECONDS / 2):
            self._write_status()
            if self._writer is not None:
                with contextlib.suppress(OSError, ValueError):
                    holder = contract.read_writer(self.folder.parent.parent)
                    self._new_writer = holder if holder not in (None, self._writer) else None

    def _write_status(self) -> None:
        with self._lock:
            self.status.heartbeat = time.time()
            # A full disk, or a reader that holds the file open (Windows), must not end the job: the next beat retries.
            try:
                write_json(self.folder / contract.STATUS_FILE, dataclasses.asdict(self.status))
                self._missed = 0
            except FileNotFoundError:
                self._missed += 1  # the shot was moved or deleted
            except OSError:
                pass


def run_job(
    folder: str | Path, listener: Listener | None = None, exclusive: bool = True, patient: bool = False
) -> tuple[int, Any]:
    """Runs the request in `folder` to its end. Returns (exit code, result or None); never raises for a failed job.

    Args:
        folder: the job's folder.
        listener: receives every event.
        alone: hold the shot's lock, and fail with a message if another job holds it. If false, several jobs may train
            runs of different names at once; the caller must prevent other writes.
        patient: wait for another writer instead of failing, and take the lock from one that died on another computer.
    """
    folder = Path(folder).absolute()
    try:
        data = contract.read_json(folder / contract.REQUEST_FILE)
        contract.check_version(data, "job request")
        request: JobRequest = contract.from_dict(JobRequest, data)
    except (OSError, ValueError, KeyError) as error:
        print(f"{folder} contains no job that can be run: {error}", file=sys.stderr)
        return ExitCode.USAGE, None
    with working_on(Path(request.shot).absolute(), folder.parent.parent):
        reporter = JobReporter(folder, request.kind, listener)
        with contextlib.ExitStack() as locks, _signals_cancel(reporter):  # keeps the lock until the last status
            return _run(request, reporter, locks if exclusive else None, patient)


def _run(
    request: JobRequest, reporter: JobReporter, locks: contextlib.ExitStack | None, patient: bool
) -> tuple[int, Any]:
    result: Any = None
    state, code, message, hint = "done", int(ExitCode.OK), "", ""
    try:
        params = request.typed_params()
        shot = Shot.open(request.shot)
        words = shot.root, request.kind, reporter.folder.name
        if locks is not None:
            lock = patient_writer(*words, reporter.waiting) if patient else only_writer(*words)
            reporter.holds(locks.enter_context(lock))
            shot.publish_frames()
        reporter.check_cancelled()
        since = time.monotonic()
        with _kept_in_place(shot, request.kind):
            result = RUNNERS[request.kind](shot, params, reporter)
        if reporter.is_fresh_start:
            _learn_pace(shot, request.kind, params, time.monotonic() - since)
    except Cancelled:
        state, code = "cancelled", int(ExitCode.CANCELLED)
        message, hint = "Cancelled.", "Start it again to continue: finished work is kept."
    except KeyboardInterrupt:
        state, code, message = "cancelled", int(ExitCode.CANCELLED), "Cancelled."
    except JobError as error:
        state, code, message, hint = "failed", error.exit_code, error.message, error.hint
        _log(reporter.folder, "\n".join([message, hint, *getattr(error, "__notes__", ())]) + "\n")
    except Exception as error:  # unexpected, so not the user's mistake
        _log(reporter.folder, traceback.format_exc())
        known, text = _about_a_path(error, request.shot) or _about_a_module(error), str(error).lower()
        known = known or unexpected(f"The {request.kind} step", error, reporter.folder / contract.LOG_FILE)
        state, code = "failed", known.exit_code
        if type(error).__name__ == "OutOfMemoryError":  # torch raises it for a card
            message = "The graphics card is out of memory."
            hint = (
                "Close other programs that use it, choose a smaller width or fewer Gaussians, or use the processor "
                "as the device."
            )
        elif isinstance(error, MemoryError) or "out of memory" in text or "defaultcpuallocator" in text:
            message, hint = "Out of memory.", "Choose a smaller width or fewer Gaussians, or close other programs."
        else:
            message, hint = known.message, known.hint
    reporter.finish(state, code, message, hint, result)
    if state == "failed" and not reporter.has_listener and not reporter.folder.is_dir():
        # In Blender, the standard error is the open log file, which moves with the shot's folder.
        print(f"{message} {hint}".rstrip(), file=sys.stderr)
    return code, result


def _learn_pace(shot: Shot, kind: str, params: Any, seconds: float) -> None:
    """Records how fast this machine was, for the estimates of later jobs."""
    with contextlib.suppress(OSError, ValueError):
        expected = contract.expected_seconds(kind, params, contract.ShotSize.of(shot))
        if expected is not None:
            contract.learn_pace(Path(sys.prefix), kind, seconds, expected)


@contextlib.contextmanager
def _kept_in_place(shot: Shot, kind: str) -> Generator[None]:
    """Raises JobError if the shot's folder was moved or deleted during the block, in place of any other error."""
    try:
        yield
    except (Cancelled, KeyboardInterrupt):
        raise
    except Exception as error:
        if not _exists(shot):
            raise contract.missing_shot_error(shot.root, kind) from error
        raise
    if not _exists(shot):
        raise contract.missing_shot_error(shot.root, kind)


def _exists(shot: Shot) -> bool:
    try:
        os.lstat(shot.info_path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        pass  # the disk does not answer: the shot may still exist
    return True


def _about_a_path(error: Exception, shot: str) -> JobError | None:
    """JobError for a full disk, or for a file that the system refuses; None for any other error."""
    if not isinstance(error, OSError):
        return None
    return disk_error(shot) if is_disk_full(error) else path_error(error)


def _about_a_module(error: Exception) -> JobError | None:
    """JobError for a missing or broken package; None for any other error, and for a module of this package."""
    if not isinstance(error, ImportError) or (error.name or "").partition(".")[0] == __package__:
        return None
    return contract.incomplete(str(error))


def _log(folder: Path, text: str) -> None:
    """Appends details that the message leaves out to the job's log, which *Open Log* shows."""
    name = folder / contract.LOG_FILE  # file names on Linux may be invalid text: "backslashreplace" writes them
    with contextlib.suppress(OSError), open(name, "a", encoding="utf-8", errors="backslashreplace") as log:
        log.write(text)


@contextlib.contextmanager
def _signals_cancel(reporter: JobReporter) -> Generator[None]:
    """Ctrl-C, SIGTERM and CTRL_BREAK end the job with a checkpoint instead of a traceback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = [name for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)]
    before = {name: signal.getsignal(getattr(signal, name)) for name in names}

    def cancel(number: int, frame: FrameType | None) -> None:
        reporter.cancel()

    for name in names:
        signal.signal(getattr(signal, name), cancel)
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


# ------------------------------------------------------------------------------------------------- stations
# Each function imports its station, so that a job loads only what it needs. Importing torch takes seconds, and an
# import job does not need torch.


def _import(shot: Shot, params: contract.ImportParams, report: Reporter) -> Any:
    from .footage import import_footage

    return import_footage(shot, params.source, params, report)


def _solve(shot: Shot, params: contract.SolveParams, report: Reporter) -> Any:
    from .footage import load_frames
    from .sfm.progress import OneBar, weights_of
    from .sfm.solving import SolveConfig, solve_shot

    config = SolveConfig(**{name: value for name, value in vars(params).items() if name != "cameras"})
    one_bar = OneBar(report, weights_of(load_frames(shot)))
    solved = solve_shot(shot, config, one_bar, params.cameras)
    from .motion_search import motion_after_solve  # imports torch, which would delay the cameras

    result = {**solved, **(motion_after_solve(shot, one_bar) or {})}
    one_bar.metric("solve", result)
    return result


def _train(shot: Shot, params: contract.TrainParams, report: Reporter) -> Any:
    from .motion.mattes import is_outdated
    from .motion_search import find_motion
    from .train import train_shot

    if is_outdated(shot) and not params.extend:  # without mattes, training would guess what moves
        find_motion(shot, report, with_points=True)
    return train_shot(shot, params, report)


def _freeze(shot: Shot, params: contract.FreezeParams, report: Reporter) -> Any:
    from .freeze import freeze_shot

    return freeze_shot(shot, params, report)


def _combine(shot: Shot, params: contract.CombineParams, report: Reporter) -> Any:
    from .freeze.mattes.combined import combine

    return combine(shot, params, report)


def _mattes(shot: Shot, params: contract.MatteParams, report: Reporter) -> Any:
    from .freeze.mattes.job import make_mattes

    return make_mattes(shot, params, report)


def _surface(shot: Shot, params: contract.SurfaceParams, report: Reporter) -> Any:
    from .freeze.surface.job import make_surface

    return make_surface(shot, params, report)


def _light(shot: Shot, params: contract.LightParams, report: Reporter) -> Any:
    from .freeze.light.job import make_light

    return make_light(shot, params, report)


RUNNERS: dict[str, Callable[[Shot, Any, Reporter], Any]] = {
    "import": _import,
    "solve": _solve,
    "train": _train,
    "freeze": _freeze,
    "mattes": _mattes,
    "surface": _surface,
    "light": _light,
    "combine": _combine,
}
"""Station of each kind of job: (shot, typed params, reporter) -> JSON-able result."""
