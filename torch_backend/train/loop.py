"""Training loop: steps, events between steps, checkpoints, the time estimate and handling of out-of-memory errors."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ..contract import FORECAST, Cancelled, ExitCode, JobError
from ..gaussians import covering
from ..native import torch_threads
from ..raster.hit_lists import forget_demands
from . import memory
from .events import schedule_events
from .forecast import Outlook, Stopwatch, smaller_presets, step_work, warning_of
from .resume import save_run
from .soundness import INSPECT_EVERY
from .trainer import Trainer


def train_to_end(trainer: Trainer, checkpoint: Path | None, evaluate: Callable[[Trainer], None]) -> None:
    """Trains a run to its end.

    Saves to `checkpoint` at intervals and on cancellation; None: nothing is written. Calls `evaluate` at the
    configured interval. If a resumed run starts at such an interval, `evaluate` is called for this step again.
    """
    on_cpu = trainer.device.type == "cpu"
    with torch_threads(3 * trainer.width * trainer.height) if on_cpu else contextlib.nullcontext():
        TrainingLoop(trainer, checkpoint, evaluate).run()


class TrainingLoop:
    """Runs the remaining steps of a run."""

    def __init__(self, trainer: Trainer, checkpoint: Path | None, evaluate: Callable[[Trainer], None]) -> None:
        """Arguments as in `train_to_end`."""
        self.trainer, self.checkpoint, self.evaluate = trainer, checkpoint, evaluate
        self._has_forecast = False
        self._saved_at = time.perf_counter()

    def run(self) -> None:
        """Runs all remaining steps."""
        trainer = self.trainer
        begin, length = 0, trainer.config.iterations
        if trainer.extensions:
            begin, length = trainer.extensions[-1].from_iteration, trainer.extensions[-1].steps
        every = max(1, round(trainer.config.evaluate_every * length))
        since = time.perf_counter() - trainer.trained_seconds
        started = trainer.iteration
        watch = Stopwatch() if trainer.device.type == "cpu" else None
        if started > begin and (started - begin) % every == 0:  # a cancellation may have interrupted this evaluation
            self._with_room(lambda: self.evaluate(trainer))
        try:
            while trainer.iteration < trainer.end:
                trainer.report.check_cancelled()
                loss = self._step_that_fits()
                if loss is None:
                    self._make_room()
                    continue
                trainer.iteration += 1
                self._with_room(lambda: trainer.average(length))
                trainer.trained_seconds = time.perf_counter() - since
                if watch is not None:
                    self._report_forecast(watch, resumed=started > 0)
                if (trainer.iteration - begin) % every == 0:
                    self._with_room(lambda: self.evaluate(trainer))
                    if watch is not None:
                        watch.begin()
                if trainer.iteration % INSPECT_EVERY == 0 or trainer.iteration == trainer.end:
                    trainer.inspect_nonfinite()
                    text = f"step {trainer.iteration}, {len(trainer.model.gaussians)} Gaussians, loss {float(loss):.4f}"
                    trainer.report.progress("training", trainer.iteration - begin, trainer.end - begin, text)
                if time.perf_counter() - self._saved_at > trainer.config.checkpoint_seconds:
                    self._with_room(self._save)
        except Cancelled:
            if trainer.iteration > started:
                self._save()
            raise
        trainer.trained_seconds = time.perf_counter() - since
        if trainer.recorder is not None:
            trainer.recorder.forget()
        self._save()

    def _with_room(self, work: Callable[[], None]) -> None:
        """Runs repeatable `work` between steps. If GPU memory runs out, frees recordings or caches, and retries."""
        with contextlib.suppress(torch.OutOfMemoryError):
            return work()
        if self.trainer.recorder is None or not self.trainer.recorder.disable():
            torch.cuda.empty_cache()
        return work()

    def _report_forecast(self, watch: Stopwatch, resumed: bool) -> None:
        """Reports the estimated time left after a step on the CPU, once enough steps have been timed. With the first
        estimate, warns if the run will take long."""
        trainer = self.trainer
        pixels, now = trainer.width * trainer.height, len(trainer.model.gaussians)
        seconds_per_pixel = watch.step(step_work(pixels, now))
        if seconds_per_pixel is None:
            return
        grows = trainer.policy.growing and not trainer.extensions

        def count(step: int) -> float:
            share = step / trainer.config.iterations
            return max(now, trainer.densifier.target(trainer.initial, share)) if grows else now

        seconds_left = seconds_per_pixel * Outlook(pixels, trainer.iteration, trainer.end, count).work()
        trainer.report.metric(FORECAST, {"of": "training", "seconds_left": round(seconds_left, 1)})
        if not self._has_forecast:
            self._has_forecast = True
            size = trainer.scene.width, trainer.scene.height
            smaller = smaller_presets(trainer.config.preset, size, trainer.initial, seconds_per_pixel)
            warning = warning_of(
                seconds_left, trainer.width, resumed, [row for row in smaller if row.seconds < seconds_left]
            )
            if warning is not None:
                trainer.report.warning(*warning)

    def _step_that_fits(self) -> Tensor | None:
        """Runs the events that are due and one step; returns its loss, or None if GPU memory ran out. After None the
        state is consistent: growth is atomic, and the optimiser runs last."""
        try:
            schedule_events(self.trainer)
            return self.trainer.step()
        except torch.OutOfMemoryError:
            return None  # leaving the handler drops the traceback, whose stack frames hold the step's tensors

    def _make_room(self) -> None:
        """Reduces the run's memory after GPU memory ran out. JobError if it cannot be reduced further.

        Each call takes the first measure that is left: free the recorded steps; halve the chunks in which the field is
        evaluated; drop the fifth of the Gaussians that cover least. The last two save the run first, and stop growth.
        """
        trainer = self.trainer
        model = trainer.model.gaussians
        before = len(model)
        trainer.optimizer.zero_grad(set_to_none=True)
        if len(trainer.densifier.seen) != before:  # memory ran out within a round of growth
            trainer.densifier.reset(before)
        forget_demands()
        has_freed = trainer.recorder is not None and trainer.recorder.disable()
        torch.cuda.empty_cache()
        if has_freed:
            return
        self._save()
        moving = len(trainer.model.open_rows())
        if min(trainer.model.pieces or moving, moving) > memory.LEAST_PIECE:
            trainer.pieces = trainer.model.pieces = min(trainer.model.pieces or moving, moving) // 2
            done = f"motion is computed in pieces of {trainer.pieces}"
        else:
            kept = min(round(0.8 * before), trainer.most or before)
            if kept < memory.LEAST:
                raise JobError(
                    f"The graphics card has too little memory for step {trainer.iteration} with {before} Gaussians.",
                    "Close other programs that use the card, choose a smaller width, or train on the processor; the "
                    "training so far is kept.",
                    ExitCode.TRAIN,
                )
            rows = covering(model, kept)
            model.rebuild(rows, torch.zeros(kept, dtype=torch.bool, device=trainer.device), trainer.optimizer)
            trainer.densifier.reset(kept)
            done = f"the {before - kept} of {before} Gaussians that cover least were removed"
        trainer.most = len(model)
        trainer.densifier.config = trainer.densify_config()
        trainer.report.warning(
            f"The graphics card ran out of memory at step {trainer.iteration}: {done}, and no more are added. "
            "Training continues.",
            "To free memory, close other programs that use the card, or choose a smaller width.",
        )

    def _save(self) -> None:
        save_run(self.trainer, self.checkpoint)
        self._saved_at = time.perf_counter()
