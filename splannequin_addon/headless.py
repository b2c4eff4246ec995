"""The command line of the Blender side: the buttons' own code, blocking, with a console instead of a panel.

    blender --background [FILE.blend] --command splannequin freeze CLIP --t-star 34 --output DIR
    .venv-bpy-5.0/bin/python splannequin_addon/run_in_bpy.py bake --shot SHOT --take freeze --output DIR

Exit codes are `contract.ExitCode`: 0 done, 2 wrong arguments, 3 footage, 4 solve, 5 train, 6 freeze, 7 bake, 8 disk,
9 no backend, 130 cancelled.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from ..torch_backend import contract
from ..torch_backend.contract import ExitCode
from . import backend, bake, cameras, compositor, jobs, scene_setup, shots, solves, steps, stmaps


class Console:
    """Prints what jobs say: lines for people, or events as JSON lines."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._last = ("", 0.0)
        self._seq = 0

    def __call__(self, event: contract.Event) -> None:
        if self.as_json:
            print(json.dumps(dataclasses.asdict(event)), flush=True)
        elif event.type == "progress":
            self._progress(event)
        elif event.type == "warning":
            print(f"  note: {event.data['message']} {event.data['hint']}".rstrip(), flush=True)

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Progress of work that is Blender's own."""
        data = {"stage": stage, "done": done, "total": total, "message": message, "eta_seconds": None}
        self(contract.Event("progress", self._seq, time.time(), data))
        self._seq += 1

    def say(self, sentence: str) -> None:
        """A sentence for people."""
        if not self.as_json:
            print(sentence, flush=True)

    def _progress(self, event: contract.Event) -> None:
        data = event.data
        share = data["done"] / data["total"] if data["total"] else 0.0
        stage, since = self._last
        if data["stage"] == stage and share < 1.0 and event.time - since < 5.0:
            return
        self._last = (data["stage"], event.time)
        eta = f", {data['eta_seconds']:.0f} s left" if data.get("eta_seconds") and share < 1.0 else ""
        print(f"  {data['stage']:<22} {100 * share:3.0f}%  {data['message']}{eta}".rstrip(), flush=True)


_interrupts: list[int] = []
"""Signals that asked this command to stop."""


def _interrupt(number: int, frame: Any) -> None:
    """Remembered, because Blender swallows what is raised in a handler of its own while it renders."""
    _interrupts.append(number)
    raise KeyboardInterrupt


def _stop_if_interrupted() -> None:
    if _interrupts:
        raise KeyboardInterrupt


def main(argv: Sequence[str]) -> int:
    """Runs one command; returns an exit code. Ctrl-C and SIGTERM cancel the job at work with a checkpoint."""
    before = {}
    _interrupts.clear()
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):
        if hasattr(signal, name):
            number = getattr(signal, name)
            before[number] = signal.signal(number, _interrupt)
    try:
        args = parser().parse_args(list(argv))
        if getattr(args, "tied", False):
            contract.end_with_starter()
        return int(args.run(args, Console(args.json)))
    except SystemExit as stop:
        return int(stop.code or 0)
    except (contract.Cancelled, KeyboardInterrupt):
        print("Cancelled. Start the same command again to go on: finished work is kept.", file=sys.stderr)
        return ExitCode.CANCELLED
    except contract.JobError as error:
        print(f"Error: {error.message} {error.hint}".rstrip(), file=sys.stderr)
        return error.exit_code
    except (ValueError, FileNotFoundError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return ExitCode.USAGE
    except OSError as error:
        print(f"Error: {error.strerror or error}: {error.filename or ''}", file=sys.stderr)
        return ExitCode.DISK
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


# ------------------------------------------------------------------------------------------------- commands


def import_clip(args: argparse.Namespace, console: Console) -> int:
    """`import SHOT CLIP`."""
    return _one_step(args, console, "footage", _import_params(args))


def solve(args: argparse.Namespace, console: Console) -> int:
    """`solve SHOT`."""
    given = str(Path(args.cameras).absolute()) if args.cameras else ""
    return _one_step(args, console, "camera", contract.SolveParams(camera_model=args.camera_model, cameras=given))


def export(args: argparse.Namespace, console: Console) -> int:
    """`export SHOT --output DIR`: cameras and points for other programs."""
    output = Path(args.output).absolute()
    process = solves.begin_export(Path(args.shot).absolute(), args.format, output, args.text)
    console.say(solves.finish_export(process, output))
    return ExitCode.OK


def train(args: argparse.Namespace, console: Console) -> int:
    """`train SHOT`."""
    return _one_step(args, console, "train", _train_params(args))


def freeze(args: argparse.Namespace, console: Console) -> int:
    """`freeze CLIP`: import, solve, train, freeze, scene, bake; leaves OUTPUT/shot.blend and OUTPUT/summary.json."""
    began = time.perf_counter()
    output = _output(args)
    shot = output / (args.shot_name + contract.SHOT_SUFFIX)
    scene, fresh = _scene(args.blend)
    scene.splannequin.shot_path = str(shot)
    requests = {
        "footage": _import_params(args),
        "camera": contract.SolveParams(camera_model=args.camera_model),
        "train": _train_params(args),
        "freeze": _freeze_params(args),
    }
    stages: dict[str, float] = {}
    results: dict[str, Any] = {}
    for step, params in requests.items():
        since = time.perf_counter()
        kind = steps.STEPS[step].kind
        results[kind], notes = steps.run(scene, step, params, console)
        stages[kind] = round(time.perf_counter() - since, 2)
        for note in notes:
            console.say(f"  {note}")
    since = time.perf_counter()
    baked = _bake(scene, fresh, shot, args.take, output, console)
    stages["bake"] = round(time.perf_counter() - since, 2)
    source = str(shots.read(shot).info.get("source", args.clip))
    summary = contract.summarise(str(shot), source, results, stages, time.perf_counter() - began)
    jobs.write_json(output / contract.SUMMARY_FILE, {**summary, **baked})
    for line in summary["verdict"]:
        console.say(line)
    console.say(f"Composited frames: {baked['composited_dir']}")
    return ExitCode.OK


def bake_take(args: argparse.Namespace, console: Console) -> int:
    """`bake --shot SHOT --take TAKE --output DIR`: a frozen take through the compositor."""
    began = time.perf_counter()
    shot = _shot(args)
    output = _output(args)
    scene, fresh = _scene(args.blend)
    scene.splannequin.shot_path = str(shot)
    if fresh:  # else the range is the artist's, like everything else in the file
        _fit_range(scene, shot, args.take)
    first = scene.frame_start if args.first is None else args.first
    last = scene.frame_end if args.last is None else args.last
    if last < first:
        raise contract.JobError(
            f"The last frame, {last}, comes before the first, {first}.",
            "Name both with --first and --last.",
            ExitCode.USAGE,
        )
    span = range(first, last + 1, args.step if args.step > 0 else scene.frame_step)
    stale = backend.available() and steps.may_be_stale(shot, args.take)
    if stale or not steps.complete(shot, args.take, span):
        params = steps.take_params(shot, args.take) or contract.FreezeParams(take=args.take, only_missing=True)
        params.first, params.last, params.step = span.start, span.stop - 1, span.step
        params.device = _device(args)
        steps.run(scene, "freeze", params, console)
    if cameras.find(scene, shot, "CAMERA") is None and contract.ShotFolder(shot).cameras.is_file():
        steps.load_camera(scene, shot)
    baked = _bake(scene, fresh, shot, args.take, output, console, span, args.as_warp or None)
    path = output / contract.SUMMARY_FILE
    summary = contract.read_json(path) if path.is_file() else {"version": 1, "shot": str(shot)}
    summary.setdefault("wall_seconds_by_stage", {})["bake"] = round(time.perf_counter() - began, 2)
    jobs.write_json(path, {**summary, **baked})
    console.say(f"Composited frames: {baked['composited_dir']}")
    return ExitCode.OK


def write_stmaps(args: argparse.Namespace, console: Console) -> int:
    """`stmaps SHOT`: ST maps of the lens, both ways."""
    shot = _shot(args)
    asked = stmaps.begin(shot, args.width)
    asked.wait()
    facts = asked.answer()
    if console.as_json:
        print(json.dumps(facts))
    for line in stmaps.sentences(facts):
        console.say(line)
    return ExitCode.OK


def status(args: argparse.Namespace, console: Console) -> int:
    """`status SHOT`: the newest job of each kind, one line each."""
    shot = _shot(args)
    for kind, job in jobs.latest(shot).items():
        told = job.status or contract.Status(kind, "queued", 0, 0.0, 0.0, 0.0)
        if console.as_json:
            print(json.dumps({"job": job.folder.name, **dataclasses.asdict(told)}))
        else:
            share = f"{told.stage} {100 * told.fraction:.0f}%" if told.stage else ""
            print(contract.printable(f"{job.folder.name}  {told.state:<9} {share}  {told.message}").rstrip())
    return ExitCode.OK


def doctor(args: argparse.Namespace, console: Console) -> int:
    """`doctor`: this Blender, and what the backend's environment can do, as JSON."""
    facts: dict[str, Any] = {"blender": bpy.app.version_string, "blender_python": sys.version.split()[0]}
    facts["backend_python"] = backend.python()
    facts["backend"] = json.loads(backend.doctor())
    print(json.dumps(facts, indent=1))
    return ExitCode.OK


# ------------------------------------------------------------------------------------------------- inside


def _one_step(args: argparse.Namespace, console: Console, step: str, params: Any) -> int:
    scene = bpy.context.scene
    scene.splannequin.shot_path = str(Path(args.shot).absolute())
    job = steps.begin(scene, step, params)
    result = steps.wait(job, console)
    if console.as_json:
        print(json.dumps({"result": result}))
    elif isinstance(result, dict):
        for line in contract.verdict_lines(result):
            console.say(line)
    return ExitCode.OK


def _scene(blend: str) -> tuple[Any, bool]:
    """The scene to work in, and whether it is a new one: `blend`'s, or the file that Blender was started with."""
    if blend:
        path = Path(blend).absolute()
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist: --blend names a .blend file")
        bpy.ops.wm.open_mainfile(filepath=str(path))
    if bpy.data.filepath:
        return bpy.context.scene, False
    bpy.ops.wm.read_homefile(use_empty=True)
    return bpy.context.scene, True


def _fit_range(scene: Any, shot: Path, take: str) -> None:
    """A new scene's range: the take's, or the clip's before there is a take."""
    state = shots.read(shot)
    facts = state.takes.get(take)
    scene.frame_start, scene.frame_end = (facts["first"], facts["last"]) if facts else state.frame_range


def _bake(
    scene: Any,
    fresh: bool,
    shot: Path,
    take: str,
    output: Path,
    console: Console,
    span: range | None = None,
    warp: bool | None = None,
) -> dict[str, Any]:
    """Compositor, render of `span` (None: the scene's range), shot.blend; returns what the summary tells of it."""
    changes = bake.fit_take(scene, shot, take, fresh) if fresh or scene_setup.fitted(scene) else []
    if span is not None:
        scene.frame_start, scene.frame_end, scene.frame_step = span.start, span.stop - 1, span.step
    changes += steps.insert_freeze(scene, shot, take, warp)
    for change in changes:
        console.say(f"  {change}")
    folder = output / "composited"
    blend = output / "shot.blend"
    numbers = bake.render(
        scene, folder, fresh, lambda done, total: console.progress("baking", done, total), _stop_if_interrupted
    )
    _save(scene, blend, folder)
    return {
        "composited_dir": str(folder),
        "composited_frames": len(numbers),
        "blend": str(blend),
        "blender_version": bpy.app.version_string,
    }


def _save(scene: Any, blend: Path, frames: Path) -> None:
    """Saves the file with paths relative to it, so that its folder can be moved and rendered elsewhere."""
    files = bpy.context.preferences.filepaths
    backups = files.save_version
    try:
        # The first save gives the file its place; what is relative to it is only known then.
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), check_existing=False)
        files.save_version = 0
        scene = bpy.context.scene
        compositor.relative_images()
        scene.render.filepath = compositor.blend_path(frames / bake.DIGITS)
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), check_existing=False)
    except RuntimeError as error:
        raise contract.JobError(
            f"{blend} could not be saved: {str(error).strip()}", "Is the disk full?", ExitCode.BAKE
        ) from error
    finally:
        files.save_version = backups


def _import_params(args: argparse.Namespace) -> contract.ImportParams:
    clip = args.clip if "://" in args.clip else str(Path(args.clip).absolute())
    return contract.ImportParams(clip, args.first, args.last, args.step, args.working_height, args.fps, args.layer)


def _train_params(args: argparse.Namespace) -> contract.TrainParams:
    return contract.TrainParams(
        run=args.run_name,
        preset=args.preset,
        method=args.method,
        host=args.host,
        host_config=args.host_config,
        detector=args.detector,
        supervision=args.supervision,
        iterations=args.iterations,
        width=args.width,
        max_gaussians=args.max_gaussians,
        holdout=args.holdout,
        seed=args.seed,
        resume=not args.restart,
        device=_device(args),
        extend=getattr(args, "extend", 0),
    )


def _freeze_params(args: argparse.Namespace) -> contract.FreezeParams:
    return contract.FreezeParams(
        run=args.run_name,
        take=args.take,
        t_star=args.t_star,
        camera_path=str(Path(args.camera_path).absolute()) if args.camera_path else "",
        query=args.freeze_query,
        width=args.freeze_width,
        overscan=args.overscan,
        grain=not args.no_grain,
        detail=args.detail,
        develop=args.develop,
        only_missing=True,
        device=_device(args),
    )


def _device(args: argparse.Namespace) -> str:
    """Where the backend works: as this command says, else as the preferences do."""
    return args.device or backend.device()


def _shot(args: argparse.Namespace) -> Path:
    """The shot folder that a command is about. JobError if there is none."""
    shot = Path(args.shot).absolute()
    if not shots.read(shot).info:
        raise contract.JobError(f"{shot} is no shot folder.", "Name the .splannequin folder.", ExitCode.USAGE)
    return shot


def _output(args: argparse.Namespace) -> Path:
    """The --output folder, made if it is not there. JobError if it cannot be."""
    output = Path(args.output).absolute()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise steps.unwritable(output, error, "Choose another --output folder.") from error
    return output


def parser() -> argparse.ArgumentParser:
    """The grammar of the command line."""
    codes = "exit codes: " + ", ".join(f"{c.value} {c.name.lower()}" for c in ExitCode)
    top = argparse.ArgumentParser(
        prog="blender --background [FILE.blend] --command splannequin",
        description="Freeze time in a handheld clip of people holding still.",
        epilog=codes,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Any, text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text, epilog=codes)
        command.add_argument("--json", action="store_true", help="print events as JSON lines instead of text")
        command.set_defaults(run=run)
        return command

    one = add("import", import_clip, "Footage into a shot folder.")
    one.add_argument("shot", help="shot folder, made if it is not there")
    _add_import_flags(one)
    one = add("solve", solve, "Cameras of a shot.")
    one.add_argument("shot", help="shot folder")
    _add_solve_flags(one)
    one.add_argument(
        "--cameras", default="", metavar="PATH",
        help="take these cameras instead: a COLMAP folder, a transforms.json or a camera path",
    )  # fmt: skip
    one = add("export", export, "Cameras and points of a solved shot for other programs.")
    one.add_argument("shot", help="shot folder")
    one.add_argument("--format", default="colmap", choices=("colmap", "nerfstudio"), help="what to write")
    one.add_argument("--text", action="store_true", help="a COLMAP model as .txt instead of .bin")
    one.add_argument("--output", required=True, metavar="DIR", help="folder to write into")
    one = add("train", train, "Train a run of a shot.")
    one.add_argument("shot", help="shot folder")
    _add_train_flags(one)
    text = "add N steps to a finished run, which keeps its settings (other flags are passed over)"
    one.add_argument("--extend", type=int, default=0, metavar="N", help=text)
    _add_device_flag(one)
    whole = add("freeze", freeze, "Clip to baked shot: import, solve, train, freeze, bake; writes OUTPUT/shot.blend.")
    _add_import_flags(whole)
    _add_solve_flags(whole)
    _add_train_flags(whole)
    _add_device_flag(whole)
    whole.add_argument("--t-star", type=int, help="frame number at which time stands still (default: suggested)")
    whole.add_argument("--take", default="freeze", help="name of the take")
    text = "JSON camera path to render from (default: the clip's poses)"
    whole.add_argument("--camera-path", default="", metavar="FILE", help=text)
    whole.add_argument("--freeze-query", default="nearest", choices=("nearest", "plain"), help="see the user guide")
    text = "width of the frozen frames in pixels (0: the source's own)"
    whole.add_argument("--freeze-width", type=int, default=0, help=text)
    text = "on: frozen frames are made of the plates, where they can be believed; off: of the splats alone"
    whole.add_argument("--detail", default="on", choices=contract.SWITCH, help=text)
    text = "on: the instant is trained on as the still scene that it is; off: it stays as the run has it"
    whole.add_argument("--develop", default="on", choices=contract.SWITCH, help=text)
    whole.add_argument(
        "--overscan", type=contract.overscan, default=0.0, metavar="PERCENT", help="beyond the frame, or: lens"
    )
    text = "leave the plate's grain out of the files: a third smaller"
    whole.add_argument("--no-grain", action="store_true", help=text)
    whole.add_argument("--shot-name", default="shot", help="name of the shot folder in OUTPUT")
    whole.add_argument("--output", default="output", metavar="DIR", help="folder for everything that comes out")
    whole.add_argument("--blend", default="", help=".blend to insert the freeze into (default: a new scene)")
    one = add("bake", bake_take, "A frozen take through the compositor; writes DIR/composited and DIR/shot.blend.")
    one.add_argument("--shot", required=True, help="shot folder")
    one.add_argument("--take", default="freeze", help="name of the take")
    one.add_argument("--output", required=True, metavar="DIR", help="folder for what comes out")
    one.add_argument("--first", type=int, help="first frame to bake (default: the take's, or the .blend's range)")
    one.add_argument("--last", type=int, help="last frame to bake, inclusive")
    one.add_argument("--step", type=int, default=0, help="bake every n-th frame (0: the scene's step)")
    _add_device_flag(one)
    one.add_argument("--blend", default="", help=".blend to insert the freeze into (default: a new scene)")
    text = "freeze the plate that the .blend shows by the take's warp, instead of showing the take's frames"
    one.add_argument("--as-warp", action="store_true", help=text)
    one.add_argument("--tied", action="store_true", help=argparse.SUPPRESS)  # to the launcher, by the standard input
    one = add("stmaps", write_stmaps, "ST maps of the lens, both ways, into SHOT/solve.")
    one.add_argument("shot", help="shot folder")
    one.add_argument("--width", type=int, default=0, help="width of the maps in pixels (0: the working frames')")
    one = add("status", status, "Jobs of a shot.")
    one.add_argument("shot", help="shot folder")
    add("doctor", doctor, "What this Blender and its backend can do, as JSON.")
    return top


def _add_import_flags(to: argparse.ArgumentParser) -> None:
    to.add_argument("clip", help="video file, image sequence or pattern (shot.####.exr)")
    to.add_argument("--first", type=int, help="first frame number")
    to.add_argument("--last", type=int, help="last frame number, inclusive")
    to.add_argument("--step", type=int, default=0, help="solve and train on every n-th frame (0: choose)")
    to.add_argument("--working-height", type=int, default=0, help="height of the working frames in pixels")
    to.add_argument("--fps", type=float, default=0.0, help="frames per second of a sequence (0: its files', else 24)")
    to.add_argument("--layer", default="", metavar="NAME", help="EXR layer or part to take (default: the picture)")


def _add_solve_flags(to: argparse.ArgumentParser) -> None:
    to.add_argument("--camera-model", default="SIMPLE_RADIAL", choices=("SIMPLE_RADIAL", "OPENCV"), help="lens")


def _add_device_flag(to: argparse.ArgumentParser) -> None:
    text = "where to train and freeze (default: as the preferences say)"
    to.add_argument("--device", default="", choices=contract.DEVICES, help=text)


def _add_train_flags(to: argparse.ArgumentParser) -> None:
    # dest: `run` is the command's function.
    to.add_argument("--run", dest="run_name", default="main", help="name of the run")
    to.add_argument("--preset", default="preview", choices=tuple(contract.PRESET_STEPS), help="how much to spend")
    to.add_argument("--method", default="auto", choices=contract.METHODS, help="a host's name: all move")
    to.add_argument("--host", default="hexplane", choices=contract.HOSTS, help="which host `auto` puts behind the gate")
    text = "our numbers or the published ones"
    to.add_argument("--host-config", default="default", choices=contract.HOST_CONFIGS, help=text)
    to.add_argument("--supervision", default="support", choices=contract.SUPERVISIONS, help="see the user guide")
    text = "paper: what tells an ill-supervised Gaussian"
    to.add_argument("--detector", default="grad_norm", choices=contract.DETECTORS, help=text)
    to.add_argument("--iterations", type=int, default=0, help="training steps (0: the preset's)")
    to.add_argument("--width", type=int, default=0, help="width of the training images in pixels (0: the preset's)")
    to.add_argument("--max-gaussians", type=int, default=0, help="budget (0: the preset's)")
    to.add_argument("--holdout", type=int, default=-1, help="keep every n-th frame out for testing (0: none)")
    to.add_argument("--seed", type=int, default=0, help="random seed")
    to.add_argument("--restart", action="store_true", help="do not go on from the run's checkpoint")
