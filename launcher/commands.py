"""The commands freeze (and demo), setup and bench."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch_backend.contract import (
    BACKEND,
    ExitCode,
    ShotFolder,
    TakeFolder,
    command_line,
    is_shot,
    read_json,
    take_figures,
    verdict_lines,
)
from torch_backend.shot import write_json

from .blender import get_blender, set_up_wheel
from .children import run_blender, run_child, say, tied_command
from .environments import backend_environment, bench_environment, set_up
from .errors import LauncherError
from .places import ROOT, WORKING_FOLDER
from .summary import read_summary


def freeze(clip: str, output: Path, options: Sequence[str]) -> int:
    """Freezes a clip or a shot folder: runs the backend's steps, then the bake in Blender; returns an exit code.

    For a shot folder only the frames are frozen again; see `contract.freezes_a_shot`.
    """
    started = time.monotonic()
    if "://" not in clip and not any(mark in clip for mark in "#%*@") and not os.path.exists(clip):
        raise LauncherError(
            f"There is no clip at {clip}: pass the path of a video file, an image sequence or a shot folder.",
            ExitCode.USAGE,
        )
    backend = backend_environment()
    setting_up = set_up(backend, sys.executable)
    blender, took = get_blender()
    setting_up += took

    say(f"Freezing {clip} into {output}")
    is_existing_shot = "://" not in clip and is_shot(clip)
    command = tied_command(backend.python, "torch_backend", "freeze", clip, *options)
    freezing = time.monotonic()
    place = [] if is_existing_shot else ["--output", str(output)]
    code = run_child([*command, *place], cwd=WORKING_FOLDER, tied=True)
    if code:
        return code
    summary = _of_a_shot(clip, options, time.monotonic() - freezing) if is_existing_shot else read_summary(output)
    if "shot" not in summary or "take" not in summary:
        raise LauncherError(f"The backend wrote no results to {output / 'summary.json'}: see the messages above.", 1)
    write_json(output / "summary.json", summary)
    # The bake adds its figures to summary.json. Wall time and set-up are added after the bake.
    say(f"Compositing in {blender.label}")
    baking = time.monotonic()
    take = ["--shot", summary["shot"], "--take", summary["take"], "--output", str(output), "--tied"]
    bake = blender.running(ROOT / "splannequin_addon" / "run_in_bpy.py", "bake", *take)
    code = run_blender(bake, output / "blender.log", SPLANNEQUIN_BACKEND_PYTHON=backend.python)
    if code:
        return code
    summary = read_summary(output)
    stages = summary.setdefault("wall_seconds_by_stage", {})
    stages.update(setup=round(setting_up, 2), bake=round(time.monotonic() - baking, 2))
    summary["wall_seconds"] = round(time.monotonic() - started, 2)
    write_json(output / "summary.json", summary)
    closing_figures(summary, output)
    return 0


def take_of(shot: str, options: Sequence[str]) -> str:
    """Name of the take that `freeze SHOT` creates with these options."""
    parser, _ = command_line("splannequin.py", BACKEND)
    return str(parser.parse_known_args(["freeze", shot, *options])[0].take)


def _of_a_shot(shot: str, options: Sequence[str], seconds: float) -> dict[str, Any]:
    """Figures of a freeze of a shot folder that took `seconds`: the take and its quality."""
    folder = ShotFolder(shot)
    take = TakeFolder(folder.take(take_of(shot, options)))
    facts = read_json(take.facts)
    return {
        "version": 1,
        "shot": str(folder.root),
        **take_figures(facts, take),
        "run": facts.get("run"),
        "verdict": verdict_lines(facts),
        "wall_seconds_by_stage": {"freeze": round(seconds, 2)},
    }


def closing_figures(summary: dict[str, Any], output: Path) -> None:
    """Prints the last lines of a freeze: files, duration and quality."""
    stages = summary["wall_seconds_by_stage"]
    say(f"Figures:       {output / 'summary.json'}")
    say("Wall seconds:  " + ", ".join(f"{name} {seconds:.0f}" for name, seconds in stages.items()))
    if "registered" not in summary:  # a freeze of a shot folder: the backend has printed the take's quality
        say(f"{summary['wall_seconds']:.0f} s in all.")
        return
    psnr = summary["heldout_psnr_db"]
    quality = f"Held-out PSNR {psnr:.2f} dB" if psnr is not None else "No held-out frames"
    say(
        f"{quality}; trained {summary.get('train_seconds', 0):.0f} s; {summary.get('registered')} of "
        f"{summary.get('solved_frames', summary.get('frames'))} frames registered; "
        f"{summary['wall_seconds']:.0f} s in all."
    )
    for line in summary.get("verdict", []):
        say(line)


def setup(series: Sequence[str], testing: bool, backend_only: bool, output: Path, wheels: str | None = None) -> int:
    """Sets up the environments of the backend and of bpy wheels; returns an exit code.

    Args:
        series: Blender series of the bpy wheels; empty: one that fits this machine.
        testing: include the packages that `test` needs.
        backend_only: set up no bpy wheel unless `series` names one.
        output: folder for summary.json.
        wheels: folder to install from instead of a package index.
    """
    folder = None if wheels is None else Path(os.path.abspath(wheels))
    if folder is not None and not any(folder.glob("*.whl")):
        raise LauncherError(
            f"There are no wheels (*.whl) in {folder}: pass the folder that contains them.", ExitCode.USAGE
        )
    stages = {"backend": round(set_up(backend_environment(testing), sys.executable, folder), 2)}
    for name in series:
        stages[f"bpy-{name}"] = round(set_up_wheel(name, testing, folder)[1], 2)
    if not series and not backend_only:
        blender, took = get_blender(testing, folder)
        stages[blender.label.replace(" ", "-")] = round(took, 2)
    write_json(output / "summary.json", {"command": "setup", "exit_code": 0, "wall_seconds_by_stage": stages})
    say("Ready: " + ", ".join(stages))
    say(f"Backend Python, for the add-on's preferences: {backend_environment().python}")
    return 0


def bench(arguments: Sequence[str], output: Path) -> int:
    """Runs benchmarks/bench.py with `arguments` after setting up its packages; returns its exit code."""
    started = time.monotonic()
    backend = backend_environment()
    setting_up = set_up(backend, sys.executable)
    setting_up += set_up(bench_environment(), backend.python)
    renderer: list[str] = []
    if not _brings_scenes(arguments):
        blender, took = get_blender()
        if not blender.is_wheel:
            raise LauncherError(
                "The benchmark renders its scenes with a bpy wheel, and none fits this Python. Use Python 3.11 or "
                "3.13, or pass your own scenes with --truth or --shot."
            )
        renderer, setting_up = ["--bpy", blender.command[0]], setting_up + took
    command = [backend.python, "-P", "-m", "benchmarks.bench", "--results", str(output), "--tied", *renderer]
    code = run_child([*command, *arguments], cwd=WORKING_FOLDER, tied=True)
    summary: dict[str, Any] = {"command": "bench", "exit_code": code}
    summary.update(wall_seconds=round(time.monotonic() - started, 2), setup_seconds=round(setting_up, 2))
    if code == 0:
        summary["report"] = str(output / "report" / "report.md")
    write_json(output / "summary.json", summary)
    return code


def _brings_scenes(arguments: Sequence[str]) -> bool:
    """True if a benchmark's arguments need no synthetic scene."""
    named = {word.partition("=")[0] for word in arguments}
    return bool(named & {"--truth", "--shot"}) and not named & {"--size", "--quick", "--limits", "--hard"}
