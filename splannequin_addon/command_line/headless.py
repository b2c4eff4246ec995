"""The command line of the Blender side. It runs the operators' code, blocking, with a console instead of a panel.

    blender --background [FILE.blend] --command splannequin freeze CLIP --t-star 34 --output DIR
    blender --background --command splannequin freeze SHOT --t-star 40
    .venv-bpy-5.0/bin/python splannequin_addon/run_in_bpy.py bake --shot SHOT --take freeze --output DIR

Exit codes are `contract.ExitCode`: 0 done, 2 wrong arguments, 3 footage, 4 solve, 5 train, 6 freeze, 7 bake, 8 disk, 9
no backend, 130 cancelled.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import bpy

from ...torch_backend import contract
from ...torch_backend.contract import ExitCode
from ..access import scene_in, settings_of
from ..bake import cg_camera, farm_job, insertion, rendering
from ..freeze import takes
from ..process import backend, begin, jobs, steps
from ..scene import scene_setup, sequences
from ..shot import inventory
from ..solve import arrival, cameras, exchange, stmaps
from . import first_view
from .console import Console

# Signals received by this command.
_interrupts: list[int] = []


def _interrupt(number: int, frame: object) -> None:
    """Records the signal."""
    _interrupts.append(number)  # during a render, Blender swallows the exception
    raise KeyboardInterrupt


def _stop_if_interrupted() -> None:
    if _interrupts:
        raise KeyboardInterrupt


def main(argv: Sequence[str]) -> int:
    """Runs one command and returns its exit code. Ctrl-C and SIGTERM cancel the running job, which saves a
    checkpoint."""
    before: dict[int, Any] = {}
    _interrupts.clear()
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):
        if hasattr(signal, name):
            number = getattr(signal, name)
            before[number] = signal.signal(number, _interrupt)
    try:
        args = parser().parse_args(list(argv))
        if getattr(args, "tied", False):
            contract.end_with_starter()
        for note in contract.notes(args):
            print(f"note: {note}", file=sys.stderr, flush=True)
        return int(_COMMANDS[args.command](args, Console(contract.as_json(args))))
    except SystemExit as stop:
        return int(stop.code or 0)
    except (contract.Cancelled, KeyboardInterrupt):
        print("Cancelled. Run the same command again to continue: finished work is kept.", file=sys.stderr)
        return ExitCode.CANCELLED
    except contract.JobError as error:
        print(f"Error: {error.message} {error.hint}".rstrip(), file=sys.stderr)
        return error.exit_code
    except Exception as error:
        known = contract.path_error(error) if isinstance(error, OSError) else None
        known = known or contract.broke(f"`{argv[0] if argv else 'splannequin'}`", error)
        print(f"Error: {known.message} {known.hint}".rstrip(), file=sys.stderr)
        return known.exit_code
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


# ------------------------------------------------------------------------------------------------- commands


def import_clip(args: argparse.Namespace, console: Console) -> int:
    """`import SHOT CLIP`."""
    return _one_step(args, console, "import", args.shot)


def solve(args: argparse.Namespace, console: Console) -> int:
    """`solve SHOT`."""
    return _one_step(args, console, "solve", args.shot)


def export(args: argparse.Namespace, console: Console) -> int:
    """`export SHOT --output DIR`: cameras, points and splats for other programs."""
    output = Path(args.output).absolute()
    words: contract.ExportWords = contract.words_of(args)
    words.shot, words.output = str(Path(words.shot).absolute()), str(output)
    question = exchange.begin_export(words)
    console.say(exchange.exported(question, output))
    return ExitCode.OK


def export_for_farm(args: argparse.Namespace, console: Console) -> int:
    """`farm export SHOT... --output DIR`: a job for a render farm; `farm measure`: rates from measured task
    durations."""
    _output(args)
    words: contract.FarmWords = contract.words_of(args)
    args.t_star = None  # each instant becomes a separate take
    requests: dict[str, Any] = {kind: dataclasses.asdict(params) for kind, params in requested_params(args).items()}
    if not contract.trains_anew(args):
        del requests["train"]
    if args.request:
        for kind, values in contract.read_json(args.request).items():
            requests[kind] = {**requests.get(kind, {}), **values}
    question = farm_job.begin(words, requests)
    question.wait()
    for line in farm_job.written(question):
        print(line, flush=True)
    return ExitCode.OK


def train(args: argparse.Namespace, console: Console) -> int:
    """`train SHOT`."""
    return _one_step(args, console, "train", args.shot)


def freeze(args: argparse.Namespace, console: Console) -> int:
    """`freeze SHOT`: this step only. `freeze CLIP`: all missing steps in a new shot, and the bake."""
    return (
        _one_step(args, console, "freeze", args.clip) if contract.freezes_a_shot(args) else _freeze_clip(args, console)
    )


def make_mattes(args: argparse.Namespace, console: Console) -> int:
    """`mattes SHOT`, `combine SHOT`: jobs of the Freeze step."""
    return _one_step(args, console, "freeze", args.shot)


def make_surface(args: argparse.Namespace, console: Console) -> int:
    """`surface SHOT`, `light SHOT`: jobs of the Freeze step."""
    return _one_step(args, console, "freeze", args.shot)


def _freeze_clip(args: argparse.Namespace, console: Console) -> int:
    """Runs import, solve, train, freeze and bake. Writes OUTPUT/shot.blend and OUTPUT/summary.json."""
    began = time.perf_counter()
    output = _output(args)
    shot = output / (args.shot_name + contract.SHOT_SUFFIX)
    contract.check_same_clip(shot, args.clip)
    scene, fresh = _scene(args.blend)
    settings_of(scene).shot_path = str(shot)
    requests = requested_params(args)
    stages: dict[str, float] = {}
    results: dict[str, Any] = {}
    for step in ("import", "solve", "train", "freeze"):
        since = time.perf_counter()
        kind = steps.STEPS[step].kind
        params = requests[kind]
        if step == "solve":
            params = exchange.with_file_read(scene, params, shot)
        results[kind], notes = begin.run(scene, step, params, console)
        stages[kind] = round(time.perf_counter() - since, 2)
        for note in notes:
            console.say(f"  {note}")
    since = time.perf_counter()
    baked = _bake(scene, fresh, shot, args.take, output, console)
    stages["bake"] = round(time.perf_counter() - since, 2)
    source = str(inventory.read(shot).info.get("source", args.clip))
    summary = contract.summarise(str(shot), source, results, stages, time.perf_counter() - began)
    contract.write_json(output / contract.SUMMARY_FILE, {**summary, **baked}, parents=False)
    for line in summary["verdict"]:
        console.say(line)
    console.say(f"Composited frames: {baked['composited_dir']}")
    return ExitCode.OK


def bake_take(args: argparse.Namespace, console: Console) -> int:
    """`bake --shot SHOT --take TAKE --output DIR`: sends a frozen take through the compositor."""
    began = time.perf_counter()
    shot = _shot(args)
    output = _output(args)
    scene, fresh = _scene(args.blend)
    settings_of(scene).shot_path = str(shot)
    if fresh:  # an existing file keeps the artist's range
        _fit_range(scene, shot, args.take)
    first = scene.frame_start if args.first is None else args.first
    last = scene.frame_end if args.last is None else args.last
    if last < first:
        raise contract.JobError(
            f"The last frame, {last}, comes before the first, {first}.",
            "Set both with --first and --last.",
            ExitCode.USAGE,
        )
    span = range(first, last + 1, args.step if args.step > 0 else scene.frame_step)
    if args.part != "all":
        return _bake_a_part(args, scene, fresh, shot, output, span, console)
    stale = backend.available() and takes.may_be_stale(shot, args.take)
    if stale or not takes.complete(shot, args.take, span):
        params = takes.take_params(shot, args.take) or contract.FreezeParams(take=args.take, only_missing=True)
        params.first, params.last, params.step = span.start, span.stop - 1, span.step
        params.device = _device(args)
        begin.run(scene, "freeze", params, console)
    if cameras.find(scene, shot, "CAMERA") is None and contract.ShotFolder(shot).cameras.is_file():
        arrival.load_camera(scene, shot)
    baked = _bake(scene, fresh, shot, args.take, output, console, span, args.as_warp or None)
    path = output / contract.SUMMARY_FILE
    summary = _summary_of(path, shot, args.take)
    summary.setdefault("wall_seconds_by_stage", {})["bake"] = round(time.perf_counter() - began, 2)
    contract.write_json(path, {**summary, **baked}, parents=False)
    console.say(f"Composited frames: {baked['composited_dir']}")
    return ExitCode.OK


def _bake_a_part(
    args: argparse.Namespace,
    scene: bpy.types.Scene,
    fresh: bool,
    shot: Path,
    output: Path,
    span: range,
    console: Console,
) -> int:
    """`bake --part frames` and `--part file`: one part of a bake of an existing take, shared by several computers."""
    if not takes.complete(shot, args.take, span):
        raise contract.JobError(
            f"Take {args.take} of {shot.name} lacks frames from {span.start} to {span.stop - 1}.",
            "Freeze it first. A bake with --part does not freeze frames.",
            ExitCode.BAKE,
        )
    if cameras.find(scene, shot, "CAMERA") is None and contract.ShotFolder(shot).cameras.is_file():
        arrival.load_camera(scene, shot)
    _set_up(scene, fresh, shot, args.take, console, span, args.as_warp or None)
    folder = output / rendering.COMPOSITED
    if args.part == "frames":
        _render(scene, folder, fresh, console, is_part=True)
        return ExitCode.OK
    numbers = rendering.gathered(scene, folder, fresh)
    if fresh:
        first_view.set_up(scene, shot, args.take)
    _save(scene, output / "shot.blend", folder)
    summary = {"version": 1, "shot": str(shot), "take": args.take, **_bake_facts(output, numbers)}
    contract.write_json(output / contract.SUMMARY_FILE, summary, parents=False)
    console.say(f"Composited frames: {folder}")
    return ExitCode.OK


def write_stmaps(args: argparse.Namespace, console: Console) -> int:
    """`stmaps SHOT`: ST maps of the lens, in both directions."""
    shot = _shot(args)
    question = stmaps.begin(shot, args.width)
    question.wait()
    facts = stmaps.answer(question)
    if console.as_json:
        print(json.dumps(facts))
    for line in stmaps.sentences(facts):
        console.say(line)
    return ExitCode.OK


def status(args: argparse.Namespace, console: Console) -> int:
    """`status SHOT`: the newest job of each kind, one line each."""
    shot = _shot(args)
    for kind, job in jobs.latest(shot).items():
        status = job.status or contract.Status(kind, "queued", 0, 0.0, 0.0, 0.0)
        if console.as_json:
            print(json.dumps({"job": job.folder.name, **dataclasses.asdict(status)}))
        else:
            share = f"{status.stage} {100 * status.fraction:.0f}%" if status.stage else ""
            print(contract.printable(f"{job.folder.name}  {status.state:<9} {share}  {status.message}").rstrip())
    return ExitCode.OK


def doctor(args: argparse.Namespace, console: Console) -> int:
    """`doctor`: this Blender's version and the capabilities of the backend's environment, as JSON."""
    facts: dict[str, Any] = {"blender": bpy.app.version_string, "blender_python": sys.version.split()[0]}
    facts["backend_python"] = backend.python()
    facts["backend"] = json.loads(backend.doctor(args.gpu))
    print(json.dumps(facts, indent=1))
    return ExitCode.OK


# ------------------------------------------------------------------------------------------------- inside


def _one_step(args: argparse.Namespace, console: Console, step: str, shot: str) -> int:
    (params,) = requested_params(args).values()
    scene = scene_in(bpy.context)
    settings_of(scene).shot_path = str(Path(shot).absolute())
    if step == "solve":
        params = exchange.with_file_read(scene, params, Path(shot).absolute())
    job = begin.begin(scene, step, params)
    result = begin.wait(job, console)
    if console.as_json:
        print(json.dumps({"result": result}))
    elif isinstance(result, dict):
        for line in contract.verdict_lines(cast("dict[str, Any]", result)):
            console.say(line)
    return ExitCode.OK


def _scene(blend: str) -> tuple[Any, bool]:
    """(the scene to work in, whether it is new). It comes from `blend` or from the file Blender was started with."""
    if blend:
        path = Path(blend).absolute()
        if not path.is_file():
            raise contract.MissingError(f"{path} does not exist. --blend needs a .blend file.")
        try:
            # The file may come from a stranger, so its scripts and its drivers with Python do not run.
            bpy.ops.wm.open_mainfile(filepath=str(path), use_scripts=False)
        except RuntimeError as error:  # not a .blend, damaged, or saved by a newer Blender
            raise contract.JobError(
                f"Blender {bpy.app.version_string} cannot open {path}: {str(error).strip()}",
                "Open it in the Blender that saved it.",
                ExitCode.USAGE,
            ) from error
        bpy.context.view_layer.update()  # drivers are only reported once they are evaluated
        if bpy.app.autoexec_fail:
            print(
                f"Note: {path.name} contains Python that was not run ({bpy.app.autoexec_fail_message}). If the image "
                "depends on it, bake its result into keyframes and save the file.",
                file=sys.stderr,
            )
    if bpy.data.filepath:
        return scene_in(bpy.context), False
    bpy.ops.wm.read_homefile(use_empty=True)
    return scene_in(bpy.context), True


def _fit_range(scene: bpy.types.Scene, shot: Path, take: str) -> None:
    """Sets a new scene's range to the take's, or to the clip's if the take does not exist yet."""
    state = inventory.read(shot)
    facts = state.takes.get(take)
    scene.frame_start, scene.frame_end = (facts["first"], facts["last"]) if facts else state.frame_range


def _bake(
    scene: bpy.types.Scene,
    fresh: bool,
    shot: Path,
    take: str,
    output: Path,
    console: Console,
    span: range | None = None,
    warp: bool | None = None,
) -> dict[str, Any]:
    """Sets up the compositor, renders `span` (None: the scene's range) and saves shot.blend. Returns the summary's
    facts."""
    _set_up(scene, fresh, shot, take, console, span, warp)
    folder = output / rendering.COMPOSITED
    numbers = _render(scene, folder, fresh, console)
    if fresh:
        first_view.set_up(scene, shot, take)
    _save(scene, output / "shot.blend", folder)
    return _bake_facts(output, numbers)


def _render(scene: bpy.types.Scene, folder: Path, fresh: bool, console: Console, is_part: bool = False) -> list[int]:
    """Renders the scene's range into a folder. Returns the frames that were written."""
    return rendering.render(
        scene,
        folder,
        fresh,
        lambda done, total: console.progress("baking", done, total),
        _stop_if_interrupted,
        is_part,
        lambda line: console.say(f"  {line}"),
        cg_camera.check,
    )


def _set_up(
    scene: bpy.types.Scene, fresh: bool, shot: Path, take: str, console: Console, span: range | None, warp: bool | None
) -> None:
    """Inserts a take into a scene's compositor and sets the scene's range to `span`, unless it is None."""
    changes = insertion.fit_take(scene, shot, take, fresh) if fresh or scene_setup.fitted(scene) else []
    if span is not None:
        scene.frame_start, scene.frame_end, scene.frame_step = span.start, span.stop - 1, span.step
    changes += insertion.insert_freeze(scene, shot, take, warp)
    for change in changes:
        console.say(f"  {change}")


def _summary_of(path: Path, shot: Path, take: str) -> dict[str, Any]:
    """The entries of a summary.json for this take of this shot. A new summary if the file is missing, damaged or for
    another take."""
    fresh: dict[str, Any] = {"version": 1, "shot": str(shot), "take": take}
    try:
        found = {**fresh, **contract.read_json(path)}
    except (OSError, ValueError):
        return fresh
    is_same = all(found[name] == value for name, value in fresh.items())
    return found if is_same and isinstance(found.get("wall_seconds_by_stage", {}), dict) else fresh


def _bake_facts(output: Path, numbers: list[int]) -> dict[str, Any]:
    """The summary's facts about a bake."""
    return {
        "composited_dir": str(output / rendering.COMPOSITED),
        "composited_frames": len(numbers),
        "blend": str(output / "shot.blend"),
        "blender_version": bpy.app.version_string,
    }


def _save(scene: bpy.types.Scene, blend: Path, frames: Path) -> None:
    """Saves the file with relative paths, so that its folder can be moved and rendered elsewhere."""
    files = bpy.context.preferences.filepaths
    backups = files.save_version
    contract.sweep_half_written(blend.parent)
    with contract.atomic_path(blend) as half:  # Blender reports success for a truncated compressed file
        try:
            # The first save gives the file a path, which relative paths need.
            bpy.ops.wm.save_as_mainfile(filepath=str(half), check_existing=False)
            files.save_version = 0
            scene = scene_in(bpy.context)
            sequences.relative_images()
            scene.render.filepath = rendering.output_path(frames)
            bpy.ops.wm.save_as_mainfile(filepath=str(half), check_existing=False)
            if not contract.is_whole_picture(half):
                raise contract.disk_error(blend.parent, f"{blend.name} could not be saved")
        except RuntimeError as error:
            message = f"{blend.name} could not be saved: {str(error).strip()}"
            if rendering.is_full(blend.parent, os.path.getsize(half) if half.exists() else 1 << 20):
                raise contract.disk_error(blend.parent, message) from error
            raise contract.JobError(
                f"{message}.", f"Make sure that {blend.parent} is writable.", ExitCode.BAKE
            ) from error
        finally:
            files.save_version = backups
        if backups and blend.exists():
            contract.replace_file(blend, blend.with_name(f"{blend.name}1"))


def requested_params(args: argparse.Namespace) -> dict[str, Any]:
    """Kind of job -> parameters from a parsed command line; empty for a command that starts no job."""
    return contract.requested_params(args, {"device": backend.device()})


def _device(args: argparse.Namespace) -> str:
    """Device of the backend: from the command line, otherwise from the preferences."""
    return args.device or backend.device()


def _shot(args: argparse.Namespace) -> Path:
    """The shot folder that a command names. Raises JobError if it does not exist."""
    shot = Path(args.shot).absolute()
    if not inventory.read(shot).info:
        raise contract.JobError(f"{shot} is not a shot folder.", "Specify the .splannequin folder.", ExitCode.USAGE)
    return shot


def _output(args: argparse.Namespace) -> Path:
    """The --output folder, created if missing. Raises JobError if it cannot be created."""
    output = Path(args.output).absolute()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise inventory.unwritable(output, error, "Choose another --output folder.") from error
    return output


# Command -> its function.
_COMMANDS = {
    "import": import_clip,
    "solve": solve,
    "train": train,
    "freeze": freeze,
    "mattes": make_mattes,
    "surface": make_surface,
    "light": make_surface,
    "combine": make_mattes,
    "bake": bake_take,
    "stmaps": write_stmaps,
    "export": export,
    "farm": export_for_farm,
    "status": status,
    "doctor": doctor,
}
# Field -> description of its default, used if the command line does not set it.
_UNSET = {"device": "from the add-on's preferences"}


def parser() -> argparse.ArgumentParser:
    """The argument parser of the command line."""
    top, verbs = contract.command_line(
        "blender --background [FILE.blend] --command splannequin", contract.BLENDER, _UNSET
    )
    verbs["bake"].add_argument("--tied", action="store_true", help=argparse.SUPPRESS)  # ends when stdin closes
    return top
