"""The paper's anchoring terms in a training step, for hidden and defective Gaussians in two frames."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from ..raster import RasterOutput
from ..supervision import PaperView, paper_loss, well_supervised
from ..torch_types import backward
from .losses import photometric
from .run_view import RunView


class RenderedRun(RunView, Protocol):
    """A run that can render further frames within a step; `Trainer` implements it."""

    generator: torch.Generator
    """Random number generator of the run."""

    def render_trained(self, state: dict[str, Tensor], frame: int, **options: Any) -> RasterOutput:
        """Renders the parameters `state` from the camera of the training frame at position `frame`."""
        ...

    def image_of(self, frame: int) -> Tensor:
        """[H, W, 3] float32 image of the training frame at position `frame`, on the device."""
        ...


def paper_step(run: RenderedRun, frame: int, rows: Tensor, state: dict[str, Tensor], out: RasterOutput) -> int | None:
    """Adds the gradients of the paper's terms for this frame and another random frame to those of the step.

    Args:
        frame: position of the step's frame among the training frames.
        rows: [M] Gaussians that move.
        state: all parameters at the frame's time; `means` must hold its gradient.
        out: render of the frame, after the backward pass.

    Returns the position of the other frame; None if it has the same time or is excluded.
    """
    second = int(torch.randint(len(run.train_ids), (1,), generator=run.generator, device="cpu"))
    if run.times[second] == run.times[frame] or second in run.excluded_frames:
        return None
    supervision, model = run.config.supervision, run.model
    supervised = _supervised(run, frame, rows, state, out)
    second_state = model.state_at(run.times[second])
    second_state["means"].retain_grad()
    second_out = run.render_trained(second_state, second)
    exposed = model.exposure.apply(second_out.colors[0], run.times[second])
    ignored = run.ignored_at(run.train_ids[second])
    loss = photometric(exposed, run.image_of(second), run.config.dssim, ignored)
    # With `pulls` all, the terms below use this graph again.
    backward(loss, retain_graph=True)
    second_supervised = _supervised(run, second, rows, second_state, second_out)
    every = supervision.pulls == "all"
    if not every:
        # The published code also pulls canonical parameters. That cost 4DGaussians 0.32 dB (docs/decisions.md).
        second_state = model.state_at(run.times[second], canonical=False)
    views = [
        _view(run, model.state_at(run.times[frame], canonical=every), frame, rows, supervised),
        _view(run, second_state, second, rows, second_supervised),
    ]
    loss = paper_loss(views[0], views[1], run.progress, supervision)
    # A gradient that is not finite would make the optimiser skip the photometric loss of the step, too.
    if loss is not None and bool(torch.isfinite(loss)):
        backward(loss)
    return second


def _supervised(run: RenderedRun, frame: int, rows: Tensor, state: dict[str, Tensor], out: RasterOutput) -> Tensor:
    """bool [M] Gaussians of `rows` that the frame supervises well. Call it after the backward pass."""
    index, pull = run.train_ids[frame], state["means"].grad
    if pull is None or out.weight_sum is None:
        raise RuntimeError("the frame was rendered without gradients or contributions")
    return well_supervised(
        run.config.supervision, out.weight_sum[0][rows], out.means2d_grad[0][rows], pull[rows],
        run.Ks[index], run.viewmats[index], state["means"].detach()[rows], (run.width, run.height),
    )  # fmt: skip


def _view(run: RenderedRun, state: dict[str, Tensor], frame: int, rows: Tensor, supervised: Tensor) -> PaperView:
    index = run.train_ids[frame]
    means = state["means"][rows].detach()
    inside = inside_frustum(means, run.viewmats[index], run.Ks[index], run.width, run.height)
    return PaperView(run.times[frame], {k: v[rows] for k, v in state.items()}, inside, supervised)


def inside_frustum(means: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """bool [M] True for `means` [M, 3] in front of the camera and inside its image. The paper calls others *hidden*;
    `Gaussians.hidden` also holds occluded ones."""
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[:, 2].clamp_min(1e-6)
    x = camera[:, 0] / depth * K[0, 0] + K[0, 2]
    y = camera[:, 1] / depth * K[1, 1] + K[1, 2]
    return (camera[:, 2] > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
