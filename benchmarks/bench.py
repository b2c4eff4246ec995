"""Benchmark of the method: hosts x supervision x presets on scenes with truth, and its report.

    python3 splannequin.py bench [--quick] [--ablations]
    python -m benchmarks.bench --size medium --seeds 2 --results DIR
    python -m benchmarks.bench --truth FOLDER --shot SHOT --results DIR    your own scenes

Each run is a child process: it trains (or resumes from its checkpoint), freezes, scores, and writes
RESULTS/<run-id>.json atomically. Runs with a record are skipped, so an interrupted benchmark can continue.
With `--jobs N`, N children run at once, each on its own cores. Children end when this process ends for any reason.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch, as in cli.main: spinning threads starve others

from benchmarks.report.records import RECORD_VERSION, RunRecord, finished, machine_facts, save_record
from benchmarks.report.truth import TruthScene
from benchmarks.sources import Log, child_environ, end_with_parent, load_source, make_scenes
from benchmarks.synthetic.make import default_folder
from benchmarks.synthetic.sizes import HARD, KINDS, LIMITS, SIZES
from torch_backend.contract import METHODS, SUPERVISIONS, ExitCode, JobError, TrainParams, from_dict, read_json
from torch_backend.job import new_job, run_job
from torch_backend.native import default_threads
from torch_backend.scene import load_scene, split_frames
from torch_backend.shot import content_key, locked, write_json
from torch_backend.train import PRESETS, TrainConfig, config_from_params
from torch_backend.train.config import config_to_json
from torch_backend.train.device import choose_device

HOSTS = {"hexplane": "4DGaussians", "mlp": "Deformable 3DGS", "control_points": "SC-GS"}
"""TrainConfig.method of each published host -> the method's name."""
QUICK_GAUSSIANS = 5000
QUERIES = {"none": "plain", "paper": "plain", "support": "nearest"}
"""Supervision -> time query of its freeze: `plain` at t* itself, as published; `nearest` where a Gaussian was seen."""
HOLDOUT = 8
"""One of every `HOLDOUT` frames is held out of training."""


@dataclass(frozen=True)
class Ablation:
    """One change to a method, or one part removed from it."""

    name: str
    host: str
    supervision: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Dotted field of TrainConfig -> value."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Field of TrainParams -> value."""
    query: str = ""
    """Time query of the freeze; empty for the value in `QUERIES`."""


ABLATIONS = (
    Ablation("no hidden loss", "hexplane", "paper", {"supervision.weight_hidden": 0.0}),
    Ablation("no defective loss", "hexplane", "paper", {"supervision.weight_defective": 0.0}),
    Ablation("no confidence weighting", "hexplane", "paper", {"supervision.tau": 0.0}),
    Ablation("canonical parameters pulled too", "hexplane", "paper", {"supervision.pulls": "all"}),
    Ablation("canonical parameters pulled too", "mlp", "paper", {"supervision.pulls": "all"}),
    Ablation(
        "a tenth of the weights",
        "control_points",
        "paper",
        {"supervision.weight_hidden": 1.0, "supervision.weight_defective": 1.0},
    ),
    Ablation("detector: weight", "hexplane", "paper", training={"detector": "weight"}),
    Ablation("detector: grad_signed", "hexplane", "paper", training={"detector": "grad_signed"}),
    Ablation("gate, no anchors", "auto", "none"),
    Ablation("gate, paper's anchors", "auto", "paper"),
    Ablation("frozen at t* itself", "auto", "support", query="plain"),
    Ablation("frozen at t* itself", "hexplane", "support", query="plain"),
    Ablation("frozen where seen nearest", "hexplane", "none", query="nearest"),
    Ablation("frozen where seen nearest", "hexplane", "paper", query="nearest"),
    Ablation("no exposure", "auto", "support", {"exposure.on": False}),
)
"""Ablations of the paper and of this project. The main table's detector is grad_norm. Hosts with `support` have no
gate. Ablations that only change the freeze share a training run."""


@dataclass
class RunSpec:
    """One run of the plan, passed to its child process."""

    source: str
    """Location of the scene, see `load_source`."""
    scene_key: str
    """Content hash of the scene."""
    host: str
    supervision: str
    preset: str
    variant: str = "default"
    seed: int = 0
    query: str = ""
    """Time query of Gaussians at t*: nearest or plain; empty for the value in `QUERIES`."""
    overrides: dict[str, Any] = field(default_factory=dict)
    """Dotted field of TrainConfig -> value."""
    training: dict[str, Any] = field(default_factory=dict)
    """Field of TrainParams -> value."""
    iterations: int = 0
    """0 uses the preset's value; also for `width` and `max_gaussians`."""
    width: int = 0
    max_gaussians: int = 0
    holdout_phase: int = 0
    """Index of the held-out frame within every `HOLDOUT`, chosen to keep the instants in training."""
    device: str = "auto"
    """cpu, cuda or auto."""

    def __post_init__(self) -> None:
        self.query = self.query or QUERIES[self.supervision]

    def params(self, run: str) -> TrainParams:
        """The training job's parameters. ValueError for an unknown name in `training`."""
        unknown = set(self.training) - {f.name for f in dataclasses.fields(TrainParams)}
        if unknown:
            raise ValueError(f"a training job has no parameter {min(unknown)}")
        return TrainParams(
            run=run,
            preset=self.preset,
            method=self.host,
            supervision=self.supervision,
            iterations=self.iterations,
            width=self.width,
            max_gaussians=self.max_gaussians,
            holdout=HOLDOUT,
            seed=self.seed,
            device=self.device,
            **self.training,
        )

    def config(self) -> TrainConfig:
        """The full training configuration. ValueError for an unknown parameter or override."""
        config = config_from_params(self.params("bench"))
        for path, value in {"holdout_phase": self.holdout_phase, **self.overrides}.items():
            override(config, path, value)
        return config

    @property
    def run_name(self) -> str:
        """The training run's folder in the shot. Runs that differ only in their time query share it."""
        return f"bench-{content_key(config_to_json(self.config()))}"

    @property
    def run_id(self) -> str:
        """Name of the record: readable words and a hash of scene and settings, not of the code."""
        words = f"{Path(self.source).stem}-{self.host}-{self.supervision}-{self.preset}-{self.variant}-s{self.seed}"
        key = content_key(RECORD_VERSION, self.scene_key, config_to_json(self.config()), self.query, self.device)
        return re.sub(r"[^\w-]+", "-", words).strip("-")[:80] + f"-{key}"


def override(config: Any, path: str, value: Any) -> None:
    """Sets a dotted field of a configuration. ValueError for an unknown field."""
    *parents, name = path.split(".")
    for parent in parents:
        config = getattr(config, parent, None)
    if config is None or name not in {f.name for f in dataclasses.fields(config)}:
        raise ValueError(f"the training configuration has no {path}")
    setattr(config, name, value)


# ------------------------------------------------------------------------------------------------- the plan


def _settings(reference: bool, ablations: bool) -> tuple[list[RunSpec], list[str]]:
    """(settings that `plan` runs on every scene, sentences about missing ones)."""
    offered = [host for host in HOSTS if host in METHODS]
    supervised = [s for s in ("none", "paper", "support") if s in SUPERVISIONS]
    settings = [RunSpec("", "", host, supervision, "preview") for host in offered for supervision in supervised]
    settings += [RunSpec("", "", "auto", "support", "preview"), RunSpec("", "", "static", "none", "preview")]
    if reference:
        published = {"host_config": "reference"}
        settings += [
            RunSpec("", "", host, supervision, "preview", "reference", training=published)
            for host in offered
            for supervision in supervised
            if supervision != "support"
        ]
    notes = [
        f"{name} is not in this report: the trainer has no host {host!r}."
        for host, name in HOSTS.items()
        if host not in METHODS
    ]
    if ablations:
        for a in ABLATIONS:
            spec = RunSpec("", "", a.host, a.supervision, "preview", a.name, query=a.query)
            spec = dataclasses.replace(spec, overrides=dict(a.overrides), training=dict(a.training))
            try:
                spec.config()
            except ValueError as error:
                notes.append(f"The ablation {a.name!r} is not in this report: {error}.")
            else:
                settings.append(spec)
    return settings, notes


def plan(
    sources: Sequence[str],
    results: Path,
    *,
    presets: Sequence[str] = ("preview",),
    seeds: Sequence[int] = (0,),
    reference: bool = False,
    ablations: bool = False,
    methods: Sequence[str] = (),
    **common: Any,
) -> tuple[list[RunSpec], list[str]]:
    """(runs, sentences about missing ones): hosts x {none, paper, support}, auto and static, then ablations.

    Runs are ordered by setting, then scene, so that an interrupted benchmark has compared settings on every scene.
    `reference` adds the hosts with the published sizes, rates and schedules, without supervision and with `paper`.
    `methods` limits TrainConfig.method to these values, unless empty. `common` goes to every `RunSpec`: iterations,
    width, max_gaussians, device.
    """
    settings, notes = _settings(reference, ablations)
    settings = [setting for setting in settings if not methods or setting.host in methods]
    scenes = [(source, load_source(source, results)) for source in sources]
    runs = []
    for preset in presets:
        for seed in seeds:
            for setting in settings:
                for source, scene in scenes:
                    runs.append(
                        dataclasses.replace(
                            setting,
                            source=source,
                            scene_key=scene.key,
                            preset=preset,
                            seed=seed,
                            holdout_phase=hold_out_phase(scene),
                            **common,
                        )
                    )
    return runs, notes


def hold_out_phase(scene: TruthScene) -> int:
    """The hold-out phase that holds out the fewest instants; among equals the lowest. 0 for a real clip."""
    if scene.kind == "real":
        return 0
    loaded = load_scene(scene.shot)

    def lost(phase: int) -> int:
        _, test = split_frames(loaded.solved, HOLDOUT, phase)
        return len({loaded.frames[i] for i in test} & set(scene.t_stars))

    return min(range(HOLDOUT), key=lost)


# ------------------------------------------------------------------------------------------------- running


def run_plan(runs: Iterable[RunSpec], results: Path, jobs: int = 1) -> list[str]:
    """Runs every spec without a record, `jobs` children at once. Returns sentences about failed runs.

    Specs that share a training run are run one after the other. KeyboardInterrupt stops the children at their next
    checkpoint and is raised again.
    """
    failures = []
    todo = [spec for spec in runs if not finished(results, spec.run_id)]
    trained = {spec.run_id: (spec.source, spec.run_name) for spec in todo}
    total, running = len(todo), dict[int, tuple[RunSpec, subprocess.Popen[bytes]]]()
    try:
        while todo or running:
            for slot in set(range(jobs)) - set(running):
                busy = {trained[spec.run_id] for spec, _ in running.values()}
                spec = next((spec for spec in todo if trained[spec.run_id] not in busy), None)
                if spec is not None:
                    todo.remove(spec)
                    print(f"[{total - len(todo)}/{total}] {spec.run_id}", flush=True)
                    running[slot] = spec, _start(spec, results, slot, jobs)
            time.sleep(0.05)
            for slot, (spec, child) in list(running.items()):
                if child.poll() is None:
                    continue
                del running[slot]
                _close(child)
                if child.returncode != ExitCode.OK or not finished(results, spec.run_id):
                    log = results / "logs" / f"{spec.run_id}.txt"
                    failures.append(f"{spec.run_id} failed (exit code {child.returncode}): see {log}.")
                    print(f"  {failures[-1]}", flush=True)
    except BaseException:
        for _, child in running.values():
            child.terminate()
        for _, child in running.values():
            child.wait()
            _close(child)
        raise
    return failures


def cores() -> list[int]:
    """Numbers of the CPU cores available to this process."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def default_jobs(device: str) -> int:
    """2 on CPUs with two or more cores, because most of a training step is not parallel; 1 on a GPU."""
    return 1 if choose_device(device).type == "cuda" else min(2, len(cores()))


def _start(spec: RunSpec, results: Path, slot: int, jobs: int) -> subprocess.Popen[bytes]:
    """Starts one spec in a child process on its share of the cores, with its output in RESULTS/logs."""
    request = results / "requests" / f"{spec.run_id}.json"
    write_json(request, dataclasses.asdict(spec))
    log = results / "logs" / f"{spec.run_id}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-P", "-m", "benchmarks.bench", "--work", str(request), "--results", str(results)]
    mine = cores()
    share = max(1, len(mine) // jobs)
    threads = {f"{library}_NUM_THREADS": str(share) for library in ("OMP", "MKL", "OPENBLAS")}
    with open(log, "w", encoding="utf-8") as out:
        try:
            # A child inherits its parent's cores. Without sched_setaffinity each run uses all cores (see its record).
            if hasattr(os, "sched_setaffinity") and jobs > 1:
                os.sched_setaffinity(0, {mine[(slot * share + n) % len(mine)] for n in range(share)})
            return subprocess.Popen(
                [*command, "--jobs", str(jobs)],
                env=child_environ(**threads),
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        finally:
            if hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(0, mine)


def _close(child: subprocess.Popen[bytes]) -> None:
    if child.stdin:
        child.stdin.close()


def work(request: Path, results: Path, jobs: int) -> int:
    """Work of the child process: trains, freezes, scores, writes the record. Returns an exit code."""
    end_with_parent()
    spec: RunSpec = from_dict(RunSpec, read_json(request))
    if spec.run_id != request.stem:
        raise ValueError("the program was changed while the benchmark ran: start it again")
    truth = load_source(spec.source, results)
    run_name = spec.run_name
    code, device, trained = train_spec(spec, truth, jobs)
    return code or _judge(spec, truth, run_name, results, trained, device)


def train_spec(spec: RunSpec, truth: TruthScene, jobs: int) -> tuple[int, str, dict[str, Any]]:
    """Trains a spec unless it is trained: (exit code, device, facts of the training that its summary lacks)."""
    run_name, known = spec.run_name, PRESETS[spec.preset]
    # The job's parameters name a preset. During this call the preset of that name includes the plan's overrides.
    PRESETS[spec.preset] = lambda: _overridden(known(), spec)
    try:
        if config_from_params(spec.params(run_name)) != spec.config():
            raise ValueError(f"an override of {spec.run_id} is set by the job's parameters: give it there")
        # A child of a benchmark that was just killed may still be writing its last checkpoint.
        with locked(truth.shot.root / "bench" / f"{run_name}.lock"):
            return _train(spec, truth, run_name, jobs)
    finally:
        PRESETS[spec.preset] = known


def _train(spec: RunSpec, truth: TruthScene, run_name: str, jobs: int) -> tuple[int, str, dict[str, Any]]:
    folder = truth.shot.run(run_name)
    path = folder / "bench.json"
    facts: dict[str, Any] = read_json(path) if path.is_file() else {}
    whole, trained = not folder.exists(), (folder / "summary.json").is_file()
    pace = {"threads": default_threads(), "jobs": jobs}
    if not trained:
        if not whole and pace.items() != {name: facts.get(name) for name in pace}.items():
            pace = dict.fromkeys(pace)  # training began at another pace, so its seconds are unknown
        facts = {"version": 1, **pace, "train_cpu_seconds": None}
        write_json(path, facts)
    since = time.process_time()
    # Several children train runs of one shot at once, each under a lock named after its run.
    code, summary = run_job(new_job(truth.shot, "train", spec.params(run_name)), print, exclusive=False)
    if code != ExitCode.OK:
        return int(code), "", facts
    if whole:
        facts["train_cpu_seconds"] = round(time.process_time() - since, 2)
        write_json(path, facts)
    return int(ExitCode.OK), summary["device"], facts


def _overridden(config: TrainConfig, spec: RunSpec) -> TrainConfig:
    for path, value in {"holdout_phase": spec.holdout_phase, **spec.overrides}.items():
        override(config, path, value)
    return config


def _judge(
    spec: RunSpec, truth: TruthScene, run_name: str, results: Path, trained: dict[str, Any], trained_on: str
) -> int:
    """Scores the trained run on the device that trained it, and writes its record."""
    from benchmarks.report.evaluate import evaluate_run

    measured = evaluate_run(truth, run_name, spec.query, results, spec.run_id, Log(), trained_on)
    record = RunRecord(
        run_id=spec.run_id,
        scene=truth.name,
        kind=truth.kind,
        cameras=truth.cameras,
        host=spec.host,
        supervision=spec.supervision,
        preset=spec.preset,
        variant=spec.variant,
        seed=spec.seed,
        query=spec.query,
        train_cpu_seconds=trained.get("train_cpu_seconds"),
        threads=trained.get("threads"),
        jobs=trained.get("jobs"),
        machine=machine_facts(),
        command=f"python -m benchmarks.bench --work requests/{spec.run_id}.json",
        device=trained_on,
        finished=time.strftime("%Y-%m-%d %H:%M", time.gmtime()),
        **measured,
    )
    save_record(results, record)
    return int(ExitCode.OK)


# ------------------------------------------------------------------------------------------------- command line


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns an exit code."""
    args = _parser().parse_args(argv)
    if args.jobs < 0 or args.seeds < 1:
        _parser().error("--jobs and --seeds count runs: they should be 1 or more")
    results = Path(args.results).absolute()
    if args.work:
        return work(Path(args.work), results, args.jobs)
    if args.tied:
        end_with_parent()
    from benchmarks.report.write import write_report

    results.mkdir(parents=True, exist_ok=True)
    quick = {"max_gaussians": args.max_gaussians or QUICK_GAUSSIANS} if args.quick else {}
    sources = [f"truth:{Path(p).absolute()}" for p in args.truth] + [f"shot:{Path(p).absolute()}" for p in args.shot]
    try:
        kinds = tuple(dict.fromkeys((*(LIMITS if args.limits else ()), *(HARD if args.hard else ()), *args.kinds)))
        if not sources or args.size or args.quick or kinds:
            cameras = ("exact", "solved") if args.cameras == "both" else (args.cameras,)
            size = args.size or ("quick" if args.quick else "medium")
            folder = Path(args.scenes).absolute()
            sources += make_scenes(size, args.tuning, cameras, folder, args.bpy, kinds or ("plain",))
        runs, notes = plan(
            sources,
            results,
            presets=args.preset or ("preview",),
            seeds=range(args.seeds),
            reference=args.reference,
            ablations=args.ablations,
            methods=args.methods or (),
            **{"iterations": args.iterations, "width": args.width, "max_gaussians": args.max_gaussians, **quick},
            device=args.device,
        )
        notes += run_plan(runs, results, args.jobs or default_jobs(args.device))
    except (RuntimeError, JobError, FileNotFoundError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return int(ExitCode.USAGE)
    except KeyboardInterrupt:
        print("Interrupted. The same command goes on from here.", flush=True)
        return int(ExitCode.CANCELLED)
    path = write_report(results, results / "report", [r.run_id for r in runs], notes, _command(args, argv))
    print(f"Report: {path}", flush=True)
    return int(ExitCode.OK)


def _command(args: argparse.Namespace, argv: Sequence[str] | None) -> str:
    """The command line that the user typed, for this module or, if the launcher started it, for the launcher."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not args.tied:
        return subprocess.list2cmdline(["python", "-m", "benchmarks.bench", *words])
    for name in ("--tied", "--bpy", "--results"):
        at = words.index(name) if name in words else len(words)
        del words[at : at + 1 + (name != "--tied")]
    usual = Path(args.results) == Path("output/bench").absolute()
    return subprocess.list2cmdline(
        ["python3", "splannequin.py", "bench", *([] if usual else ["--output", args.results]), *words]
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench", description="Compares hosts and supervisions with ground truth.")
    parser.add_argument(
        "--quick", action="store_true", help="use quick scenes, exact cameras and at most 5,000 Gaussians"
    )
    parser.add_argument(
        "--size", choices=tuple(SIZES), help="size of synthetic scenes (default: medium, if no scene is given)"
    )
    parser.add_argument(
        "--cameras", choices=("exact", "solved", "both"), default="exact", help="cameras of synthetic scenes"
    )
    parser.add_argument("--scenes", default=str(default_folder()), metavar="DIR", help="folder of synthetic scenes")
    parser.add_argument("--tuning", action="store_true", help="use the scenes for tuning instead of those for reports")
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=[], metavar="KIND", help="use only scenes of these kinds"
    )
    parser.add_argument("--limits", action="store_true", help="use only the four scenes that violate an assumption")
    parser.add_argument("--hard", action="store_true", help="use only the hard scenes")
    parser.add_argument(
        "--truth",
        action="append",
        default=[],
        metavar="FOLDER",
        help="scene with rendered ground truth; may be repeated",
    )
    parser.add_argument(
        "--shot", action="append", default=[], metavar="SHOT", help="solved shot of a real clip; may be repeated"
    )
    parser.add_argument(
        "--results", default="output/bench", metavar="DIR", help="folder for records, pictures and report"
    )
    parser.add_argument(
        "--preset", action="append", choices=tuple(PRESETS), help="training preset; may be repeated (default: preview)"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="methods to run (default: all)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="training seeds 0 to N - 1")
    parser.add_argument(
        "--reference",
        action="store_true",
        help="also run hosts in their published settings, with supervision none and paper",
    )
    parser.add_argument("--ablations", action="store_true", help="also run the ablations of the paper and ours")
    parser.add_argument("--iterations", type=int, default=0, help="training steps (0: the value of the preset)")
    parser.add_argument(
        "--width", type=int, default=0, help="width of training images in pixels (0: the value of the preset)"
    )
    parser.add_argument(
        "--max-gaussians", type=int, default=0, help="largest number of Gaussians (0: the value of the preset)"
    )
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument(
        "--jobs",
        type=int,
        default=0,
        metavar="N",
        help="concurrent runs, each with an equal share of the cores (default: 2)",
    )
    parser.add_argument("--bpy", metavar="PYTHON", help="Python with bpy, for rendering synthetic scenes")
    parser.add_argument("--tied", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
