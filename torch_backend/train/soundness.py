"""Detects steps with values that are not finite, and repairs their cause. A run that keeps failing ends with an error.

`repair.py` implements the repairs. On a GPU, a step reads nothing back: skipped steps are counted on the GPU, and the
count is read every `INSPECT_EVERY` steps.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

import torch
from torch import Tensor

from ..gaussians import Densifier
from ..scene import Scene
from ..torch_types import integers
from .repair import FieldMemory, drop_offenders, repair, unstable
from .run_view import RunView

INSPECT_EVERY = 10
"""Interval in steps of inspections of a GPU's counts, and of progress reports."""
_MAX_BAD_STEPS = 20
"""Number of consecutive skipped steps after which the run ends."""


class MendedRun(RunView, Protocol):
    """A run in training that can be repaired."""

    scene: Scene
    """Scene of the run."""
    densifier: Densifier
    """Densifier, whose statistics are kept in step with the Gaussians."""
    iteration: int
    """Number of finished steps."""
    order: list[int]
    """Positions of the upcoming training frames, the next one last."""

    @property
    def optimizer(self) -> torch.optim.Optimizer:
        """Optimiser of all trained parameters."""
        ...

    def image_of(self, frame: int) -> Tensor:
        """[H, W, 3] float32 image of the training frame at position `frame`."""
        ...


class Soundness:
    """Keeps track of a run's steps, frames and fields that are not finite."""

    def __init__(self, extent: float, device: torch.device) -> None:
        """`extent`: extent of the scene in scene units."""
        self.memory = FieldMemory(extent, device)
        """Stored parameters of the field while it was stable."""
        self.unusable: set[int] = set()
        """Positions of the training frames whose images are not finite; they are not trained on again."""
        self.mended = 0
        """Number of inspections that found a fault."""
        self.troubled = False
        """True if the last step before the last inspection was skipped. The following steps are then launched
        (`recorder`), so that the next inspection finds the gradients of a step."""
        self._in_a_row = 0
        self._counted = torch.zeros(2, dtype=torch.int32, device=device)
        # Twice, because a step of the paper's rule uses two frames.
        self._recent: deque[int] = deque(maxlen=2 * INSPECT_EVERY)

    def trains_on(self, *frames: int) -> None:
        """Notes the training frames (positions) that a step uses."""
        self._recent.extend(frames)

    def count(self, applied: Tensor) -> None:
        """Counts a step as applied or skipped, by `applied` (0-dim bool). On the CPU, it is called for applied steps
        only; `skipped` is called for others."""
        self._in_a_row = 0
        if applied.device.type != "cpu":
            left_out = ~applied
            self._counted.copy_(torch.stack([self._counted[0] + left_out, (self._counted[1] + 1) * left_out]))

    def skipped(self, run: MendedRun, frame: int) -> None:
        """Repairs the run after a skipped step on the CPU. JobError if the run keeps failing."""
        self._in_a_row += 1
        if self._in_a_row >= _MAX_BAD_STEPS:
            raise unstable(run.iteration)
        number = run.scene.frames[run.train_ids[frame]]
        text = f"Step {run.iteration} on frame {number} was skipped: its loss or gradient is not finite."
        self._recover(run, text if self._in_a_row == 1 else "", gradients=True)

    def inspect(self, run: MendedRun) -> None:
        """Reads a GPU's counts of skipped steps (since the last inspection, and consecutive), and repairs values that
        are not finite. JobError if the run keeps failing."""
        count, in_a_row = (0, 0) if run.device.type == "cpu" else integers(self._counted)
        self._counted[0] = 0
        if in_a_row >= _MAX_BAD_STEPS:
            raise unstable(run.iteration)
        self.troubled = in_a_row > 0
        if self.troubled and all(p.grad is None for p in run.model.gaussians.params.values()):
            self._counted.zero_()  # recorded steps leave no gradients to inspect, so counting restarts
        text = f"{count} of the steps up to {run.iteration} were skipped: their loss or gradient is not finite."
        self._recover(run, text if count else "", gradients=in_a_row > 0)

    def _recover(self, run: MendedRun, skipped: str, gradients: bool) -> None:
        """Finds and repairs values that are not finite, and warns.

        Args:
            skipped: sentence that says which steps were skipped; empty if none.
            gradients: True if the parameters hold the gradients of a skipped step.
        """
        model = run.model
        done = repair(model, run.optimizer, run.densifier, self.memory, run.iteration)
        if model.field is not None and not done:
            done = self.memory.restore_stable(model.field, run.optimizer)
        bad = [] if done or not (skipped or gradients) else self._bad_images(run)
        if bad:
            self.unusable.update(bad)
            run.order = [frame for frame in run.order if frame not in self.unusable]
            if len(self.unusable) == len(run.train_ids):
                raise unstable(run.iteration)
            names = ", ".join(str(run.scene.frames[run.train_ids[frame]]) for frame in bad)
            done = f"excluded frame {names} from the training (its image is not finite)"
        elif gradients and not done:
            done = drop_offenders(model, run.optimizer, run.densifier)
        self.mended += bool(done) or gradients
        if done:
            run.report.warning(f"{skipped or f'Step {run.iteration}.'} Repaired: {done}. Training continues.")
        elif skipped:
            run.report.warning(skipped)
        elif not gradients:
            self.memory.keep(model.field, model.gaussians.params["means"].detach()[model.open_rows()])

    def _bad_images(self, run: MendedRun) -> list[int]:
        """Positions of the recently used training frames whose image is not finite."""
        frames = sorted({*self._recent} - self.unusable)
        return [frame for frame in frames if not bool(torch.isfinite(run.image_of(frame)).all())]
