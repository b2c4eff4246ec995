"""What crosses the wall between Blender and the backend. Standard library only: both sides read this file.

A job is a folder: Blender writes `request.json` and starts `python -m torch_backend run-job FOLDER`; the backend
appends events to `events.jsonl`, rewrites `status.json`, and stops when a file named `cancel` appears.
Everything here carries a version; a newer version than ours is refused in words, an older one is migrated.

Frames of reference, here as everywhere: camera axes OpenCV (x right, y down, z forward), `viewmat` world-to-camera,
row-major; `K` = (fx, fy, cx, cy) in pixels, pixel centres at +0.5; frame numbers are those of the clip.
"""

from __future__ import annotations

import _thread
import calendar
import contextlib
import dataclasses
import enum
import functools
import hashlib
import json
import math
import os
import re
import shutil
import signal
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
import typing
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

CONTRACT_VERSION = 1
STATUS_VERSION = 2
"""Of status.json: 2 has the host."""

REQUEST_FILE = "request.json"
STATUS_FILE = "status.json"
EVENTS_FILE = "events.jsonl"
LOG_FILE = "log.txt"
CANCEL_FILE = "cancel"
WRITER_FILE = "lock.json"
JOB_COMMAND = "-m torch_backend run-job"
"""How the process of a job was called, but for its Python and the job's folder."""

HEARTBEAT_SECONDS = 2.0
"""How often a living job rewrites status.json."""
GRACE_SECONDS = 30.0
"""How long a cancelled process may take for its checkpoint before it is ended by force."""
LAST_FRAME = 1_048_574
"""Blender's last frame number: no scene reaches further."""
LONGEST_JSON = 1 << 28
"""Bytes of a JSON file that are read; the listing of a clip of 100,000 frames takes a tenth."""
SHORT_JSON = 1 << 20
"""Bytes of a file that Blender reads between two turns of its timer: a status, a run's figures."""
LONGEST_LINE = 1 << 20
"""Bytes of a line of events.jsonl or metrics.jsonl that are read."""


class ExitCode(enum.IntEnum):
    """Exit codes of every command, documented in docs/troubleshooting.md."""

    OK = 0
    INTERNAL = 1
    USAGE = 2
    FOOTAGE = 3
    SOLVE = 4
    TRAIN = 5
    FREEZE = 6
    BAKE = 7
    DISK = 8
    ENVIRONMENT = 9
    CANCELLED = 130


class JobError(Exception):
    """A failure that an artist reads: what was wrong and where, in one sentence, and what to do about it."""

    def __init__(self, message: str, hint: str = "", exit_code: int = ExitCode.INTERNAL) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = int(exit_code)


class Cancelled(Exception):
    """Raised by `Reporter.check_cancelled` when someone asked the job to stop."""


class Reporter(Protocol):
    """How a station speaks while it works. Implemented by `job.JobReporter` and by the command line."""

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """`done` of `total` units of `stage` are finished."""

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        """Figures of the run, units in the key names."""

    def image(self, label: str, path: str | Path) -> None:
        """A picture worth showing was written."""

    def warning(self, message: str, hint: str = "") -> None:
        """Something the artist should know; the job goes on."""

    def check_cancelled(self) -> None:
        """Raises `Cancelled` if a stop was asked for."""


# ------------------------------------------------------------------------------------------------- job requests


@dataclass
class ImportParams:
    """Footage into a shot folder."""

    source: str = ""
    """Video file, image of a sequence, folder of images, or a pattern such as shot.####.exr."""
    first: int | None = None
    """First frame number of the clip to take; None: the first there is."""
    last: int | None = None
    """Last frame number to take, inclusive; None: the last there is."""
    step: int = 0
    """Every how many frames are solved and trained on; 0 chooses. All frames are delivered whatever it is."""
    working_height: int = 0
    """Height in pixels of the working frames; 0: the source's, at most 720."""
    fps: float = 0.0
    """Frames per second of a sequence; 0: the footage's own, 24 for a sequence that says none."""
    layer: str = ""
    """Layer or part of a sequence's pictures to take, by its name or the end of it; empty: the picture itself."""


@dataclass
class SolveParams:
    """Cameras from the working frames."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model: SIMPLE_RADIAL or OPENCV (strong or tangential distortion)."""
    overlap: int = 15
    """Each solved frame is matched with this many following ones (and with quadratically spaced ones beyond)."""
    cameras: str = ""
    """Cameras to take instead of solving: a COLMAP model's folder, a nerfstudio transforms.json, or a CameraPath.
    Pictures are matched to frames by number. Empty: solve."""


@dataclass
class TrainParams:
    """One run of the trainer."""

    run: str = "main"
    """Name of the run's folder in runs/."""
    preset: str = "preview"
    """preview, standard or final."""
    method: str = "auto"
    """auto (the host behind the gate), static, or a host whose field moves all: hexplane, mlp, control_points."""
    host: str = "hexplane"
    """Which host `auto` puts behind the gate."""
    host_config: str = "default"
    """default (ours) or reference (the published sizes, rates and schedules, as shares of the run)."""
    supervision: str = "support"
    """support, paper or none: which anchoring losses hold ill-supervised Gaussians."""
    detector: str = "grad_norm"
    """`paper`, who is ill-supervised: weight, grad_norm, or grad_signed (the published code's signed sum)."""
    iterations: int = 0
    """Training steps; 0: the preset's."""
    width: int = 0
    """Width in pixels of the training images; 0: the preset's."""
    max_gaussians: int = 0
    """Budget of Gaussians; 0: the preset's."""
    holdout: int = -1
    """Every how many frames one is kept out for testing; 0: none, -1: the preset's choice."""
    seed: int = 0
    """Random seed."""
    resume: bool = True
    """Go on from the run's checkpoint if there is one."""
    device: str = "auto"
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used. A run may go on on another device."""
    extend: int = 0
    """Steps to add to a finished run, whose own settings are kept; 0: none."""


PRESET_STEPS = {"preview": 2000, "standard": 9000, "final": 30_000}
"""Training steps of each preset."""
PRESET_WIDTHS = {"preview": 320, "standard": 640, "final": 1280}
"""Width in pixels of each preset's training images, never above the working frames'."""
HOSTS = ("control_points", "hexplane", "mlp")
"""Hosts of the deformation, as their files in deformation/ name themselves."""
METHODS = ("auto", *HOSTS, "static")
"""What `TrainParams.method` may be."""
HOST_CONFIGS = ("default", "reference")
"""What `TrainParams.host_config` may be."""
SUPERVISIONS = ("support", "paper", "none")
"""What `TrainParams.supervision` may be."""
DETECTORS = ("weight", "grad_norm", "grad_signed")
"""What `TrainParams.detector` may be."""


@dataclass
class FreezeParams:
    """Frozen frames from a run."""

    run: str = "main"
    """Run to freeze."""
    take: str = "freeze"
    """Name of the take's folder in takes/."""
    t_star: int | None = None
    """Frame number of the clip at which time stands still; None: suggested from support and sharpness."""
    t_star_per_frame: dict[str, float] = field(default_factory=dict)
    """Clip frame number -> t* as a frame number, one per output frame: freeze ramps. Overrides `t_star`."""
    first: int | None = None
    """First output frame; None: the clip's first."""
    last: int | None = None
    """Last output frame, inclusive; None: the clip's last."""
    step: int = 1
    """Every how many frames, from `first`, one is rendered. Frames of the take that were rendered before stay."""
    camera_path: str = ""
    """JSON file of a CameraPath, in solve units, to render from; empty: the clip's own poses."""
    query: str = "nearest"
    """nearest: each Gaussian is asked at its nearest supported time to t*; plain: at t* itself."""
    width: int = 0
    """Width in pixels of the frozen frames; 0: the source's own."""
    detail: str = "on"
    """on: frozen frames are made of the plates, where they can be believed; off: of the splats alone."""
    develop: str = "on"
    """on: the instant is trained on as the still scene that it is, and kept with the run; off: it stays as the run has
    it. Of keyed instants, six at most."""
    overscan: float = 0.0
    """Picture beyond the frame on every side, in percent of its width and height; -1: what the way back through the
    lens needs. `width` is that of the frame without it."""
    only_missing: bool = False
    """Keep frames of the take that are already rendered from the same run, t* and camera."""
    grain: bool = True
    """Write the plate's grain, measured and drawn anew for every frame, as a layer of its own beside the picture."""
    device: str = "auto"
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


def overscan(text: str) -> float:
    """`FreezeParams.overscan` as a command line gives it: 0 to 100 percent, or "lens" (-1). ValueError on else."""
    try:
        value = -1.0 if text == "lens" else float(text)
    except ValueError:
        value = math.nan
    if text != "lens" and not 0.0 <= value <= 100.0:
        raise ValueError(f"overscan is 0 to 100 percent, or lens, got {text!r}")
    return value


SWITCH = ("on", "off")
"""What `FreezeParams.detail` and `FreezeParams.develop` may be."""
DEVICES = ("auto", "cpu", "cuda")
"""Where a run may train and freeze."""

PARAMS: dict[str, type] = {
    "import": ImportParams,
    "solve": SolveParams,
    "train": TrainParams,
    "freeze": FreezeParams,
}
"""Kind of job -> the dataclass of its parameters."""


@dataclass(frozen=True)
class Limit:
    """What a number among a job's parameters may be."""

    what: str
    """What a sentence calls it."""
    low: float
    """Least."""
    high: float
    """Most."""
    also: Mapping[int, str] = field(default_factory=dict)
    """Values outside of that which have a meaning -> what they are for."""


_FRAMES = ((1 << 31) - 1) * 1.0
_PRESET = {0: "the preset's"}
LIMITS: dict[type, dict[str, Limit]] = {
    ImportParams: {
        "first": Limit("first frame", -_FRAMES, _FRAMES),
        "last": Limit("last frame", -_FRAMES, _FRAMES),
        "step": Limit("step between solved frames", 1, 100_000, {0: "one that is chosen"}),
        "working_height": Limit("height of the working frames", 16, 16_384, {0: "the source's"}),
    },
    SolveParams: {"overlap": Limit("number of following frames that are matched", 1, 1000)},
    TrainParams: {
        "iterations": Limit("number of training steps (iterations)", 10, 10_000_000, _PRESET),
        "width": Limit("width of the training images", 16, 16_384, _PRESET),
        "max_gaussians": Limit("budget of Gaussians", 100, 20_000_000, _PRESET),
        "holdout": Limit("distance between held-out frames", 2, 1_000_000, {0: "none", -1: "the preset's"}),
        "seed": Limit("random seed", 0, (1 << 53) - 1),
        "extend": Limit("number of steps to add", 1, 10_000_000, {0: "none"}),
    },
    FreezeParams: {
        "t_star": Limit("t*", -_FRAMES, _FRAMES),
        "t_star_per_frame": Limit("t* of a frame", -_FRAMES, _FRAMES),
        "first": Limit("first frame", -_FRAMES, _FRAMES),
        "last": Limit("last frame", -_FRAMES, _FRAMES),
        "step": Limit("step between frozen frames", 1, 1_000_000),
        "width": Limit("width of the frozen frames", 16, 16_384, {0: "the source's"}),
        "overscan": Limit("overscan in percent", 0, 100, {-1: "what the lens needs"}),
    },
}
"""The numbers of each kind of parameters, by field."""


def check_params(params: Any) -> None:
    """ValueError, in a sentence, names the first number of a job's parameters that is out of its `LIMITS`."""
    for name, limit in LIMITS.get(type(params), {}).items():
        given = getattr(params, name)
        values = given.values() if isinstance(given, dict) else (given,)
        for value in values:
            if value is None or value in limit.also or limit.low <= value <= limit.high:  # NaN is none of them
                continue
            also = "".join(f", or {value} for {meaning}" for value, meaning in limit.also.items())
            message = f"The {limit.what} is {value}: it should be {limit.low:.0f} to {limit.high:.0f}{also}."
            raise ValueError(message)
    odd = [key for key in getattr(params, "t_star_per_frame", {}) if not key.lstrip("-").isdecimal()]
    if odd:
        raise ValueError(f"t* is given for frame {odd[0]!r}: it should be the number of a frame.")


@dataclass
class JobRequest:
    """What Blender asks for: one station, on one shot."""

    kind: str
    """import, solve, train or freeze."""
    shot: str
    """Absolute path of the shot folder."""
    params: dict[str, Any] = field(default_factory=dict)
    """Fields of the kind's dataclass in `PARAMS`."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def typed_params(self) -> Any:
        """The parameters as their dataclass. ValueError names an unknown kind or field, or a value that cannot be."""
        if self.kind not in PARAMS:
            raise ValueError(f"unknown job kind {self.kind!r}: expected one of {', '.join(PARAMS)}")
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
    """Computer that the job runs on, as `host_name` says; empty in files from before version 2."""
    version: int = STATUS_VERSION
    """Version of this file."""

    @property
    def ended(self) -> bool:
        """True once the job will write nothing more."""
        return self.state in ("done", "failed", "cancelled")


# ------------------------------------------------------------------------------------------------- one writer


@dataclass
class Writer:
    """lock.json of a shot: who writes into it. There is none while nobody does."""

    host: str
    """Computer that it runs on, as `host_name` says."""
    pid: int
    """Its process."""
    process_started: float
    """`Process.started` of it."""
    kind: str
    """Kind of job."""
    job: str
    """Name of the job's folder."""
    since: float
    """When it took the shot, seconds since the epoch."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def works(self) -> bool:
        """True if its process lives, stopped or not. That of another computer is never said not to."""
        return self.host != host_name() or runs_still(self.pid, self.process_started)


WORK = {"import": "The import", "solve": "The camera solve", "train": "The training", "freeze": "The freeze"}
"""Kind of job -> what a sentence calls it."""


def gone(shot: Path, kind: str) -> JobError:
    """What is told of a job whose shot was moved or deleted while it ran."""
    return JobError(
        f"{WORK.get(kind, 'A step')} ended: the shot folder {shot} was moved or deleted meanwhile.",
        "Finished work is in the folder, wherever it is now: choose it there and start again.",
        ExitCode.USAGE,
    )


def read_writer(shot: Path) -> Writer | None:
    """Who writes into a shot, as its lock says, dead or alive; None without a lock. ValueError on a damaged one."""
    path = shot / WRITER_FILE
    try:
        data = read_json(path, SHORT_JSON)
    except FileNotFoundError:
        return None
    check_version(data, str(path))
    return from_dict(Writer, data)


def gives_back(shot: Path, writer: Writer) -> bool:
    """True if the job that holds the shot has told its end: it lets go of the lock in a moment."""
    try:
        status = read_json(shot / "jobs" / checked_name(writer.job, "job") / STATUS_FILE, SHORT_JSON)
    except (OSError, ValueError):
        return False
    return status.get("state") in ("done", "failed", "cancelled") and status.get("pid") == writer.pid


def busy(shot: Path, writer: Writer) -> JobError:
    """What the second one who would write into a shot is told: who does, since when, where, and what to do."""
    try:
        now, then = time.localtime(), time.localtime(writer.since)
        since = time.strftime("%H:%M" if now[:3] == then[:3] else "%Y-%m-%d %H:%M", then)
    except (OSError, OverflowError, ValueError):
        since = "an unknown time"
    what, where = WORK.get(writer.kind, "A step"), printable(writer.host.partition(" (")[0], 80)
    hint, lock = "Wait for it or cancel it.", shot / WRITER_FILE
    if writer.host != host_name():
        hint = f"Wait for it or cancel it there. If {where} surely works on it no longer, delete {lock}."
    return JobError(f"{what} of {shot.name} has been running on {where} since {since}.", hint, ExitCode.USAGE)


# ------------------------------------------------------------------------------------------------- camera paths


@dataclass
class CameraFrame:
    """One pose of a camera path."""

    frame: int
    """Frame number of the clip (or of the Blender scene, for a path from Blender)."""
    viewmat: list[float]
    """16 floats, world-to-camera, row-major, OpenCV axes, solve units."""
    K: list[float]
    """fx, fy, cx, cy in pixels of the path's width and height."""
    source: str = "registered"
    """registered (by the mapper, or given), localised (against the model), interpolated, or blender."""

    def __post_init__(self) -> None:
        if len(self.viewmat) != 16 or len(self.K) != 4:
            raise ValueError(f"camera frame {self.frame}: viewmat needs 16 numbers and K needs 4")
        if not all(math.isfinite(v) for v in (*self.viewmat, *self.K)):
            raise ValueError(f"camera frame {self.frame}: viewmat or K is not finite")


@dataclass
class CameraPath:
    """A pinhole camera over frames: the solve's answer, or a path that Blender sends."""

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    frames: list[CameraFrame]
    """Poses by ascending frame number."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def to_json(self) -> dict[str, Any]:
        """Plain types, for `json.dump`."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> CameraPath:
        """Inverse of `to_json`; ValueError on an unknown version or malformed frames."""
        check_version(data, "camera path")
        missing = {"width", "height", "frames"} - set(data)
        if missing:
            raise ValueError(f"camera path has no {min(missing)}")
        frames = [from_dict(CameraFrame, f) for f in data["frames"]]
        numbers = [f.frame for f in frames]
        if numbers != sorted(set(numbers)):
            raise ValueError("camera path should list its frames once each, in ascending order")
        if not (int(data["width"]) > 0 and int(data["height"]) > 0):
            raise ValueError(f"camera path is {data['width']} x {data['height']} pixels: both should be above 0")
        return CameraPath(int(data["width"]), int(data["height"]), frames)

    @staticmethod
    def load(path: str | Path) -> CameraPath:
        """Reads a path; FileNotFoundError or ValueError names the file."""
        data = read_json(path)
        try:
            return CameraPath.from_json(data)
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"{path} holds no camera path: {error}") from error


# ------------------------------------------------------------------------------------------------- live session


@dataclass
class LiveView:
    """What a live session is asked to draw: one view of the frozen scene."""

    view: int
    """Which of the asker's views it is for; a newer request for the same view takes an older one's place."""
    seq: int
    """Given back with the frame."""
    viewmat: list[float]
    """16 floats, world-to-camera, row-major, OpenCV axes, solve units."""
    K: list[float]
    """fx, fy, cx, cy in pixels of `width` x `height`."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    t_star: float
    """Frame number of the clip at which time stands still."""
    exposed_like: float | None = None
    """Frame number whose exposure the camera has; None: t*'s."""
    show: str = "color"
    """color; guesses: colour, tinted where nobody saw it near t*; support or motion: that matte as a grey picture."""
    detail: bool = False
    """Make it of the plates, as a take is: it takes longer, and waits for all views that are not. Of `color` alone."""
    develop: bool = True
    """Show the instant developed, if it has been: see `FreezeParams.develop`."""

    def __post_init__(self) -> None:
        if len(self.viewmat) != 16 or len(self.K) != 4:
            raise ValueError("a live view needs 16 numbers of viewmat and 4 of K")
        if not all(math.isfinite(v) for v in (*self.viewmat, *self.K, self.t_star)):
            raise ValueError("a live view is not finite")
        if not (0 < self.width <= LIVE_LIMIT and 0 < self.height <= LIVE_LIMIT):
            raise ValueError(f"a live view is {self.width} x {self.height} pixels: 1 to {LIVE_LIMIT} can be drawn")
        if self.show not in LIVE_SHOWS:
            raise ValueError(f"show is {self.show!r}: it should be one of {', '.join(LIVE_SHOWS)}")


LIVE_LIMIT = 8192
"""Most pixels of a live view along a side."""
LIVE_SHOWS = ("color", "guesses", "support", "motion")
"""What a live view can show."""
_MESSAGE = struct.Struct("<4sIQ")
"""Before every message: a mark, bytes of the header, bytes of the body."""
_MARK = b"SPL1"
_LONGEST = (1 << 20, 1 << 31)


def write_message(stream: BinaryIO, header: Mapping[str, Any], body: bytes | memoryview = b"") -> None:
    """Writes one message of a live session: a JSON object, then raw bytes. The stream's own errors pass through."""
    text = json.dumps(header, allow_nan=False).encode()
    stream.write(_MESSAGE.pack(_MARK, len(text), len(body)) + text)
    stream.write(body)
    stream.flush()


def read_message(stream: BinaryIO) -> tuple[dict[str, Any], bytes] | None:
    """The next message of a live session, as (header, body); None at the end of the stream.

    ValueError on anything else than a message: what follows it cannot be understood either.
    """
    start = _read_exactly(stream, _MESSAGE.size)
    if start is None:
        return None
    mark, long, size = _MESSAGE.unpack(start)
    if mark != _MARK or long > _LONGEST[0] or size > _LONGEST[1]:
        raise ValueError("the live session's stream holds something that is no message")
    text, body = _read_exactly(stream, long), _read_exactly(stream, size)
    if text is None or body is None:
        return None
    header = json.loads(text)
    if not isinstance(header, dict):
        raise ValueError("a live message's header should be a JSON object")
    return header, body


def _read_exactly(stream: BinaryIO, count: int) -> bytes | None:
    parts, missing = [], count
    while missing:
        part = stream.read(missing)
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


# ------------------------------------------------------------------------------------------------- processes


def python_child(python: str | Path, module: str, *words: str) -> dict[str, Any]:
    """`args` and `cwd` of the `Popen` that runs a module of ours; paths in `words` should be absolute.

    Python takes modules from the folder that it stands in, and a shot folder may come from anywhere: -P says no. The
    child stands beside its interpreter, where nobody puts files for it: a loader of libraries still looks there
    (Windows always, Linux with an empty entry in LD_LIBRARY_PATH). It is neither the shot's folder nor the extension's:
    Windows keeps the folder that a process stands in from being moved or removed.
    """
    python = os.path.abspath(python)
    return {"args": [python, "-P", "-m", module, *words], "cwd": os.path.dirname(python)}


def end_with_starter(grace_seconds: float = GRACE_SECONDS) -> None:
    """Stops this process, as Ctrl-C does, once its standard input closes: its starter holds that open, however it ends.

    A checkpoint may take `grace_seconds`; then the process ends at once, with the group that it leads (POSIX).
    """
    starter = os.dup(0)
    # Nobody else has it: on Windows a child of ours that inherits a pipe hangs at its start while we read from that.
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    watch = functools.partial(_stop_when_alone, starter, grace_seconds)
    threading.Thread(target=watch, name="end with starter", daemon=True).start()


def _stop_when_alone(starter: int, grace_seconds: float) -> None:
    with contextlib.suppress(OSError):
        while os.read(starter, 1):
            pass
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:  # a signal of its own also ends a wait of the main thread
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    time.sleep(grace_seconds)
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(ExitCode.CANCELLED)


def program(name: str) -> str | None:
    """Absolute path of a program on the PATH; None if there is none, or if the folder we stand in has one to offer.

    `shutil.which` looks into that folder first on Windows, and it may be one that came with a .blend or a clip.
    """
    found = shutil.which(name)
    return found if found and os.path.isabs(found) else None


@functools.cache
def host_name() -> str:
    """This computer as files name it: its name, and in brackets what tells it from another one of the same name.

    On Linux that is a hash of the machine's id and, in a container, of its process ids' namespace; on Windows of the
    machine's GUID; elsewhere there is none.
    """
    marks = []
    if sys.platform == "win32":
        import winreg

        with contextlib.suppress(OSError):
            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, r"SOFTWARE\Microsoft\Cryptography") as known:
                marks.append(str(winreg.QueryValueEx(known, "MachineGuid")[0]))
    else:
        with contextlib.suppress(OSError):
            marks.append(Path("/etc/machine-id").read_text(encoding="ascii", errors="replace").strip())
        with contextlib.suppress(OSError):
            marks.append(os.readlink("/proc/self/ns/pid"))
    mark = hashlib.sha256("\n".join(marks).encode()).hexdigest()[:8]
    return f"{socket.gethostname()} ({mark})" if any(marks) else socket.gethostname()


@dataclass(frozen=True)
class Process:
    """What the system says of a living process."""

    started: float
    """When it started, in the system's own unit: only to be compared with another answer. 0 if it does not tell."""
    command: str
    """Its command line, arguments separated by spaces; empty if the system does not tell."""


def process(pid: int) -> Process | None:
    """A living process of this computer; None if there is none of that id. Standard library, on all three systems."""
    if not (isinstance(pid, int) and 0 < pid < 1 << 31):
        return None
    if sys.platform == "win32":
        return _process_of_windows(pid)
    try:
        os.kill(pid, 0)  # asks only: no signal is sent
    except ProcessLookupError:
        return None
    except OSError:
        pass  # somebody else's, but there
    return _process_of_proc(pid) if Path("/proc/self/stat").exists() else process_of_ps(pid)


def process_start(pid: int) -> float:
    """`Process.started` of a process; 0 if there is none or the system does not tell."""
    found = process(pid)
    return found.started if found is not None else 0.0


def runs_still(pid: int, started: float) -> bool:
    """True if a process of this computer lives that has this id and start; one that is only stopped does.

    Where the system tells no start, a process of this id is taken for it: a job is not declared dead on a guess.
    """
    found = process(pid)
    return found is not None and (not found.started or not started or found.started == started)


def _process_of_proc(pid: int) -> Process | None:
    """From /proc. Start in clock ticks since boot."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        if fields[0] in ("Z", "X"):
            return None  # it has ended: only its exit code is kept for its parent
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        return Process(float(fields[19]), " ".join(os.fsdecode(word) for word in words).rstrip(" "))
    except (OSError, ValueError, IndexError):
        return Process(0.0, "")  # hidden from us, or ending just now


def process_of_ps(pid: int) -> Process | None:
    """From `ps`, on systems without /proc (macOS). Start in seconds since the epoch, whole ones."""
    command = ["/bin/ps", "-ww", "-o", "stat=,lstart=,command=", "-p", str(pid)]
    environ = {"LC_ALL": "C", "TZ": "UTC0", "PATH": "/usr/bin:/bin"}
    try:
        # close_fds=False: macOS then spawns it without copying the parent, which may be a heavy Blender.
        told = subprocess.run(command, capture_output=True, env=environ, close_fds=False, timeout=5.0, check=False)
        state, _, month, day, clock, year, line = os.fsdecode(told.stdout).strip("\n").split(None, 6)
        if state.startswith("Z"):
            return None
        hours, minutes, seconds = map(int, clock.split(":"))
        when = (int(year), _MONTHS.index(month) + 1, int(day), hours, minutes, seconds)
    except (OSError, ValueError, subprocess.SubprocessError):
        return Process(0.0, "")
    return Process(float(calendar.timegm((*when, 0, 0, 0))), line)


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def _process_of_windows(pid: int) -> Process | None:
    """From the Windows API. Start in units of 100 ns since 1601; the command line since Windows 8.1."""
    if sys.platform != "win32":
        return None
    import ctypes
    from ctypes import wintypes

    class UnicodeString(ctypes.Structure):
        _fields_ = [("length", wintypes.USHORT), ("room", wintypes.USHORT), ("text", ctypes.c_void_p)]

    kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    kernel.OpenProcess.restype = wintypes.HANDLE
    opened = kernel.OpenProcess(wintypes.DWORD(0x1000), False, wintypes.DWORD(pid))  # PROCESS_QUERY_LIMITED_INFORMATION
    if not opened:
        return None if ctypes.get_last_error() == 87 else Process(0.0, "")  # ERROR_INVALID_PARAMETER: no such process
    handle = wintypes.HANDLE(opened)
    try:
        code, times = wintypes.DWORD(), [wintypes.FILETIME() for _ in range(4)]
        if kernel.GetExitCodeProcess(handle, ctypes.byref(code)) and code.value != 259:  # STILL_ACTIVE
            return None
        told = kernel.GetProcessTimes(handle, *(ctypes.byref(time) for time in times))
        started = times[0].dwHighDateTime << 32 | times[0].dwLowDateTime if told else 0
        room, needed = ctypes.create_string_buffer(1 << 17), wintypes.ULONG()
        query = ctypes.WinDLL("ntdll").NtQueryInformationProcess  # 60: ProcessCommandLineInformation
        if query(handle, 60, room, wintypes.ULONG(len(room)), ctypes.byref(needed)):
            return Process(float(started), "")
        line = UnicodeString.from_buffer(room)
        text = ctypes.string_at(line.text, line.length).decode("utf-16-le", "replace") if line.text else ""
        return Process(float(started), text.replace('"', ""))
    finally:
        kernel.CloseHandle(handle)


def runs_job(pid: int, started: float, folder: Path) -> bool:
    """True if a process is the job of a folder beyond doubt: its start, and a command line that runs that job.

    A file's word for a process is not enough to end it: whoever wrote the file could have anything ended.
    """
    found = process(pid) if pid > 1 else None
    if found is None or not started or found.started != started:
        return False
    _, ours, told = found.command.rpartition(f" {JOB_COMMAND} ")
    try:
        return bool(ours) and os.path.isabs(told) and os.path.samefile(told, folder)
    except (OSError, ValueError):
        return False


# ------------------------------------------------------------------------------------------------- reading


def check_version(data: Mapping[str, Any], what: str, newest: int = CONTRACT_VERSION) -> None:
    """ValueError, in words, if `data` was written by a newer Splannequin."""
    version = data.get("version", 1)
    if not isinstance(version, int) or version > newest:
        raise ValueError(
            f"{what} has version {_short(version)}, this Splannequin reads up to {newest}: "
            "update the add-on and its backend"
        )


def open_regular(path: str | Path) -> BinaryIO:
    """Opens a regular file (or a link to one) for reading, without ever waiting for it.

    A shot folder may come from anywhere: a pipe would hold up Blender's main thread, a device would fill its memory.
    FileNotFoundError or another OSError of the system's; ValueError names a path that holds something else.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    # One owner of the handle from the start: closed twice, by us and by a file object that goes, an interrupt between
    # the two would read as a fault of the disk.
    try:
        source = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115 -- it is what we return
    except IsADirectoryError:
        raise ValueError(f"{path} is not a file: remove it") from None
    try:
        if not stat.S_ISREG(os.fstat(source.fileno()).st_mode):
            raise ValueError(f"{path} is not a file: remove it")
    except BaseException:
        source.close()
        raise
    return source


def read_json(path: str | Path, longest: int = LONGEST_JSON) -> dict[str, Any]:
    """A JSON object from a file of at most `longest` bytes.

    FileNotFoundError, or ValueError naming the file and what is wrong in it.
    """
    with open_regular(path) as source:
        text = source.read(longest + 1)
    if len(text) > longest:
        raise ValueError(f"{path} is longer than {longest >> 20} MB: nothing of ours is")
    try:
        data = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:  # ValueError: no JSON, no UTF-8, or a number of too many digits
        raise ValueError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path} should hold a JSON object, found {type(data).__name__}")
    return data


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def read_lines(
    path: str | Path, start: int = 0, longest: int = LONGEST_LINE
) -> Generator[tuple[bytes, int], None, None]:
    """Whole lines of a file that grows, from a byte on: (line, where the next one begins).

    One longer than `longest` bytes is passed over: (b"", where it goes on). OSError or ValueError as `open_regular`.
    """
    with open_regular(path) as source:
        source.seek(start)
        inside = False  # of a line that is too long
        while line := source.readline(longest):
            start += len(line)
            whole = line.endswith(b"\n")
            if not whole and len(line) < longest:
                return  # half written: it is read with the next call
            yield (line if whole and not inside else b""), start
            inside = not whole


def measured(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """(seconds of training, dB on frames kept out) of a measurement; None if it is none, or holds no plain numbers."""
    seconds, quality = row.get("seconds"), row.get("heldout_psnr_db")
    if any(isinstance(v, bool) or not isinstance(v, (int, float)) or not abs(v) < 1e9 for v in (seconds, quality)):
        return None
    return float(seconds), float(quality)  # pyright: ignore[reportArgumentType]


def printable(text: str, longest: int = 2000) -> str:
    """Text from a file as it may be shown or printed: no escape codes or other control characters, and not endless."""
    return "".join(c if c.isprintable() else " " for c in text[:longest])


def checked_name(name: str, what: str) -> str:
    """`name` if it is safe as a folder name on every system; ValueError otherwise."""
    if not _NAME.fullmatch(name) or name.endswith((".", " ")):
        raise ValueError(f"{what} name {name!r} should be 1 to 64 letters, digits, spaces, '.', '_' or '-'")
    if name.partition(".")[0].rstrip().upper() in _DEVICES:
        raise ValueError(f"{what} name {name!r} is the name of a device on Windows: choose another one")
    return name


_NAME = re.compile(r"\w[\w .-]{0,63}")
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in "0123456789¹²³")}


def frame_number(stem: str) -> int | None:
    """Number of a frame's file by its name without suffix; None if it is no such file."""
    return int(stem) if _NUMBER.fullmatch(stem) else None


_NUMBER = re.compile(r"-?[0-9]{1,9}")


def is_link(path: Path) -> bool:
    """True for a symbolic link, and on Windows for a junction, whether or not it leads anywhere."""
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == _JUNCTION


def remove_link(path: Path) -> None:
    """Removes a link, never what it leads to."""
    if sys.platform == "win32" and path.is_dir():
        os.rmdir(path)  # how Windows removes a link to a folder
    else:
        os.unlink(path)


_JUNCTION = 0xA0000003
"""stat.IO_REPARSE_TAG_MOUNT_POINT, which only Windows has: its link between folders."""


def from_dict(cls: type, data: Mapping[str, Any]) -> Any:
    """A dataclass from plain JSON. ValueError names an unknown or missing field, or a value of the wrong type."""
    hints = _hints(cls)
    unknown = set(data) - set(hints)
    if unknown:
        raise ValueError(f"{cls.__name__} has no field {sorted(unknown)[0]!r}: it has {', '.join(hints)}")
    missing = _needed(cls) - set(data)
    if missing:
        raise ValueError(f"{cls.__name__} has no {min(missing)}")
    values = {name: _checked(cls.__name__, name, hints[name], value) for name, value in data.items()}
    try:
        return cls(**values)
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{cls.__name__}: {error}") from error


@functools.cache
def _needed(cls: type) -> set[str]:
    """Fields that have no default."""
    none = dataclasses.MISSING
    return {f.name for f in dataclasses.fields(cls) if f.default is none and f.default_factory is none}


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """Asked for once per class: a camera path makes hundreds of frames on Blender's main thread."""
    return typing.get_type_hints(cls)


def _checked(owner: str, name: str, hint: Any, value: Any) -> Any:
    """`value` if it fits the annotation; ints are taken for floats, bools never for numbers."""
    accepted = typing.get_args(hint) if type(None) in typing.get_args(hint) else (hint,)
    for option in accepted:
        base = typing.get_origin(option) or option
        if base is Any or (base is type(None) and value is None):
            return value
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if base is float and number and abs(value) < _LARGEST_FLOAT:
            return float(value)
        if base is int:
            if number and isinstance(value, int) and abs(value) < _LARGEST_INT:
                return value
        elif base is not float and isinstance(base, type) and isinstance(value, base):
            return value
    raise ValueError(f"{owner}.{name} cannot be {_short(value)}")


_LARGEST_FLOAT, _LARGEST_INT = 1e300, 1 << 53
"""What JSON cannot hold without loss, or is no number (NaN, infinity), comes from no file of ours."""


def _short(value: Any) -> str:
    """A value as a sentence names it."""
    if isinstance(value, (list, dict)):
        return f"a {'list' if isinstance(value, list) else 'JSON object'}"
    if isinstance(value, int) and abs(value) >= _LARGEST_INT:
        return "a number that large"
    return repr(value if not isinstance(value, str) else printable(value, 80))


# ------------------------------------------------------------------------------------------------- frozen frames

EXR_LAYERS = ("Combined", "Depth", "Support", "Motion")
"""Passes of a frozen frame: premultiplied scene-linear RGBA, planar depth in solve units, two mattes in [0, 1]."""

NO_DEPTH = 1e10
"""Depth of a pixel that nothing covers (what Blender's own Z pass says)."""


# ------------------------------------------------------------------------------------------------- what came out

VERDICT_WORDS = {"good": "Good.", "fair": "Fair.", "poor": "Poor."}
"""Good: it holds. Fair: it holds but for what is named. Poor: it is not worth going on from. As they are shown."""
_MOST_LINES = 12


@dataclass
class Verdict:
    """What an artist should know of a run or a take; stands in a run's summary.json and in a take.json."""

    word: str
    """One of `VERDICT_WORDS`."""
    sentences: list[str]
    """What is so."""
    where: list[dict[str, Any]] = field(default_factory=list)
    """Where it will not hold, worst first: `first` and `last` frame number, and `region` of the picture in words."""
    advice: list[str] = field(default_factory=list)
    """What to do about it."""

    def lines(self) -> list[str]:
        """All of it as it is printed and drawn; the word stands before the first sentence."""
        return [f"{VERDICT_WORDS[self.word]} {self.sentences[0]}", *self.sentences[1:], *self.advice]


def verdict_of(told: Mapping[str, Any]) -> Verdict | None:
    """The verdict in a summary.json or take.json, which may come from anywhere; None if there is none to be shown."""
    data = told.get("verdict")
    if not isinstance(data, dict):
        return None
    try:
        found: Verdict = from_dict(Verdict, data)
    except ValueError:
        return None
    texts = [*found.sentences, *found.advice]
    if found.word not in VERDICT_WORDS or not found.sentences or not all(isinstance(text, str) for text in texts):
        return None
    shown, advice = ([printable(text, 300) for text in part[:_MOST_LINES]] for part in (found.sentences, found.advice))
    return Verdict(found.word, shown, found.where, advice)


def verdict_lines(*told: Mapping[str, Any]) -> list[str]:
    """The lines of the verdicts that summaries or takes hold; none where there is no verdict."""
    found = (verdict_of(one) for one in told)
    lines = (line for verdict in found if verdict is not None for line in verdict.lines())
    return list(dict.fromkeys(lines))  # a take repeats what its run's verdict found amiss


def summarise(
    shot: str, source: str, results: Mapping[str, Mapping[str, Any]], stages: Mapping[str, float], wall_seconds: float
) -> dict[str, Any]:
    """The figures of a whole run as DIR/summary.json holds them; units in the key names.

    Args:
        shot: absolute path of the shot folder.
        source: footage as given.
        results: what the jobs "solve", "train" and "freeze" answered in their `done` event.
        stages: seconds by kind of job.
        wall_seconds: seconds in all.
    """
    train, freeze, solve = results["train"], results["freeze"], results["solve"]
    return {
        "version": CONTRACT_VERSION,
        "shot": shot,
        "source": source,
        **{k: solve[k] for k in ("frames", "solved_frames", "registered", "reprojection_error_px")},
        **{k: train[k] for k in ("gaussians", "moving_share", "train_seconds", "iterations", "heldout_psnr_db")},
        "train_width_px": train["width_px"],
        "modelled": train.get("modelled", []),
        "quality": train.get("quality", ""),
        "verdict": verdict_lines(train, freeze),
        **{k: (freeze.get("detail") or {}).get(k) for k in ("plate_share", "invented_share")},
        **{k: freeze[k] for k in ("t_star_frame", "exr_dir", "contact_sheet", "video", "ply", "take")},
        "run": train["run"],
        "wall_seconds_by_stage": dict(stages),
        "wall_seconds": round(wall_seconds, 2),
    }


def frame_file(frame: int, suffix: str) -> str:
    """File name of a frame: its number in the clip, six digits (a minus sign for negative ones) and a suffix."""
    return f"{frame:06d}{suffix}"


# ------------------------------------------------------------------------------------------------- unborn shots

_UNBORN = {"shot.json", "jobs", "frames"}
"""What an import that did not end well may leave in a shot folder."""


def discard_unborn(shot: Path) -> bool:
    """Takes away what a failed import left of a shot that it was to begin. True if it did; what cannot go stays.

    A shot that has a frame, or anything else that took work, is left alone, and so are files that are not ours. Kept is
    also the log of a job that ended without a sentence of its own.
    """
    try:
        names = {p.name for p in shot.iterdir()}
        frames = [p for p in (shot / "frames").rglob("*") if not p.is_dir()] if "frames" in names else []
        jobs = list((shot / "jobs").iterdir()) if "jobs" in names else []
        if "shot.json" not in names or frames or names & {"solve", "runs", "takes"} or (shot / "jobs").is_symlink():
            return False
        if not all("-import-" in job.name and not job.is_symlink() and _said_why(job) for job in jobs):
            return False
        writer = read_writer(shot)
        if writer is not None and writer.works():
            return False
        for name in _UNBORN & names - {"shot.json"}:
            shutil.rmtree(shot / name, ignore_errors=True)  # a link is left alone
        (shot / WRITER_FILE).unlink(missing_ok=True)
        (shot / "shot.json").unlink()
        with contextlib.suppress(OSError):  # it holds something of the artist's
            shot.rmdir()
    except (OSError, ValueError):
        return False
    return True


def _said_why(job: Path) -> bool:
    """True if a job ended in a sentence, or was cancelled, or never wrote a word: nobody needs its log."""
    status = from_dict(Status, read_json(job / STATUS_FILE)) if (job / STATUS_FILE).is_file() else None
    log = job / LOG_FILE
    if status is not None and not status.ended:
        return False
    named = status is not None and (status.state == "cancelled" or status.exit_code != ExitCode.INTERNAL)
    return named or not log.is_file() or not log.stat().st_size
