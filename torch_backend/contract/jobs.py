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
"""Of status.json: 2 has the host."""
REQUEST_FILE = "request.json"
STATUS_FILE = "status.json"
EVENTS_FILE = "events.jsonl"
LOG_FILE = "log.txt"
CANCEL_FILE = "cancel"
FORECAST = "forecast"
"""Stage of a metric that says how long the stage `of` will take from then on: `seconds_left`."""
CAMERAS_KNOWN = "cameras known"
"""Stage of a metric that says that a running solve has written the shot's cameras: from then on they can be shown."""
STEP_FILE = "step"
"""Name of the panel's step that asked for the job; Blender's own."""
SCENE_FILE = "scene"
"""Name of the scene from which Blender started the job."""
BLEND_FILE = "blend"
"""Name of the .blend from which Blender started the job, without its folder; missing for an unsaved file."""
JOB_COMMAND = "-m torch_backend run-job"
"""How the process of a job was called, but for its Python and the job's folder."""
HEARTBEAT_SECONDS = 2.0
"""How often a living job rewrites status.json."""


class Reporter(Protocol):
    """How a station speaks while it works. Implemented by `job.JobReporter`; a class of it says nothing by itself."""

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
    """What Blender asks for: one station, on one shot."""

    kind: str
    """import, solve, train, freeze, mattes, combine, surface or light."""
    shot: str
    """Absolute path of the shot folder."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    """Fields of the kind's dataclass in `PARAMS`."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def typed_params(self) -> Any:
        """The parameters as their dataclass. ValueError names an unknown kind or field, or a value that cannot be."""
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
    """Counts from 0 within the job."""
    time: float
    """Seconds since the epoch."""
    data: dict[str, Any]
    """progress: stage, done, total, message, eta_seconds. metric: stage, values. image: label, path.
    warning: message, hint. error: message, hint, exit_code. done: state, result."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""


@dataclass
class Status:
    """status.json: where a job stands. Rewritten whole, at least every `HEARTBEAT_SECONDS` while it lives."""

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
    """Stage at work."""
    fraction: float = 0.0
    """Share of that stage that is finished, 0 to 1."""
    message: str = ""
    """What it is doing, or the error's sentence."""
    hint: str = ""
    """What to do about the error."""
    eta_seconds: float | None = None
    """Seconds left in this stage, if it can be told."""
    exit_code: int | None = None
    """Exit code once it has ended."""
    host: str = ""
    """Computer that the job runs on, as `computer_name` says; empty in files from before version 2."""
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
    "mattes": "The job of the mattes",
    "surface": "The job of the surface",
    "light": "The job of the light",
    "combine": "The job that combines takes",
}
"""Kind of job -> what a sentence calls it."""


def gone(shot: Path, kind: str) -> JobError:
    """The error of a job whose shot was moved or deleted while it ran."""
    return JobError(
        f"{WORK.get(kind, 'A step')} ended: the shot folder {shot} was moved or deleted meanwhile.",
        "Finished work is in the folder, wherever it is now: choose it there and start again.",
        ExitCode.USAGE,
    )


def runs_job(pid: int, started: float, folder: Path) -> bool:
    """True if a process is the job of a folder beyond doubt: its start, and a command line that runs that job.

    A process is never ended because a file names it: the author of the file could have any process ended.
    """
    found = process(pid) if pid > 1 else None
    if found is None or not started or found.started != started:
        return False
    _, ours, named_folder = found.command.rpartition(f" {JOB_COMMAND} ")
    try:
        return bool(ours) and os.path.isabs(named_folder) and os.path.samefile(named_folder, folder)
    except (OSError, ValueError):
        return False


def new_job(shot: ShotFolder | Path, kind: str, params: Any) -> Path:
    """Makes a job folder with its request in a shot; returns it.

    Args:
        shot: the shot folder. OSError, FileNotFoundError among them, if it cannot be written or is gone; JobError if
            its jobs would go through a link to elsewhere.
        kind: of `PARAMS`.
        params: the kind's dataclass; a dict of its fields as a request holds them.
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
