"""Cost and results of a farm job, compared with its estimate and with one machine.

    python -m benchmarks.farm --output DIR [--openjd PYTHON] [--blender BLENDER] [--measure]

Makes short clips of the bundled one, exports them as a job from import to bake, and runs it with `openjd run`. Two
hosts run at once, each on its own core, with shuffled tasks and a new session for every few tasks. Prints estimated and
measured processor seconds of every process, including the engine, and elapsed time. Then freezes and bakes the same
instants on one machine with all its cores, and compares every frame bit for bit.

`--measure` first runs the job of another clip, of one instant in longer parts, and estimates by its rates. Without it
the program's rates are used. `--openjd` is a Python with openjd-cli (requirements/test.txt). Linux and macOS. Run it on
an idle machine; the load is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from torch_backend.contract import SHOT_SUFFIX, ShotFolder, read_json
from torch_backend.farm import records
from torch_backend.farm.cost import HOSTS
from torch_backend.footage.images import write_png
from torch_backend.footage.opening import open_source

ROOT = Path(__file__).resolve().parents[1]
CLIP = ROOT / "examples" / "sitting.mp4"
CLIP_FRAMES = 74
RATES_CLIP_FRAMES = 20
"""Frames of the shot that gives the rates. Its parts have 8 or 4 frames, to separate fixed cost and cost per frame."""
TASKSET = ("taskset", "--cpu-list")


@dataclass(frozen=True)
class Host:
    """Programs that tasks use on every host."""

    openjd: str
    """Python with openjd-cli."""
    blender: str
    """Blender's program; empty to use a bpy wheel."""


@dataclass
class Job:
    """A running job."""

    folder: Path
    host: Host
    session_tasks: int
    pending: dict[str, list[dict[str, str]]]
    """Step -> its tasks not yet taken, shuffled."""
    waits: dict[str, str]
    """Step -> the step that must end before it."""
    chance: np.random.Generator
    left: dict[str, int] = field(default_factory=dict[str, int])
    """Step -> number of unfinished tasks."""
    begun: int = 0
    """Number of started sessions."""
    seconds: float = 0.0
    """Processor seconds of all finished sessions, including their child processes."""
    failed: list[str] = field(default_factory=list[str])
    turn: threading.Condition = field(default_factory=threading.Condition)

    def __post_init__(self) -> None:
        self.left = {step: len(tasks) for step, tasks in self.pending.items()}

    def take(self) -> tuple[int, str, list[dict[str, str]]] | None:
        """Waits for (number of a session, step, some of its tasks). None if no tasks are left or a session failed."""
        with self.turn:
            while not self.failed and any(self.pending.values()):
                ready = [
                    s for s, tasks in self.pending.items() if tasks and not self.left.get(self.waits.get(s, ""), 0)
                ]
                if ready:
                    step = ready[self.chance.integers(len(ready))]
                    tasks = self.pending[step]
                    taken, self.pending[step] = tasks[: self.session_tasks], tasks[self.session_tasks :]
                    self.begun += 1
                    return self.begun, step, taken
                self.turn.wait()
        return None

    def work(self, core: int | None) -> None:
        """Runs one host: sessions one after another, on one core."""
        while taken := self.take():
            number, step, tasks = taken
            code, seconds = self.session(number, step, tasks, core)
            with self.turn:
                self.seconds += seconds
                self.left[step] -= len(tasks)
                if code:
                    self.failed.append(f"Session {number}, {step},")
                self.turn.notify_all()

    def session(self, number: int, step: str, tasks: list[dict[str, str]], core: int | None) -> tuple[int, float]:
        """Runs a session; returns (exit code, processor seconds)."""
        values = read_json(self.folder / "parameters.json")
        values |= {"HostPython": sys.executable, "BackendPython": sys.executable, "Blender": self.host.blender}
        command = [self.host.openjd, "-P", "-m", "openjd", "run", str(self.folder / "template.json")]
        command += ["-p", json.dumps(values), "--no-run-dependencies", "--step", step, "--tasks", json.dumps(tasks)]
        with open(self.folder / f"session-{number:03d}.log", "wb") as log:
            child = subprocess.Popen(pinned(core, command), stdout=log, stderr=log, env=environ())
            _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        return child.returncode, used.ru_utime + used.ru_stime


def environ() -> dict[str, str]:
    """This process's environment without variables that would change the tasks'."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "OMP_NUM_THREADS")}


def pinned(core: int | None, command: list[str]) -> list[str]:
    """A command pinned to one core where taskset exists, because a task uses all cores available to it."""
    return command if core is None or shutil.which("taskset") is None else [*TASKSET, str(core), *command]


def clip_of(folder: Path, name: str, first: int, frames: int, shrink: int) -> str:
    """Writes frames of the bundled clip as pictures, `shrink` times smaller; returns their file pattern."""
    place = folder / name
    place.mkdir(parents=True)
    for number, frame in enumerate(open_source(str(CLIP)).frames(first, first + frames - 1), 1):
        high, wide = (size // shrink for size in frame.pixels.shape[:2])
        cut = frame.pixels[: high * shrink, : wide * shrink].reshape(high, shrink, wide, shrink, 3)
        pixels = np.rint(cut.mean((1, 3), dtype=np.float64)).astype(frame.pixels.dtype)
        write_png(place / f"{name}.{number:04d}.png", pixels)
    return str(place / f"{name}.####.png")


def exported(folder: Path, clips: Sequence[str], words: Sequence[str]) -> dict[str, Any]:
    """Exports a job of clips; returns its estimate."""
    shots = ["--shots-folder", str(folder / "shots")]
    return json.loads(backend("--json", "farm", "export", *clips, "--output", str(folder), *shots, "--bake", *words))


def run(folder: Path, host: Host, session_tasks: int, at_once: int, seed: int) -> tuple[Job, float]:
    """Runs an exported job; returns (job, elapsed seconds)."""
    chance = np.random.default_rng(seed)
    pending: dict[str, list[dict[str, str]]] = {}
    waits: dict[str, str] = {}
    for step in read_json(folder / "template.json")["steps"]:
        space = {one["name"]: one["range"] for one in step["parameterSpace"]["taskParameterDefinitions"]}
        tasks = [dict(zip(space, map(str, values), strict=True)) for values in product(*space.values())]
        pending[step["name"]] = [tasks[n] for n in chance.permutation(len(tasks))]
        for one in step.get("dependencies", []):
            waits[step["name"]] = one["dependsOn"]
    job = Job(folder, host, session_tasks, pending, waits, chance)
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    hosts = [
        threading.Thread(target=job.work, args=(cores[n] if len(cores) >= at_once else None,)) for n in range(at_once)
    ]
    began = time.monotonic()
    for one in hosts:
        one.start()
    for one in hosts:
        one.join()
    if job.failed:
        raise SystemExit(f"{job.failed[0]} failed: see its log in {folder}")
    return job, time.monotonic() - began


def print_comparison(said: dict[str, Any], job: Job, clock: float, at_once: int) -> None:
    """Prints the estimate and the measurement side by side."""
    took: dict[str, list[float]] = {}
    for shot in sorted((job.folder / "shots").glob(f"*{SHOT_SUFFIX}")):
        for record in records.read(shot):
            took.setdefault(record["step"], []).append(record["cpu_seconds"])
    took["engine"] = [job.seconds - sum(map(sum, took.values()))]
    print(f"{'step':<10}{'tasks':>6}{'estimate':>12}{'measured':>12}  core-seconds")
    for row in said["rows"]:
        print(f"{row['kind']:<10}{row['tasks']:>6}{row['core_seconds']:>12.1f}{sum(took[row['kind']]):>12.1f}")
    print(f"engine: {job.begun} sessions; estimated {said['rows'][-1]['tasks']} on one host")
    for what, guess, was in (
        ("core-seconds", said["core_hours"] * 3600.0, job.seconds),
        ("seconds by the clock", said["on_hosts"][str(at_once)], clock),
    ):
        print(f"{what}: estimated {guess:.0f}, measured {was:.0f}, {100.0 * (guess / was - 1.0):+.0f} %")


def repeat_locally(folder: Path, target: Path, host: Host) -> None:
    """Repeats all takes and bakes of a job from its trained shots, on this machine with all its cores."""
    for shot in sorted((folder / "shots").glob(f"*{SHOT_SUFFIX}")):
        copy = target / "shots" / shot.name
        shutil.copytree(shot, copy, ignore=shutil.ignore_patterns("takes", "farm", "developed", "jobs"))
        for take in sorted(ShotFolder(shot).takes.iterdir()):
            t_star = read_json(take / "take.json")["t_star_frame"]
            backend("freeze", str(copy), "--take", take.name, "--t-star", str(t_star))
            out = target / "baked" / shot.name.removesuffix(SHOT_SUFFIX) / take.name
            baked(host, ["--shot", str(copy), "--take", take.name, "--output", str(out)])


def backend(*words: str) -> str:
    """Runs a command of the backend; returns its output."""
    env = environ() | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-P", "-m", "torch_backend", *words], cwd=ROOT, env=env, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def baked(host: Host, words: Sequence[str]) -> None:
    """Bakes a whole take in the hosts' Blender."""
    entered = [
        str(ROOT / "splannequin.py"),
        "farm-host",
        "--bake",
        "--python",
        sys.executable,
        "--blender",
        host.blender,
    ]
    output = subprocess.run(
        [sys.executable, *entered], capture_output=True, text=True, check=True, env=environ()
    ).stdout
    variables = dict(line.removeprefix("openjd_env: ").split("=", 1) for line in output.splitlines() if "=" in line)
    command: list[str] = json.loads(variables["SPLANNEQUIN_BLENDER_COMMAND"])
    command += [str(ROOT / "splannequin_addon" / "run_in_bpy.py"), *(["--"] if host.blender else []), "bake", *words]
    env = environ() | {"SPLANNEQUIN_BACKEND_PYTHON": sys.executable}
    subprocess.run(command, check=True, env=env, stdout=subprocess.DEVNULL)


def compared(ours: Path, theirs: Path) -> bool:
    """Prints how many files of two folders are identical, by folder and kind; True if all are."""
    same: dict[str, list[bool]] = {}
    different: list[str] = []
    for path in sorted(p for top in ("shots", "baked") for p in (theirs / top).rglob("*")):
        name = path.relative_to(theirs)
        if not path.is_file() or (name.parts[0] == "shots" and "takes" not in name.parts):
            continue
        if path.suffix not in (".exr", ".png", ".ply"):
            continue
        kind = (
            f"{'baked' if name.parts[0] == 'baked' else name.parts[4] if len(name.parts) > 5 else 'take'} {path.suffix}"
        )
        second = ours / name
        same.setdefault(kind, []).append(second.is_file() and second.read_bytes() == path.read_bytes())
        if not same[kind][-1]:
            different.append(str(name))
    for kind, equal in sorted(same.items()):
        print(f"{kind:<16}{sum(equal):>5} of {len(equal)} files are bit-identical")
    for name in different[:10]:
        print(f"  differs: {name}")
    return not different


def main() -> int:
    """Runs the benchmark; returns 1 if a frame differs, else 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, required=True, help="output folder, which must not exist yet")
    parser.add_argument("--openjd", default=sys.executable, help="Python with openjd-cli")
    parser.add_argument("--blender", default="", help="Blender's program (default: a bpy wheel)")
    parser.add_argument(
        "--measure", action="store_true", help="first measure another shot, and use its rates for the estimate"
    )
    parser.add_argument("--shots", type=int, default=3)
    parser.add_argument("--length", type=int, default=24, help="frames per shot")
    parser.add_argument("--part", type=int, default=3, help="frames per task")
    parser.add_argument("--shrink", type=int, default=2, help="divisor of the size of 640 x 480")
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--session-tasks", type=int, default=4)
    parser.add_argument("--at-once", type=int, default=2, choices=HOSTS)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    host = Host(args.openjd, args.blender)
    out: Path = args.output.absolute()
    out.mkdir(parents=True)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()}", flush=True)
    options = ["--iterations", str(args.iterations), "--session-tasks", str(args.session_tasks)]
    rates: list[str] = []
    if args.measure:
        clip = clip_of(out / "clips", "other", 18, RATES_CLIP_FRAMES, args.shrink)
        exported(out / "other", [clip], [*options, "--t-star", str(RATES_CLIP_FRAMES // 2), "--frames", "8"])
        run(out / "other", host, args.session_tasks, args.at_once, args.seed)
        backend("farm", "measure", str(out / "other" / "shots" / f"other{SHOT_SUFFIX}"), "--output", str(out))
        rates = ["--rates", str(out / "rates.json")]
    names = [f"shot{n + 1}" for n in range(args.shots)]
    spacing = max(1, (CLIP_FRAMES - args.length) // max(1, args.shots - 1))
    clips = [clip_of(out / "clips", name, 1 + n * spacing, args.length, args.shrink) for n, name in enumerate(names)]
    instants = f"{args.length // 3},{2 * args.length // 3}"
    options += ["--t-star", instants, "--frames", str(args.part)]
    said = exported(out / "job", clips, options)
    if rates:
        guess = f"{said['core_hours'] * 3600:.0f} core-seconds, {said['on_hosts'][str(args.at_once)]:.0f} by the clock"
        print(f"estimate by the program's built-in rates: {guess}")
        said = exported(out / "job", clips, [*options, *rates])
    job, clock = run(out / "job", host, args.session_tasks, args.at_once, args.seed)
    print(f"load {os.getloadavg()}", flush=True)
    print_comparison(said, job, clock, args.at_once)
    backend("farm", "measure", *map(str, (out / "job" / "shots").iterdir()), "--output", str(out / "job"))
    print(f"rates of this run: {out / 'job' / 'rates.json'}", flush=True)
    repeat_locally(out / "job", out / "alone", host)
    return 0 if compared(out / "job", out / "alone") else 1


if __name__ == "__main__":
    sys.exit(main())
