"""Develop: a frozen instant is trained on as the static scene that it is, until it shows what plate t* shows.

The field has to explain a whole clip; a freeze needs one instant of it. So the frozen Gaussians, with what plate t*
shows and the field lost (`instant.py`), become parameters of their own. Still pixels are learnt from all trained
frames, in each of which what moves stands where the field has it; what moves at t* is learnt from plate t* alone. The
pictures are larger than those of a preview run, so the frozen scene becomes sharper than the run.

Their number stays: growing was tried, and lost 0.3 dB on held-out frames (docs/benchmarks.md, "Developed instants").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..scene import Scene, read_image
from ..train import LoadedRun
from ..train.adam import FusedAdam
from ..train.losses import photometric
from ..train.model import render
from .query import Descent, FrozenGaussians
from .reproject import resized, widened
from .travel import Travel

MovingOf = Callable[[int], "Tensor | None"]
"""Frame number -> [h, w] in 0..1, what moves in its plate, or None where nobody has looked."""
Check = Callable[[int, int], None]
"""Called with (steps done, steps in all); raises to cancel."""


@dataclass(frozen=True)
class DevelopConfig:
    """How an instant is developed. Rates are those of a run's end (`TrainConfig`), in scene units."""

    steps: int = 300
    """Training steps, of one frame each."""
    width: int = 640
    """Pixels of the pictures that are trained on, at most; never above the working frames'."""
    frames: int = 160
    """Frames that are trained on, at most, evenly over the clip."""
    probes: int = 6
    """Trained frames that are left out, at most, to see whether developing helped."""
    harm: float = 0.02
    """Loss on the still pixels of those, in dB, from which on the instant stays as it was."""
    instant_share: float = 0.1
    """Share of the steps that are taken on plate t* itself, or on its neighbours where it was held out of training."""
    margin: int = 2
    """Pixels of pictures 640 wide around what moves that are left out with it."""
    dssim: float = 0.2
    """As in `TrainConfig`."""
    lr_means: float = 1e-4
    """Start rate of means; all rates fall to a tenth."""
    lr_quats: float = 2e-3
    """Of quaternions."""
    lr_scales: float = 8e-3
    """Of log-scales."""
    lr_opacities: float = 2e-2
    """Of opacity logits."""
    lr_sh0: float = 4e-3
    """Of the constant colour."""
    lr_sh_rest: float = 2e-4
    """Of the other harmonics."""
    warm: float = 0.15
    """Share of the steps over which the rates rise: Adam has no memory of the gradients at first."""
    opacity_weight: float = 1e-3
    """Weight of the mean opacity."""
    seed: int = 0
    """Of the order of frames."""


def develop(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: int,
    moving: MovingOf,
    config: DevelopConfig | None = None,
    check: Check | None = None,
) -> FrozenGaussians:
    """Trains a frozen scene on as the static scene that it is.

    Returns what became of it; or the scene as it was, if frames that were left out got worse where nothing moves, or
    plate t* did not gain: a run that is as sharp as the pictures already is better left alone.

    Args:
        frozen: the run's scene at t*, and behind its Gaussians those of an instant's layer, if it has one.
        t_star: frame number. If it is none of the run's trained frames its plate is not looked at: what moves is learnt
            from the nearest trained frame on either side, in which it stands where the field has it.
        moving: what moves in the clip's frames.
        check: reports progress, and cancels.
    """
    return _Darkroom(run, scene, frozen, t_star, moving, config or DevelopConfig()).run(check)


class _Darkroom:
    """One development."""

    def __init__(
        self, run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int, moving: MovingOf,
        config: DevelopConfig,
    ) -> None:  # fmt: skip
        self.trained, self.scene, self.frozen, self.config, self.t_star = run, scene, frozen, config, t_star
        self.device = frozen.support.device
        self.width = min(scene.width, config.width)
        self.height = max(16, round(scene.height * self.width / scene.width))
        self.index = {frame: i for i, frame in enumerate(scene.frames)}
        self.instants = _instants(run.train_frames, t_star)
        frames = [frame for frame in _spread(run.train_frames, config.frames) if frame not in self.instants]
        self.probes = _spread(frames[1:-1], min(config.probes, len(frames) // 4))
        self.frames = sorted({*frames, *self.instants} - {*self.probes})
        self.Ks = scene.camera_at(self.width, self.height).to(self.device)
        self.viewmats = scene.viewmats.to(self.device)
        self.moving, self.travel = moving, Travel(run, scene, frozen)
        self.generator = torch.Generator(device="cpu").manual_seed(config.seed)
        self.params = {name: torch.nn.Parameter(value.detach().clone()) for name, value in frozen.state.items()}
        self.origin = torch.arange(len(frozen.support), device=self.device)
        self.optimizer = self._optimizer()
        self._pictures: dict[int, Tensor] = {}
        self._mattes: dict[int, Tensor] = {}
        self.mover = self._movers()

    def run(self, check: Check | None) -> FrozenGaussians:
        """All steps, and the judgement."""
        steps, order, before = self.config.steps, [], self._judged()
        for n in range(steps):
            if check is not None:
                check(n, steps)
            for group in self.optimizer.param_groups:
                group["lr"] = group["first"] * 0.1 ** (n / steps) * min(1.0, (n + 1) / (self.config.warm * steps + 1))
            if float(torch.rand(1, generator=self.generator, device="cpu")) < self.config.instant_share:
                frame = self.instants[n % len(self.instants)]
            else:
                order = order or torch.randperm(len(self.frames), generator=self.generator, device="cpu").tolist()
                frame = self.frames[order.pop()]
            self._step(frame)
        after = self._judged()
        if after[0] < before[0] - self.config.harm or after[1] <= before[1]:
            state = dict(self.frozen.state)
        else:
            state = {name: p.detach() for name, p in self.params.items()}
        was = self.frozen
        return FrozenGaussians(state, was.sh_degree, was.support, was.motion, Descent(was, self.origin))

    @torch.no_grad()
    def _judged(self) -> tuple[float, float]:
        """(PSNR in dB of the still pixels of the probes, of plate t* or its neighbours)."""
        sums = torch.zeros(2, 2, dtype=torch.float64, device=self.device)
        for n, frames in enumerate((self.probes, self.instants)):
            for frame in frames:
                shown, learnt = self._shown(frame)
                error = (shown.clamp(0.0, 1.0) - self._picture(frame)).square().mean(-1)[learnt]
                sums[n] += torch.stack([error.double().sum(), torch.tensor(float(error.numel()), device=self.device)])
        errors = (sums[:, 0] / sums[:, 1].clamp_min(1.0)).clamp_min(1e-12)
        return tuple((-10.0 * errors.log10()).tolist())

    def _step(self, frame: int) -> None:
        shown, learnt = self._shown(frame, torch.rand(3, generator=self.generator, device="cpu").to(self.device))
        target = torch.where(learnt[..., None], self._picture(frame), shown.detach())
        loss = photometric(shown, target, self.config.dssim)
        total = loss + self.config.opacity_weight * torch.sigmoid(self.params["opacity_logits"]).mean()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.optimizer.step(guard=[total])

    def _shown(self, frame: int, background: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """A frame as the scene has it, [H, W, 3], and bool [H, W]: what it says of the frozen scene.

        What shows through a hole is another colour at every step, so no hole can pass for a grey wall.
        """
        i, time = self.index[frame], self.scene.time_of_frame(frame)
        background = torch.full((3,), 0.5, device=self.device) if background is None else background
        state = self.travel.moved(dict(self.params), self.origin, frame)
        out = render(
            state, self.frozen.sh_degree, self.viewmats[i], self.Ks[i], self.width, self.height,
            background=torch.cat([background, background.new_zeros(1)]), colors=self.mover[:, None],
            with_contributions=False,
        )  # fmt: skip
        shown = self.trained.model.exposure.apply(out.colors[0, ..., :3], time)
        return shown, self._learnt(frame, out.colors[0, ..., 3].detach())

    def _learnt(self, frame: int, mover: Tensor) -> Tensor:
        """bool [H, W]: which pixels of a frame say what the frozen scene should show there."""
        matte = self._matte(frame)
        if frame in self.instants:
            return torch.ones_like(matte, dtype=torch.bool)
        return (matte < 0.5) & (mover < 0.1)

    def _picture(self, frame: int) -> Tensor:
        if frame not in self._pictures:
            image = read_image(self.scene.image_path(self.index[frame]), self.width, self.height)
            self._pictures[frame] = (image * 255.0).round().byte()
        return self._pictures[frame].to(self.device).float() / 255.0

    def _matte(self, frame: int) -> Tensor:
        if frame not in self._mattes:
            found = self.moving(frame)
            found = torch.zeros(self.height, self.width, device="cpu") if found is None else found
            found = resized(found.float(), self.width, self.height)
            self._mattes[frame] = widened(found, round(self.config.margin * self.width / 640)).half()
        return self._mattes[frame].to(self.device).float()

    @torch.no_grad()
    def _movers(self) -> Tensor:
        """[N] in 0..1: of what camera t* sees of each Gaussian, the share that lies in what moves there."""
        known = len(self.trained.model.gaussians)
        flags = torch.zeros(len(self.frozen.support), device=self.device)
        flags[known:] = 1.0
        i = self.index[self.t_star]
        matte = self._matte(self.t_star)
        with torch.enable_grad():
            # The weight of a Gaussian at a pixel is what the pixel gains by its colour: a gradient gathers it.
            probe = torch.zeros(len(flags), 2, device=self.device, requires_grad=True)
            out = render(
                self.frozen.state, 0, self.viewmats[i], self.Ks[i], self.width, self.height, colors=probe,
                with_contributions=False,
            )  # fmt: skip
            gained = out.colors[0, ..., 3:]
            ((gained[..., 0] * matte).sum() + gained[..., 1].sum()).backward()
        assert probe.grad is not None
        inside, whole = probe.grad.unbind(1)
        share = torch.where(whole > 0.05, inside / whole.clamp_min(1e-6), 0.0)
        return torch.maximum(flags, (share > 0.5).float())

    def _optimizer(self) -> FusedAdam:
        c, p = self.config, self.params
        rates = {
            "means": c.lr_means, "quats": c.lr_quats, "log_scales": c.lr_scales, "opacity_logits": c.lr_opacities,
            "sh0": c.lr_sh0, "shN": c.lr_sh_rest,
        }  # fmt: skip
        groups = [{"params": [p[name]], "lr": rate, "first": rate, "rows": True} for name, rate in rates.items()]
        return FusedAdam(groups, eps=1e-15)


def _instants(trained: list[int], t_star: int) -> list[int]:
    """The trained frames that show an instant: its own, else the nearest on either side of it."""
    if t_star in trained:
        return [t_star]
    before, after = [f for f in trained if f < t_star], [f for f in trained if f > t_star]
    return [*before[-1:], *after[:1]]


def _spread(frames: list[int], most: int) -> list[int]:
    """At most so many of ascending frames, evenly."""
    if len(frames) <= most:
        return list(frames)
    step = len(frames) / max(1, most)
    return [frames[int((n + 0.5) * step)] for n in range(most)]
