"""Develop: fine-tunes a frozen instant as a static scene, so that it matches plate t*.

The deformation field has to explain a whole clip; a freeze needs one instant of it. The frozen Gaussians therefore
become free parameters. Still pixels are learnt from all trained frames, with movers placed by the run's scene flow.
Movers at t* are learnt from plate t* alone. Plate t* does not train Gaussians that it sees from much farther away than
other frames do. The training pictures are larger than those of a preview run, so the frozen scene becomes sharper than
the run.

If still pixels gain nothing, they are left unchanged. Movers are then trained alone, and blended between their states
before and after training.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...scene import Scene
from ...torch_types import backward, integers
from ...train import LoadedRun
from ...train.adam import FusedAdam
from ...train.average import ParameterMean
from ...train.config import TrainConfig
from ...train.losses import photometric
from ...train.model import render
from ..frozen import FrozenGaussians
from ..views.scene_flow import SceneFlow
from ..views.source_views import LENGTHS_OF, MovingOf
from ..views.working_plates import WorkingPlates, showing, spread
from .undersampled import UNDERSAMPLED_RATIO, undersampled

_TRAINING = TrainConfig()
"""Loss, weights and learning rates of a training of 3000 steps, from which those of an instant are derived."""
_NEIGHBOURS = 2
"""Number of trained frames on either side of t* that judge movers trained alone."""
_PARTS = (0.0, 0.5, 1.0)
"""Blend factors between movers before and after fine-tuning; the best of them is kept."""
Check = Callable[[int, int], None]
"""Called with (steps done, steps in total); raises to cancel."""


@dataclass(frozen=True)
class DevelopConfig:
    """Parameters to develop an instant. Loss, weights and learning rates are those of a training: see `_TRAINING`."""

    steps: int = 120
    """Number of training steps, of one frame each. Between 75 and 300 steps, the delivered frames differ by at most
    0.06 dB on three clips."""
    width: int = LENGTHS_OF
    """Largest width in pixels of the training pictures; at most that of the working frames."""
    probes: int = 6
    """Largest number of trained frames that are left out, to measure whether developing helps."""
    gain: float = 0.2
    """Gain in dB that the still pixels of the frames left out must reach. Below it, movers are trained alone, on plate
    t*. With a smaller gain at the run's own width, instants lost half a dB against frozen ground truth. Frames of the
    clip did not show this loss, because movers are elsewhere in them."""
    worth: float = 3.0
    """Movers trained alone are kept if the gain of plate t* exceeds this factor times the loss of the neighbouring
    trained frames, in mean squared error."""
    instant_share: float = 0.25
    """Share of the steps on plate t* itself, or on its neighbours if it was held out of training. It gives 30 steps to
    plate t*, which alone shows the movers at t*."""
    afar: float = UNDERSAMPLED_RATIO
    """Ratio of distances above which plate t* does not train a Gaussian, as in `undersampled`."""
    seed: int = 0
    """Seed of the order of frames."""


def develop(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: int,
    moving: MovingOf,
    config: DevelopConfig | None = None,
    check: Check | None = None,
) -> FrozenGaussians:
    """Fine-tunes a frozen scene as a static scene.

    Returns the fine-tuned scene. If the frames left out gain less than `DevelopConfig.gain` on still pixels, or plate
    t* loses, only movers are changed, as far as the trained frames near t* allow.

    Args:
        frozen: the run's scene at t*, followed by the Gaussians of missing movers (`missing.py`).
        t_star: frame number. If it was not trained on, its plate is not used. Movers are then learnt from the nearest
            trained frame on either side, where scene flow places them.
        moving: motion mattes of the clip's frames.
        check: callback that reports progress and raises to cancel.
    """
    return _FineTuning(run, scene, frozen, t_star, moving, config or DevelopConfig()).run(check)


class _FineTuning:
    """State of one fine-tuning."""

    def __init__(
        self, run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int, moving: MovingOf,
        config: DevelopConfig,
    ) -> None:  # fmt: skip
        self.trained, self.scene, self.frozen, self.config, self.t_star = run, scene, frozen, config, t_star
        self.device = frozen.support.device
        self.plates = WorkingPlates(scene, config.width, moving, device=self.device)
        self.instants = showing(run.train_frames, t_star)
        frames = [frame for frame in run.train_frames if frame not in self.instants]
        self.probes = spread(frames[1:-1], min(config.probes, len(frames) // 4))
        self.frames = sorted({*frames, *self.instants} - {*self.probes})
        self.travel = SceneFlow(run, scene, frozen, t_star)
        self.generator = torch.Generator(device="cpu").manual_seed(config.seed)
        # No growth: densification lost 0.3 dB on held-out frames (docs/decisions.md, "Developing an instant").
        self.params = {name: torch.nn.Parameter(value.detach().clone()) for name, value in frozen.state.items()}
        self.optimizer = self._optimizer()
        self.mover = (self.plates.moving_share(frozen, t_star) > 0.5).float()
        known = len(run.model.gaussians)
        self.undersampled = torch.zeros_like(self.mover)
        self.undersampled[:known] = undersampled(run, scene, frozen.state["means"][:known], t_star, config.afar).float()
        # An undersampled Gaussian that moves in other frames is not trained, because they show it at other times.
        moves = torch.stack([self.plates.moving_share(frozen, frame) for frame in self.probes or self.instants])
        opened = torch.zeros_like(self.mover).index_fill(0, run.model.open_rows(), 1.0)
        # Added movers (`missing.py`) are trained, too.
        opened[known:] = 1.0
        self.fixed_rows = ((self.undersampled > 0.5) & (moves.amax(0) > 0.5)).nonzero()[:, 0]
        self.mover_rows = (self.mover * opened > 0.5).nonzero()[:, 0]
        """Rows of movers that lie on moving pixels of plate t*."""

    def run(self, check: Check | None) -> FrozenGaussians:
        """Runs all steps, and keeps the changes that improve the judged frames."""
        steps, before = self.config.steps, self._judged()

        def checked(done: int) -> None:
            if check is not None:
                check(done, steps)

        self._train(steps, self.config.instant_share, checked)
        after = self._judged()
        state = {name: p.detach() for name, p in self.params.items()}
        # A run as sharp as its pictures gains nothing on still pixels. Its movers may still be blurred.
        if after[0] < before[0] + self.config.gain or after[1] < before[1]:
            state = self._movers_only(lambda _: checked(steps))
        was = self.frozen
        return FrozenGaussians(state, was.sh_degree, was.support, was.motion, was)

    def _train(self, steps: int, instant_share: float, check: Callable[[int], None]) -> None:
        """Runs `steps` steps, a share of them on plate t*; `check` is called with the number of finished steps."""
        order: list[int] = []
        mean = ParameterMean()
        for n in range(steps):
            check(n)
            for group in self.optimizer.param_groups:
                # The second half of a training's schedule; `first` is the rate at its middle.
                group["lr"] = group["first"] * _TRAINING.lr_end ** (0.5 * n / steps)
            if float(torch.rand(1, generator=self.generator, device="cpu")) < instant_share:
                frame = self.instants[n % len(self.instants)]
            else:
                order = order or integers(torch.randperm(len(self.frames), generator=self.generator, device="cpu"))
                frame = self.frames[order.pop()]
            self._step(frame)
            if n >= steps // 2:
                # One frame a step makes parameters oscillate; their mean is nearer to the optimum of all frames
                # (`average.py`).
                mean.add(self.params)
        mean.copy_into(self.params)

    def _movers_only(self, check: Callable[[int], None]) -> dict[str, Tensor]:
        """The state before training, except for movers, which are trained on plate t* alone.

        Movers get the blend of `_PARTS` that gains most on plate t*, minus `worth` times the loss of frames near t*.
        """
        was, rows, neighbours = self.frozen.state, self.mover_rows, self._neighbours()
        kept = dict(was)
        if not len(rows) or not neighbours:
            return kept
        self._show(was)
        self.optimizer = self._optimizer()
        self.fixed_rows = (
            torch.ones_like(self.mover).index_fill(0, rows, 0.0).index_fill(0, self.fixed_rows, 1.0).nonzero()[:, 0]
        )
        steps = max(1, round(self.config.instant_share * self.config.steps))
        self._train(steps, 1.0, check)
        developed = {name: p.detach()[rows] for name, p in self.params.items()}
        best, first = 0.0, (0.0, 0.0)
        for n, part in enumerate(_PARTS):
            state = {k: v.index_copy(0, rows, torch.lerp(v[rows], developed[k], part)) for k, v in was.items()}
            self._show(state)
            errors = self._error(self.instants, movers=True), self._error(neighbours, movers=True)
            first = first if n else errors
            # Errors of one plate are misplaced in its neighbours, so their loss counts three times.
            benefit = first[0] - errors[0] - self.config.worth * max(0.0, errors[1] - first[1])
            if benefit > best:
                best, kept = benefit, state
        return kept

    def _show(self, state: dict[str, Tensor]) -> None:
        for name, value in state.items():
            self.params[name].data = value.clone()

    def _neighbours(self) -> list[int]:
        """The trained frames nearest to t* on either side, without those that show t* itself."""
        before = [frame for frame in self.trained.train_frames if frame < min(self.instants)]
        after = [frame for frame in self.trained.train_frames if frame > max(self.instants)]
        return [*before[-_NEIGHBOURS:], *after[:_NEIGHBOURS]]

    def _judged(self) -> tuple[float, float]:
        """(PSNR in dB of the still pixels of the probes, PSNR in dB of plate t* or its neighbours)."""
        still, instants = (-10.0 * math.log10(max(self._error(of), 1e-12)) for of in (self.probes, self.instants))
        return still, instants

    @torch.no_grad()
    def _error(self, frames: list[int], movers: bool = False) -> float:
        """Mean squared error of frames, display-referred, over the pixels of `_learnt` or, with `movers`, over moving
        pixels. 0 without such pixels."""
        sums = torch.zeros(2, dtype=torch.float64, device=self.device)
        for frame in frames:
            rendered, pixels = self._render(frame)
            if movers:
                ignored, pixels = self.plates.ignored(frame), self.plates.matte(frame) > 0.5
                pixels = pixels if ignored is None else pixels & ~ignored
            error = (rendered.clamp(0.0, 1.0) - self.plates.picture(frame)).square().mean(-1)[pixels]
            sums += torch.stack([error.double().sum(), torch.tensor(float(error.numel()), device=self.device)])
        return float(sums[0] / sums[1].clamp_min(1.0))

    def _step(self, frame: int) -> None:
        # Another background at every step, so that a hole cannot pass for a grey wall.
        rendered, learnt = self._render(frame, torch.rand(3, generator=self.generator, device="cpu").to(self.device))
        target = torch.where(learnt[..., None], self.plates.picture(frame), rendered.detach())
        loss = photometric(rendered, target, _TRAINING.dssim)
        # Gaussians that plate t* does not train get no opacity penalty, which would only fade them.
        shares = torch.sigmoid(self.params["opacity_logits"]) * (1.0 - self.undersampled)
        total = loss + _TRAINING.opacity_weight * shares.mean()
        self.optimizer.zero_grad(set_to_none=True)
        backward(total)
        for parameter in self.params.values():
            if parameter.grad is not None:
                parameter.grad[self.fixed_rows] = 0.0
        self.optimizer.step(guard=[total])

    def _render(self, frame: int, background: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(render [H, W, 3] of the scene moved to a frame, pixels [H, W] bool as from `_learnt`)."""
        background = torch.full((3,), 0.5, device=self.device) if background is None else background
        marks = torch.stack([self.mover, self.undersampled], dim=1)
        state = self.travel.moved(dict(self.params), frame)
        out = render(
            state, self.frozen.sh_degree, *self.plates.camera(frame),
            background=torch.cat([background, background.new_zeros(2)]), colors=marks,
            with_contributions=False,
        )  # fmt: skip
        rendered = self.trained.model.exposure.apply(out.colors[0, ..., :3], self.scene.time_of_frame(frame))
        return rendered, self._learnt(frame, *out.colors[0, ..., 3:].detach().unbind(-1))

    def _learnt(self, frame: int, mover: Tensor, undersampled: Tensor) -> Tensor:
        """bool [H, W]: pixels of a frame that are valid training data for the frozen scene."""
        matte, ignored = self.plates.matte(frame), self.plates.ignored(frame)
        learnt = (matte < 0.5) & (mover < 0.5)
        if frame in self.instants:
            # A face that is six pixels wide matches plate t* with its eyes in any position.
            learnt = learnt | (undersampled < 0.5)
        return learnt if ignored is None else learnt & ~ignored

    def _optimizer(self) -> FusedAdam:
        """Optimiser with the learning rates of mid-training."""
        c, p = _TRAINING, self.params
        rates = {
            "quats": c.lr_quats, "log_scales": c.lr_scales, "opacity_logits": c.lr_opacities, "sh0": c.lr_sh0,
            "shN": c.lr_sh_rest,
        }  # fmt: skip
        # Means are nearly converged: they use the final rate. Rates by distance gained nothing (docs/decisions.md).
        rates = {"means": c.lr_means_end, **{name: rate * math.sqrt(c.lr_end) for name, rate in rates.items()}}
        groups = [{"params": [p[name]], "lr": rate, "first": rate, "rows": True} for name, rate in rates.items()]
        return FusedAdam(groups, eps=1e-15)
