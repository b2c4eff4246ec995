"""Benchmarks for half an hour on a GPU: `python -m benchmarks.gpu STAGE --results DIR`.

Stages, of at most 8 minutes each; docs/gpu.md explains their figures:
  environment  the self-test, kernels compiled cold and warm, the tests that need a card
  sanitizer    compute-sanitizer's four tools over the tests of the rasteriser and of a field's planes
  raster       W2, W3 and W4 against gsplat in one run, a profile of a step, the cost of a hit list that is too short,
               the cost of a field's planes
  training     a solved shot (--shot) on both devices, two seeds: PSNR, ms per step, waits of the host
  limits       memory of 4, 6 and 8 GB, resuming on either device, a freeze, composited frames, views per second

Each stage writes DIR/gpu-STAGE.json. A failed part, or one without enough time left, is reported in that file, and the
other parts continue. `--only PART ...` selects parts of a stage. `--dry-run` runs the same code on the CPU at tiny
sizes; its figures are meaningless.
"""

import argparse
import cProfile
import itertools
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from torch.nn.functional import interpolate

from benchmarks import raster as raster_bench
from benchmarks.sources import Warnings
from benchmarks.workload import WORKLOADS, room
from torch_backend.cli import card_facts
from torch_backend.contract import METRICS_FILE, CameraPath, FreezeParams, JobError, LiveView, TrainParams, program
from torch_backend.deformation import HexPlane, HexPlaneConfig, planes_cuda
from torch_backend.footage.plates import Plates
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.composite.compositor import CompositeFrame, Compositor
from torch_backend.freeze.frozen import OutputFrame, freeze_at, render_frozen, span_of
from torch_backend.live import LiveSession
from torch_backend.native import default_threads
from torch_backend.raster import hit_lists
from torch_backend.scene import load_images, load_scene, split_frames
from torch_backend.shot import Shot, write_json
from torch_backend.train import PRESETS, config_from_params, load_run, train_shot
from torch_backend.train.device import cuda_refusal
from torch_backend.train.events import schedule_events
from torch_backend.train.loop import train_to_end
from torch_backend.train.memory import plan_memory
from torch_backend.train.pictures import training_size
from torch_backend.train.recorder import Recorder
from torch_backend.train.resume import restore_run, save_run
from torch_backend.train.trainer import Trainer

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 480.0
"""Time limit of a stage."""
TESTS = (
    "tests/backend/raster/test_cuda.py",
    "tests/backend/deformation/test_planes.py",
    "tests/backend/deformation/test_planes_cuda.py",
    "tests/backend/raster/test_ssim_cuda.py",
    "tests/backend/train/test_device.py",
)
"""Files with tests that need a card."""
TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
PEER = "benchmarks.peers.gsplat"


class Stage:
    """A running stage: its parts, its time limit and its results."""

    def __init__(
        self, dry: bool, shot: Path | None, results: Path, seconds: float = SECONDS, only: Sequence[str] = ()
    ) -> None:
        """`only`: names of the parts to run; empty for all."""
        self.dry, self.shot, self.results, self.only = dry, shot, results, only
        self.device = torch.device("cpu" if dry else "cuda")
        self.found: dict[str, Any] = {}
        self.until = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Seconds left."""
        return self.until - time.monotonic()

    def part(self, name: str, call: Callable[[], Any], needs: float = 0.0) -> None:
        """Records a part's result or failure. `needs`: seconds that must be left to start it."""
        if self.only and name not in self.only:
            return
        if self.left < needs and not self.dry:
            self.found[name] = {"left_out": f"{self.left:.0f} s were left, {needs:.0f} are needed"}
            return
        since = time.monotonic()
        try:
            result = call()
        except Exception as error:  # later parts still run: the GPU is available for a short time only
            traceback.print_exc()
            result = {"failed": f"{type(error).__name__}: {error}".splitlines()[0]}
        self.found[name] = {"seconds": round(time.monotonic() - since, 2), **result}
        print(f"{name}: {json.dumps(self.found[name])[:400]}", flush=True)

    def child(self, command: list[str], most: float, **environ: str) -> dict[str, Any]:
        """Runs a child process; returns its exit code, seconds, and the end of its output."""
        since = time.monotonic()
        paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        whole = {**os.environ, "PYTHONPATH": paths, "PYTHONSAFEPATH": "1", **environ}
        limit = max(10.0, min(most, self.left))
        try:
            ran = subprocess.run(command, cwd=ROOT, env=whole, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return {"exit_code": None, "seconds": round(limit, 1), "said": "it was ended: no time was left"}
        output = (ran.stdout + ran.stderr).strip().splitlines()
        if ran.returncode:
            print("\n".join(output), file=sys.stderr)
        return {"exit_code": ran.returncode, "seconds": round(time.monotonic() - since, 2), "said": output[-25:]}

    def scratch_shot(self) -> Shot:
        """A copy of the shot for training runs. JobError without a shot."""
        if self.shot is None:
            raise JobError("This part needs a solved shot.", "Name one with --shot.", 2)
        copy = self.results / "gpu-scratch.splannequin"
        if not copy.exists():
            shutil.copytree(self.shot, copy, ignore=shutil.ignore_patterns("runs", "takes", "jobs"))
        return Shot.open(copy)

    def wait(self) -> None:
        """Waits until the GPU is idle."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()


# ------------------------------------------------------------------------------------------------------ environment

COMPILE = """
import sys, time, torch
from torch_backend.deformation import planes_cuda
from torch_backend.raster import cuda, ssim_cuda
since = time.perf_counter()
device = torch.device(sys.argv[1])
cuda.warm_up(int(sys.argv[2]), device)
image = torch.rand(16, 16, 3, device=device)
ssim_cuda.ssim(image, image)
plane = torch.rand(1, 16, 8, 8, device=device).contiguous(memory_format=torch.channels_last)
planes_cuda.penalty([plane], [(1.0, 1.0, 1.0)])
if device.type == "cuda":
    torch.cuda.synchronize()
print(round(time.perf_counter() - since, 2))
"""


def environment(stage: Stage) -> None:
    refusal = "" if stage.dry else cuda_refusal()
    stage.part("card", lambda: card_facts("a dry run" if stage.dry else refusal))
    with tempfile.TemporaryDirectory() as cache:
        for name in ("compile_cold", "compile_warm"):
            command = [sys.executable, "-P", "-c", COMPILE, stage.device.type, "4"]
            stage.part(name, lambda command=command: stage.child(command, 240.0, WARP_CACHE_PATH=cache))
    picked = ["-k", "first_call"] if stage.dry else []
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-ra", *(TESTS[:1] if stage.dry else TESTS), *picked]
    stage.part("tests", lambda: stage.child(command, 300.0), needs=30.0)


# -------------------------------------------------------------------------------------------------------- sanitizer


def sanitizer(stage: Stage) -> None:
    tool = program("compute-sanitizer")
    if tool is None and not stage.dry:
        stage.found["sanitizer"] = {"failed": "compute-sanitizer (of the CUDA toolkit) is not on the PATH"}
        return
    picked = (TESTS[0], "-k", "first_call") if stage.dry else (*TESTS[:2], "-k", "cuda")
    tests = [sys.executable, "-P", "-m", "pytest", "-q", *picked]
    for name in TOOLS:
        before = [] if tool is None else [tool, "--tool", name, "--error-exitcode", "99", "--target-processes", "all"]
        before += ["--racecheck-report", "all"] if tool is not None and name == "racecheck" else []
        stage.part(name, lambda before=before: stage.child([*before, *tests], SECONDS / len(TOOLS)), needs=20.0)


# ----------------------------------------------------------------------------------------------------------- raster


def raster(stage: Stage) -> None:
    torch.set_num_threads(default_threads())
    bodies = {"ours": raster_bench.Body("cpu" if stage.dry else "cuda", stage.device.type)}
    if not stage.dry:
        bodies["graph"] = raster_bench.Body("cuda", stage.device.type, graph=True)
    missing = raster_bench._peer(PEER).missing(stage.device.type)
    if missing is None:
        bodies["gsplat"] = raster_bench.Body("peer", stage.device.type, peer=PEER)
    rivals = [name for name in bodies if name == "gsplat"]
    stage.found["peer"] = missing or "measured beside ours, round by round"
    for name in ("W0",) if stage.dry else ("W2", "W3", "W4"):
        rounds = 2 if stage.dry else 30
        stage.part(name, lambda n=name, r=rounds: raster_bench.measure(WORKLOADS[n], bodies, rivals, r), needs=60.0)
    largest = "W0" if stage.dry else "W4"
    stage.part("profile", lambda: _profile(stage, largest), needs=30.0)
    stage.part("host", lambda: _frames_host(stage, bodies["ours"]), needs=20.0)
    stage.part("short_list", lambda: _short_list(stage, largest), needs=30.0)
    stage.part("planes", lambda: _planes(stage), needs=20.0)


def _profile(stage: Stage, name: str) -> dict[str, Any]:
    """The 20 operations or kernels that take most of a frame and its gradient."""
    case = raster_bench._Case(
        room(*WORKLOADS[name]), raster_bench.Body("cpu" if stage.dry else "cuda", stage.device.type)
    )
    case.image()
    kinds = [torch.profiler.ProfilerActivity.CPU]
    kinds += [torch.profiler.ProfilerActivity.CUDA] if stage.device.type == "cuda" else []
    with torch.profiler.profile(activities=kinds) as seen:
        for _ in range(2 if stage.dry else 10):
            case.image()
        stage.wait()

    def spent(event: Any) -> float:
        return float(getattr(event, "self_device_time_total", 0.0) or event.self_cpu_time_total)

    rows = sorted(seen.key_averages(), key=spent, reverse=True)[:20]
    return {"us": [{"what": row.key[:80], "self_us": round(spent(row), 1), "calls": row.count} for row in rows]}


def _host(stage: Stage, run: Callable[[], Any], count: int) -> dict[str, Any]:
    """Mean host time of `count` runs: ms in total, without a profiler, and the functions that take most, by cProfile,
    each as [calls, own us, us including callees]. cProfile overstates small functions."""
    for _ in range(5):
        run()
    stage.wait()
    since = time.perf_counter()
    for _ in range(count):
        run()
    issued = time.perf_counter() - since
    stage.wait()
    whole = time.perf_counter() - since
    watch = cProfile.Profile()
    watch.enable()
    for _ in range(count):
        run()
    watch.disable()
    stage.wait()
    rows: dict[str, list[float]] = {}
    for entry in watch.getstats():
        code = entry.code
        name = code if isinstance(code, str) else f"{Path(code.co_filename).name}:{code.co_firstlineno} {code.co_name}"
        spent = [entry.callcount, 1e6 * entry.inlinetime, 1e6 * entry.totaltime]
        rows[name[:70]] = [round(value / count, 2) for value in spent]

    def most(column: int) -> dict[str, Any]:
        return dict(sorted(rows.items(), key=lambda row: row[1][column], reverse=True)[:45])

    times = {"ms": round(1e3 * whole / count, 3), "issued_ms": round(1e3 * issued / count, 3)}
    return {**times, "own": most(1), "with_calls": most(2)}


def _frames_host(stage: Stage, body: raster_bench.Body) -> dict[str, Any]:
    """`_host` for a small frame and its gradient."""
    case = raster_bench._Case(room(*WORKLOADS["W0" if stage.dry else "W2"]), body)
    return _host(stage, case.image, 20 if stage.dry else 500)


def _late_step(stage: Stage) -> dict[str, Any]:
    """Host and GPU figures (`_host`, `_busy`) of a late step of `preview`, with its field made and its trial over."""
    scene = load_scene(stage.scratch_shot())
    few, width = (600, 64) if stage.dry else (PRESETS["preview"]().densify.budget, PRESETS["preview"]().width)
    config = config_from_params(
        TrainParams(preset="preview", iterations=100 if stage.dry else 0, max_gaussians=few, width=width)
    )
    images = load_images(scene, scene.solved, *training_size(scene, width)).to(stage.device)
    trainer = Trainer(scene, images, scene.solved, config, Warnings(), {}, stage.device)
    while trainer.iteration < 0.6 * config.iterations:
        _step(trainer)
    row: dict[str, Any] = {"gaussians": len(trainer.model.gaussians), "open": len(trainer.model.open_rows())}
    for name, recorder in _ways(trainer).items():
        trainer.recorder = recorder
        row[name] = {**_busy(stage, trainer), **_host(stage, lambda: _step(trainer), 20 if stage.dry else 200)}
    return {**row, **_replays(trainer)}


def _ways(trainer: Trainer) -> dict[str, Recorder | None]:
    """Ways to run a step: launched kernel by kernel, or recorded as a CUDA graph."""
    ways: dict[str, Recorder | None] = {"launched": None}
    return ways if trainer.recorder is None else {**ways, "recorded": trainer.recorder}


def _replays(trainer: Trainer) -> dict[str, Any]:
    """Number of replayed steps, and why others were refused."""
    recorder = trainer.recorder
    return {} if recorder is None else {"replayed": recorder.replayed, "refused": recorder.refused}


def _whole_runs(stage: Stage) -> dict[str, Any]:
    """Seconds and held-out dB of whole runs of `preview`, two seeds, with steps launched and with steps recorded."""
    scene = load_scene(stage.scratch_shot())
    few, width = (600, 64) if stage.dry else (PRESETS["preview"]().densify.budget, PRESETS["preview"]().width)
    train, test = split_frames(scene.solved, 8, 0)
    images = load_images(scene, train + test, *training_size(scene, width)).to(stage.device)
    rows: dict[str, Any] = {}
    for seed in (0,) if stage.dry else (0, 1):
        for records in (False, True):
            steps = 20 if stage.dry else 0
            params = TrainParams(
                preset="preview", iterations=steps, max_gaussians=few, width=width, seed=seed, holdout=8
            )
            config = config_from_params(params)
            trainer = Trainer(scene, images[: len(train)], train, config, Warnings(), {}, stage.device)
            trainer.recorder = trainer.recorder if records else None
            stage.wait()
            since = time.perf_counter()
            train_to_end(trainer, stage.results / "gpu-scratch.safetensors", lambda _: None)
            stage.wait()
            seconds = time.perf_counter() - since
            rows[f"{'recorded' if records else 'launched'}-{seed}"] = {
                "seconds": round(seconds, 2), "steps": trainer.iteration, "gaussians": len(trainer.model.gaussians),
                "heldout_db": trainer.heldout_psnr(test, images[len(train) :]), **_replays(trainer),
            }  # fmt: skip
    return rows


def _short_list(stage: Stage, name: str) -> dict[str, Any]:
    """ms of a frame whose list holds all its hits, and of one whose list holds a tenth of them."""
    size = (60, 24, 17) if stage.dry else WORKLOADS[name]  # a dry run uses fibers
    case = raster_bench._Case(room(*size), raster_bench.Body("cuda", stage.device.type))
    times: dict[str, Any] = {}
    most, step = hit_lists.HITS_MAX, hit_lists.HITS_STEP
    try:
        for what, share in (("whole_ms", 1.0), ("tenth_ms", 0.1)):
            hit_lists.forget_demands()
            if share < 1.0:
                capacity = max(1, int(share * times["hits"]))
                hit_lists.HITS_MAX, hit_lists.HITS_STEP = capacity, min(step, capacity)
            case.image()
            times["hits"] = max(int(demand.most) for demand in hit_lists._demands.values())
            times[what] = round(min(case.run()[1] for _ in range(2 if stage.dry else 5)), 3)
    finally:
        hit_lists.HITS_MAX, hit_lists.HITS_STEP = most, step
        hit_lists.forget_demands()
    return times


def _planes(stage: Stage) -> dict[str, Any]:
    """ms for samples, penalty and gradients of a field's planes, by the project's kernels and by torch's operators.

    Uses 100,000 points at one instant, as in a step, so that gradients go to two rows of the time planes.
    """
    g, count = torch.Generator().manual_seed(0), 300 if stage.dry else 100_000
    field = HexPlane(HexPlaneConfig(time_nodes=40), torch.tensor([[-1.0] * 3, [1.0] * 3]), g).to(stage.device)
    where, when = (2.0 * torch.rand(count, 3, generator=g) - 1.0).to(stage.device), field.box.new_full((1,), 0.4)
    pull = torch.randn(count, 32, generator=g).to(stage.device)
    times: dict[str, Any] = {}
    for name, refused in (("ours_ms", ""), ("torch_ms", "for comparison")):
        planes_cuda.refused = refused
        try:
            spent: list[float] = []
            for _ in range(3 if stage.dry else 30):
                field.zero_grad()
                stage.wait()
                since = time.perf_counter()
                torch.autograd.backward([field.features_at(where, when), field.regularisation()], [pull, None])
                stage.wait()
                spent.append(time.perf_counter() - since)
            times[name] = round(1e3 * sorted(spent)[len(spent) // 2], 3)
        finally:
            planes_cuda.refused = ""
    return {"points": count, **times}


# --------------------------------------------------------------------------------------------------------- training


def training(stage: Stage) -> None:
    torch.set_num_threads(default_threads())
    devices = ("cpu",) if stage.dry else ("cuda", "cpu")
    for device in devices:  # the GPU first: the CPU may need longer than the stage's limit
        for preset in ("preview", "final"):
            for seed in (0,) if stage.dry else (0, 1):
                name = f"{preset}-{device}-{seed}"
                needs = 20.0 if device == "cuda" else 150.0
                stage.part(name, lambda p=preset, d=device, s=seed: _trained(stage, p, d, s), needs=needs)
    stage.part("full_hd", lambda: _full_hd(stage), needs=30.0)
    stage.part("waits", lambda: _waits(stage), needs=20.0)
    stage.part("step", lambda: _late_step(stage), needs=20.0)
    stage.part("whole", lambda: _whole_runs(stage), needs=90.0)


def _trained(stage: Stage, preset: str, device: str, seed: int) -> dict[str, Any]:
    """Trains a run; returns its held-out PSNR, and ms per step between its measurements."""
    steps = 20 if stage.dry else {"preview": 0, "final": 3000}[preset]
    report, name = Warnings(), f"gpu-{preset}-{device}-{seed}"
    shot, known = stage.scratch_shot(), PRESETS[preset]()
    # Both devices use the CPU's preset sizes, because a GPU has other defaults.
    few = 400 if stage.dry else known.densify.budget
    width = 64 if stage.dry else known.width or load_scene(shot).width
    params = TrainParams(
        run=name, preset=preset, iterations=steps, seed=seed, device=device, holdout=8, max_gaussians=few, width=width,
        resume=False,
    )  # fmt: skip
    summary = train_shot(shot, params, report)
    lines = (shot.run(name) / METRICS_FILE).read_text(encoding="utf-8").splitlines()
    rows = [{"iteration": 0, "seconds": 0.0}, *map(json.loads, lines)]
    pace = [
        {"to": b["iteration"], "ms": round(1e3 * (b["seconds"] - a["seconds"]) / (b["iteration"] - a["iteration"]), 2)}
        for a, b in itertools.pairwise(rows)
        if b["iteration"] > a["iteration"]
    ]
    kept = ("heldout_psnr_db", "gaussians", "moving_gaussians", "train_seconds", "iterations", "device", "width_px")
    return {**{key: summary[key] for key in kept}, "ms_per_step": pace, "warnings": report.warnings}


def _trainer(
    stage: Stage, iterations: int, most: int, width: int = 0, method: str = "auto", stretched: tuple[int, int] = (0, 0)
) -> Trainer:
    """An unsaved run of `final`. `stretched`: (width, height) to which its frames are resized, or zeros."""
    scene = load_scene(stage.scratch_shot())
    config = config_from_params(
        TrainParams(preset="final", iterations=iterations, max_gaussians=most, method=method, width=width)
    )
    size = training_size(scene, config.width)
    images = load_images(scene, scene.solved, *size).to(stage.device)
    if stretched[0]:
        planes = [image.permute(2, 0, 1)[None].float() for image in images]
        images = torch.cat([interpolate(plane, stretched[::-1], mode="bilinear").half() for plane in planes])
        images = images.permute(0, 2, 3, 1).contiguous()
    return Trainer(scene, images, scene.solved, config, Warnings(), {}, stage.device)


def _step(trainer: Trainer) -> None:
    schedule_events(trainer)
    trainer.step()
    trainer.iteration += 1


def _enlarged(trainer: Trainer, many: int) -> None:
    """Grows a run to `many` Gaussians by splitting each into smaller ones around its position; all are open."""
    gaussians = trainer.model.gaussians
    few, device = len(gaussians), gaussians.open.device
    rows = torch.arange(many, device=device) % few
    gaussians.rebuild(rows, torch.zeros(many, dtype=torch.bool, device=device), trainer.optimizer)
    with torch.no_grad():
        means, log_scales = gaussians.params["means"], gaussians.params["log_scales"]
        means += log_scales.exp() * torch.randn(means.shape, generator=trainer.generator).to(device)
        log_scales -= 0.5 * math.log(max(1.0, many / few))
    gaussians.open[:] = True
    trainer.densifier.reset(many)


def _full_hd(stage: Stage) -> dict[str, Any]:
    """A step of `final` with 1,000,000 Gaussians on frames stretched to 1920 x 1080, while none, a tenth and all of
    them may move: ms, and the GPU's busy time and number of kernels."""
    many, size, count = (2000, (64, 36), 2) if stage.dry else (1_000_000, (1920, 1080), 30)
    trainer = _trainer(stage, 300, 2000 if stage.dry else 100_000, 64 if stage.dry else 0, "hexplane", size)
    schedule_events(trainer)
    figures: dict[str, Any] = {"gaussians": many, "width": size[0], "height": size[1], "frames": len(trainer.times)}
    for name, share in (("static", 0.0), ("tenth", 0.1), ("all", 1.0)):
        if name == "tenth":
            trainer.iteration = 101  # past a third of the run the field exists
            schedule_events(trainer)
        if len(trainer.model.gaussians) != many:
            _enlarged(trainer, many)
        trainer.model.gaussians.open[:] = torch.rand(many, device=stage.device) < share
        for way, recorder in _ways(trainer).items():
            trainer.recorder = recorder
            if stage.device.type == "cuda":
                torch.cuda.reset_peak_memory_stats()
            for _ in range(3):
                trainer.step()
            stage.wait()
            since = time.perf_counter()
            for _ in range(count):
                trainer.step()
            stage.wait()
            ms = round(1e3 * (time.perf_counter() - since) / count, 2)
            row = figures[f"{name}, {way}"] = {"ms": ms, **_busy(stage, trainer)}
            if stage.device.type == "cuda":
                row["peak_gb"] = round(torch.cuda.max_memory_allocated() / 1e9, 2)
    return {**figures, **_replays(trainer)}


def _busy(stage: Stage, trainer: Trainer) -> dict[str, Any]:
    """Per step, over three profiled steps: busy ms of the GPU, number of kernels, the ten longest kernels."""
    if stage.device.type != "cuda":
        return {}
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as seen:
        for _ in range(3):
            trainer.step()
        stage.wait()
    # torch annotates a range around optimizer steps, which would count their kernels twice.
    kernels = [
        row
        for row in seen.key_averages()
        if "CUDA" in str(row.device_type) and not getattr(row, "is_user_annotation", False)
    ]
    kernels.sort(key=lambda row: row.self_device_time_total, reverse=True)
    longest = {row.key[:60]: round(row.self_device_time_total / 3e3, 3) for row in kernels[:10]}
    busy = sum(row.self_device_time_total for row in kernels) / 3e3
    return {"busy_ms": round(busy, 2), "kernels": sum(row.count for row in kernels) // 3, "longest_ms": longest}


def _waits(stage: Stage) -> dict[str, Any]:
    """Code lines where the host waits for the GPU, by torch's sync debug mode, without every tenth step."""
    trainer = _trainer(stage, 400, 600 if stage.dry else 100_000, 64 if stage.dry else 640, "hexplane")
    places: dict[str, int] = {}
    steps = 0
    while trainer.iteration < (140 if stage.dry else 300):
        schedule_events(trainer)
        look = trainer.iteration >= 135 and trainer.iteration % 10 != 0  # the field exists after a third of the run
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            if look and stage.device.type == "cuda":
                torch.cuda.set_sync_debug_mode("warn")
            trainer.step()
            if stage.device.type == "cuda":
                torch.cuda.set_sync_debug_mode("default")
        trainer.iteration += 1
        steps += look
        for warning in heard if look else ():
            where = f"{Path(warning.filename).name}:{warning.lineno}"
            places[where] = places.get(where, 0) + 1
    return {"steps": steps, "waits": places}


# ----------------------------------------------------------------------------------------------------------- limits


def limits(stage: Stage) -> None:
    torch.set_num_threads(default_threads())
    for gb in (6,) if stage.dry else (8, 6, 4):
        stage.part(f"memory_{gb}", lambda gb=gb: _memory(stage, gb), needs=40.0)
    stage.part("resume", lambda: _resumed(stage), needs=30.0)
    stage.part("freeze", lambda: _frozen(stage), needs=60.0)
    stage.part("composite", lambda: _composited(stage), needs=60.0)
    stage.part("live", lambda: _live(stage), needs=20.0)


def _memory(stage: Stage, gb: int) -> dict[str, Any]:
    """Measured and planned memory of a step, for a run of the size that the plan allows on a GPU of `gb` GB."""
    scene = load_scene(stage.scratch_shot())
    config = config_from_params(TrainParams(preset="final", method="hexplane", max_gaussians=1_000_000))
    size = training_size(scene, config.width)
    plan = plan_memory(config, size, len(scene.solved), 0, gb * 10**9 - 900_000_000)
    trainer = _trainer(stage, 60, 2000, 64 if stage.dry else 0, "hexplane")
    trainer.iteration = 21  # past a third of the run the field exists
    schedule_events(trainer)
    trainer.model.pieces = 500 if stage.dry else plan.pieces
    _enlarged(trainer, 2000 if stage.dry else plan.gaussians)
    row: dict[str, Any] = {"planned": {"gaussians": plan.gaussians, "pieces": plan.pieces}, "sentence": plan.sentence}
    if stage.device.type == "cuda":
        whole = torch.cuda.get_device_properties(stage.device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, (gb * 1e9 - 9e8) / whole))
        torch.cuda.reset_peak_memory_stats()
    try:
        for _ in range(3):
            trainer.step()
            trainer.iteration += 1
        stage.wait()
        row["fits"] = True
    except torch.OutOfMemoryError as error:
        row |= {"fits": False, "said": str(error).splitlines()[0]}
    finally:
        if stage.device.type == "cuda":
            row["peak_gb"] = round(torch.cuda.max_memory_allocated() / 1e9, 3)
            row["reserved_gb"] = round(torch.cuda.max_memory_reserved() / 1e9, 3)
            torch.cuda.set_per_process_memory_fraction(1.0)
            del trainer
            torch.cuda.empty_cache()
    return row


def _resumed(stage: Stage) -> dict[str, Any]:
    """Saves a run before a growth round, and resumes it on each device."""
    most, width = (1200, 64) if stage.dry else (60_000, 640)
    trainer = _trainer(stage, 600, most, width)
    growth = trainer.config.densify
    for _ in range(growth.every * max(1, math.ceil(growth.start * trainer.config.iterations / growth.every))):
        _step(trainer)
    path = stage.results / "gpu-scratch.safetensors"
    save_run(trainer, path)
    row: dict[str, Any] = {"at": trainer.iteration}
    for device in dict.fromkeys((stage.device.type, "cpu")):
        resumed = Trainer(
            trainer.scene, trainer.images.to(device), trainer.train_ids, trainer.config, Warnings(), {}, device
        )
        restore_run(resumed, path)
        before = len(resumed.model.gaussians)
        for _ in range(3):
            _step(resumed)
        loss = float(resumed.step())
        row[device] = {"gaussians": [before, len(resumed.model.gaussians)], "loss": loss}
    path.unlink()
    return row


def _run_of(stage: Stage) -> str:
    """Name of a run of the scratch shot, trained if missing; the stage `training` leaves some."""
    shot = stage.scratch_shot()
    name = f"gpu-preview-{stage.device.type}-0"
    if not (shot.run(name) / METRICS_FILE).is_file():
        _trained(stage, "preview", stage.device.type, 0)
    return name


def _frozen(stage: Stage) -> dict[str, Any]:
    """Number of frames of a take, and seconds per delivered frame."""
    shot, name = stage.scratch_shot(), _run_of(stage)
    first = load_scene(shot).frames[0]
    last = first + (0 if stage.dry else 9)
    since = time.perf_counter()
    params = FreezeParams(run=name, take="gpu", first=first, last=last, device=stage.device.type)
    params.develop = "off" if stage.dry else params.develop
    facts = freeze_shot(shot, params, Warnings())
    return {"frames": facts["frames"], "seconds_per_frame": round((time.perf_counter() - since) / facts["frames"], 3)}


def _composited(stage: Stage) -> dict[str, Any]:
    """Frames composited from plates at 1080p: seconds each, reading the plates included, and error between devices."""
    shot, name = stage.scratch_shot(), _run_of(stage)
    scene, size = load_scene(shot), (64, 48) if stage.dry else (1920, 1080)
    plates, Ks, frames = Plates(shot, size), scene.camera_at(*size), range(0, len(scene.frames), 3)
    last: list[CompositeFrame] = []
    row: dict[str, Any] = {}
    for device, count in ((stage.device.type, 3 if stage.dry else 24), ("cpu", 3)):
        run = load_run(shot, name, torch.device(device))
        t_star, compositor, spent = run.train_frames[0], Compositor(run, scene, plates), list[float]()
        frozen = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run))
        for i in [*frames[:count][::-1], frames[0]]:  # the last frame is the same on both devices
            since, frame = time.perf_counter(), scene.frames[i]
            output = OutputFrame(frame, scene.viewmats[i], Ks[i], float(t_star), float(frame))
            exposed_at = scene.time_of_frame(frame)
            image = render_frozen(frozen, output.viewmat, output.K, *size, run.model.exposure, exposed_at)
            composite = compositor.frame(output, frozen, image, *size, (frame,)).cpu()
            spent.append(time.perf_counter() - since)
        last.append(composite)
        row[f"{device}_s"] = [round(value, 4) for value in (statistics.median(spent), min(spent), max(spent))]
    row["error"] = float((last[0].linear - last[-1].linear).abs().max())
    return row


def _live(stage: Stage) -> dict[str, Any]:
    """Views per second drawn by a live session at 320 x 180, without the pipe to Blender."""
    shot = stage.scratch_shot()
    session = LiveSession(shot, _run_of(stage), stage.device.type)
    cameras = CameraPath.load(shot.cameras).frames
    scene, count = session.scene, 3 if stage.dry else 200
    width, height = (64, 36) if stage.dry else (320, 180)
    focal = float(scene.Ks[0, 0, 0]) * width / scene.width
    trained = session.run.train_frames
    spent: list[float] = []
    for n in range(count):
        view = LiveView(
            view=0, seq=n, t_star=trained[3 * n % len(trained)], viewmat=cameras[n % len(cameras)].viewmat,
            K=[focal, focal, width / 2, height / 2], width=width, height=height, show="color", detail=False,
        )  # fmt: skip
        since = time.perf_counter()
        session.draw(view)
        spent.append(time.perf_counter() - since)
    return {"views_per_second": round(count / sum(spent), 1), "median_ms": round(1e3 * sorted(spent)[count // 2], 2)}


STAGES: dict[str, Callable[[Stage], None]] = {
    "environment": environment,
    "sanitizer": sanitizer,
    "raster": raster,
    "training": training,
    "limits": limits,
}


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=tuple(STAGES))
    parser.add_argument("--results", type=Path, default=Path("output/gpu"), metavar="DIR")
    parser.add_argument("--shot", type=Path, help="solved shot folder for the stages training and limits; it is copied")
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="run only these parts of the stage")
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="time limit of the stage in seconds (default: %(default)g)"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="run on the CPU at tiny sizes; the figures are meaningless"
    )
    args = parser.parse_args(words)
    if not args.dry_run and (refusal := cuda_refusal()):
        print(f"{refusal} --dry-run goes through the stage on the processor.", file=sys.stderr)
        return 9
    args.results.mkdir(parents=True, exist_ok=True)
    stage = Stage(args.dry_run, args.shot, args.results.absolute(), args.seconds, args.only)
    since = time.monotonic()
    STAGES[args.stage](stage)
    report = {
        "stage": args.stage, "dry_run": args.dry_run, "machine": raster_bench.machine(stage.device.type),
        "seconds": round(time.monotonic() - since, 1), "found": stage.found,
    }  # fmt: skip
    place = args.results / f"gpu-{args.stage}.json"
    write_json(place, report)
    failed = [name for name, result in stage.found.items() if isinstance(result, dict) and "failed" in result]
    print(f"{place}: {len(stage.found)} parts, {len(failed)} failed {failed or ''}".rstrip())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
