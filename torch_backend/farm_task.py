"""One task of a render farm's job: `python -m torch_backend farm-task STEP ...`, the command in a job template.

A task reports to the engine in Open Job Description: lines `openjd_progress: PERCENT` and `openjd_status: TEXT` on the
standard output, and `openjd_fail: TEXT` if it fails. Every task may run twice, even at the same time or after it was
killed. Import, solve and training wait for each other through the shot's lock and skip finished work. A take is made in
parts (`freeze/take/parts.py`). A baked file is renamed into place once it is complete.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Generator
from pathlib import Path
from types import FrameType
from typing import Any

from . import contract
from .contract import Cancelled, Event, ExitCode, FreezeParams, JobError, Reporter, ShotFolder
from .contract.files import is_json_object
from .farm import records
from .farm.request import read_request, shot_name
from .job import new_job, run_job
from .shot import Shot, disk_error, is_disk_full, path_error

BLENDER_VARIABLE = "SPLANNEQUIN_BLENDER_COMMAND"
"""Environment variable of the job: JSON list of the command that runs an add-on script on this host, without the
script."""
_STATUS_SECONDS = 5.0


class EngineReporter(Reporter):
    """Reporter that writes to the engine of the farm, and listener of a job."""

    def __init__(self, what: str) -> None:
        self.what = what
        """Name of the task, for messages."""
        self.error = ""
        """Message and hint of the failed job; empty if none failed."""
        self._cancelled = False
        self._last = ("", 0.0, -1.0)

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Reports progress to the engine, every few seconds and at the end of a stage."""
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        now, (before, since, last_share) = time.monotonic(), self._last
        if stage == before and ((now - since < _STATUS_SECONDS and share < 1.0) or share == last_share):
            return
        self._last = (stage, now, share)
        self._emit("openjd_progress", f"{100 * share:.1f}")
        self._emit("openjd_status", f"{self.what}: {stage} {100 * share:.0f}% {message}")

    def image(self, label: str, path: str | Path) -> None:
        """Prints a line to the log."""
        print(contract.printable(f"{label}: {path}", 400), flush=True)

    def warning(self, message: str, hint: str = "") -> None:
        """Prints a line to the log, because the engine shows only the last status."""
        print(contract.printable(f"note: {message} {hint}".rstrip(), 1000), flush=True)

    def check_cancelled(self) -> None:
        """Raises `Cancelled` once the engine asked this process to stop."""
        if self._cancelled:
            raise Cancelled

    def cancel(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Handler of the signals with which an engine cancels a task."""
        self._cancelled = True

    def __call__(self, event: Event) -> None:
        """Handles one event of a job."""
        data = event.data
        if event.type == "progress":
            self.progress(data["stage"], data["done"], data["total"], data["message"])
        elif event.type == "image":
            self.image(data["label"], data["path"])
        elif event.type == "warning":
            self.warning(data["message"], data["hint"])
        elif event.type == "error":
            self.error = f"{data['message']} {data['hint']}".rstrip()

    def fail(self, sentence: str) -> None:
        """Tells the engine why the task failed."""
        self._emit("openjd_fail", f"{self.what}: {sentence}")

    def _emit(self, word: str, text: str) -> None:
        print(f"{word}: {contract.printable(text, 400)}", flush=True)


def run_task(args: argparse.Namespace) -> int:
    """Runs one task, with the arguments of `contract.verbs.TaskWords`. Reports a failure; returns an `ExitCode`."""
    began = time.time() - time.process_time()  # includes the time of imports
    reporter = EngineReporter(f"{Path(args.shot).name}, {args.step}")
    with contract.working_on(Path(args.shot).absolute()), _cancelling(reporter):
        try:
            request = read_request(args.request)
            take = f" {request['takes'][args.t_star]}" if "takes" in request else ""
            reporter.what = f"{request['name']}, {args.step}{take}"
            if args.path_rules:
                os.environ[contract.RULES_VARIABLE] = str(Path(args.path_rules).absolute())
            code = _STEPS[args.step](args, request, reporter)
            if code == ExitCode.OK:
                records.write(
                    Path(args.shot), args.step, args.t_star, args.first, args.frames, _amount(args, request), began
                )  # fmt: skip
            return code
        except (Cancelled, KeyboardInterrupt):
            reporter.fail("Cancelled; finished work is kept.")
            return ExitCode.CANCELLED
        except JobError as error:
            reporter.fail(f"{error.message} {error.hint}".rstrip())
            return error.exit_code
        except Exception as error:
            known = None
            if isinstance(error, OSError):
                known = disk_error(args.shot) if is_disk_full(error) else path_error(error)
            if known is None:
                traceback.print_exc()
                known = contract.unexpected("The task", error, "the log")
            reporter.fail(f"{known.message} {known.hint}".rstrip())
            return known.exit_code


def _amount(args: argparse.Namespace, request: dict[str, Any]) -> float:
    """Amount of work of a task, in the units of `farm.work`."""
    return float(request["amounts"].get(str(args.first) if args.frames else "0", 0.0))


@contextlib.contextmanager
def _cancelling(reporter: EngineReporter) -> Generator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)]
    before = {number: signal.signal(number, reporter.cancel) for number in names}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def params_of(args: argparse.Namespace, request: dict[str, Any], kind: str) -> Any:
    """Parameters of one kind of job for a task: those of the request, with the paths of this computer.

    ValueError names the invalid parameter.
    """
    values = dict(request[kind])
    for setting in args.paths or ():
        field, _, path = setting.partition("=")
        of, _, name = field.partition(".")
        if of == kind:
            values[name] = path
    params = contract.from_dict(contract.PARAMS[kind], values)
    contract.check_params(params)
    return params


def _station(args: argparse.Namespace, request: dict[str, Any], reporter: EngineReporter) -> int:
    """Runs import, solve or train as a job of the shot. The job waits while another one writes to the shot."""
    params = params_of(args, request, args.step)
    shot = Shot.create(args.shot, request["name"]) if args.step == "import" else Shot.open(args.shot)
    code, _ = run_job(new_job(shot, args.step, params), reporter, patient=True)
    if code != ExitCode.OK:
        reporter.fail(reporter.error or "Cancelled; finished work is kept.")
        if args.step == "import":
            contract.discard_unborn(shot.root)
    return code


def _take(args: argparse.Namespace, request: dict[str, Any], reporter: EngineReporter) -> int:
    """Runs open, freeze or finish: a part of a take, without the shot's lock."""
    from .freeze import finish_take, freeze_part, open_take

    shot, params = Shot.open(args.shot), _freezing(args, request)
    if args.frames:
        params.first, params.last = args.first, min(args.first + args.frames - 1, int(request["last"]))
    work = {"open": open_take, "freeze": freeze_part, "finish": finish_take}[args.step]
    answer = work(shot, params, reporter)
    if args.step != "finish":
        print(json.dumps(answer), flush=True)
    return ExitCode.OK


def _freezing(args: argparse.Namespace, request: dict[str, Any]) -> FreezeParams:
    params: FreezeParams = params_of(args, request, "freeze")
    params.take, params.only_missing = request["takes"][args.t_star], True
    params.t_star = int(args.t_star) if args.t_star else params.t_star
    params.first, params.last = int(request["first"]), int(request["last"])
    if params.camera_path and not os.path.isabs(params.camera_path):
        params.camera_path = str(ShotFolder(args.shot).root / params.camera_path)
    return params


def _bake(args: argparse.Namespace, request: dict[str, Any], reporter: EngineReporter) -> int:
    """Runs bake or deliver in the Blender of this host."""
    blender = os.environ.get(BLENDER_VARIABLE, "")
    if not blender:
        raise JobError(
            "No Blender is set up on this host.", "Enter the job's environment with --bake.", ExitCode.ENVIRONMENT
        )
    params = _freezing(args, request)
    first, last = params.first or 0, params.last or 0
    if args.frames:
        first, last = args.first, min(args.first + args.frames - 1, last)
    folder = str(request.get("output") or shot_name(Path(args.shot)))  # requests of earlier versions have no `output`
    output = Path(args.output).absolute() / folder / params.take
    part = "frames" if args.step == "bake" else "file"
    script = Path(__file__).resolve().parent.parent / "splannequin_addon" / "run_in_bpy.py"
    command: list[str] = json.loads(blender)
    words = ["bake", "--json", "--tied", "--shot", args.shot, "--take", params.take, "--output", str(output)]
    words += [f"--first={first}", f"--last={last}", "--step", "1", "--part", part]
    separator = ["--"] if len(command) > 2 else []  # Blender reads arguments before `--` as its own options
    environ = {**os.environ, "SPLANNEQUIN_BACKEND_PYTHON": sys.executable}
    child = subprocess.Popen(
        [*command, str(script), *separator, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace", env=environ,
        cwd=os.path.dirname(os.path.abspath(command[0])),
    )  # fmt: skip
    message = ""
    try:
        for line in child.stdout or ():
            event = _event(line)
            if event is not None:
                reporter(event)
            elif line.startswith("Error: "):
                message = line.removeprefix("Error: ").strip()
            elif line.strip():
                print(contract.printable(line.rstrip(), 1000), flush=True)
            if event is not None:
                reporter.check_cancelled()
    finally:
        if child.stdin is not None:
            child.stdin.close()  # a tied child ends when its input is closed
    code = child.wait()
    if code:
        reporter.fail(message or f"Blender ended with exit code {code}: see the log.")
    return code if code in {one.value for one in ExitCode} else int(ExitCode.BAKE)


def _event(line: str) -> Event | None:
    """Event in a line that Blender's side printed; None for any other line."""
    if not line.startswith("{"):
        return None
    try:
        data: Any = json.loads(line)
        known = {one.name for one in dataclasses.fields(Event)}
        return Event(**data) if is_json_object(data) and set(data) <= known and "seq" in data else None
    except (ValueError, TypeError):
        return None


_STEPS = {
    "import": _station,
    "solve": _station,
    "train": _station,
    "open": _take,
    "freeze": _take,
    "finish": _take,
    "bake": _bake,
    "deliver": _bake,
}
"""Function of each step of a template."""
