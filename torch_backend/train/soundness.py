"""Keeps a run finite: steps that were left out are counted, what caused them is found and mended, and a run that keeps
failing ends in words. The repairs themselves are in `repair.py`.

On a GPU a step reads nothing back: what was left out is counted there, and looked at every `INSPECT_EVERY` steps.
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
"""Steps between two looks at what a GPU counted, and between two reports of progress."""
_MAX_BAD_STEPS = 20


class MendedRun(RunView, Protocol):
    """A run in training that can be mended."""

    scene: Scene
    """What it is trained on."""
    densifier: Densifier
    """Drops Gaussians with the model."""
    iteration: int
    """Steps that are done."""
    order: list[int]
    """Positions of the trained frames that come next, the next one last."""

    @property
    def optimizer(self) -> torch.optim.Optimizer:
        """Of everything that is learnt."""
        ...

    def image_of(self, frame: int) -> Tensor:
        """[H, W, 3] float32, the trained frame at position `frame`."""
        ...


class Soundness:
    """Bookkeeping of a run's steps, frames and fields that are not finite."""

    def __init__(self, extent: float, device: torch.device) -> None:
        """`extent`: of the scene, in its units."""
        self.memory = FieldMemory(extent, device)
        """What the field was when it was in order."""
        self.unusable: set[int] = set()
        """Positions of the trained frames whose pictures are not finite; nobody trains on them again."""
        self.mended = 0
        """How often something was found out of order."""
        self.troubled = False
        """Was the last step before the last look left out? Its successors are taken one launch at a time (`recorder`),
        so that the next look finds the gradients of one."""
        self._in_a_row = 0
        self._counted = torch.zeros(2, dtype=torch.int32, device=device)
        self._recent: deque[int] = deque(maxlen=2 * INSPECT_EVERY)

    def trains_on(self, *frames: int) -> None:
        """Frames, by their positions among the trained ones, that a step looks at."""
        self._recent.extend(frames)

    def count(self, applied: Tensor) -> None:
        """After a step: `applied` (0-dim bool) says whether it was; on the CPU it was, else see `skipped`."""
        self._in_a_row = 0
        if applied.device.type != "cpu":
            left_out = ~applied
            self._counted.copy_(torch.stack([self._counted[0] + left_out, (self._counted[1] + 1) * left_out]))

    def skipped(self, run: MendedRun, frame: int) -> None:
        """After a step that was left out on the CPU: repairs; a run that keeps failing ends in words."""
        self._in_a_row += 1
        if self._in_a_row >= _MAX_BAD_STEPS:
            raise unstable(run.iteration)
        number = run.scene.frames[run.train_ids[frame]]
        text = f"Step {run.iteration} on frame {number} was skipped: its loss or gradient is not finite."
        self._recover(run, text if self._in_a_row == 1 else "", gradients=True)

    def inspect(self, run: MendedRun) -> None:
        """Repairs what is not finite; reads a GPU's counts of steps left out: since the last look, and in a row."""
        count, in_a_row = (0, 0) if run.device.type == "cpu" else integers(self._counted)
        self._counted[0] = 0
        if in_a_row >= _MAX_BAD_STEPS:
            raise unstable(run.iteration)
        self.troubled = in_a_row > 0
        if self.troubled and all(p.grad is None for p in run.model.gaussians.params.values()):
            self._counted.zero_()  # recorded steps leave no gradients to look into: their successors count anew
        text = f"{count} of the steps up to {run.iteration} were skipped: their loss or gradient is not finite."
        self._recover(run, text if count else "", gradients=in_a_row > 0)

    def _recover(self, run: MendedRun, skipped: str, gradients: bool) -> None:
        """Finds what is not finite and drops or mends it; `skipped` says which steps were left out, if any.

        gradients: the parameters hold those of a step that was left out.
        """
        model = run.model
        done = repair(model, run.optimizer, run.densifier, self.memory, run.iteration)
        if model.field is not None and not done:
            done = self.memory.put_back(model.field, run.optimizer)
        bad = [] if done or not (skipped or gradients) else self._bad_images(run)
        if bad:
            self.unusable.update(bad)
            run.order = [frame for frame in run.order if frame not in self.unusable]
            if len(self.unusable) == len(run.train_ids):
                raise unstable(run.iteration)
            names = ", ".join(str(run.scene.frames[run.train_ids[frame]]) for frame in bad)
            done = f"left frame {names} out from now on (its image is not finite)"
        elif gradients and not done:
            done = drop_offenders(model, run.optimizer, run.densifier)
        self.mended += bool(done) or gradients
        if done:
            run.report.warning(f"{skipped or f'Step {run.iteration}.'} Repaired: {done}. Training goes on.")
        elif skipped:
            run.report.warning(skipped)
        elif not gradients:
            self.memory.keep(model.field, model.gaussians.params["means"].detach()[model.open_rows()])

    def _bad_images(self, run: MendedRun) -> list[int]:
        """Of the frames trained on lately, those whose image is not finite."""
        frames = sorted({*self._recent} - self.unusable)
        return [frame for frame in frames if not bool(torch.isfinite(run.image_of(frame)).all())]
