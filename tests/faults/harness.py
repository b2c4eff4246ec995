"""Runs jobs of a small shot in real child processes, disturbs them, and checks the files on disk.

A case is drawn from a seed: a fault, a kind of job and a moment. Each case works on a copy of one prepared folder. A
job counts as whole if its files equal those of the undisturbed job. Kinds of `PROGRAMS` take longer or start child
processes: solves, tasks of a farm, the launcher, Blender.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import OpenImageIO as oiio

from launcher.blender import BPY_WHEELS, choose_wheels
from launcher.environments import backend_environment, bpy_environment
from torch_backend import contract
from torch_backend.contract import (
    CombineParams,
    ExitCode,
    FreezeParams,
    ImportParams,
    LightParams,
    MatteParams,
    SolveParams,
    SurfaceParams,
    TrainParams,
)

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_SECONDS = 300.0
"""A job that runs longer hangs; the slowest takes 20 s on one core."""
ORPHAN_SECONDS = 20.0
"""Time limit for processes of an ended job to notice that it ended."""
VOLATILE = {
    "seconds", "created", "ms_per_step", "train_seconds", "trained_seconds", "beside", "wall_seconds",
    "wall_seconds_by_stage", "ended", "cpu_seconds", "memory_mib",
}  # fmt: skip
"""Keys of JSON files that differ between two undisturbed runs: times, memory, the path from the shot to its footage."""
SEEK_TABLE = b"\xb1\xea\x92\x8f"
"""Last bytes of a completely written compressed .blend."""
MARK = "SPLANNEQUIN_FAULT_CASE"
"""Environment variable that identifies the processes of a child in all sessions."""


# ------------------------------------------------------------------------------------------------- jobs


@dataclass(frozen=True)
class Kind:
    """A kind of job."""

    params: Callable[[Path], Any] = lambda _: None
    """Parameters of the job, from the folder with footage and lassos."""
    base: str = "shot"
    """Name of the start folder, a key of `prepare.BASES`."""
    words: tuple[str, ...] = ()
    """Command line instead of a job.

        SHOT is the shot, OUT the output folder, FILES the folder with footage and requests, ARTIST an artist's .blend.
    """
    program: str = "backend"
    """Program that runs the command line: `backend`, `launcher`, or `blender`."""


TAKE: dict[str, Any] = {"t_star": 108, "first": 104, "last": 107, "develop": "off", "device": "cpu"}
JOBS: dict[str, Kind] = {
    "import": Kind(lambda files: ImportParams(source=str(files / "clip")), "empty"),
    "train": Kind(lambda _: TrainParams(run="second", iterations=40, holdout=8, max_gaussians=900, device="cpu")),
    "freeze": Kind(lambda _: FreezeParams(take="new", detail="off", **TAKE)),
    "freeze of plates": Kind(lambda _: FreezeParams(take="new", **{**TAKE, "last": 105})),
    "mattes": Kind(lambda files: MatteParams(take="base", polygons=str(files / "lassos.json"), device="cpu")),
    "combine": Kind(lambda _: CombineParams(take="both", base="base", things="drawn=base")),
    "surface": Kind(lambda _: SurfaceParams(take="base")),
    "light": Kind(lambda _: LightParams(take="base", position="0,0,0")),
    "export": Kind(words=("export", "SHOT", "--format", "ply", "--take", "base", "--output", "OUT")),
}
_STATION = ("--shot", "SHOT", "--request", "FILES/stations.json")
_OF_TAKE = ("--shot", "SHOT", "--request", "FILES/take.json", "--first=104", "--frames", "4")
_BAKE = ("bake", "--shot", "SHOT", "--take", "base", "--output", "OUT")
_FREEZE = "--take new --t-star 108 --first 104 --last 105 --detail off --develop off --device cpu --output OUT"
PROGRAMS: dict[str, Kind] = {
    "solve": Kind(lambda _: SolveParams(), "room"),
    "farm import": Kind(base="nothing", words=("farm-task", "import", *_STATION), program="launcher"),
    "farm solve": Kind(base="room", words=("farm-task", "solve", *_STATION), program="launcher"),
    "farm open": Kind(words=("farm-task", "open", *_OF_TAKE, "--t-star=108"), program="launcher"),
    "farm freeze": Kind(base="opened", words=("farm-task", "freeze", *_OF_TAKE, "--t-star=108"), program="launcher"),
    "farm bake": Kind(
        base="artist", words=("farm-task", "bake", *_OF_TAKE, "--t-star=1", "--output", "OUT"), program="launcher"
    ),
    "launcher freeze": Kind(base="artist", words=("freeze", "SHOT", *_FREEZE.split()), program="launcher"),
    "blender bake": Kind(base="artist", words=_BAKE, program="blender"),
    "blender bake into a file": Kind(base="artist", words=(*_BAKE, "--blend", "ARTIST"), program="blender"),
    "blender surface": Kind(base="artist", words=("surface", "SHOT", "--take", "base"), program="blender"),
}
KINDS = JOBS | PROGRAMS
FAULTS = (
    "kill", "stop and continue", "interrupt", "disk full", "file size limit", "read-only", "memory limit",
    "truncated file", "bit flips", "two at once", "clock", "renamed shot",
)  # fmt: skip
NEEDS_MOUNT = {"disk full", "read-only"}


@dataclass(frozen=True)
class Case:
    """One disturbed job, reproducible from (seed, number)."""

    number: int
    fault: str
    kind: str
    early: bool
    """True if the fault strikes while the process starts, not while the job works."""
    moment: float
    """Time of the fault as a fraction of the undisturbed time."""
    seed: str

    def __str__(self) -> str:
        when = "at the start" if self.early else "at work"
        return f"case {self.number}: {self.fault}, {self.kind}, {when} {self.moment:.2f}"


def draw(seed: int, number: int, kinds: Collection[str]) -> Case:
    """Draw the case of a number: faults take turns, kinds and moments are random."""
    drawn = random.Random(f"{seed}-{number}")
    turn = random.Random(f"{seed}-turn-{number // len(FAULTS)}").sample(FAULTS, len(FAULTS))
    kind = drawn.choice(list(kinds))
    return Case(number, turn[number % len(FAULTS)], kind, drawn.random() < 0.15, drawn.random(), f"{seed}-{number}")


@dataclass
class Prepared:
    """Files that all cases copy, and results of undisturbed jobs."""

    shot: Path
    """Shot with frames, cameras, mattes, the run `main`, and the take `base` with the matte `drawn`."""
    files: Path
    """Folder with footage, lassos and requests for the jobs."""
    bases: dict[str, Path] = field(default_factory=dict[str, Path])
    """Map from name to start folder."""
    finished: dict[str, Path] = field(default_factory=dict[str, Path])
    """Map from kind to a folder after the undisturbed job."""
    expected: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    """Map from kind to the `snapshot` of that folder."""
    spans: dict[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    """Map from kind to (seconds before the undisturbed job began to work, seconds of work)."""


# ------------------------------------------------------------------------------------------------- one process


@dataclass
class Child:
    """A job or a command in a new process and session."""

    process: subprocess.Popen[bytes]
    output: Path
    """File with its printed output; the name is also the child's `MARK`."""
    job: Path | None
    """Folder of the job; None for a command."""
    began: float

    def wait(self) -> int:
        """Wait for the exit code. Raises AssertionError if the child hangs."""
        try:
            return self.process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            _kill(_marked(self.output.name))
            self.process.wait()
            raise AssertionError("the process hung") from None

    def printed(self) -> str:
        return self.output.read_text(encoding="utf-8", errors="replace")

    def orphans(self) -> list[int]:
        """Kill its processes, in all sessions, that are alive after `ORPHAN_SECONDS`; return their ids."""
        until = time.monotonic() + ORPHAN_SECONDS
        while (left := _marked(self.output.name)) and time.monotonic() < until:
            time.sleep(0.05)
        _kill(left)
        return left


def _marked(mark: str) -> list[int]:
    """Living processes with a mark in their environment. Zombies have no environment."""
    found: list[int] = []
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # the process has ended, or belongs to another user
            if f"{MARK}={mark}".encode() in environment.read_bytes().split(b"\0"):
                found.append(int(environment.parent.name))
    return found


def _kill(processes: list[int]) -> None:
    for pid in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@functools.cache
def blender_python() -> str:
    """Python of a bpy wheel, 5.2 first; empty if the launcher's environments are not set up."""
    wheels = [bpy_environment(series) for series in sorted(BPY_WHEELS, reverse=True)]
    wanted = [backend_environment(), *(bpy_environment(series) for series, _ in choose_wheels()[:1])]
    is_set_up = len(wanted) == 2 and all(environment.ready() for environment in wanted)
    return next((wheel.python for wheel in wheels if wheel.ready()), "") if is_set_up else ""


def can_run(kind: str) -> bool:
    """False for a kind with Blender if that is not set up; tests do not set it up."""
    needs_blender = kind in ("farm bake", "launcher freeze") or KINDS[kind].program == "blender"
    return not needs_blender or blender_python() != ""


def start(folder: Path, kind: str, prepared: Prepared, limits: Mapping[int, int] | None = None) -> Child:
    """Start a job as the add-on does. `folder` holds the shot as `shot.splannequin`."""
    limits = limits or {}
    shot, job, what = folder / "shot.splannequin", None, KINDS[kind]
    places = {"SHOT": shot, "OUT": folder / "out", "FILES": prepared.files, "ARTIST": folder / "artist.blend"}
    words = [functools.reduce(lambda word, name: word.replace(name, str(places[name])), places, w) for w in what.words]
    if not words:
        job = contract.new_job(shot, kind.partition(" ")[0], what.params(prepared.files))
        words = ["run-job", str(job)]
    return start_words(words, job, limits, what.program)


def start_words(words: list[str], job: Path | None, limits: Mapping[int, int], program: str = "backend") -> Child:
    """Start a program of `Kind.program` with a command line."""
    command = contract.python_child(sys.executable, "torch_backend", *words)
    if program == "launcher":
        command["args"] = [sys.executable, str(ROOT / "splannequin.py"), *words]
    if program == "blender":
        command["args"] = [blender_python(), "-P", str(ROOT / "splannequin_addon" / "run_in_bpy.py"), *words]
    output = _scratch() / f"{time.monotonic_ns()}.txt"
    environment = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "SPLANNEQUIN_BACKEND_PYTHON": sys.executable,
        "SPLANNEQUIN_BLENDER_COMMAND": json.dumps([blender_python(), "-P"]),
        MARK: output.name,
    }

    def limit() -> None:
        for what, value in limits.items():
            resource.setrlimit(what, (value, value))

    with open(output, "wb") as stream:
        process = subprocess.Popen(
            command["args"],
            cwd=command["cwd"],
            env=contract.child_environment(ROOT) | environment,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=limit if limits else None,
        )
    return Child(process, output, job, time.monotonic())


def _scratch() -> Path:
    folder = Path(os.environ["SPLANNEQUIN_FAULTS_SCRATCH"])
    folder.mkdir(exist_ok=True)
    return folder


def begun(child: Child) -> float:
    """Wait until the job writes its first event or ends; a command writes none. Returns the seconds since the start."""
    while child.process.poll() is None and child.job is not None:
        events = child.job / contract.EVENTS_FILE
        if (events.is_file() and events.stat().st_size) or time.monotonic() - child.began > PATIENCE_SECONDS:
            break
        time.sleep(0.005)
    return time.monotonic() - child.began


def await_moment(child: Child, case: Case, prepared: Prepared) -> None:
    """Wait for the moment of a case, or the end of the child."""
    before, during = prepared.spans[case.kind]
    if case.early:
        until = child.began + case.moment * before
    else:
        begun(child)
        until = time.monotonic() + case.moment * during
    while child.process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)


# ------------------------------------------------------------------------------------------------- files on disk


def snapshot(folder: Path) -> dict[str, str]:
    """Map from path to digest of each file, without jobs, locks and temporary files. JSON is compared by its values."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or path.is_symlink() or "/jobs/" in f"/{name}" or contract.is_half_written(path.name):
            continue
        if path.name in (contract.WRITER_FILE, contract.METRICS_FILE, "blender.log", "colmap.log"):
            continue  # metrics and logs hold seconds in each line
        if ".kept." in path.name:
            continue  # an import keeps pictures that a damaged frames.json no longer lists, see foreign_files.py
        if path.suffix == ".blend1":
            continue  # Blender's backup of an earlier bake
        found[name] = _digest(path, str(folder))
    return found


def _digest(path: Path, folder: str) -> str:
    data = path.read_bytes()
    with contextlib.suppress(ValueError, KeyError, struct.error):  # damaged files are compared by their bytes
        if path.suffix == ".json":
            data = _steady_text(json.loads(data.decode().replace(folder, "")))
        if path.name == contract.CHECKPOINT_FILE:
            (length,) = struct.unpack("<Q", data[:8])
            facts = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["splannequin"])
            data = _steady_text(facts) + data[8 + length :]
        if path.name == "shot.blend" and data.endswith(SEEK_TABLE):  # two saves differ by addresses
            data = SEEK_TABLE
        if path.parent.name == "composited" and contract.is_whole_picture(path):  # Blender adds the date
            data = oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8).tobytes()
        # The encoder's bytes depend on memory alignment, so decoded frames are compared.
        if path.suffix == ".mp4" and contract.is_whole_picture(path):
            with av.open(str(path)) as video:
                data = str([(frame.width, frame.height) for frame in video.decode(video=0)]).encode()
    return hashlib.sha256(data).hexdigest()[:16]


def _steady_text(value: Any) -> bytes:
    return json.dumps(_steady(value), sort_keys=True).encode()


def _steady(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _steady(v) for k, v in value.items() if k not in VOLATILE}
    return [_steady(v) for v in value] if isinstance(value, list) else value


def differences(found: Mapping[str, str], expected: Mapping[str, str]) -> list[str]:
    """Names of missing, additional and different files."""
    return sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))


def copy_of(prepared: Prepared, kind: str, folder: Path, finished: bool = False) -> Path:
    """Copy of the start folder of a kind, or of the folder of its finished job."""
    source = prepared.finished[kind] if finished else prepared.bases[KINDS[kind].base]
    return Path(shutil.copytree(source, folder, dirs_exist_ok=True))


def complaints_about(child: Child, code: int, folder: Path, may_break: bool = False) -> list[str]:
    """Faults in how a child ended with a code other than 0. `may_break` accepts an internal error."""
    wrong: list[str] = []
    text = child.printed()
    if "Traceback" in text:
        wrong.append("a traceback was printed: " + text.strip().splitlines()[-1][:200])
    status: dict[str, Any] = {}
    if child.job is not None and (child.job / contract.STATUS_FILE).is_file():
        status = contract.read_json(child.job / contract.STATUS_FILE)
    sentence = str(status.get("message") or text.strip())
    if code == ExitCode.INTERNAL and not may_break:
        wrong.append(f"ended as a bug: {sentence[:300]}")
    if code > 0 and not sentence:
        wrong.append("no sentence says why it ended")
    if code > 0 and status and status.get("state") not in ("failed", "cancelled", "running"):
        wrong.append(f"exit code {code}, but the status says {status.get('state')}")
    if code == 0 and child.job is not None and status.get("state") != "done":
        wrong.append(f"exit code 0, but the status says {status.get('state')}")
    return wrong
