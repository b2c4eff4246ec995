"""A job: a folder with a request, a status, events and a log.

Blender writes `request.json` and starts `python -m torch_backend run-job FOLDER`; the backend appends events to
`events.jsonl`, rewrites `status.json`, and stops when a file named `cancel` appears.
"""

from __future__ import annotations

import dataclasses
import os
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from .errors import ExitCode, JobError, UserError
from .files import is_json_object
from .options import PARAMS, check_params
from .processes import process
from .shot_folder import ShotFolder
from .typed import CONTRACT_VERSION, from_dict
from .writing import write_json

STATUS_VERSION = 2
"""Version of status.json; version 2 added the host."""
REQUEST_FILE = "request.json"
STATUS_FILE = "status.json"
EVENTS_FILE = "events.jsonl"
LOG_FILE = "log.txt"
CANCEL_FILE = "cancel"
FORECAST = "forecast"
"""Stage of a metric that forecasts the remaining time of the stage `of`: `seconds_left`."""
CAMERAS_KNOWN = "cameras known"
"""Stage of a metric that a running solve sends once it has written the shot's cameras. They can be shown then."""
STEP_FILE = "step"
"""File with the name of the panel's step that started the job; only Blender uses it."""
SCENE_FILE = "scene"
"""File with the name of the scene from which Blender started the job."""
BLEND_FILE = "blend"
"""File with the name of the .blend, without its folder, from which Blender started the job; missing if unsaved."""
JOB_COMMAND = "-m torch_backend run-job"
"""Arguments that start the process of a job, between the Python executable and the job's folder."""
HEARTBEAT_SECONDS = 2.0
"""How often a living job rewrites status.json."""


class Reporter(Protocol):
    """Interface through which a station reports, implemented by `job.JobReporter`. The methods below do nothing."""

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """`done` of `total` units of `stage` are finished."""

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        """Figures of the run, units in the key names."""

    def image(self, label: str, path: str | Path) -> None:
        """A picture worth showing was written."""

    def warning(self, message: str, hint: str = "") -> None:
        """Something the artist should know; the job goes on."""

    def check_cancelled(self) -> None:
        """Raises `Cancelled` if a stop was requested."""


@dataclass
class JobRequest:
    """Request for one station on one shot."""

    kind: str
    """import, solve, train, freeze, mattes, combine, surface or light."""
    shot: str
    """Absolute path of the shot folder."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    """Fields of the kind's dataclass in `PARAMS`."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def typed_params(self) -> Any:
        """The parameters as their dataclass. ValueError names an unknown kind or field, or an invalid value."""
        if self.kind not in PARAMS:
            raise UserError(f"unknown job kind {self.kind!r}: expected one of {', '.join(PARAMS)}")
        params = from_dict(PARAMS[self.kind], self.params)
        check_params(params)
        return params


@dataclass
class Event:
    """One line of events.jsonl. `done` is always the last."""

    type: str
    """progress, metric, image, warning, error or done."""
    seq: int
    """Number of the event within the job, from 0."""
    time: float
    """Seconds since the epoch."""
    data: dict[str, Any]
    """progress: stage, done, total, message, eta_seconds. metric: stage, values. image: label, path.
    warning: message, hint. error: message, hint, exit_code. done: state, result."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""


@dataclass
class Status:
    """status.json: state of a job. Rewritten as a whole, at least every `HEARTBEAT_SECONDS` while the job lives."""

    kind: str
    """Kind of job."""
    state: str
    """queued, running, done, failed or cancelled."""
    pid: int
    """Process id of the child."""
    started: float
    """Start of the job, seconds since the epoch."""
    process_started: float
    """`Process.started` of the child, so that a reused pid is not believed; 0 if unknown."""
    heartbeat: float
    """Last sign of life, seconds since the epoch."""
    stage: str = ""
    """Current stage."""
    fraction: float = 0.0
    """Share of that stage that is finished, 0 to 1."""
    message: str = ""
    """Current activity, or the message of the error."""
    hint: str = ""
    """What to do about the error."""
    eta_seconds: float | None = None
    """Seconds left in this stage; None if unknown."""
    exit_code: int | None = None
    """Exit code once it has ended."""
    host: str = ""
    """Computer that the job runs on, as `computer_name` returns; empty in files before version 2."""
    version: int = STATUS_VERSION
    """Version of this file."""

    @property
    def ended(self) -> bool:
        """True once the job will write nothing more."""
        return self.state in ("done", "failed", "cancelled")


WORK = {
    "import": "The import",
    "solve": "The camera solve",
    "train": "The training",
    "freeze": "The freeze",
    "mattes": "The matte job",
    "surface": "The surface job",
    "light": "The light job",
    "combine": "The job that combines takes",
}
"""Kind of job -> its name in messages."""


def missing_shot_error(shot: Path, kind: str) -> JobError:
    """The error of a job whose shot was moved or deleted while it ran."""
    return JobError(
        f"{WORK.get(kind, 'A step')} stopped: the shot folder {shot} was moved or deleted in the meantime.",
        "Finished work is still in that folder. Choose it at its new location and start again.",
        ExitCode.USAGE,
    )


def runs_job(pid: int, started: float, folder: Path) -> bool:
    """True if a process is certainly the job of a folder: it has this start, and its command line runs that job."""
    # The id in a file is not enough to end a process: the author of the file could name any process.
    found = process(pid) if pid > 1 else None
    if found is None or not started or found.started != started:
        return False
    _, separator, named_folder = found.command.rpartition(f" {JOB_COMMAND} ")
    try:
        return bool(separator) and os.path.isabs(named_folder) and os.path.samefile(named_folder, folder)
    except (OSError, ValueError):
        return False


def new_job(shot: ShotFolder | Path, kind: str, params: Any) -> Path:
    """Makes a job folder with its request in a shot; returns it.

    Args:
        shot: the shot folder. OSError if it cannot be written, FileNotFoundError if it is gone; JobError if its folder
            of jobs is a link.
        kind: a key of `PARAMS`.
        params: an object of the kind's dataclass, or a dict of its fields as in a request.
    """
    if not isinstance(params, (PARAMS[kind], dict)):
        raise ValueError(f"a {kind} job takes {PARAMS[kind].__name__}, not {type(params).__name__}")
    shot_folder = shot if isinstance(shot, ShotFolder) else ShotFolder(shot)
    folder = shot_folder.jobs / f"{time.strftime('%Y%m%d-%H%M%S')}-{kind}-{uuid.uuid4().hex[:6]}"
    shot_folder.own(shot_folder.jobs).mkdir(exist_ok=True)
    folder.mkdir()
    values = params if is_json_object(params) else dataclasses.asdict(params)
    request = JobRequest(kind=kind, shot=str(shot_folder.root), params=values)
    write_json(folder / REQUEST_FILE, dataclasses.asdict(request), parents=False)
    return folder
