"""The benchmark of the method: hosts x supervision x presets on scenes with truth, and the report of it.

    python3 splannequin.py bench [--quick] [--ablations]
    python -m benchmarks.bench --size medium --seeds 2 --results DIR
    python -m benchmarks.bench --truth FOLDER --shot SHOT --results DIR    scenes of one's own

Every run is a child process: it trains (or goes on from its checkpoint), freezes, scores, and writes
RESULTS/<run-id>.json whole. A run that has its file is not run again, so an interrupted benchmark goes on where it was.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch, as cli.main does: spinning threads starve others

from benchmarks.sources import ROOT, Log, load_source, make_scenes
from benchmarks.synthetic.make import default_folder
from benchmarks.synthetic.sizes import SIZES
from torch_backend.contract import ExitCode, JobError, TrainParams, from_dict, read_json
from torch_backend.job import new_job, run_job
from torch_backend.report.records import RECORD_VERSION, RunRecord, finished, machine_facts, save_record
from torch_backend.report.truth import TruthScene
from torch_backend.scene import load_scene, split_frames
from torch_backend.shot import content_key, write_json
from torch_backend.train import PRESETS, TrainConfig, config_from_params
from torch_backend.train.config import METHODS, SUPERVISIONS, config_to_json

HOSTS = {"hexplane": "4DGaussians", "mlp": "Deformable 3DGS", "control_points": "SC-GS"}
"""TrainConfig.method of each published host -> its name."""
QUICK_GAUSSIANS = 5000
HOLDOUT = 8
"""Every how many frames one is kept out of training."""


@dataclass(frozen=True)
class Ablation:
    """One thing taken away from, or changed in, a method."""

    name: str
    host: str
    supervision: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Dotted field of TrainConfig -> value."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Field of TrainParams -> value."""
    query: str = "nearest"


ABLATIONS = (
    Ablation("no hidden loss", "hexplane", "paper", {"supervision.weight_hidden": 0.0}),
    Ablation("no defective loss", "hexplane", "paper", {"supervision.weight_defective": 0.0}),
    Ablation("no confidence weighting", "hexplane", "paper", {"supervision.tau": 0.0}),
    Ablation("detector: weight", "hexplane", "paper", training={"detector": "weight"}),
    Ablation("detector: grad_signed", "hexplane", "paper", training={"detector": "grad_signed"}),
    Ablation("gate, no anchors", "auto", "none"),
    Ablation("gate, paper's anchors", "auto", "paper"),
    Ablation("asked at t* itself", "auto", "support", query="plain"),
    Ablation("no exposure", "auto", "support", {"exposure.on": False}),
)
"""The paper's and ours. The main table's detector is grad_norm; its hosts with `support` are those without a gate."""


@dataclass
class RunSpec:
    """One run of the plan: what its child process is told."""

    source: str
    """Where the scene is, see `load_source`."""
    scene_key: str
    """Content of the scene."""
    host: str
    supervision: str
    preset: str
    variant: str = "default"
    seed: int = 0
    query: str = "nearest"
    overrides: dict[str, Any] = field(default_factory=dict)
    """Dotted field of TrainConfig -> value."""
    training: dict[str, Any] = field(default_factory=dict)
    """Field of TrainParams -> value."""
    iterations: int = 0
    """0: the preset's; the same for the next two."""
    width: int = 0
    max_gaussians: int = 0
    holdout_phase: int = 0
    """Which of every `HOLDOUT` frames is kept out: one that spares the instants."""
    device: str = "auto"
    """cpu, cuda or auto."""

    def params(self, run: str) -> TrainParams:
        """The training job's parameters. ValueError if one of `training` does not exist."""
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
        """Every number of the run. ValueError if something of it does not exist."""
        config = config_from_params(self.params("bench"))
        for path, value in {"holdout_phase": self.holdout_phase, **self.overrides}.items():
            override(config, path, value)
        return config

    @property
    def run_name(self) -> str:
        """The training run's folder in the shot: runs that differ only in how they are asked share it."""
        return f"bench-{content_key(config_to_json(self.config()))}"

    @property
    def run_id(self) -> str:
        """Name of the record: readable, and hashed from scene and settings, not from the code."""
        words = f"{Path(self.source).stem}-{self.host}-{self.supervision}-{self.preset}-{self.variant}-s{self.seed}"
        key = content_key(RECORD_VERSION, self.scene_key, config_to_json(self.config()), self.query, self.device)
        return re.sub(r"[^\w-]+", "-", words).strip("-")[:80] + f"-{key}"


def override(config: Any, path: str, value: Any) -> None:
    """Sets a dotted field of a configuration. ValueError if there is none of that name."""
    *parents, name = path.split(".")
    for parent in parents:
        config = getattr(config, parent, None)
    if config is None or name not in {f.name for f in dataclasses.fields(config)}:
        raise ValueError(f"the training configuration has no {path}")
    setattr(config, name, value)


# ------------------------------------------------------------------------------------------------- the plan


def plan(
    sources: Sequence[str],
    results: Path,
    *,
    presets: Sequence[str] = ("preview",),
    seeds: Sequence[int] = (0,),
    reference: bool = False,
    ablations: bool = False,
    **common: Any,
) -> tuple[list[RunSpec], list[str]]:
    """(runs, sentences about what is missing): hosts x {none, paper, support}, auto and static, then ablations.

    Runs are ordered so that an interrupted benchmark has compared something on every scene: by setting, then scene.
    `reference` adds the hosts with the published sizes, rates and schedules. `common` goes to every `RunSpec`:
    iterations, width, max_gaussians, device.
    """
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
        ]
    said = [
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
                said.append(f"The ablation {a.name!r} is not in this report: {error}.")
            else:
                settings.append(spec)
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
                            holdout_phase=_phase(scene),
                            **common,
                        )
                    )
    return runs, said


def _phase(scene: TruthScene) -> int:
    """The hold-out phase that keeps the fewest instants out of training; 0 (used elsewhere) if it can be."""
    if scene.kind == "real":
        return 0
    loaded = load_scene(scene.shot)

    def lost(phase: int) -> int:
        _, test = split_frames(loaded.solved, HOLDOUT, phase)
        return len({loaded.frames[i] for i in test} & set(scene.t_stars))

    return min(range(HOLDOUT), key=lost)


# ------------------------------------------------------------------------------------------------- running


def run_plan(runs: Iterable[RunSpec], results: Path) -> list[str]:
    """Runs what has no record yet, one child at a time. Returns sentences about runs that failed.

    KeyboardInterrupt ends the child at its next checkpoint and is raised again; so does the end of this process.
    """
    failures = []
    todo = [spec for spec in runs if not finished(results, spec.run_id)]
    for n, spec in enumerate(todo):
        print(f"[{n + 1}/{len(todo)}] {spec.run_id}", flush=True)
        code = _child(spec, results)
        if code != ExitCode.OK or not finished(results, spec.run_id):
            log = results / "logs" / f"{spec.run_id}.txt"
            failures.append(f"{spec.run_id} failed (exit code {code}): see {log}.")
            print(f"  {failures[-1]}", flush=True)
    return failures


def _child(spec: RunSpec, results: Path) -> int:
    """Runs one spec in a process of its own, its output to RESULTS/logs; returns the exit code."""
    request = results / "requests" / f"{spec.run_id}.json"
    write_json(request, dataclasses.asdict(spec))
    log = results / "logs" / f"{spec.run_id}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "benchmarks.bench", "--work", str(request), "--results", str(results)]
    with open(log, "w", encoding="utf-8") as out:
        child = subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=subprocess.STDOUT)
        try:
            return child.wait()
        except BaseException:
            child.send_signal(signal.SIGTERM)
            child.wait()
            raise


def work(request: Path, results: Path) -> int:
    """The child: trains, freezes, scores, writes the record. Returns an exit code."""
    _die_with(os.getppid())
    spec: RunSpec = from_dict(RunSpec, read_json(request))
    truth = load_source(spec.source, results)
    run_name = spec.run_name
    folder = truth.shot.run(run_name)
    whole = not folder.exists()
    # The job's parameters name a preset; this process knows one more, with the plan's overrides in it.
    known = PRESETS[spec.preset]
    PRESETS[spec.preset] = lambda: _overridden(known(), spec)
    if config_from_params(spec.params(run_name)) != spec.config():
        raise ValueError(f"an override of {spec.run_id} is set by the job's parameters: give it there")
    since = time.process_time()
    code, summary = run_job(new_job(truth.shot, "train", spec.params(run_name)), print)
    cpu_seconds = round(time.process_time() - since, 2)
    facts = folder / "bench.json"
    if code != ExitCode.OK:
        return int(code)
    if whole and not facts.is_file():
        write_json(facts, {"version": 1, "train_cpu_seconds": cpu_seconds, "machine": machine_facts()})
    return _judge(spec, truth, run_name, results, read_json(facts) if facts.is_file() else {}, summary["device"])


def _die_with(parent: int) -> None:
    """Ends this process at its next checkpoint when the benchmark that started it is gone, however it went.

    Two children of two benchmarks must not train one run.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="watch", daemon=True).start()


def _overridden(config: TrainConfig, spec: RunSpec) -> TrainConfig:
    for path, value in {"holdout_phase": spec.holdout_phase, **spec.overrides}.items():
        override(config, path, value)
    return config


def _judge(
    spec: RunSpec, truth: TruthScene, run_name: str, results: Path, trained: dict[str, Any], trained_on: str
) -> int:
    """Scores the trained run, on the device that trained it, and writes its record."""
    from torch_backend.report.evaluate import evaluate_run

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
    results = Path(args.results).absolute()
    if args.work:
        return work(Path(args.work), results)
    from torch_backend.report.write import write_report

    results.mkdir(parents=True, exist_ok=True)
    quick = {"max_gaussians": args.max_gaussians or QUICK_GAUSSIANS} if args.quick else {}
    sources = [f"truth:{Path(p).absolute()}" for p in args.truth] + [f"shot:{Path(p).absolute()}" for p in args.shot]
    try:
        if not sources or args.size or args.quick:
            cameras = ("exact", "solved") if args.cameras == "both" else (args.cameras,)
            size = args.size or ("quick" if args.quick else "medium")
            sources += make_scenes(size, args.tuning, cameras, Path(args.scenes).absolute())
        runs, said = plan(
            sources,
            results,
            presets=args.preset or ("preview",),
            seeds=range(args.seeds),
            reference=args.reference,
            ablations=args.ablations,
            **{"iterations": args.iterations, "width": args.width, "max_gaussians": args.max_gaussians, **quick},
            device=args.device,
        )
        said += run_plan(runs, results)
    except (RuntimeError, JobError, FileNotFoundError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return int(ExitCode.USAGE)
    except KeyboardInterrupt:
        print("Interrupted. The same command goes on from here.", flush=True)
        return int(ExitCode.CANCELLED)
    command = "python -m benchmarks.bench " + subprocess.list2cmdline(sys.argv[1:] if argv is None else list(argv))
    path = write_report(results, results / "report", [r.run_id for r in runs], said, command.strip())
    print(f"Report: {path}", flush=True)
    return int(ExitCode.OK)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench", description="Hosts and supervisions against truth.")
    parser.add_argument("--quick", action="store_true", help="quick scenes, exact cameras, at most 5,000 Gaussians")
    parser.add_argument("--size", choices=tuple(SIZES), help="synthetic scenes (medium, if no scene is named)")
    parser.add_argument("--cameras", choices=("exact", "solved", "both"), default="exact", help="of synthetic scenes")
    parser.add_argument("--scenes", default=str(default_folder()), metavar="DIR", help="of synthetic scenes")
    parser.add_argument("--tuning", action="store_true", help="scenes to tune on instead of those to report on")
    parser.add_argument("--truth", action="append", default=[], metavar="FOLDER", help="scene with rendered truth")
    parser.add_argument("--shot", action="append", default=[], metavar="SHOT", help="solved shot of a real clip")
    parser.add_argument("--results", default="output/bench", metavar="DIR", help="records, pictures and report")
    parser.add_argument("--preset", action="append", choices=tuple(PRESETS), help="default: preview")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="training seeds 0 to N - 1")
    parser.add_argument("--reference", action="store_true", help="hosts with the published settings as well")
    parser.add_argument("--ablations", action="store_true", help="the paper's and ours")
    parser.add_argument("--iterations", type=int, default=0, help="training steps (0: the preset's)")
    parser.add_argument("--width", type=int, default=0, help="width of training images in pixels (0: the preset's)")
    parser.add_argument("--max-gaussians", type=int, default=0, help="budget (0: the preset's)")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--work", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
