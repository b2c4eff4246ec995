"""Develop: a frozen instant is trained on as the static scene that it is, until it shows what plate t* shows.

The field has to explain a whole clip; a freeze needs one instant of it. So the frozen Gaussians, with what plate t*
shows and the field lost (`instant.py`), become parameters of their own: still pixels are learnt from all trained
frames, what moves from plate t*, and from frames around it as far as the field knows how it moved. They may grow in
number, so that the frozen scene is as sharp as the plates it is trained on, whatever the run was trained at.

Source: design/method; figures in docs/benchmarks.md, "Developed instants".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussians import Densifier, DensifyConfig, Gaussians
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

    steps: int = 500
    """Training steps, of one frame each."""
    width: int = 640
    """Pixels of the pictures that are trained on, at most; never above the working frames'."""
    grow: float = 1.5
    """How many Gaussians there may be in the end, over those there were; no more than `density` allows."""
    density: float = 0.25
    """Gaussians to a pixel of the pictures, at most, that growth goes to."""
    frames: int = 160
    """Frames that are trained on, at most: the nearest in time first thinned out where there are more."""
    instant_share: float = 0.15
    """Share of the steps that are taken on plate t* itself."""
    reach: float = 0.0
    """Seconds from t* at which what moves in other frames is learnt from with a probability of 1/e; 0: never."""
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
    betas: tuple[float, float] = (0.9, 0.99)
    """Of Adam."""
    rigid: tuple[str, ...] = ("means", "quats", "log_scales")
    """Parameters of what moves at t* that stay: one plate sees it, which says nothing of depth."""
    opacity_weight: float = 1e-3
    """Weight of the mean opacity."""
    seed: int = 0
    """Of the order of frames."""


class _Descendants(Gaussians):
    """Gaussians that remember from which of the scene before they descend."""

    def __init__(self, params: dict[str, Tensor]) -> None:
        super().__init__(params, 1)
        self.origin = torch.arange(len(self), device=self.open.device)

    def rebuild(self, parent: Tensor, fresh: Tensor, optimizer: torch.optim.Optimizer) -> None:
        super().rebuild(parent, fresh, optimizer)
        self.origin = self.origin[parent]


def develop(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: int,
    moving: MovingOf,
    config: DevelopConfig | None = None,
    check: Check | None = None,
) -> FrozenGaussians:
    """Trains a frozen scene on as the static scene that it is; returns what became of it.

    Args:
        frozen: the run's scene at t*, and behind its Gaussians those of an instant's layer, if it has one.
        t_star: frame number; one of the trained frames.
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
        self.frames = _thinned(run.train_frames, t_star, config.frames)
        self.seconds = {frame: float(scene.seconds[self.index[frame]]) for frame in self.frames}
        self.Ks = scene.camera_at(self.width, self.height).to(self.device)
        self.viewmats = scene.viewmats.to(self.device)
        self.moving, self.travel = moving, Travel(run, scene, frozen)
        self.generator = torch.Generator(device="cpu").manual_seed(config.seed)
        self.model = _Descendants({name: value.detach().clone() for name, value in frozen.state.items()})
        self.optimizer = self._optimizer()
        initial = len(self.model)
        room = max(initial, round(config.density * self.width * self.height))
        budget = min(room, round(config.grow * initial))
        growth = DensifyConfig(budget=budget, start=0.0, stop=0.5, every=max(1, config.steps // 12))
        self.densifier, self.initial = Densifier(growth, initial, self.device), initial
        self.grows = budget > initial
        self._pictures: dict[int, Tensor] = {}
        self._mattes: dict[int, Tensor] = {}
        self.mover = self._movers()

    def run(self, check: Check | None) -> FrozenGaussians:
        """All steps."""
        steps, order = self.config.steps, []
        for n in range(steps):
            if check is not None:
                check(n, steps)
            if self.grows and n and n % self.densifier.config.every == 0 and n / steps < self.densifier.config.stop:
                self.densifier.step(self.model, self.optimizer, self.initial, n / steps)
            for group in self.optimizer.param_groups:
                group["lr"] = group["first"] * 0.1 ** (n / steps) * min(1.0, (n + 1) / (self.config.warm * steps + 1))
            if float(torch.rand(1, generator=self.generator)) < self.config.instant_share:
                frame = self.t_star
            else:
                order = order or torch.randperm(len(self.frames), generator=self.generator).tolist()
                frame = self.frames[order.pop()]
            self._step(frame)
        state = {name: p.detach() for name, p in self.model.params.items()}
        origin, before = self.model.origin, self.frozen
        descent = Descent(before, origin)
        return FrozenGaussians(state, before.sh_degree, before.support[origin], before.motion[origin], descent)

    def _step(self, frame: int) -> None:
        i, time = self.index[frame], self.scene.time_of_frame(frame)
        state = self.travel.moved(dict(self.model.params), self.model.origin, frame)
        background = torch.rand(3, generator=self.generator, device="cpu").to(self.device)
        flags = self.mover[self.model.origin][:, None]
        out = render(
            state, self.frozen.sh_degree, self.viewmats[i], self.Ks[i], self.width, self.height,
            background=torch.cat([background, background.new_zeros(1)]), colors=flags, with_contributions=False,
        )  # fmt: skip
        exposure = self.trained.model.exposure
        shown = exposure.apply(out.colors[0, ..., :3], time)
        learnt = self._learnt(frame, out.colors[0, ..., 3].detach())
        target = torch.where(learnt[..., None], self._picture(frame), shown.detach())
        loss = photometric(shown, target, self.config.dssim)
        total = loss + self.config.opacity_weight * torch.sigmoid(self.model.params["opacity_logits"]).mean()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        if self.config.rigid:
            movers = torch.nonzero(self.mover[self.model.origin] > 0.5).flatten()
            for name in self.config.rigid:
                grad = self.model.params[name].grad
                if grad is not None:
                    grad[movers] = 0.0
        self.optimizer.step(guard=[total])
        self.densifier.observe(out.means2d_absgrad[0], out.radii[0])

    def _learnt(self, frame: int, mover: Tensor) -> Tensor:
        """bool [H, W]: which pixels of a frame say what the frozen scene should show there."""
        matte = self._matte(frame)
        if frame == self.t_star:
            return torch.ones_like(matte, dtype=torch.bool)
        reach = self.config.reach
        if reach > 0:
            away = abs(self.seconds[frame] - self.seconds[self.t_star])
            if float(torch.rand(1, generator=self.generator)) < math.exp(-away / reach):
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
            if found is None:
                found = torch.zeros(self.height, self.width, device="cpu")
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
        c, p = self.config, self.model.params
        rates = {
            "means": c.lr_means, "quats": c.lr_quats, "log_scales": c.lr_scales, "opacity_logits": c.lr_opacities,
            "sh0": c.lr_sh0, "shN": c.lr_sh_rest,
        }  # fmt: skip
        return FusedAdam(
            [{"params": [p[name]], "lr": rate, "first": rate, "rows": True} for name, rate in rates.items()],
            betas=c.betas, eps=1e-15
        )


def _thinned(frames: list[int], t_star: int, most: int) -> list[int]:
    """At most so many of ascending frames, evenly, t* among them."""
    if len(frames) <= most:
        return sorted({*frames, t_star})
    at = torch.linspace(0, len(frames) - 1, most, device="cpu").round().long().unique().tolist()
    return sorted({*(frames[n] for n in at), t_star})
