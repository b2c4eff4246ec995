"""The launcher's command line."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torch_backend.contract import INPUT, SHOT_SUFFIX, ExitCode, is_imported_from, is_shot, path_digest
from torch_backend.shot import is_disk_full, write_json

from . import farm
from .blender import BPY_WHEELS
from .children import run_child
from .commands import bench, freeze, setup, take_of
from .doctor import doctor
from .environments import backend_environment
from .errors import LauncherError
from .places import DEMO_CLIP, WORKING_FOLDER
from .release import package
from .summary import failed_job, read_summary
from .testing import run_sensitive_tests, run_tests

COMMANDS = {
    "demo": "freeze the bundled clip",
    "freeze": "freeze your own clip, or a shot folder again; other options go to the backend (--t-star N, ...)",
    "test": "run all tests; other arguments go to pytest",
    "bench": "compare the method with ground truth; other options go to benchmarks/bench.py (--quick, --jobs N, ...)",
    "doctor": "check what this machine can do",
    "setup": "create the environments and stop",
    "package": "build a release: the extension's zip, a repository folder, checksums and an SBOM",
    "farm": "write shots as a job for a render farm, and estimate its cost; takes the backend's options",
}
"""Commands and their help texts."""


def parser() -> argparse.ArgumentParser:
    """The argument parser. `main` passes unknown arguments on: of `freeze` and `demo` to the backend, of `test` to
    pytest, of `bench` to benchmarks/bench.py."""
    top = argparse.ArgumentParser(
        prog="splannequin.py", description="Freeze time in a handheld clip.", allow_abbrev=False
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        if name == "freeze":
            command.add_argument("clip", metavar="INPUT", help=INPUT[1])
        if name in ("test", "setup"):
            command.add_argument(
                "--bpy", choices=sorted(BPY_WHEELS), action="append", default=[],
                help="the bpy wheel (default: one that fits); may be repeated",
            )  # fmt: skip
        if name == "test":
            command.add_argument(
                "--instructions", action="store_true",
                help="only tests that depend on floats, computed as on an older processor (without AVX-512)",
            )  # fmt: skip
        if name == "doctor":
            command.add_argument(
                "--gpu", action="store_true", help="test the graphics card, and write the results to DIR/gpu.json"
            )
        if name == "setup":
            command.add_argument("--tests", action="store_true", help="also install what `test` needs")
            command.add_argument("--backend", action="store_true", help="only the backend (for the add-on)")
            command.add_argument("--wheels", metavar="FOLDER", help="install from this folder of wheels, not online")
        if name == "package":
            command.add_argument(
                "--blender", metavar="PATH", action="append", default=[],
                help="Blender that builds it (default: the first one found); more than one: the others validate it",
            )  # fmt: skip
        names = ("--output", "--results") if name == "bench" else ("--output",)
        command.add_argument(*names, metavar="DIR", help="folder for summary.json and results (output/...)")
    return top


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # as in `cli.main`: a file name may not fit the console's code page
            stream.reconfigure(errors="backslashreplace")
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["farm-host"]:
        return farm.host(words[1:])
    if words and words[0] in ("farm", "farm-task"):
        return farm.task(words[0], words[1:])
    module = {"freeze": ["torch_backend", "freeze"], "bench": ["benchmarks.bench"]}.get(words[0] if words else "")
    if module and {"-h", "--help"} & set(words) and backend_environment().ready():
        return run_child([backend_environment().python, "-P", "-m", *module, "--help"], cwd=WORKING_FOLDER)
    args, extra = parser().parse_known_args(words)
    if extra and args.command in ("doctor", "setup", "package"):
        parser().error(f"unrecognized arguments: {' '.join(extra)}")
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
            signal.signal(getattr(signal, name), _interrupt)
    default = _place_of(args.clip, extra) if args.command == "freeze" else args.command
    try:
        output = Path(os.path.abspath(args.output or Path("output") / default))
    except OSError:
        print("Error: The current folder no longer exists: change to another folder and start again.", file=sys.stderr)
        return ExitCode.USAGE
    error = ""
    try:
        output.mkdir(parents=True, exist_ok=True)
        # The summary of an earlier run must not be mistaken for this run's.
        (output / "summary.json").unlink(missing_ok=True)
        tempfile.TemporaryFile(dir=output).close()  # fails now if the folder is not writable, not after minutes of work
        code = dispatch(args, extra, output)
    except LauncherError as refused:
        error, code = str(refused), refused.exit_code
    except KeyboardInterrupt as interrupt:
        error, code = "Cancelled.", ExitCode.CANCELLED
        if not interrupt.args:
            print("Cancelled. Run the same command again to continue.", file=sys.stderr, flush=True)
    except OSError as failed:
        error, code = _unwritable(failed, output)
    if code and not error:
        error = failed_job(output) or f"{args.command} ended with exit code {code}: see what it printed."
    elif error and code != ExitCode.CANCELLED:
        print(f"Error: {error}", file=sys.stderr, flush=True)
    if code:
        with contextlib.suppress(OSError):
            failure = {"command": args.command, "exit_code": code, "error": error}
            write_json(output / "summary.json", {**read_summary(output), **failure})
    return code


def _place_of(clip: str, options: Sequence[str], folder: Path = Path("output")) -> str:
    """Name of the folder in output/ for a freeze of a clip or shot; different inputs get different folders.

    It is the name of the clip, or of shot and take. If another input already uses it, a digest of the path is appended.
    """
    place = Path(clip)
    name = place.stem
    if "://" not in clip and is_shot(clip):
        if name == "shot":  # the default of `--shot-name`; the parent folder has the telling name
            name = place.absolute().parent.name
        name = f"{name}_{take_of(clip, options)}"
    name = re.sub(r"[^\w.-]+", "_", name)
    return f"{name}-{path_digest(_absolute(clip))}" if _has_different_source(folder / name, clip) else name


def _has_different_source(folder: Path, clip: str) -> bool:
    """True if a folder is known to hold results of another clip or shot than `clip`."""
    target, shots = _absolute(clip), list(folder.glob("*" + SHOT_SUFFIX))
    if "://" not in clip and is_shot(clip):
        shot_path = str(read_summary(folder).get("shot") or "")
        return bool(shots) or (bool(shot_path) and os.path.normcase(shot_path) != os.path.normcase(target))
    is_from_shot = not shots and bool(read_summary(folder).get("shot"))
    return is_from_shot or any(is_imported_from(shot, target) is False for shot in shots)


def _absolute(clip: str) -> str:
    return clip if "://" in clip else os.path.abspath(clip)


def _unwritable(failed: OSError, output: Path) -> tuple[str, int]:
    """(sentence, exit code) for an error of the system, usually that the output folder is not writable."""
    where = Path(os.fsdecode(failed.filename)) if isinstance(failed.filename, (str, bytes)) else output
    code = ExitCode.DISK if is_disk_full(failed) else ExitCode.USAGE
    if where != output and where not in output.parents and output not in where.parents:
        code = ExitCode.DISK if code == ExitCode.DISK else ExitCode.ENVIRONMENT
        return f"{failed.strerror or failed}: {where}. Run `doctor`, then run the same command again.", code
    return f"Cannot write to {output}: {failed.strerror or failed}. Choose another --output folder.", code


def dispatch(args: argparse.Namespace, extra: list[str], output: Path) -> int:
    """Runs the chosen command; returns its exit code."""
    if args.command == "demo":
        return freeze(str(DEMO_CLIP), output, ["--preset", "preview", *extra])
    if args.command == "freeze":
        return freeze(args.clip, output, extra)
    if args.command == "setup":
        return setup(args.bpy, args.tests, args.backend, output, args.wheels)
    if args.command == "package":
        return package(args.blender, output)
    if args.command == "bench":
        return bench(extra, output)
    if args.command == "test":
        return run_sensitive_tests(extra, output) if args.instructions else run_tests(extra, args.bpy, output)
    return doctor(output, args.gpu)
