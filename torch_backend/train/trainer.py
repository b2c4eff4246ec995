"""A run in training: its model, and one optimisation step on one image.

Schedules are shares of the run, so presets differ in numbers only. `events.py` implements the events between steps,
`loop.py` the training loop, and `resume.py` the checkpoint.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contract import Reporter
from ..deformation import Deltas, field_box, split_deltas
from ..gaussians import Densifier, DensifyConfig, initialise
from ..raster import RasterOutput
from ..scene import Scene
from ..supervision import (
    Anchored,
    anchored_pairs,
    bin_of,
    bin_times,
    draw,
    mark_hidden,
    mark_seen,
    still_weight,
    stillness,
    support_loss,
)
from ..torch_types import backward, from_numpy, integers, norm_of_all
from .average import ParameterMean
from .config import TrainConfig
from .depth import DepthTargets, FittedDepth, depth_pull
from .exposure import Exposure
from .extend import Extension
from .losses import psnr
from .model import DynamicModel, render
from .optimizer import optimizer_of, schedule_rates
from .paper import paper_step
from .poses import Poses, corrected
from .recorder import Recorder
from .residual import correlation_of_movers
from .softened import SoftenedMovers
from .soundness import Soundness
from .step_facts import StepFacts, StepKind
from .stopping import RunSchedule, StoppingPolicy


class Trainer:
    """Optimises one run on one device.

    On a GPU a step reads nothing back; the loop checks the state every `INSPECT_EVERY` steps.

    Args:
        scene: normalised scene, on the CPU.
        images: [I, H, W, 3] float16 display-referred training frames, on the device or in host memory.
        train: [I] indices of the training frames in the scene's frames.
        config: configuration of the run.
        identity: JSON-able facts that identify the run; stored in its checkpoint.
        device: device of the training.
        movers: bool [I, H, W] moving pixels of the training frames by the motion mattes; None: there are no mattes.
        ignored: index of a scene frame -> bool [H, W] pixels that are left out of training and measurements.
        most: number of Gaussians that fit the device's memory; None: the configured budget fits.
        pieces: number of Gaussians per call of the field; None: all in one call.
        depth: the user's depth maps. Seeds start at them, and Gaussians in `movers` are pulled to them.
    """

    def __init__(
        self, scene: Scene, images: Tensor, train: list[int], config: TrainConfig, report: Reporter,
        identity: dict[str, Any] | None = None, device: torch.device | str = "cpu", movers: Tensor | None = None,
        ignored: dict[int, Tensor] | None = None, most: int | None = None, pieces: int | None = None,
        depth: FittedDepth | None = None,
    ) -> None:  # fmt: skip
        self.identity, self.device = identity or {}, torch.device(device)
        self.scene, self.images, self.train_ids, self.config, self.report = scene, images, train, config, report
        self.movers = movers if config.decides else None
        self.ignored = ignored or {}
        self.depth, self.targets = depth, None
        if depth is not None and self.movers is not None and config.method != "static":
            self.targets = DepthTargets(depth, [scene.frames[i] for i in train], self.movers)
        self.height, self.width = images.shape[1:3]
        opens = config.gate.start
        self.softened = SoftenedMovers(self.movers, self.width, (opens, opens + config.soft_movers), config.soft_block)
        self.viewmats = scene.viewmats.to(self.device)
        self.Ks = scene.camera_at(self.width, self.height).to(self.device)
        self.times = [float(scene.times[i]) for i in train]
        self.seconds = float(scene.seconds[train[-1]] - scene.seconds[train[0]])
        # Drawn on the CPU for every device: a run is the same experiment, and its checkpoint resumes on any.
        self.generator = torch.Generator(device="cpu").manual_seed(config.seed)
        centres = bin_times(scene.times[train])
        self._bins = [bin_of(centres, time) for time in self.times]
        self.centres = centres.to(self.device)
        self.most, self.pieces = most, pieces
        budget = self.densify_config().budget
        count = len(self.centres)
        known = None if depth is None else depth.at
        gaussians = initialise(scene, images, train, count, config.init, self.generator, budget, self.ignored, known)
        gaussians = gaussians.to(self.device)
        self.model = DynamicModel(gaussians, None, self.centres, 0, Exposure(self.centres, config.exposure), pieces)
        self.initial = len(gaussians)
        gate, densify = config.gate, config.densify
        schedule = RunSchedule(
            config.iterations, densify.every, densify.stop, gate.give_up, config.sh_every, config.lr_end,
            self.softened.until,
        )  # fmt: skip
        self.policy = StoppingPolicy(config.needs, len(train) if config.decides else 0, schedule)
        self.extensions: list[Extension] = []
        self.iteration = 0
        self.trained_seconds = 0.0
        self.order: list[int] = []
        low, high = field_box(scene.points)
        self.soundness = Soundness(float(norm_of_all(high - low)), self.device)
        self.poses = Poses(self.times, config.poses, self.device)
        self.refined = False
        """True once the corrected cameras have replaced the solve's cameras."""
        self.optimizer = optimizer_of(self.model, self.poses, config)
        self.mean = ParameterMean()
        self.densifier = Densifier(self.densify_config(), len(gaussians), self.device)
        self.recorder = self.new_recorder()

    # ------------------------------------------------------------------ the run

    def bin_of_frame(self, frame: int) -> int:
        """Time bin of the support bitmap for the training frame at position `frame`."""
        return self._bins[frame]

    @property
    def excluded_frames(self) -> set[int]:
        """Positions among the training frames that are currently excluded: probe frames and unusable frames."""
        return self.soundness.unusable | self.policy.excluded

    @property
    def gaussian_count(self) -> int:
        """Current number of Gaussians."""
        return len(self.model.gaussians)

    @property
    def sh_degree(self) -> int:
        """SH degree in use."""
        return self.model.sh_degree

    @property
    def progress(self) -> float:
        """Share of the run that is done. 1 for an extended run, in which every schedule has reached its end."""
        return 1.0 if self.extensions else self.iteration / self.config.iterations

    @property
    def end(self) -> int:
        """Iteration at which the run ends: as configured, earlier if the policy stops it, later if it is extended."""
        return self.extensions[-1].end if self.extensions else self.policy.end

    def extend(self, steps: int, heldout_psnr_db: float | None) -> None:
        """Adds steps to a finished run; `heldout_psnr_db` is its mean PSNR on held-out frames so far.

        The gate stays unchanged, and Gaussians are not densified. Anchors and the price of motion keep their full
        weight. The policy does not stop the run early.
        """
        self.extensions.append(Extension(self.iteration, steps, heldout_psnr_db, self.trained_seconds))
        self.policy.joined = True  # the probe frames of a run that ended early may still be excluded

    def densify_config(self) -> DensifyConfig:
        """The densification settings, with the budget limited to `most`."""
        config = self.config.densify
        # A copy, because the run's key is computed from `config`.
        return config if self.most is None else dataclasses.replace(config, budget=min(config.budget, self.most))

    def step(self) -> Tensor:
        """Runs one optimisation step on one training frame and returns its photometric loss (0-dim). A step whose loss
        or gradients are not finite is not applied."""
        frame = self._next_frame()
        self._schedule_rates()
        kind, facts = self._step_inputs(frame)
        if self.recorder is not None:
            return self.recorder.step(kind, facts, frame)
        return self.carry_out(kind, facts.on(self.device), frame)

    def _step_inputs(self, frame: int) -> tuple[StepKind, StepFacts]:
        """Kind and inputs of the next step, on the training frame at position `frame`. All random numbers of a
        recordable step are drawn in this function; other steps also draw in `carry_out`."""
        model, s, field, c = self.model, self.config.supervision, self.model.field, self.config
        rows, index, time = model.open_rows(), self.train_ids[frame], self.times[frame]
        draws = None
        if field is not None and len(rows) and s.is_anchor_step(self.iteration, self.progress):
            draws = draw(len(rows), len(self.centres), s, self.generator)
        field_time = time if field is None else field.training_time(time, self.progress, self.generator)
        # A random background colour at every step penalises holes, which a fixed colour could hide.
        background = torch.rand(3, generator=self.generator, device="cpu")
        left, right, share = model.exposure.place(time)
        is_due = self.targets is not None and self.iteration % self.targets.every == 0
        depth = self.targets.at(frame) if is_due and self.targets is not None else None
        numbers = from_numpy(np.array([field_time, 1.0 - share, share, still_weight(self.progress, s)], np.float32))
        ignored = self.ignored.get(index)
        movers = self.softened.movers_at(frame, self.progress)
        facts = StepFacts(
            numbers=torch.cat([numbers, background]),
            places=from_numpy(np.array([self._bins[frame], left, right], np.int64)),
            viewmat=self.viewmats[index], K=self.Ks[index], image=self.images[frame], ignored=ignored,
            movers=movers, draws=draws, depth=depth,
        )  # fmt: skip
        is_irregular = self._refines_poses() or (field is not None and s.is_paper_step(self.iteration, self.progress))
        kind = StepKind(
            sh_degree=model.sh_degree,
            moves=field is not None and len(rows) > 0,
            detached=self.progress < c.field.detached,
            hidden=field is not None and s.is_hidden_step(self.iteration),
            anchored=draws is not None,
            penalised=self.iteration % c.field_every == 0,
            soft=movers is not None,
            ignored=ignored is not None,
            depth=depth is not None,
            recordable=not is_irregular and (field is None or field.recordable),
        )
        return kind, facts

    def carry_out(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        """Runs a step of kind `kind` on inputs `facts` on the device; returns its photometric loss (0-dim).

        Inputs that change between steps of one kind come from `facts`, so that a CUDA graph of the step can be
        replayed. `frame` is only used by steps that are not recorded.
        """
        supervision, model = self.config.supervision, self.model
        rows = model.open_rows()
        pairs = None if facts.draws is None else anchored_pairs(model.gaussians, rows, facts.draws, supervision)
        deltas, anchored = self._deltas(rows, facts.field_time, pairs)
        if deltas is not None:
            self.soundness.memory.observe(deltas.means.detach())
        # As published for SC-GS: until 13/80 of a run, the photometric loss does not train the field.
        if deltas is not None and kind.detached:
            deltas = deltas.detached()
        state = model.moved(rows, deltas)
        viewmat = corrected(facts.viewmat, self.poses.values[frame]) if self._refines_poses() else facts.viewmat
        out = render(
            state, model.sh_degree, viewmat, facts.K, self.width, self.height, background=facts.background,
            with_depth=kind.hidden, with_contributions=True,
        )  # fmt: skip
        paper = kind.moves and supervision.is_paper_step(self.iteration, self.progress)
        if paper:
            # The paper's detectors read this gradient after the backward pass; torch would free it.
            state["means"].retain_grad()
        exposed = model.exposure.apply_at(out.colors[0], facts.exposure_bins, facts.exposure_shares)
        loss = self.softened.loss(exposed, facts.image, self.config.dssim, facts.ignored, facts.movers)
        total = loss + self._regularisers(rows, kind.penalised)
        if deltas is not None and supervision.preset == "support":
            price = stillness(deltas, len(model.gaussians), loss, facts.motion_price, supervision)
            total = total + self.config.field.still * price
        if facts.depth is not None and self.targets is not None:
            moves = model.gaussians.open if kind.moves else None
            total = total + self.targets.weight * depth_pull(state, moves, viewmat, facts.K, facts.depth)
        if self._refines_poses():
            total = total + self.poses.regularisation()
        if pairs is not None and anchored is not None:
            total = total + self._support_loss(pairs, anchored)
        self.optimizer.zero_grad(set_to_none=True)
        backward(total)
        if paper:
            second = paper_step(self, frame, rows, state, out)
            self.soundness.trains_on(*([] if second is None else [second]))
        self.optimizer.step(guard=[total])
        if self._refines_poses():
            self.poses.fix_gauge(self.excluded_frames)
        applied = self.optimizer.applied
        # Only on the CPU: on a GPU, reading `applied` would wait for the step.
        if self.device.type == "cpu" and not bool(applied):
            self.soundness.skipped(self, frame)
            return loss.detach()
        self.soundness.count(applied)
        self._observe(facts, rows, state, out, applied)
        return loss.detach()

    def _observe(
        self, facts: StepFacts, rows: Tensor, state: dict[str, Tensor], out: RasterOutput, applied: Tensor
    ) -> None:
        """Updates the densifier and the support bitmap after a step. `applied` (0-dim bool): was the step applied?"""
        if out.weight_sum is None:
            raise RuntimeError("the frame was rendered without contributions")
        radii, weight = out.radii[0], out.weight_sum[0]
        if self.device.type != "cpu":
            # A skipped step must not count as a view of the Gaussians. The product needs no read-back.
            radii, weight = radii * applied, weight * applied
        self.densifier.observe(out.means2d_absgrad[0], radii)
        mark_seen(self.model.gaussians, facts.time_bin, weight)
        if out.depth_median is not None:  # at steps that mark hidden Gaussians
            view = facts.viewmat, facts.K, out.depth_median[0]
            mark_hidden(self.model.gaussians, rows, facts.time_bin, state, *view)

    def new_recorder(self) -> Recorder | None:
        """A new recorder of steps on a GPU; None on the CPU."""
        return Recorder(self, self.model.device) if self.device.type == "cuda" else None

    def layout(self) -> tuple[object, ...]:
        """The objects that steps read and write, and the repair count. Recorded steps stay valid while it is unchanged.

        Densification, the gate, a repair, a change of SH degree or a checkpoint replaces some of these tensors. Moments
        of the optimiser need not be compared: they are replaced only with these tensors.
        """
        model, growth, field = self.model.gaussians, self.densifier, self.model.field
        return (
            self.soundness.mended, self.model.pieces, len(self.optimizer.param_groups), self.optimizer,
            field, None if field is None else self.model.open_rows(), model.open, model.support, model.hidden,
            growth.gradient, growth.seen, self.model.exposure.values, self.poses.values, *model.params.values(),
        )  # fmt: skip

    def _deltas(self, rows: Tensor, time: Tensor, pairs: Anchored | None) -> tuple[Deltas | None, Deltas | None]:
        """(deltas of `rows` at the frame's `time` [1], deltas of the anchored `pairs`). One call of the field
        computes both, unless the field requires separate calls on a GPU (`has_separate_calls`)."""
        field = self.model.field
        if field is None:
            return None, None
        if pairs is None:
            return self.model.deltas(rows, time), None
        times = torch.cat([time.expand(len(rows)), self.centres[pairs.bins]])
        means = self.model.gaussians.params["means"]
        # Anchors train the field only: without `detach`, gradients through the field would also move the means.
        positions = torch.cat([means[rows], means.detach()[pairs.rows]])
        # At one time, a node's motion is computed once. A joint call of mixed times would compute it for each pair.
        if field.has_separate_calls and self.device.type != "cpu":
            anchored = field(positions[len(rows) :], times[len(rows) :], self.model.gaussians.host_params(pairs.rows))
            return self.model.deltas(rows, time), anchored
        host_params = self.model.gaussians.host_params(torch.cat([rows, pairs.rows]))
        return split_deltas(self.model.evaluate(field, positions, times, host_params), len(rows))

    def image_of(self, frame: int) -> Tensor:
        """[H, W, 3] float32 image of the training frame at position `frame`, on the device."""
        return self.images[frame].to(self.device, torch.float32, non_blocking=True)

    def ignored_at(self, index: int) -> Tensor | None:
        """bool [H, W] ignored pixels of the scene's frame `index`, on the device; None: no pixel is ignored."""
        ignored = self.ignored.get(index)
        return None if ignored is None else ignored.to(self.device, non_blocking=True)

    # ------------------------------------------------------------------ the cameras

    def _refines_poses(self) -> bool:
        c = self.config.poses
        return c.on and c.start <= self.progress < c.until

    def freeze_poses(self) -> None:
        """Replaces the cameras of all frames, including frames that are not trained on, by the corrected cameras."""
        refined = corrected(self.viewmats, self.poses.at(self.scene.times))
        self.policy.judge_cameras(self, refined)
        self.viewmats, self.refined = refined, True

    def _viewmat(self, index: int, frame: int | None = None) -> Tensor:
        """[4, 4] corrected camera of the scene's frame `index`. `frame`: its position among the training frames."""
        if not self._refines_poses():
            return self.viewmats[index]
        if frame is None:
            return corrected(self.viewmats[index], self.poses.at(self.scene.times[index : index + 1])[0])
        return corrected(self.viewmats[index], self.poses.values[frame])

    # ------------------------------------------------------------------ one step's parts

    @property
    def background(self) -> Tensor:
        """[3] background colour for measurements and previews: mid grey."""
        return torch.full((3,), 0.5, device=self.device)

    def render_trained(self, state: dict[str, Tensor], frame: int, **options: Any) -> RasterOutput:
        """Renders parameters `state` from the current camera of the training frame at position `frame`."""
        index = self.train_ids[frame]
        options.setdefault("background", self.background)
        options.setdefault("with_contributions", True)
        options.setdefault("with_depth", False)
        degree = options.pop("sh_degree", self.model.sh_degree)
        return render(
            state, degree, self._viewmat(index, frame), self.Ks[index], self.width, self.height, **options
        )  # fmt: skip

    def _next_frame(self) -> int:
        if not self.order:
            shuffled = integers(torch.randperm(len(self.train_ids), generator=self.generator, device="cpu"))
            out = self.excluded_frames
            self.order = [frame for frame in shuffled if frame not in out]
        self.soundness.trains_on(self.order[-1])
        return self.order.pop()

    def _regularisers(self, rows: Tensor, penalised: bool) -> Tensor:
        c, p = self.config, self.model.gaussians.params
        total = c.opacity_weight * torch.sigmoid(p["opacity_logits"]).mean()
        total = total + c.scale_weight * p["log_scales"].exp().mean() + self.model.exposure.regularisation()
        field = self.model.field
        if field is None or not len(rows):
            return total
        if penalised:
            # Times the interval of these steps.
            total = total + c.field_every * field.regularisation(self.progress, self.generator)
        return total

    def _support_loss(self, pairs: Anchored, deltas: Deltas) -> Tensor:
        s, field = self.config.supervision, self.model.field
        if field is None:
            raise RuntimeError("pairs were drawn without a field")
        loss = support_loss(self.model.gaussians, field, pairs, deltas, self.centres, self.seconds, s)
        return s.support_every * loss  # times the interval of these steps

    def inspect_nonfinite(self) -> None:
        """Repairs parameters that are not finite, and warns. JobError if the run keeps failing."""
        self.soundness.inspect(self)

    # ------------------------------------------------------------------ optimiser

    def average(self, length: int) -> None:
        """Averages the parameters over the last steps, and sets them to the mean after the last one.

        length: steps of the run, or of the extension. Called after each step.
        """
        if self.iteration > self.end - round(self.config.average * length):
            self.mean.add(self.named_tensors())
        if self.iteration == self.end:
            self.mean.copy_into(self.named_tensors())

    def _schedule_rates(self) -> None:
        schedule = self.extensions[-1] if self.extensions else self.policy
        schedule_rates(self.optimizer, schedule.rate_progress(self.iteration, self.config.iterations))

    # ------------------------------------------------------------------ held-out frames

    @torch.no_grad()
    def render_frame(
        self, index: int, *, sh_degree: int | None = None, exposure: bool = True, field: bool = True,
        viewmats: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """[H, W, 3] render of the scene's frame `index` at its time, not clamped.

        Options: another SH degree, no exposure correction, no field, or other cameras [F, 4, 4].
        """
        model, time = self.model, float(self.scene.times[index])
        state = model.state_at(time) if field else model.moved(model.open_rows(), None)
        viewmat = self._viewmat(index) if viewmats is None else viewmats[index]
        out = render(
            state, model.sh_degree if sh_degree is None else sh_degree, viewmat, self.Ks[index], self.width,
            self.height, background=self.background, with_depth=False, with_contributions=False,
        )  # fmt: skip
        return model.exposure.apply(out.colors[0], time) if exposure else out.colors[0]

    def frame_psnrs(self, indices: list[int], images: Tensor | list[Tensor], **options: Any) -> list[float]:
        """PSNR in dB of the renders of frames `indices` of the scene against images [I, H, W, 3].

        `options` go to `render_frame`.
        """
        values: list[float] = []
        for n, i in enumerate(indices):
            self.report.check_cancelled()
            image = images[n].to(self.device, torch.float32)
            values.append(psnr(self.render_frame(i, **options), image, self.ignored_at(i)))
        return values

    def heldout_psnr(self, indices: list[int], images: Tensor) -> float | None:
        """Mean PSNR in dB over held-out frames, without frames that are ignored entirely; None if none is left."""
        values = [value for value in self.frame_psnrs(indices, images) if math.isfinite(value)]
        return sum(values) / len(values) if values else None

    def probe_psnr(
        self, frames: list[int], *, exposure: bool = True, field: bool = True, **options: Any
    ) -> float | None:  # fmt: skip
        """See `stopping.Probe.probe_psnr`; `options` go to `render_frame`."""
        if not (exposure or self.config.exposure.on) or not (field or self.model.field is not None) or not frames:
            return None
        indices, options = [self.train_ids[n] for n in frames], {**options, "exposure": exposure, "field": field}
        values = self.frame_psnrs(indices, [self.images[n] for n in frames], **options)
        value = sum(values) / len(values)
        return value if math.isfinite(value) else None

    def correlation_frames(self) -> float | None:
        """See `stopping.Probe.correlation_frames`."""
        return correlation_of_movers(self)

    # ------------------------------------------------------------------ trained parameters

    def named_tensors(self) -> dict[str, Tensor]:
        """All trained parameters by their names in a checkpoint."""
        named: dict[str, Tensor] = {**self.model.gaussians.params, "exposure": self.model.exposure.values}
        if self.config.poses.on:
            named["poses"] = self.poses.values
        if self.model.field is not None:
            named.update({f"field.{n}": p for n, p in self.model.field.named_parameters()})
        return named
