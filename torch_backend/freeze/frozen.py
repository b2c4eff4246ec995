"""Freezes a dynamic model: evaluates every Gaussian once, at t* or at the nearest time at which a frame saw it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..contract import UserError
from ..raster import RasterSettings
from ..scene import Scene
from ..supervision import nearest_bin, support_confidence
from ..torch_types import norm
from ..train import LoadedRun
from ..train.exposure import Exposure
from ..train.model import DynamicModel, render
from .bands import bands

_ENDS = 0.08
"""Distance to an end of the clip, as a share of the trained frames, below which instants are ranked lower. With plates
on only one side, depth is poorly determined: hands and heads came out worse there."""
SUPPORT_SECONDS = 2.0
"""The support of a moving Gaussian falls to 1/e this many seconds from the nearest time at which it was seen."""


@dataclass
class FrozenGaussians:
    """A static scene: N Gaussians at one instant, in scene units, no gradients."""

    state: dict[str, Tensor]
    """means, quats, log_scales, opacity_logits, sh0, shN of N Gaussians."""
    sh_degree: int
    """SH degree in use."""
    support: Tensor
    """[N] in 0..1: certainty of each Gaussian's state at the instant."""
    motion: Tensor
    """[N] in 0..1: 1 for Gaussians that move in the clip."""
    descent: FrozenGaussians | None = None
    """The same rows before they were developed: the Gaussians at t*, which follow the run's scene flow. None if the
    instant was not developed."""
    origin: Tensor | None = None
    """[N] uint8: 0 for a row unchanged from the run, else the number of the repair that changed it last, counted from 1
    in the order of `instant.repairs.repairs`. None: no repair was applied."""


@dataclass
class FrozenImage:
    """One frozen frame, without a background."""

    color: Tensor
    """[H, W, 3] premultiplied, display-referred."""
    alpha: Tensor
    """[H, W] in 0..1."""
    depth: Tensor
    """[H, W] median depth along the camera's axis in scene units; 1e10 where alpha is 0."""
    support: Tensor
    """[H, W] in 0..1: mean support of the visible Gaussians."""
    motion: Tensor
    """[H, W] in 0..1: share of the pixel that moves in the clip."""
    depth_sigma: Tensor | None = None
    """[H, W] standard deviation of `depth` in scene units; None: unknown, `depth` is that of the splats."""

    def cpu(self) -> FrozenImage:
        """The frame on the CPU, for writing files; tensors that are there already are not copied."""
        return replace(self, **{name: value.cpu() for name, value in vars(self).items() if value is not None})


@dataclass
class OutputFrame:
    """One frame to render."""

    frame: int
    """Frame number in the clip."""
    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] pixels of the output size, without overscan."""
    t_star: float
    """Frame number at which time stands still."""
    exposed_like: float
    """Frame number whose exposure is applied: `frame` on the clip's poses, t* on a new camera path."""


def span_of(scene: Scene, run: LoadedRun) -> float:
    """Seconds between the first and the last trained frame."""
    at = {frame: second for frame, second in zip(scene.frames, scene.seconds, strict=True)}
    return max(1e-6, float(at[run.train_frames[-1]] - at[run.train_frames[0]]))


@torch.no_grad()
def freeze_at(model: DynamicModel, time: float, seconds: float, query: str = "nearest") -> FrozenGaussians:
    """Freezes a model at a normalised time. The field is evaluated once; views then only need rasterisation.

    Args:
        time: t* in [0, 1].
        seconds: length of the trained range in seconds, for the decay of support.
        query: "nearest" evaluates a moving Gaussian at its supported time bin nearest to t*, so that every state shown
            is constrained by a frame. "plain" evaluates it at t* (the published method). ValueError otherwise.
    """
    if query not in ("nearest", "plain"):
        raise UserError(f"query is {query!r}: it should be nearest or plain")
    gaussians, rows = model.gaussians, model.open_rows()
    times = torch.full((len(rows),), float(time), device=model.device)
    if query == "nearest" and len(rows):
        bins, known = nearest_bin(gaussians.support[rows], model.centres, time)
        times = torch.where(known, model.centres[bins], times)
    state = model.moved(rows, model.deltas(rows, times))
    moving = torch.zeros(len(gaussians), device=model.device)
    moving[rows] = 1.0
    support = support_confidence(gaussians.support, moving > 0, model.centres, time, SUPPORT_SECONDS / seconds)
    return FrozenGaussians({k: v.detach() for k, v in state.items()}, model.sh_degree, support, moving)


@torch.no_grad()
def render_frozen(
    frozen: FrozenGaussians,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    exposure: Exposure | None = None,
    exposed_at: float = 0.0,
    overscan: tuple[float, float] = (0.0, 0.0),
) -> FrozenImage:
    """Renders one view of a frozen scene, on its device: viewmat [4, 4] in scene units, K [3, 3] in pixels.

    `exposure` at the normalised time `exposed_at` is applied, so that the frame matches the plate it is mixed with.
    Time is frozen for the scene, not for the camera's exposure. None: colours of the Gaussians. `overscan`: pixels
    (left and right, above and below) around the camera's frame; the frame itself looks the same with and without them.
    """
    mattes = torch.stack([frozen.support, frozen.motion], dim=1)
    out = render(
        frozen.state,
        frozen.sh_degree,
        viewmat.to(mattes.device),
        K.to(mattes.device),
        width,
        height,
        colors=mattes,
        with_depth=True,
        with_contributions=False,
        settings=RasterSettings(overscan=overscan),
    )
    if out.depth_median is None:
        raise RuntimeError("the rasteriser returned no depth")
    colors, alphas, depth = out.colors[0], out.alphas[0], out.depth_median[0]
    del out  # frees the mean depth, which is large at 4K
    parts = bands(height, width)
    if len(parts) == 1:
        color, alpha, support, motion = _separated(colors, alphas, exposure, exposed_at)
        return FrozenImage(color, alpha, depth, support, motion)
    image = FrozenImage(
        torch.empty(height, width, 3, device=depth.device), torch.empty_like(depth), depth,
        torch.empty_like(depth), torch.empty_like(depth),
    )  # fmt: skip
    for rows in parts:
        color, alpha, support, motion = _separated(colors[rows], alphas[rows], exposure, exposed_at)
        image.color[rows], image.alpha[rows] = color, alpha
        image.support[rows], image.motion[rows] = support, motion
    return image


def fade(frozen: FrozenGaussians, kept: Tensor) -> FrozenGaussians:
    """A frozen scene whose opacities are multiplied by `kept` [N]."""
    logits = frozen.state["opacity_logits"]
    kept = kept.to(logits)
    less = torch.logit((torch.sigmoid(logits) * kept).clamp(1e-6, 1.0 - 1e-6))
    state = {**frozen.state, "opacity_logits": torch.where(kept < 1.0, less, logits)}
    return replace(frozen, state=state)


def _separated(
    colors: Tensor, alphas: Tensor, exposure: Exposure | None, exposed_at: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(color [h, w, 3], alpha, support, motion [h, w]) from rasterised rows: colors [h, w, 5], alphas [h, w]."""
    alpha = alphas.clamp(0.0, 1.0)
    # Mattes are not premultiplied: divide by alpha, and set them to 0 where alpha is 0.
    covered = alpha.clamp_min(1e-4)
    mattes = torch.where(alpha[..., None] > 1e-3, colors[..., 3:] / covered[..., None], 0.0).clamp(0.0, 1.0)
    color = colors[..., :3]
    if exposure is not None:
        color = exposure.apply(color, exposed_at, alpha)
    return color.clamp_min(0.0), alpha, mattes[..., 0], mattes[..., 1]


@dataclass
class CandidateInstant:
    """A trained frame as a candidate for t*."""

    index: int
    """Index into the trained frames."""
    score: float
    """Score of the frame: higher is better. Only comparable within one ranking."""
    seen: float
    """Share of the moving Gaussians seen in this frame, weighted by travel, 0 to 1; 1 if nothing moves."""
    sharpness: float
    """Rank of the plate's sharpness among the trained frames, 0 (softest) to 1 (sharpest)."""


def best_instants(instants: list[CandidateInstant], count: int = 5, separation: float = 0.08) -> list[CandidateInstant]:
    """Up to `count` of a ranking, best first, at least the share `separation` of the trained frames from each other."""
    chosen: list[CandidateInstant] = []
    for instant in sorted(instants, key=lambda i: -i.score):
        if all(abs(instant.index - previous.index) >= separation * len(instants) for previous in chosen):
            chosen.append(instant)
    return chosen[:count]


@torch.no_grad()
def rank_instants(model: DynamicModel, times: np.ndarray, sharpness: np.ndarray) -> list[CandidateInstant]:
    """Scores every trained frame as a candidate for t*: good frames show most movers and have a sharp plate.

    Gaussians are weighted by their travel, so that people count more than a flickering lamp. Frames near an end of the
    clip get a slightly lower score.

    Args:
        times: [S] normalised times of the trained frames.
        sharpness: [S] sharpness of their plates, on any scale.
    """
    rows = model.open_rows()
    rank = np.argsort(np.argsort(sharpness)) / max(1, len(sharpness) - 1)
    if not len(rows) or model.field is None:
        return [CandidateInstant(n, float(r), 1.0, float(r)) for n, r in enumerate(rank)]
    instants = torch.linspace(0, 1, 12, device=model.device)
    moves = [model.deltas(rows, instants[n : n + 1]) for n in range(len(instants))]
    places = torch.stack([move.means for move in moves if move is not None])
    travel = norm(places - places.mean(0), 2).mean(0)
    support = model.gaussians.support[rows].float()
    seen = (travel[:, None] * support).sum(0) / travel.sum().clamp_min(1e-9)
    bins = [int((model.centres - float(t)).abs().argmin()) for t in times]
    share = seen.cpu().numpy()[bins]
    end = np.minimum(np.arange(len(times)), np.arange(len(times))[::-1])
    inner = np.minimum(end / max(1.0, _ENDS * len(times)), 1.0)
    scores = share / max(float(share.max()), 1e-6) + 0.5 * rank + 0.1 * inner
    figures = zip(scores.tolist(), share.tolist(), rank.tolist(), strict=True)
    return [CandidateInstant(n, score, saw, sharp) for n, (score, saw, sharp) in enumerate(figures)]
