"""The command line of the backend: `python -m torch_backend COMMAND`, installed as `splannequin`.

Each station runs as a job in the shot's folder, with the same code as for Blender. The console prints its events.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from . import contract
from .contract import Event, ExitCode
from .shot import SHOT_SUFFIX, Shot, path_error, write_json


class Console:
    """Listener that prints a job's events: one line per stage on a terminal, a line every few seconds elsewhere."""

    def __init__(self, stream: TextIO | None = None, as_json: bool = False) -> None:
        self.stream = stream or sys.stdout
        self.as_json = as_json
        self._tty = self.stream.isatty()
        self._last = ("", 0.0)
        self._open_line = False
        self.error: dict[str, Any] | None = None
        self._total: contract.TotalProgress | None = None
        self._job = ("", 0.0)
        """Kind of the running job, and its start in seconds since the epoch."""

    def __call__(self, event: Event) -> None:
        if event.type == "error":
            self.error = event.data
        if self.as_json:
            print(json.dumps(dataclasses.asdict(event)), file=self.stream, flush=True)
        elif event.type == "progress":
            self._progress(event)
        elif event.type == "metric" and event.data["values"].get("modelled"):
            self._line(modelled_table(event.data["values"]["modelled"]))
        elif event.type == "warning":
            self._line(contract.printable(f"  note: {event.data['message']} {event.data['hint']}".rstrip()))
        elif event.type == "error":
            self._line(contract.printable(f"Error: {event.data['message']} {event.data['hint']}".rstrip()))
        elif event.type == "done" and event.data["state"] == "cancelled":
            self._line("Cancelled. Run the same command again to continue: finished work is kept.")

    def begins(self, kind: str, total: contract.TotalProgress | None) -> None:
        """Notes that a job of `kind` begins. `total`: progress of the sequence of jobs to which the job belongs."""
        self._job, self._total = (kind, time.time()), total

    def _of_all(self, event: Event) -> str:
        """Progress of all jobs together, in words; empty if there is no estimate."""
        if self._total is None:
            return ""
        kind, since = self._job
        lasts = event.data["stage"] in contract.LASTING_STAGES
        share, left = self._total.at(kind, event.time - since, event.data.get("eta_seconds") if lasts else None)
        return f"; in all {share:.0%}, {contract.duration(left)} left"

    def _progress(self, event: Event) -> None:
        data = event.data
        share = data["done"] / data["total"] if data["total"] else 0.0
        stage, since = self._last
        finished = share >= 1.0
        if data["stage"] == stage and not finished and event.time - since < (0.2 if self._tty else 10.0):
            return
        self._last = (data["stage"], event.time)
        eta = f", {data['eta_seconds']:.0f} s left" if data.get("eta_seconds") and not finished else ""
        text = f"  {data['stage']:<22} {100 * share:3.0f}%  {data['message']}{eta}{self._of_all(event)}"
        if self._tty:
            self.stream.write("\r" + text[:118].ljust(118) + ("\n" if finished else ""))
            self.stream.flush()
            self._open_line = not finished
        else:
            self._line(text.rstrip())

    def _line(self, text: str) -> None:
        if self._open_line:
            self.stream.write("\n")
            self._open_line = False
        print(text, file=self.stream, flush=True)


def run_station(shot: Shot, kind: str, params: Any, console: Console) -> Any:
    """Runs one station as a job of `shot` and returns its result. SystemExit with the job's exit code if it fails."""
    from .job import new_job, run_job

    contract.check_params(params)
    try:
        folder = new_job(shot, kind, params)
    except OSError as error:
        _give_up(error, shot.root)
    code, result = run_job(folder, console)
    if code != ExitCode.OK:
        if kind == "import":
            contract.discard_unborn(shot.root)
        raise SystemExit(code)
    return result


def _begun(folder: str) -> Shot:
    """The shot for an import, created if missing. Ends the command with a message if it cannot be created."""
    try:
        return Shot.create(folder)
    except OSError as error:
        _give_up(error, Path(folder).absolute(), "Choose another shot folder.")


def one_step(args: argparse.Namespace, console: Console) -> int:
    """`import SHOT CLIP`, `solve SHOT`, `train SHOT`, `freeze SHOT`, `mattes SHOT`, `combine SHOT`, `surface SHOT`,
    `light SHOT`."""
    ((kind, params),) = contract.requested_params(args).items()
    folder = args.clip if args.command == "freeze" else args.shot
    shot = _begun(folder) if kind == "import" else Shot.open(folder)
    result = run_station(shot, kind, params, console)
    if kind == "import":
        print_reading(result, console)
    if kind in ("train", "freeze"):
        print_verdict(result, console)
    if kind in ("freeze", "combine"):
        print_places(result, console)
    if kind == "mattes":
        print_mattes(result, console)
    if kind == "surface" and not console.as_json:
        print(f"Surface: {result['surface']}", file=console.stream, flush=True)
    if kind == "light" and not console.as_json:
        message = (
            f"Light: {result['light']}. This is an estimate: {result['filled']:.0%} of the sphere was not seen and "
            "is filled in."
        )
        print(message, file=console.stream, flush=True)
    return ExitCode.OK


def freeze_clip(args: argparse.Namespace, console: Console) -> int:
    """`freeze CLIP`: import, solve, train, freeze; writes OUTPUT/summary.json."""
    output = Path(args.output).absolute()
    started = time.perf_counter()
    requests = _requests(args)
    try:
        root = output / (args.shot_name + SHOT_SUFFIX)
        _check_same_clip(root, requests["import"])
        shot = Shot.create(root, args.shot_name)
    except OSError as error:
        _give_up(error, output)
    stages: dict[str, float] = {}
    results: dict[str, Any] = {}
    total: contract.TotalProgress | None = None
    for kind, params in requests.items():
        since = time.perf_counter()
        console.begins(kind, total)
        results[kind] = run_station(shot, kind, params, console)
        stages[kind] = round(time.perf_counter() - since, 2)
        if kind == "import":
            print_reading(results[kind], console)
            total = _total_progress(shot, requests, stages[kind])
        info = shot.info()
        if args.t_star is not None and not info.first <= args.t_star <= info.last:  # report it before hours of training
            raise contract.UserError(f"t* is frame {args.t_star}: the shot has frames {info.first} to {info.last}.")
    summary = contract.summarise(str(shot.root), shot.info().source, results, stages, time.perf_counter() - started)
    write_json(output / contract.SUMMARY_FILE, summary)
    print_summary(summary, console)
    return ExitCode.OK


def _total_progress(shot: Shot, requests: dict[str, Any], spent: float) -> contract.TotalProgress | None:
    """Time estimate of the jobs after the import, which took `spent` seconds; None if there is none."""
    try:
        size, pace = contract.ShotSize.of(shot), contract.paces(Path(sys.prefix))
    except (OSError, ValueError):
        return None
    seconds = {kind: contract.expected_seconds(kind, requests[kind], size) for kind in requests if kind != "import"}
    return contract.TotalProgress({kind: (s or 0.0) * pace.get(kind, 1.0) for kind, s in seconds.items()}, spent)


def _check_same_clip(root: Path, params: contract.ImportParams) -> None:
    """Raises JobError if the shot in a folder comes from another clip than the requested one or a copy of it."""
    if contract.is_imported_from(root, params.source) is False:
        from .footage.importing import holds_footage

        if not holds_footage(root, params):
            contract.check_same_clip(root, params.source)


def _requests(args: argparse.Namespace) -> dict[str, Any]:
    """Parameters of each job of `freeze CLIP`, by kind. Raises ValueError or JobError before any work is done."""
    requests = contract.requested_params(args)
    for params in requests.values():
        contract.check_params(params)
    for name, what in ((args.run, "run"), (args.take, "take"), (args.shot_name, "shot")):
        contract.checked_name(name, what)
    if args.camera_path:
        contract.CameraPath.load(args.camera_path)
    return requests


def print_summary(summary: dict[str, Any], console: Console) -> None:
    """Prints the closing lines: results, quality, duration and paths."""
    if console.as_json:
        return
    psnr = summary["heldout_psnr_db"]
    quality = f"{psnr:.2f} dB on held-out frames" if psnr is not None else "no frames held out"
    print(
        f"\nFrozen at frame {summary['t_star_frame']}: {summary['frames']} frames, "
        f"{summary['registered']} of {summary['solved_frames']} solved frames registered.\n"
        f"{quality}, {summary['gaussians']} Gaussians, {100 * summary['moving_share']:.1f} % of them move, "
        f"trained in {summary['train_seconds']:.0f} s.\n" + "\n".join(summary["verdict"]),
        file=console.stream,
        flush=True,
    )
    print_places(summary, console)


def print_places(take: dict[str, Any], console: Console) -> None:
    """Prints the paths of a take's files."""
    if not console.as_json:
        for name, key in (("EXR frames:", "exr_dir"), ("Contact sheet:", "contact_sheet"), ("Video:", "video")):
            print(f"{name:<14} {take[key]}", file=console.stream, flush=True)


def print_mattes(result: dict[str, Any], console: Console) -> None:
    """Prints the paths of a take's mattes."""
    if not console.as_json:
        for name, folder in result["mattes"].items():
            print(f"Matte {name}: {folder}", file=console.stream, flush=True)
        print(f"Cryptomatte: {result['cryptomatte'] or 'none'}", file=console.stream, flush=True)


def print_verdict(facts: dict[str, Any], console: Console) -> None:
    """Prints what an artist should know of a run or a take, line by line."""
    if not console.as_json:
        for line in contract.verdict_lines(facts):
            print(line, file=console.stream, flush=True)


def print_reading(facts: dict[str, Any], console: Console) -> None:
    """Prints how an import read the footage, and which settings were assumed."""
    if not console.as_json:
        for line in facts["read_as"]:
            print(f"  {contract.printable(line)}", file=console.stream, flush=True)


def modelled_table(rows: list[dict[str, Any]]) -> str:
    """Table of what a run modelled, its cost and its gain, from rows of the summary; "-" where nothing was measured."""
    head = ["modelled", "", "s", "ms/step", "kB", "gain dB"]
    lines = [head]
    for row in rows:
        size = None if row["bytes"] is None else row["bytes"] / 1000.0
        numbers = ((row["seconds"], ".1f"), (row["ms_per_step"], ".1f"), (size, ".0f"), (row["gain_db"], "+.2f"))
        lines.append([row["what"], row["detail"], *("-" if v is None else format(v, f) for v, f in numbers)])
    widths = [max(len(line[n]) for line in lines) for n in range(len(head))]
    pad = (str.ljust, str.ljust, str.rjust, str.rjust, str.rjust, str.rjust)
    return "\n".join("  ".join(p(cell, w) for p, cell, w in zip(pad, line, widths, strict=True)) for line in lines)


def doctor(args: argparse.Namespace, console: Console) -> int:
    """`doctor`: what the backend's environment can do, as JSON on the standard output."""
    import importlib.metadata

    facts: dict[str, Any] = {"python": sys.version.split()[0], "packages": {}}
    for name in ("torch", "warp-lang", "pycolmap", "OpenImageIO", "av", "safetensors", "numpy", "scipy", "usd-core"):
        try:
            facts["packages"][name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            facts["packages"][name] = None
    import av
    import torch

    from .train.device import choose_device, cuda_refusal, failed_self_test

    facts["torch_device"] = "cuda" if torch.cuda.is_available() else "cpu"
    facts["cuda_device"] = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    facts["torch_cuda"] = torch.version.cuda
    facts["cuda_refusal"] = cuda_refusal()
    if args.gpu:
        facts["gpu"] = card_facts(facts["cuda_refusal"])
        facts["trains_on"] = "cpu" if facts["gpu"]["test"]["problem"] else "cuda"
    else:
        facts["trains_on"] = choose_device("auto").type
        if not facts["cuda_refusal"]:
            facts["cuda_refusal"] = " ".join(failed_self_test() or ())
    facts["cores"] = os.cpu_count()
    facts["h264"] = "libx264" in av.codecs_available
    print(json.dumps(facts, indent=1), file=console.stream)
    return ExitCode.OK


def card_facts(refusal: str) -> dict[str, Any]:
    """Facts of the card: a self-test in this process, and the folder of its compiled kernels.

    `refusal`: why the card cannot be used; empty if it can.
    """
    import platform

    import torch

    from .cards import nvidia_cards
    from .train.self_test import SelfTest, keep, kernel_folder, run_self_test, self_test_key

    cards, trouble = nvidia_cards()
    key = self_test_key()
    tested = SelfTest(key=key, problem=refusal, lasting=False) if refusal else run_self_test(torch.device("cuda"), key)
    keep(tested, kernel_folder())
    facts: dict[str, Any] = {
        "test": dataclasses.asdict(tested), "system": platform.platform(),
        "cards": [dataclasses.asdict(card) for card in cards], "driver_trouble": trouble,
        "kernels": str(kernel_folder()),
    }  # fmt: skip
    if not refusal and not tested.problem:  # after a failed kernel, all later CUDA calls of this process fail
        free, total = torch.cuda.mem_get_info()
        facts["memory_gb"] = {"free": round(free / 1e9, 2), "total": round(total / 1e9, 2)}
    return facts


def run_job(args: argparse.Namespace, console: Console) -> int:
    """`run-job FOLDER`: writes the job's events to its folder and, with --json, to the standard output."""
    from .job import run_job

    return run_job(args.folder, console if console.as_json else None)[0]


def live(args: argparse.Namespace, console: Console) -> int:
    """`live SHOT`: draws the frames that are requested on the standard input."""
    from .live import run_live

    return run_live(args.shot, args.run, args.device)


def status(args: argparse.Namespace, console: Console) -> int:
    """`status SHOT`: its jobs, newest last, one line each."""
    shot = Shot.open(args.shot)
    for path in sorted(shot.jobs.glob(f"*/{contract.STATUS_FILE}")):
        try:
            job: contract.Status = contract.from_dict(contract.Status, contract.read_json(path, contract.SHORT_JSON))
            line = f"{job.state:<9} {job.stage} {100 * job.fraction:.0f}%  {job.message}"
            facts = dataclasses.asdict(job)
        except (OSError, ValueError) as error:
            line = f"damaged   {error}"
            facts = {"state": "damaged", "message": str(error)}
        if console.as_json:
            print(json.dumps({"job": path.parent.name, **facts}), file=console.stream)
        else:
            print(contract.printable(f"{path.parent.name}  {line}").rstrip(), file=console.stream)
    return ExitCode.OK


def export(args: argparse.Namespace, console: Console) -> int:
    """`export SHOT --output DIR`: cameras, points and splats for other programs; prints what was written."""
    words, shot, folder = contract.words_of(args), Shot.open(args.shot), Path(args.output).absolute()
    if words.format in ("ply", "usd"):
        from .freeze.take.splats import export_splats

        written = export_splats(shot, words.format, folder, words.take, words.placement)
    else:
        from .cameras.export import export_cameras

        written = export_cameras(shot, words.format, folder, words.text, words.placement)
    for path in written:
        print(json.dumps({"written": str(path)}) if console.as_json else path, file=console.stream)
    return ExitCode.OK


def stmaps(args: argparse.Namespace, console: Console) -> int:
    """`stmaps SHOT`: writes ST maps of the lens into SHOT/solve."""
    from .lens.stmap import write_maps

    facts = write_maps(Shot.open(args.shot), args.width)
    if console.as_json:
        print(json.dumps(facts), file=console.stream)
        return ExitCode.OK
    across, down = facts["overscan_percent"]
    print(
        f"Undistort: {facts['undistort']}\nRedistort: {facts['redistort']}\nThe lens sees {across:.1f} % of the "
        f"width beyond each side of the undistorted frames, and {down:.1f} % of the height. Freeze with --overscan "
        "lens to include that.",
        file=console.stream,
    )
    return ExitCode.OK


def farm(args: argparse.Namespace, console: Console) -> int:
    """`farm export SHOT... --output DIR`: writes a render farm job. `farm measure`: writes rates of past tasks."""
    from .farm import cost, export, rates, records

    words: contract.FarmWords = contract.words_of(args)
    output = Path(words.output)
    if words.action == "measure":
        found = rates.measure(record for shot in words.shots for record in records.read(Path(shot)))
        if not found:
            raise contract.JobError("These shots contain no timings of farm tasks.", "", ExitCode.USAGE)
        write_json(output / export.RATES_FILE, rates.to_json(found))
        print(output / export.RATES_FILE, file=console.stream)
        return ExitCode.OK
    args.t_star = None  # each instant is a separate take; see `FarmWords`
    summary, files = export.export(words, contract.requested_params(args), contract.trains_anew(args))
    if console.as_json:
        print(json.dumps({"written": [str(p) for p in files], **dataclasses.asdict(summary)}), file=console.stream)
        return ExitCode.OK
    for line in [*cost.sentences(summary, words.rates or "of docs/farm.md"), *map(str, files)]:
        print(line, file=console.stream)
    return ExitCode.OK


def farm_task(args: argparse.Namespace, console: Console) -> int:
    """`farm-task STEP --shot SHOT --request FILE ...`: runs one task of a farm's job, with messages for the engine."""
    from .farm_task import run_task

    return run_task(args)


def _give_up(error: OSError, where: Path, hint: str = "Choose another --output folder.") -> NoReturn:
    """Ends the command with a message that a folder cannot be written."""
    refusal = path_error(error) or contract.JobError(
        f"Cannot write to {where}: {error.strerror or error}.", hint, ExitCode.USAGE
    )
    print(f"Error: {refusal.message} {refusal.hint}", file=sys.stderr)
    raise SystemExit(refusal.exit_code)


def parser() -> argparse.ArgumentParser:
    """Argument parser of the command line."""
    return contract.command_line("splannequin", contract.BACKEND)[0]


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns an `ExitCode`."""
    # Spinning OpenMP threads made a frame four times slower when a core was busy; must be set before torch loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a file name outside the Windows code page must not end a job
            stream.reconfigure(errors="backslashreplace")
    args = parser().parse_args(argv)
    console = Console(as_json=contract.as_json(args))
    try:
        for note in contract.notes(args):
            print(f"note: {note}", file=sys.stderr, flush=True)
        return int(_dispatch(args, console))
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        return ExitCode.CANCELLED
    except contract.JobError as error:
        print(f"Error: {error.message} {error.hint}".rstrip(), file=sys.stderr)
        return error.exit_code
    except Exception as error:
        refusal = path_error(error) if isinstance(error, OSError) else None
        refusal = refusal or contract.broke(f"`{args.command}`", error)
        print(f"Error: {refusal.message} {refusal.hint}".rstrip(), file=sys.stderr)
        return refusal.exit_code


def _dispatch(args: argparse.Namespace, console: Console) -> int:
    if args.command in contract.COMMANDS and args.command not in _UTILITIES:
        return freeze_clip(args, console) if _is_full_run(args) else one_step(args, console)
    return _UTILITIES[args.command](args, console)


def _is_full_run(args: argparse.Namespace) -> bool:
    """True if the command runs all steps from a clip; False if it runs one step on a shot."""
    return args.command == "freeze" and not contract.freezes_a_shot(args)


_UTILITIES = {
    "status": status, "doctor": doctor, "export": export, "stmaps": stmaps, "run-job": run_job, "live": live,
    "farm": farm, "farm-task": farm_task,
}  # fmt: skip
"""Functions of the verbs that start no job of a shot."""
