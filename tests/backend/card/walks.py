"""Walks on the simulated device, run in a separate process: `python walks.py "WALK ARGUMENT ..." ...`; prints JSON.

They use the tiny shot of `conftest.py` at a quarter of its size, because the rasteriser's kernels run on fibers here.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parents[2])]

from pretend_card import CARD, pretended_card  # noqa: E402  (before torch)


def small_world(folder: Path) -> tuple[Any, type]:
    """(the tiny shot at 32 x 24, the class of its silent reporter)."""
    spec = importlib.util.spec_from_file_location("tiny", FOLDER.parent / "conftest.py")
    assert spec is not None and spec.loader is not None
    tiny = importlib.util.module_from_spec(spec)
    sys.modules["tiny"] = tiny
    spec.loader.exec_module(tiny)
    tiny.WIDTH, tiny.HEIGHT = 32, 24
    return tiny.build_world(folder), tiny.Quiet


def new_trainer(world: Any, quiet: type, method: str, supervision: str, poses: bool, iterations: int = 20) -> Any:
    """Trainer of a short run that includes every event: growth, the gate, pose refinement, and both kinds of
    anchors."""
    from torch_backend.contract import TrainParams
    from torch_backend.scene import load_images, load_scene
    from torch_backend.train import config_from_params
    from torch_backend.train.trainer import Trainer

    scene = load_scene(world.shot)
    train_params = TrainParams(iterations=iterations, max_gaussians=330, method=method, supervision=supervision)
    config = config_from_params(train_params)
    config.poses.on, config.densify.every, config.init.seeds = poses, 5, 0
    config.gate.start, config.field.start, config.supervision.support_samples = 0.2, 0.2, 64
    config.densify.start = min(config.densify.start, 0.2)
    if method in ("mlp", "control_points"):
        config.field.noise = 0.1  # the published configuration perturbs times
    images = load_images(scene, scene.solved, 32, 24).to("cuda")
    return Trainer(scene, images, scene.solved, config, quiet(), {}, "cuda")


def _steps(trainer: Any, count: int) -> dict[str, int]:
    """Take steps; return the synchronisations by operator and place, except in every tenth step."""
    from torch_backend.train.events import schedule_events

    waits: dict[str, int] = {}
    for _ in range(count):
        schedule_events(trainer)
        CARD.waits.clear()
        tenth = trainer.iteration % 10 == 0
        trainer.step()
        trainer.iteration += 1
        for what, times in () if tenth else CARD.waits.items():
            waits[what] = waits.get(what, 0) + times
        if trainer.iteration % 10 == 0:
            trainer.inspect_nonfinite()
    return waits


def steps(folder: Path, *runs: str) -> dict[str, Any]:
    """Per run (`METHOD/SUPERVISION[/poses]`): synchronisations in steps, and the state at the end."""
    world, quiet = small_world(folder)
    results: dict[str, Any] = {}
    for run in runs:
        method, supervision, *poses = run.split("/")
        with pretended_card():
            trainer = new_trainer(world, quiet, method, supervision, bool(poses))
            waits = _steps(trainer, 5)
            moving = len(trainer.model.open_rows())
            waits |= _steps(trainer, 8)
            means = trainer.model.gaussians.params["means"]
            results[run] = {"waits": waits, "moving": moving, "finite": bool(means.isfinite().all())}
    return results


def recorded(folder: Path, *methods: str) -> dict[str, Any]:
    """Per method: compare a run with recorded steps and one with launched steps, through all events of a run."""
    world, quiet = small_world(folder)
    results: dict[str, Any] = {}
    for method in methods:
        found: list[Any] = []
        for records in (False, True):
            with pretended_card():
                trainer = new_trainer(world, quiet, method, "support", False, iterations=40)
                trainer.config.densify.every = 10
                recorder = trainer.recorder
                trainer.recorder = recorder if records else None
                _steps(trainer, 22)  # with two rounds of growth
                model = trainer.model.gaussians
                values = {name: p.detach()._real.double() for name, p in trainer.named_tensors().items()}
                values |= {name: getattr(model, name)._real.double() for name in ("support", "hidden")}
                found.append(values)
                moving = len(trainer.model.open_rows())
        plain, replayed = found
        error = {
            name: float((replayed[name] - value).norm() / value.norm().clamp_min(1e-9)) for name, value in plain.items()
        }
        worst = max(error, key=lambda name: error[name])
        results[method] = {
            "replayed": recorder.replayed, "refused": recorder.refused, "off": error[worst], "worst": worst,
            "moving": moving,
        }  # fmt: skip
    return results


def launches(folder: Path, *methods: str) -> dict[str, Any]:
    """Per method: launches in each of six steps with the backend's plane kernels, and with torch's operators.

    Counted are the backend's kernels and torch's operators; each operator launches at least one kernel.
    """
    from torch_backend.deformation import planes_cuda

    world, quiet = small_world(folder)
    results: dict[str, Any] = {}
    for method in methods:
        counts: dict[str, list[int]] = {}
        for name, refused in (("ours", ""), ("torch", "it is wrong")):
            planes_cuda.refused = refused
            try:
                with pretended_card():
                    trainer = new_trainer(world, quiet, method, "support", False)
                    trainer.recorder = None
                    _steps(trainer, 6)  # after these, field and tables exist
                    for _ in range(6):
                        before = CARD.operators + sum(CARD.launched.values())
                        _steps(trainer, 1)
                        counts.setdefault(name, []).append(CARD.operators + sum(CARD.launched.values()) - before)
            finally:
                planes_cuda.refused = ""
        results[method] = counts
    return results


def resume(folder: Path, method: str) -> dict[str, Any]:
    """Resume a run just before a round of growth, when the optimiser's moments are restored but not yet used."""
    from torch_backend.train.resume import restore_run, save_run

    world, quiet = small_world(folder)
    with pretended_card():
        trainer = new_trainer(world, quiet, method, "support", False)
        _steps(trainer, 5)
        save_run(trainer, folder / "x.safetensors")
        resumed = new_trainer(world, quiet, method, "support", False)
        restore_run(resumed, folder / "x.safetensors")
        before = len(resumed.model.gaussians)
        _steps(resumed, 1)
        moments = resumed.optimizer.state[resumed.model.gaussians.params["means"]]
        return {
            "iteration": resumed.iteration, "before": before, "after": len(resumed.model.gaussians),
            "devices": sorted({value.device.type for value in moments.values()}),
        }  # fmt: skip


def station(folder: Path) -> dict[str, Any]:
    """Train, extend, freeze, draw live and composite: all stations of a shot."""
    from torch_backend.contract import FreezeParams, LiveView, TrainParams
    from torch_backend.freeze import freeze_shot
    from torch_backend.live import LiveSession
    from torch_backend.train import train_shot

    world, quiet = small_world(folder)
    report = quiet()
    with pretended_card():
        params = TrainParams(run="g", iterations=10, max_gaussians=260, device="cuda", holdout=0)
        trained = train_shot(world.shot, params, report)
        extended = train_shot(world.shot, TrainParams(run="g", device="cuda", extend=2), report)
        train_params = FreezeParams(run="g", take="t", first=101, last=101, device="cuda", develop="off")
        frozen = freeze_shot(world.shot, train_params, report)
        live = LiveSession(world.shot, "g", "cuda")
        view = LiveView(
            view=0, seq=1, t_star=105, viewmat=world.viewmats[3].flatten().tolist(), K=[60.0, 60.0, 32.0, 24.0],
            width=32, height=24, show="color",
        )  # fmt: skip
        drawn = live.draw(view)
    return {
        "device": trained["device"], "iterations": [trained["iterations"], extended["iterations"]],
        "frames": frozen["frames"], "drawn": len(drawn[1]), "launched": sorted(CARD.launched),
        "composited": composited(world),
    }  # fmt: skip


def composited(world: Any) -> dict[str, Any]:
    """A frozen frame of plates of run `g` on the card and on the processor: errors, and the card's waits."""
    import torch

    from torch_backend.footage.plates import Plates
    from torch_backend.freeze.composite.compositor import Compositor
    from torch_backend.freeze.frozen import OutputFrame, freeze_at, render_frozen
    from torch_backend.scene import load_scene
    from torch_backend.train import load_run

    scene, plates = load_scene(world.shot), Plates(world.shot)
    K, (t_star, frame) = scene.camera_at(plates.width, plates.height)[6], (scene.frames[1], scene.frames[6])
    output = OutputFrame(frame, scene.viewmats[6], K, float(t_star), float(frame))

    def made(device: str) -> Any:
        run = load_run(world.shot, "g", torch.device(device))
        frozen, exposure = freeze_at(run.model, scene.time_of_frame(t_star), 1.0), run.model.exposure
        compositor, size = Compositor(run, scene, plates), (plates.width, plates.height)
        for _ in range(2):  # the second frame finds all plates in the cache
            image = render_frozen(frozen, output.viewmat, K, *size, exposure, scene.time_of_frame(frame))
            CARD.waits.clear()
            result = compositor.frame(output, frozen, image, *size, (frame,))
            waits = dict(CARD.waits)
        return result, waits

    expected, _ = made("cpu")
    with pretended_card():
        found, waits = made("cuda")
        devices = sorted({value.device.type for value in vars(found).values() if isinstance(value, torch.Tensor)})
        found = found.cpu()
    error = {
        name: float((getattr(found, name) - getattr(expected, name)).abs().max())
        for name in ("linear", "alpha", "plate", "support", "motion", "matte", "fill")
    }
    return {"devices": devices, "error": error, "waits": waits, "filled": float(expected.plate.mean())}


def step_bytes(folder: Path, *methods: str) -> dict[str, Any]:
    """Bytes of a step per Gaussian, compared with the memory model. All Gaussians move, except with `static`."""
    import torch

    from torch_backend.train import memory
    from torch_backend.train.events import schedule_events

    world, quiet = small_world(folder)
    results: dict[str, Any] = {}
    for method in methods:
        with pretended_card():
            trainer = new_trainer(world, quiet, method, "support", False)
            trainer.recorder = None
            trainer.iteration = 4
            schedule_events(trainer)
            peaks: list[tuple[int, int]] = []
            for times in (2, 2):
                many = len(trainer.model.gaussians) * times
                rows = torch.arange(many, device="cuda") % len(trainer.model.gaussians)
                fresh = torch.zeros(many, dtype=torch.bool, device="cuda")
                trainer.model.gaussians.rebuild(rows, fresh, trainer.optimizer)
                trainer.densifier.reset(many)
                trainer.step()  # creates the moments
                CARD.peak = CARD.live
                trainer.step()
                peaks.append((many, CARD.peak))
            (few, low), (many, high) = peaks
            whole = memory.moving_bytes(trainer.config, True) if method != "static" else 0
            harmonics = 3 * (trainer.config.sh_degree + 1) ** 2
            # Absent in so short a run: the running mean of the last steps, a second list of hits, and harmonics.
            absent = 4 * (11 + harmonics) + 16 * memory.HIT_BYTES + 8 * harmonics
            said = memory.gaussian_bytes(trainer.config, len(trainer.centres)) + whole - absent
            results[method] = {"measured": (high - low) / (many - few), "said": said}
    return results


def memory_ends(folder: Path, method: str, share: str) -> dict[str, Any]:
    """Run on a device with `share` of the memory that a step with anchors needs, from the ninth step on."""
    from torch_backend.train import memory
    from torch_backend.train.loop import train_to_end

    world, quiet = small_world(folder)
    memory.LEAST, memory.LEAST_PIECE = 40, 100
    with pretended_card():
        trainer = new_trainer(world, quiet, method, "support", False, iterations=14)
        trainer.recorder = None  # a recording would permanently hold as much memory again
        _steps(trainer, 8)
        CARD.peak = CARD.live
        _steps(trainer, 1)  # the first step with anchors, which needs most memory
        CARD.limit = CARD.live + int(float(share) * (CARD.peak - CARD.live))
        before = len(trainer.model.gaussians)
        train_to_end(trainer, folder / "c.safetensors", lambda _: None)
        saved = (folder / "c.safetensors").is_file()
    warnings = trainer.report.warnings
    means = trainer.model.gaussians.params["means"]
    return {
        "iteration": trainer.iteration, "before": before, "after": len(trainer.model.gaussians), "saved": saved,
        "warnings": warnings, "finite": bool(means.isfinite().all()), "budget": trainer.config.densify.budget,
    }  # fmt: skip


def bad_frames(folder: Path) -> dict[str, Any]:
    """Steps on NaN frames: the changed parameters and warnings after nine steps, and the error after 21."""
    from torch_backend.contract import JobError

    world, quiet = small_world(folder)
    with pretended_card():
        trainer = new_trainer(world, quiet, "auto", "support", False)
        trainer.images = trainer.images * float("nan")  # only now, because colours are initialised from the frames
        before = {name: p.detach().clone() for name, p in trainer.model.gaussians.params.items()}
        for _ in range(9):
            trainer.step()
        trainer.inspect_nonfinite()
        changed = [name for name, p in trainer.model.gaussians.params.items() if not bool((before[name] == p).all())]
        warnings = trainer.report.warnings
        for _ in range(12):
            trainer.step()
        try:
            trainer.inspect_nonfinite()
            ended = ""
        except JobError as error:
            ended = str(error)
    return {"changed": changed, "warnings": warnings, "ended": ended}


def self_test(folder: Path) -> dict[str, Any]:
    """Self-test of the device in three states: sound, with failing kernel launches, and with full memory."""
    import torch

    from torch_backend.train.self_test import run_self_test

    def fails(name: str) -> None:
        raise RuntimeError(f"CUDA error: an illegal memory access in {name}\nsee the log")

    with pretended_card():
        sound = run_self_test(torch.device("cuda"))
        CARD.before_launch = fails
        broken = run_self_test(torch.device("cuda"))
        CARD.before_launch = lambda name: None
        CARD.limit = CARD.live + 1000
        full = run_self_test(torch.device("cuda"))
    return {
        "sound": sound.problem, "recording": sound.recording, "checks": len(sound.checks), "broken": broken.problem,
        "full": [full.problem, full.lasting], "launched": sorted(CARD.launched),
    }  # fmt: skip


WALKS = {
    "steps": steps, "recorded": recorded, "launches": launches, "resume": resume, "station": station,
    "step_bytes": step_bytes, "memory_ends": memory_ends, "bad_frames": bad_frames, "self_test": self_test,
}  # fmt: skip

if __name__ == "__main__":
    results = {}
    for walk in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            CARD.limit = 8 << 30
            try:
                results[walk] = WALKS[walk.split()[0]](Path(folder), *walk.split()[1:])
            except Exception:
                results[walk] = {"broke": traceback.format_exc()}
    print(json.dumps(results))
