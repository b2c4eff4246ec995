"""The loop. One image per step; every schedule is a share of the run, so presets differ in numbers only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import Cancelled, ExitCode, JobError, Reporter
from ..deformation import HexPlane, apply_deltas, open_gate, residual_per_gaussian
from ..gaussians import Densifier, Gaussians, initialise
from ..scene import Scene
from ..supervision import PaperView, bin_of, bin_times, mark_seen, paper_loss, support_loss
from .checkpoint import load_checkpoint, optimizer_state, restore_optimizer, save_checkpoint
from .config import TrainConfig, config_to_json
from .exposure import Exposure
from .losses import photometric, psnr
from .model import DynamicModel, field_box, render

_LOG_SCALE_RANGE = (math.log(1e-5), math.log(50.0))
_MAX_BAD_STEPS = 20


class Trainer:
    """Optimises one run. All tensors on the CPU; images [I, H, W, 3] float16 display-referred.

    Args:
        scene: normalised scene.
        images: the training frames.
        train: indices into the scene's frames, one per image.
        config: every number of the run.
        identity: JSON-able facts that say which run a checkpoint belongs to; stored in it.
    """

    def __init__(
        self,
        scene: Scene,
        images: Tensor,
        train: list[int],
        config: TrainConfig,
        report: Reporter,
        identity: dict[str, Any] | None = None,
    ) -> None:
        self.identity = identity or {}
        self.scene, self.images, self.train_ids, self.config, self.report = scene, images, train, config, report
        self.height, self.width = images.shape[1:3]
        self.Ks = scene.camera_at(self.width, self.height)
        self.times = [float(scene.times[i]) for i in train]
        self.seconds = float(scene.seconds[train[-1]] - scene.seconds[train[0]])
        self.generator = torch.Generator().manual_seed(config.seed)
        self.centres = bin_times(scene.times[train])
        config.hexplane.time_nodes = max(4, round(len(train) / 2))
        budget = config.densify.budget
        gaussians = initialise(scene, images, train, len(self.centres), config.init, self.generator, budget)
        self.model = DynamicModel(gaussians, None, self.centres, 0, Exposure(self.centres, config.exposure))
        self.initial = len(gaussians)
        self.iteration = 0
        self.trained_seconds = 0.0
        self.bad_steps = 0
        self.order: list[int] = []
        self.optimizer = self._gaussian_optimizer()
        self.densifier = Densifier(config.densify, len(gaussians))
        self._saved_at = time.perf_counter()

    # ------------------------------------------------------------------ the run

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        return self.iteration / self.config.iterations

    def run(self, checkpoint: Path, evaluate: Callable[[Trainer], None]) -> None:
        """Trains to the end, saving to `checkpoint` now and then and when cancelled; calls `evaluate` as configured."""
        every = max(1, round(self.config.evaluate_every * self.config.iterations))
        since = time.perf_counter() - self.trained_seconds
        started = self.iteration
        try:
            while self.iteration < self.config.iterations:
                self.report.check_cancelled()
                self._milestones()
                loss = self.step()
                self.iteration += 1
                self.trained_seconds = time.perf_counter() - since
                if self.iteration % every == 0:
                    evaluate(self)
                if self.iteration % 10 == 0 or self.iteration == self.config.iterations:
                    text = f"step {self.iteration}, {len(self.model.gaussians)} Gaussians, loss {loss:.4f}"
                    self.report.progress("training", self.iteration, self.config.iterations, text)
                if time.perf_counter() - self._saved_at > self.config.checkpoint_seconds:
                    self.save(checkpoint)
        except Cancelled:
            if self.iteration > started:
                self.save(checkpoint)
            raise
        self.trained_seconds = time.perf_counter() - since
        self.save(checkpoint)

    def step(self) -> float:
        """One optimisation step on one training frame; returns the photometric loss (nan if the step was skipped)."""
        frame = self._next_frame()
        self._schedule()
        rows = self.model.open_rows()
        deltas = self.model.deltas(rows, torch.tensor([self.times[frame]]))
        state = apply_deltas(self.model.gaussians, rows, deltas)
        # What shows through a hole is another colour at every step, so no hole can pass for a grey wall.
        out = self._render(state, frame, background=torch.rand(3, generator=self.generator))
        exposed = self.model.exposure.apply(out.colors[0], self.times[frame])
        loss = photometric(exposed, self.images[frame].float(), self.config.dssim)
        total = loss + self._regularisers(rows)
        self.optimizer.zero_grad(set_to_none=True)
        if not bool(torch.isfinite(total)):
            return self._skip("loss", frame)
        total.backward()
        if not self._gradients_finite():
            return self._skip("gradient", frame)
        with torch.no_grad():
            self.densifier.observe(out.means2d_absgrad[0], out.radii[0])
            mark_seen(self.model.gaussians, bin_of(self.centres, self.times[frame]), out.weight_sum[0])
        if self._paper_is_due():
            self._paper_step(frame, rows, state, out.means2d_grad[0].clone())
            if not self._gradients_finite():
                return self._skip("gradient", frame)
        self.optimizer.step()
        self._after_step()
        self.bad_steps = 0
        return float(loss.detach())

    def _milestones(self) -> None:
        """What happens between steps: SH degree, densification, the gate."""
        c = self.config
        self.model.sh_degree = min(c.sh_degree, int(self.progress / c.sh_every)) if c.sh_every > 0 else c.sh_degree
        due = self.iteration > 0 and self.iteration % c.densify.every == 0
        if due and c.densify.start <= self.progress < 0.9:
            self.densifier.step(self.model.gaussians, self.optimizer, self.initial, self.progress)
        if c.method == "static":
            return
        if c.method == "hexplane":
            if self.model.field is None and self.progress >= c.gate.start:
                self.model.gaussians.open[:] = True
                self._create_field()
            elif self.model.field is not None:
                self.model.gaussians.open[:] = True
        elif any(self.iteration == round(share * c.iterations) for share in c.gate.rounds):
            self._gate_round()

    # ------------------------------------------------------------------ the gate

    def _gate_round(self) -> None:
        frames = list(range(0, len(self.train_ids), max(1, len(self.train_ids) // 40)))
        residual, weight = residual_per_gaussian(frames, self._residual_of, len(self.model.gaussians))
        open_gate(self.model.gaussians, residual, weight, self.config.gate)
        if not bool(self.model.gaussians.open.any()):
            return
        if self.model.field is None:
            self._create_field()
        else:
            self._widen_field(self.model.field)

    def _residual_of(self, frame: int) -> tuple[Tensor, Callable[[Tensor], Tensor], Tensor]:
        self.report.check_cancelled()
        with torch.no_grad():
            state = {k: v.detach() for k, v in self.model.state_at(self.times[frame]).items()}
        probe = torch.zeros(len(self.model.gaussians), 1, requires_grad=True)
        background = torch.cat([self.background, torch.zeros(1)])
        out = self._render(state, frame, colors=probe, background=background, with_contributions=True)
        exposed = self.model.exposure.apply(out.colors[0, ..., :3], self.times[frame]).detach()
        error = (exposed - self.images[frame].float()).abs().mean(-1)

        def pull(values: Tensor) -> Tensor:
            # The gradient of sum(value * image channel) for a Gaussian's colour is its sum of alpha * T * value.
            (grad,) = torch.autograd.grad(out.colors[0, ..., 3], probe, values)
            return grad[:, 0]

        return error, pull, out.weight_sum[0]

    def _create_field(self) -> None:
        model = self.model.gaussians
        box = field_box(model.params["means"].detach()[model.open])
        self.model.field = HexPlane(self.config.hexplane, box, self.generator)
        for group in self.model.field.parameter_groups():
            self.optimizer.add_param_group({**group, "lr_start": group["lr"]})

    def _widen_field(self, field: HexPlane) -> None:
        """Lets the field resolve what later rounds opened: outside its box it cannot tell one place from another."""
        means = self.model.gaussians.params["means"].detach()[self.model.gaussians.open]
        if field.outside(means) <= 0.01 * len(means):
            return
        wanted = field_box(means)
        field.refit(torch.stack([torch.minimum(field.box[0], wanted[0]), torch.maximum(field.box[1], wanted[1])]))
        for plane in [*field.spatial, *field.temporal]:
            self.optimizer.state.pop(plane, None)

    # ------------------------------------------------------------------ one step's parts

    @property
    def background(self) -> Tensor:
        """[3] what shows where nothing covers when a frame is measured or shown: mid grey."""
        return torch.full((3,), 0.5)

    def _render(self, state: dict[str, Tensor], frame: int, **options: Any) -> Any:
        index = self.train_ids[frame]
        options.setdefault("background", self.background)
        options.setdefault("with_contributions", True)
        return render(
            state, self.model.sh_degree, self.scene.viewmats[index], self.Ks[index], self.width, self.height,
            with_depth=False, **options,
        )  # fmt: skip

    def _next_frame(self) -> int:
        if not self.order:
            self.order = torch.randperm(len(self.train_ids), generator=self.generator).tolist()
        return self.order.pop()

    def _regularisers(self, rows: Tensor) -> Tensor:
        c, p = self.config, self.model.gaussians.params
        total = c.opacity_weight * torch.sigmoid(p["opacity_logits"]).mean()
        total = total + c.scale_weight * p["log_scales"].exp().mean() + self.model.exposure.regularisation()
        field = self.model.field
        if field is None or not len(rows):
            return total
        if self.iteration % c.field_every == 0:
            total = total + c.field_every * field.regularisation()
        s = c.supervision
        if s.preset == "support" and self.progress >= s.start and self.iteration % s.support_every == 0:
            anchored = support_loss(self.model.gaussians, field, self.centres, self.seconds, s, self.generator)
            if anchored is not None:
                total = total + s.support_every * anchored
        return total

    def _paper_is_due(self) -> bool:
        s = self.config.supervision
        on = s.preset == "paper" and self.progress >= s.start and self.model.field is not None
        return on and self.iteration % s.every == 0

    def _paper_step(self, frame: int, rows: Tensor, state: dict[str, Tensor], gradient: Tensor) -> None:
        """Adds the paper's terms for this frame and a random other one; their gradients join the step's."""
        other = int(torch.randint(len(self.train_ids), (1,), generator=self.generator))
        if self.times[other] == self.times[frame] or not len(rows):
            return
        other_state = self.model.state_at(self.times[other])
        out = self._render(other_state, other)
        exposed = self.model.exposure.apply(out.colors[0], self.times[other])
        photometric(exposed, self.images[other].float(), self.config.dssim).backward(retain_graph=True)
        views = [
            self._paper_view(self.model.state_at(self.times[frame]), frame, rows, gradient),
            self._paper_view(other_state, other, rows, out.means2d_grad[0]),
        ]
        loss = paper_loss(views[0], views[1], self.progress, self.config.supervision)
        if loss is not None and bool(torch.isfinite(loss)):
            loss.backward()

    def _paper_view(self, state: dict[str, Tensor], frame: int, rows: Tensor, gradient: Tensor) -> PaperView:
        index = self.train_ids[frame]
        means = state["means"][rows].detach()
        inside = inside_frustum(means, self.scene.viewmats[index], self.Ks[index], self.width, self.height)
        return PaperView(self.times[frame], {k: v[rows] for k, v in state.items()}, inside, gradient[rows])

    def _gradients_finite(self) -> bool:
        grads = [p.grad for group in self.optimizer.param_groups for p in group["params"] if p.grad is not None]
        return all(bool(torch.isfinite(grad.sum())) for grad in grads)

    def _skip(self, what: str, frame: int) -> float:
        """Leaves a step out; a run that keeps failing ends in words, with the last good checkpoint in place."""
        self.bad_steps += 1
        self.optimizer.zero_grad(set_to_none=True)
        if self.bad_steps >= _MAX_BAD_STEPS:
            raise JobError(
                f"Training became unstable at step {self.iteration} (the {what} is not finite).",
                "The last good checkpoint is kept; train again with a smaller width or another seed.",
                ExitCode.TRAIN,
            )
        if self.bad_steps == 1:
            number = self.scene.frames[self.train_ids[frame]]
            self.report.warning(f"Step {self.iteration} on frame {number} was skipped: its {what} is not finite.")
        return math.nan

    def _after_step(self) -> None:
        with torch.no_grad():
            self.model.gaussians.params["log_scales"].clamp_(*_LOG_SCALE_RANGE)

    # ------------------------------------------------------------------ optimiser

    def _gaussian_optimizer(self) -> torch.optim.Optimizer:
        c, p = self.config, self.model.gaussians.params
        rates = {
            "means": (c.lr_means, c.lr_means_end), "quats": (c.lr_quats, 0.1 * c.lr_quats),
            "log_scales": (c.lr_scales, 0.1 * c.lr_scales), "opacity_logits": (c.lr_opacities, 0.1 * c.lr_opacities),
            "sh0": (c.lr_sh0, 0.1 * c.lr_sh0), "shN": (c.lr_sh_rest, 0.1 * c.lr_sh_rest),
        }  # fmt: skip
        groups = [
            {"params": [p[name]], "lr": start, "lr_start": start, "lr_end": end, "name": name}
            for name, (start, end) in rates.items()
        ]
        e = self.model.exposure
        groups.append(
            {"params": [e.values], "lr": c.exposure.lr, "lr_start": c.exposure.lr, "lr_end": 0.1 * c.exposure.lr}
        )
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _schedule(self) -> None:
        """Log-linear learning rates from start to end over the run (3DGS get_expon_lr_func)."""
        for group in self.optimizer.param_groups:
            share = self.progress
            group["lr"] = group["lr_start"] * (group["lr_end"] / group["lr_start"]) ** share

    # ------------------------------------------------------------------ held-out frames

    @torch.no_grad()
    def render_frame(self, index: int) -> Tensor:
        """Frame `index` of the scene at its own time, [H, W, 3], not clamped."""
        state = self.model.state_at(float(self.scene.times[index]))
        out = render(
            state, self.model.sh_degree, self.scene.viewmats[index], self.Ks[index], self.width, self.height,
            background=self.background, with_depth=False, with_contributions=False,
        )  # fmt: skip
        return self.model.exposure.apply(out.colors[0], float(self.scene.times[index]))

    def heldout_psnr(self, indices: list[int], images: Tensor) -> float | None:
        """Mean PSNR in dB over held-out frames at their own times; None if there are none."""
        if not indices:
            return None
        values = []
        for n, i in enumerate(indices):
            self.report.check_cancelled()
            values.append(psnr(self.render_frame(i), images[n].float()))
        return sum(values) / len(values)

    # ------------------------------------------------------------------ checkpoints

    def _named(self) -> dict[str, Tensor]:
        named: dict[str, Tensor] = {**self.model.gaussians.params, "exposure": self.model.exposure.values}
        if self.model.field is not None:
            named.update({f"field.{n}": p for n, p in self.model.field.named_parameters()})
        return named

    def save(self, path: Path) -> None:
        """Writes everything that `restore` needs."""
        tensors = {**self.model.gaussians.state(), **optimizer_state(self._named(), self.optimizer)}
        if self.model.field is not None:
            tensors.update(self.model.field.state())
        d = self.densifier
        tensors.update({"densify.gradient": d.gradient, "densify.seen": d.seen})
        tensors["generator"] = self.generator.get_state()
        tensors["order"] = torch.tensor(self.order, dtype=torch.long)
        tensors["centres"] = self.centres
        tensors["exposure"] = self.model.exposure.values
        meta = {
            **self.identity,
            "config": config_to_json(self.config),
            "iteration": self.iteration,
            "initial": self.initial,
            "trained_seconds": self.trained_seconds,
            "sh_degree": self.model.sh_degree,
            "train_frames": [self.scene.frames[i] for i in self.train_ids],
            "width": self.width,
            "height": self.height,
        }
        save_checkpoint(path, tensors, meta)
        self._saved_at = time.perf_counter()

    def restore(self, path: Path) -> None:
        """Goes on where `save` was called. JobError if the checkpoint is of other frames."""
        tensors, meta = load_checkpoint(path)
        if meta["train_frames"] != [self.scene.frames[i] for i in self.train_ids]:
            raise JobError(
                "The run's checkpoint was trained on other frames.", "Train with --restart, or another run name.",
                ExitCode.TRAIN,
            )  # fmt: skip
        self.model = restore_model(tensors, meta, self.config)
        self.optimizer = self._gaussian_optimizer()
        if self.model.field is not None:
            for group in self.model.field.parameter_groups():
                self.optimizer.add_param_group({**group, "lr_start": group["lr"]})
        restore_optimizer(self._named(), self.optimizer, tensors)
        self.densifier = Densifier(self.config.densify, len(self.model.gaussians))
        for name in ("gradient", "seen"):
            setattr(self.densifier, name, tensors[f"densify.{name}"].clone())
        self.generator.set_state(tensors["generator"])
        self.order = tensors["order"].tolist()
        self.iteration, self.initial = int(meta["iteration"]), int(meta["initial"])
        self.trained_seconds = float(meta["trained_seconds"])


def restore_model(tensors: dict[str, Tensor], meta: dict[str, Any], config: TrainConfig) -> DynamicModel:
    """The model of a checkpoint, without its optimiser."""
    centres = tensors["centres"].clone()
    gaussians = Gaussians.from_state(tensors, len(centres))
    field = None
    if "field.box" in tensors:
        field = HexPlane(config.hexplane, tensors["field.box"], torch.Generator().manual_seed(0))
        field.load_state(tensors)
    exposure = Exposure(centres, config.exposure)
    exposure.values.data.copy_(tensors["exposure"])
    return DynamicModel(gaussians, field, centres, int(meta["sh_degree"]), exposure)


def inside_frustum(means: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """bool [M]: is the centre of means [M, 3] in front of the camera and inside its image."""
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[:, 2].clamp_min(1e-6)
    x = camera[:, 0] / depth * K[0, 0] + K[0, 2]
    y = camera[:, 1] / depth * K[1, 1] + K[1, 2]
    return (camera[:, 2] > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
