"""The backend's jobs, seen from Blender: starts a detached child, reads its files, cancels it, finds it again.

No bpy. The job folder holds all state, so that every Blender that opens the shot sees the same.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from . import children

_EXIT_SECONDS = 10.0  # maximum time to wait for a job's process after its last status
# Age after which a job without a status counts as never started.
_START_SECONDS = 30.0
_LOG_LINES = 6
# Maximum time to read the events of a rediscovered job without interruption.
_FIRST_LOOK_SECONDS = 1.0
# Time after a cancel request from which a second request kills the job.
_KILL_SECONDS = 20.0
_LONGEST_SECONDS = 1e7  # longer time estimates are not shown
# Maximum bytes read of a request. A request with a t* for each of 100,000 frames has a fifth of this size.
_LONGEST_REQUEST = 1 << 24
# Seconds without a heartbeat after which a job of an older backend counts as dead.
_SILENT_SECONDS = 10 * contract.HEARTBEAT_SECONDS


@dataclass
class Job:
    """A job that this Blender monitors. Holds paths and the data read so far."""

    folder: Path
    """Job folder, shot/jobs/<id>."""
    kind: str
    """A key of `contract.PARAMS`, such as import, solve, train or freeze."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    """Parameters of the request."""
    process: subprocess.Popen[bytes] | None = None
    """The child process if this Blender started it, else None."""
    status: contract.Status | None = None
    """Last status read."""
    read_to: int = 0
    """Bytes of events.jsonl read so far."""
    warnings: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(sentence, hint) of each warning for the artist."""
    metrics: dict[str, Any] = field(default_factory=dict[str, Any])
    """Latest metrics of the job, by name."""
    history: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    """(seconds of training, dB on held-out frames) in order of arrival."""
    images: dict[str, str] = field(default_factory=dict[str, str])
    """Label -> path of the latest image."""
    result: Any = None
    """Result in the job's `done` event."""
    end: tuple[str, _Message] | None = None
    """Final state and message of the job according to its events."""
    cameras_known: bool = False
    """True for a solve that has written the shot's cameras, even if it still runs."""
    applied: bool = False
    """True if the job's result is in the scene, even if the job still runs."""
    over: bool = False
    """True if the job had ended before this Blender first read it. Its result exists already and is not applied."""
    scene_uid: int = 0
    """`session_uid` of the scene from which this Blender started the job; 0 for a rediscovered job."""
    blend: str = ""
    """Name of the .blend from which the job was started; empty if unknown."""
    beat: tuple[float, float] | None = None
    """(last heartbeat of a job on another computer, monotonic seconds when it was first seen), or None."""

    @property
    def shot(self) -> Path:
        """Shot folder the job belongs to."""
        return self.folder.parent.parent

    @property
    def ended(self) -> bool:
        """True once the job has ended and its whole output has been read."""
        return self.status is not None and self.status.ended

    @property
    def state(self) -> str:
        """queued, running, done, failed or cancelled."""
        return self.status.state if self.status else "queued"


Params = (
    contract.ImportParams
    | contract.SolveParams
    | contract.TrainParams
    | contract.FreezeParams
    | contract.MatteParams
    | contract.SurfaceParams
    | contract.LightParams
    | contract.CombineParams
)
"""Parameters of a job. `contract.PARAMS` lists them by kind."""


def kind_of(params: Params) -> str:
    """Kind of the job with these parameters."""
    return next(kind for kind, cls in contract.PARAMS.items() if isinstance(params, cls))


def new_job(shot: Path, kind: str, params: Params) -> Job:
    """Creates a job folder in `shot` with its request. `params` is the kind's dataclass of `contract.PARAMS`."""
    return Job(contract.new_job(shot, kind, params), kind, dataclasses.asdict(params))


def start(job: Job, python: str, package_root: Path) -> None:
    """Starts the backend on a job as a detached process, which outlives this Blender.

    Args:
        job: a job from `new_job`.
        python: interpreter of the backend's environment.
        package_root: folder that contains `torch_backend`.

    Raises:
        contract.JobError: the interpreter cannot be started.
    """
    command = contract.python_child(python, "torch_backend", "run-job", str(job.folder.absolute()))
    try:
        with open(job.folder / contract.LOG_FILE, "ab") as log:
            job.process = children.start(command, package_root, stdout=log, stderr=subprocess.STDOUT)
    except OSError as error:
        raise contract.JobError(
            f"The backend's Python could not be started: {python}: {error.strerror or error}.",
            "Choose the Python of the backend's environment in the add-on's preferences.",
            contract.ExitCode.ENVIRONMENT,
        ) from error


def poll(job: Job, budget_seconds: float = 0.01) -> list[contract.Event]:
    """Reads the job's new output for about `budget_seconds`. Returns the new events.

    If the child died without a final status, reads for up to a second more and then marks the job as failed.
    """
    until = time.monotonic() + budget_seconds
    status = _read_status(job.folder) or job.status
    events, all_read = _read_events(job, until)
    if status is not None and status.ended and not all_read:
        return events  # the job has ended, but the next poll must read its remaining events
    if (status is None or not status.ended) and not is_alive(job, status):
        status = _read_status(job.folder) or status  # the job may have ended between the two reads above
        events += _read_events(job, until + 1.0)[0]  # once per job: its last events must be read before its status
        if status is None or not status.ended:
            status = _mark_failed(job, status)
    job.status = status
    return events


def _final_status(job: Job, status: contract.Status | None) -> contract.Status | None:
    """The final status from the job's events, if the job could not write it because its shot was moved or deleted."""
    if job.end is None:
        return None
    now = time.time()
    status = status or contract.Status(job.kind, "failed", 0, now, 0.0, now)
    state, error = job.end
    status.state = state if state in ("done", "failed", "cancelled") else "failed"
    status.message, status.hint, status.exit_code, status.eta_seconds = error.message, error.hint, error.exit_code, None
    return status


def is_alive(job: Job, status: contract.Status | None) -> bool:
    """True if the job's process still works on it, or may be about to."""
    if job.process is not None:
        return job.process.poll() is None
    if status is None or not status.pid:
        return _age(job.folder) < _START_SECONDS
    if status.host and status.host != contract.computer_name():
        # A job on another computer is alive while it holds the shot's lock, which can be removed by hand.
        return _has_lock(job) or not _is_silent(job, status)
    if status.host or (status.process_started and sys.platform == "linux"):
        # A process that is only stopped, as on a sleeping computer, has no heartbeat but is alive.
        return contract.runs_still(status.pid, status.process_started)
    return time.time() - status.heartbeat < _SILENT_SECONDS  # an older backend did not record its host


def refuse_second_writer(shot: Path) -> None:
    """Raises JobError if a job writes into the shot or is about to.

    The message names the job, its start and its host, if they are known.
    """
    try:
        writer = contract.read_writer(shot)
    except (OSError, ValueError):
        writer = None  # the backend reports a damaged lock
    if writer is not None and writer.works() and not contract.is_ending(shot, writer):
        raise contract.busy(shot, writer)
    for job in latest(shot).values():
        is_local = job.status is None or job.status.host in ("", contract.computer_name())  # others hold the lock
        if is_local and not job.ended and is_alive(job, job.status):
            if job.status is not None:
                status = job.status
                host, job_name = contract.computer_name(), job.folder.name
                writer = contract.Writer(host, status.pid, status.process_started, job.kind, job_name, status.started)
                raise contract.busy(shot, writer)
            raise contract.JobError(
                f"A step of {shot.name} is still running.", "Wait for it or cancel it.", contract.ExitCode.USAGE
            )


def _has_lock(job: Job) -> bool:
    """True if the job holds the shot's lock, or if the lock cannot be read."""
    try:
        writer = contract.read_writer(job.shot)
    except (OSError, ValueError):
        return True
    return writer is not None and writer.job == job.folder.name


def _is_silent(job: Job, status: contract.Status) -> bool:
    """True if a job's heartbeat has not changed while this Blender watched."""
    now = time.monotonic()  # does not rely on the other computer's clock
    if job.beat is None or job.beat[0] != status.heartbeat:
        job.beat = (status.heartbeat, now)
    return now - job.beat[1] > _SILENT_SECONDS


def cancel(job: Job) -> None:
    """Requests that the job stops with a checkpoint. A second request after `_KILL_SECONDS` kills it.

    Raises JobError instead of killing if the job's process cannot be identified with certainty.
    """
    flag = job.folder / contract.CANCEL_FILE
    try:
        os.close(os.open(flag, os.O_WRONLY | os.O_CREAT | os.O_EXCL))  # any existing file or link is left alone
    except FileNotFoundError:
        return  # the shot was moved or deleted, which ends the job, too
    except FileExistsError:
        since = flag.lstat().st_mtime
        if contract.disk_time(job.folder) - since > _KILL_SECONDS and is_alive(job, job.status):
            _kill(job)


def wait(job: Job, on_event: Callable[[contract.Event], None] | None = None) -> Any:
    """Blocks until the job has ended and returns its result. Ctrl-C requests a stop and waits for the checkpoint.

    Raises:
        contract.JobError: the job failed. The message, hint and exit code come from the job.
        contract.Cancelled: the job was cancelled.
    """
    while not job.ended:
        try:
            for event in poll(job, 1.0):
                if on_event:
                    on_event(event)
            time.sleep(0.0 if job.ended else 0.05)
        except KeyboardInterrupt:
            cancel(job)
    if job.process is not None:
        # The job releases the shot's lock after its last status. On a busy machine the next step could find it locked.
        with contextlib.suppress(subprocess.TimeoutExpired):
            job.process.wait(_EXIT_SECONDS)
    raise_if_failed(job)
    return job.result


def raise_if_failed(job: Job) -> None:
    """Raises JobError or Cancelled if the ended job did not succeed."""
    status = job.status
    if status is None or status.state == "done":
        return
    if status.state == "cancelled":
        raise contract.Cancelled
    code = status.exit_code if status.exit_code is not None else contract.ExitCode.INTERNAL
    raise contract.JobError(status.message, status.hint, code)


def open_job(folder: Path) -> Job | None:
    """A job from its folder; None if its request is unreadable or invalid."""
    try:
        data = contract.read_json(folder / contract.REQUEST_FILE, _LONGEST_REQUEST)
        contract.check_version(data, "job request")
        request: contract.JobRequest = contract.from_dict(contract.JobRequest, data)
        params = dataclasses.asdict(request.typed_params())
    except (OSError, ValueError):
        return None
    return Job(folder, request.kind, params)


def latest(shot: Path) -> dict[str, Job]:
    """The newest job of each kind in a shot, polled once. Also finds running jobs again."""
    found: dict[str, Job] = {}
    jobs_folder = contract.ShotFolder(shot).jobs
    # A link would lead to the jobs of another shot, into which this add-on must not write.
    is_local = shot.is_dir() and not contract.is_link(jobs_folder)
    folders = sorted(jobs_folder.glob("*/"), key=lambda p: p.name, reverse=True) if is_local else []
    for folder in folders:
        if contract.is_link(folder):
            continue
        kind = next((k for k in contract.PARAMS if f"-{k}-" in folder.name), None)
        if kind is None or kind in found:
            continue
        job = open_job(folder)
        if job is None:
            continue
        try:
            status = _read_status(folder)
            job.over = status is not None and status.ended
            poll(job, _FIRST_LOOK_SECONDS)
        except (OSError, ValueError):
            continue  # files damaged from outside: use the previous job instead
        found[kind] = job
    return found


def log_tail(folder: Path, lines: int = _LOG_LINES) -> list[str]:
    """Last lines of the job's log; empty without a log."""
    try:
        with contract.open_regular(folder / contract.LOG_FILE) as log:
            log.seek(0, os.SEEK_END)
            log.seek(max(log.tell() - 8192, 0))
            text = log.read(8192).decode("utf-8", "replace")
    except (OSError, ValueError):
        return []
    return [contract.printable(line) for line in text.splitlines() if line.strip()][-lines:]


def _read_status(folder: Path) -> contract.Status | None:
    """The current status; None if there is none yet. Raises ValueError if the file is not a job status."""
    try:
        data = contract.read_json(folder / contract.STATUS_FILE, contract.SHORT_JSON)
    except OSError:
        return None
    contract.check_version(data, "job status", contract.STATUS_VERSION)
    status: contract.Status = contract.from_dict(contract.Status, data)
    for name in ("stage", "message", "hint", "host"):
        setattr(status, name, contract.printable(getattr(status, name)))
    status.fraction = min(max(status.fraction, 0.0), 1.0)
    if status.eta_seconds is not None and not 0.0 <= status.eta_seconds < _LONGEST_SECONDS:
        status.eta_seconds = None
    return status


def _read_events(job: Job, until: float) -> tuple[list[contract.Event], bool]:
    """(new complete lines of events.jsonl as events, whether all were read). Skips lines that are not events."""
    events: list[contract.Event] = []
    try:
        with contextlib.closing(contract.read_lines(job.folder / contract.EVENTS_FILE, job.read_to)) as lines:
            for line, job.read_to in lines:
                event = _event(line)
                if event is not None:
                    _apply_event(job, event)
                    events.append(event)
                if time.monotonic() > until:
                    return events, False
    except OSError:
        pass  # the file does not exist yet
    return events, True


def _event(line: bytes) -> contract.Event | None:
    try:
        event: contract.Event = contract.from_dict(contract.Event, json.loads(line))
        if event.type in _EVENT_DATA:
            contract.from_dict(_EVENT_DATA[event.type], event.data)
    except (ValueError, TypeError, RecursionError):
        return None
    return event


@dataclass
class _Message:
    message: str
    hint: str = ""
    exit_code: int = 1


@dataclass
class _Metrics:
    values: dict[str, Any]
    stage: str = ""


@dataclass
class _Image:
    label: str
    path: str


@dataclass
class _Result:
    state: str = "done"
    result: Any = None


# Type of event -> its required fields. Events of other types are only passed on.
_EVENT_DATA: dict[str, type] = {
    "warning": _Message, "error": _Message, "metric": _Metrics, "image": _Image, "done": _Result,
}  # fmt: skip


def _apply_event(job: Job, event: contract.Event) -> None:
    if event.type == "warning":
        message = _Message(**event.data)
        job.warnings.append((contract.printable(message.message), contract.printable(message.hint)))
    elif event.type == "metric":
        values = event.data["values"]
        job.metrics.update(values)
        job.cameras_known |= event.data.get("stage") == contract.CAMERAS_KNOWN
        point = contract.measured(values)
        if point is not None:
            job.history.append(point)
    elif event.type == "image":
        job.images[event.data["label"]] = event.data["path"]
    elif event.type == "error":
        message = _Message(**event.data)
        message.message, message.hint = contract.printable(message.message), contract.printable(message.hint)
        job.end = ("failed", message)
    elif event.type == "done":
        job.result = event.data.get("result")
        job.end = (_Result(**event.data).state, job.end[1] if job.end else _Message("", exit_code=0))


def _mark_failed(job: Job, status: contract.Status | None) -> contract.Status:
    final = _final_status(job, status)
    if final is not None:
        return _keep(job, final)
    now = time.time()
    status = status or contract.Status(job.kind, "failed", 0, now, 0.0, now)
    if not job.folder.is_dir():
        lost = contract.missing_shot_error(job.shot, job.kind)
        status.state, status.message, status.hint, status.exit_code = "failed", lost.message, lost.hint, lost.exit_code
        return status
    code = job.process.returncode if job.process else None
    how = f" (exit code {code})" if code is not None else ""
    last = log_tail(job.folder, 1)
    status.state = "failed"
    status.exit_code = code if code is not None and code > 0 else int(contract.ExitCode.INTERNAL)
    status.message = f"The backend stopped unexpectedly during {status.stage or 'the start'}{how}."
    if last:
        status.message += f" Last line of its log: {last[0].strip()[:200]}"
    killed = code is not None and code < 0
    status.hint = (
        "The process was killed, possibly because memory ran out. Close other programs or choose a smaller "
        "preset, then start again."
        if killed
        else f"Start the step again. Finished work is kept. The full log is {job.folder / contract.LOG_FILE}"
    )
    return _keep(job, status)


def _keep(job: Job, status: contract.Status) -> contract.Status:
    """Writes the final status of a job that cannot do so itself. A job of another computer keeps its file."""
    if status.host in ("", contract.computer_name()):
        contract.write_json(job.folder / contract.STATUS_FILE, dataclasses.asdict(status), parents=False)
    return status


def _age(folder: Path) -> float:
    """Age of a job in seconds, by the clock of its disk."""
    now, created = time.time(), 0.0
    with contextlib.suppress(OSError):
        now = contract.disk_time(folder)  # another computer may have created the job
    with contextlib.suppress(OSError):
        created = (folder / contract.REQUEST_FILE).stat().st_mtime
    return now - created


def _kill(job: Job) -> None:
    """Kills the job's process and its children. Raises JobError if the process cannot be identified with certainty."""
    if job.process is not None:
        pid = job.process.pid  # the system reuses the id only after we wait for the child
    else:
        status = job.status
        if status is None or status.host not in ("", contract.computer_name()):
            where = status.host.partition(" (")[0] if status else "another computer"
            raise _not_ours(f"This step runs on {where} and can only be ended there.")
        pid = status.pid
        if not contract.runs_job(pid, status.process_started, job.folder):
            raise _not_ours("The process of this step could not be identified, so no process was ended.")
    if sys.platform == "win32":
        program = os.path.join(os.environ.get("SYSTEMROOT", r"C:\Windows"), "System32", "taskkill.exe")
        words = [program, "/F", "/T", "/PID", str(pid)]
        subprocess.run(words, capture_output=True, check=False, creationflags=subprocess.CREATE_NO_WINDOW)
        return
    try:
        if os.getpgid(pid) == pid:
            os.killpg(pid, signal.SIGKILL)
        else:
            os.kill(pid, signal.SIGKILL)  # in another process's group
    except ProcessLookupError:
        return  # it has ended in the meantime


def _not_ours(message: str) -> contract.JobError:
    return contract.JobError(
        message, "The step will stop as soon as it can. Otherwise end it where it was started.",
        contract.ExitCode.USAGE,
    )  # fmt: skip
