"""Presets and every number of a run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from ..contract import CARD_GAUSSIANS, CARD_WIDTH, DETECTORS, METHODS, SUPERVISIONS, TrainParams, UserError
from ..deformation import GateConfig, HexPlaneConfig, HostConfig, host, host_config, hosts
from ..gaussians import DensifyConfig, InitConfig
from ..supervision import SupervisionConfig
from .exposure import ExposureConfig
from .poses import PosesConfig
from .stopping import StoppingConfig


@dataclass
class TrainConfig:
    """One run. Learning rates are per scene unit of camera extent 1; shares are of the run's length.

    The Gaussians' rates are those of 3000 steps, tuned on the bundled clip (docs/decisions.md); `config_from_params`
    scales them to the run's length by the root of the ratio.
    """

    preset: str = "preview"
    """Preset these numbers come from."""
    iterations: int = 2000
    """Training steps of one image each."""
    width: int = 320
    """Width in pixels of the training images, never above the working frames', or the source's with `plates`; 0:
    theirs."""
    holdout: int = 8
    """Every how many solved frames one is held out, never the first or last; 0: none."""
    holdout_phase: int = 0
    """Which of every `holdout` frames: 0 is what is reported; tuning uses another, so as not to tune on the judge."""
    method: str = "auto"
    """auto: the host behind the gate. A host's name: all Gaussians move. static: no deformation."""
    host: str = "hexplane"
    """Which host moves them (`deformation.registry`)."""
    host_config: str = "default"
    """What the host's numbers in `field` started as: default (ours) or reference (published)."""
    seed: int = 0
    """Seed of every random draw."""
    dssim: float = 0.2
    """Share of D-SSIM in the photometric loss (3DGS: 0.2)."""
    sh_degree: int = 2
    """Highest SH degree."""
    sh_every: float = 0.15
    """The SH degree rises by one every this share of the run."""
    lr_means: float = 1.6e-3
    """Start learning rate of means (3DGS 1.6e-4 over 30,000 steps; shorter runs need longer ones)."""
    lr_means_end: float = 8e-5
    """End learning rate of means."""
    lr_means_reach: float = 5.0
    """Distance from the cameras' centre, in scene units, at which a mean has these rates. Others have them in
    proportion to theirs, of one unit at least, so that near and far ones move by as many pixels; 0: all have the same,
    as in 3DGS."""
    lr_scales: float = 2.8e-2
    """Learning rate of log-scales (3DGS: 5e-3)."""
    lr_quats: float = 5.6e-3
    """Learning rate of quaternions (3DGS: 1e-3)."""
    lr_opacities: float = 6e-2
    """Learning rate of opacity logits (3DGS: 5e-2)."""
    lr_sh0: float = 1e-2
    """Learning rate of the constant colour (3DGS: 2.5e-3)."""
    lr_sh_rest: float = 5e-3
    """Learning rate of the other harmonics (3DGS: 2.5e-3 / 20)."""
    lr_end: float = 0.2
    """Share of its start that each of these rates, but that of means, has at the end."""
    soft_movers: float = 0.2
    """Share of the run, from the opening of the gate on, in which what the motion mattes call moving is learnt from
    softened pictures (`softened.py`); 0: none, as published."""
    soft_block: float = 8.0
    """Side of a pixel of these, in pixels of pictures 640 wide."""
    average: float = 0.1
    """Share of the run, its end, whose steps' mean the run keeps (`average.py`); 0: the last step."""
    opacity_weight: float = 2e-3
    """Weight of the mean opacity: keeps what no image needs from staying (3DGS-MCMC: 1e-2)."""
    scale_weight: float = 2e-3
    """Weight of the mean standard deviation in scene units (3DGS-MCMC: 1e-2)."""
    field_every: int = 4
    """Interval in steps at which the field's regularisers are evaluated; their weight is multiplied by it."""
    evaluate_every: float = 0.1
    """Share of the run between two measurements on held-out frames."""
    checkpoint_seconds: float = 30.0
    """Seconds between two checkpoints."""
    init: InitConfig = dataclasses.field(default_factory=InitConfig)
    """Start of the Gaussians."""
    densify: DensifyConfig = dataclasses.field(default_factory=DensifyConfig)
    """Growth of the Gaussians."""
    field: HostConfig = dataclasses.field(default_factory=HexPlaneConfig)
    """The host's numbers, of its own class."""
    gate: GateConfig = dataclasses.field(default_factory=GateConfig)
    """Which Gaussians move."""
    supervision: SupervisionConfig = dataclasses.field(default_factory=SupervisionConfig)
    """Anchoring."""
    exposure: ExposureConfig = dataclasses.field(default_factory=ExposureConfig)
    """Brightness and tint that drift along the clip."""
    needs: StoppingConfig = dataclasses.field(default_factory=StoppingConfig)
    """When `auto` has enough: SH degree, Gaussians, time nodes, steps."""
    poses: PosesConfig = dataclasses.field(default_factory=PosesConfig)
    """Small corrections of the solve's cameras."""
    plates: bool = False
    """Images wider than the working frames are made of the source's own; else they stay at the working frames'."""

    @property
    def decides(self) -> bool:
        """Does the run decide what it needs and heed the motion mattes? Published configurations, and hosts that move
        everything, are left as they are."""
        return self.method in ("auto", "static") and self.host_config == "default"


def _preview() -> TrainConfig:
    return TrainConfig()


def _standard() -> TrainConfig:
    return TrainConfig(
        preset="standard",
        iterations=9000,
        width=960,
        holdout=0,
        sh_degree=3,
        init=InitConfig(seeds=15_000, frames=24, sh_degree=3),
        densify=DensifyConfig(budget=160_000),
    )


def _final() -> TrainConfig:
    return TrainConfig(
        preset="final",
        iterations=30_000,
        width=0,
        holdout=0,
        sh_degree=3,
        init=InitConfig(seeds=30_000, frames=32, sh_degree=3),
        densify=DensifyConfig(budget=400_000),
    )


PRESETS = {"preview": _preview, "standard": _standard, "final": _final}
"""Name -> a fresh configuration."""


def _for_card(config: TrainConfig) -> None:
    """What a preset has on a card; the others have the same there."""
    if config.preset == "final":
        config.width, config.plates, config.densify.budget = CARD_WIDTH, True, CARD_GAUSSIANS


def config_from_params(params: TrainParams, on_card: bool = False) -> TrainConfig:
    """The preset, that of a card or of the processor, with the artist's changes. ValueError names a choice that does
    not exist."""
    for name, value, allowed in (
        ("preset", params.preset, tuple(PRESETS)),
        ("method", params.method, METHODS),
        ("supervision", params.supervision, SUPERVISIONS),
        ("detector", params.detector, DETECTORS),
    ):
        if value not in allowed:
            raise UserError(f"{name} is {value!r}: it should be one of {', '.join(allowed)}")
    config = PRESETS[params.preset]()
    if on_card:
        _for_card(config)
    config.method, config.seed = params.method, params.seed
    config.iterations = params.iterations or config.iterations
    config.width = params.width or config.width
    _rates_for(config)
    config.densify.budget = params.max_gaussians or config.densify.budget
    config.supervision.preset, config.supervision.detector = params.supervision, params.detector
    config.host = params.method if params.method in hosts() else params.host
    config.host_config = params.host_config
    if params.host_config == "reference":
        config.supervision.pulls = "all"
    _gate_for(config)
    if config.method != "auto" or not config.decides:
        config.soft_movers = 0.0
    config.field = host_config(config.host, config.host_config, config.iterations)
    if params.holdout >= 0:
        config.holdout = params.holdout
    if config.iterations < 10:
        raise UserError(f"iterations is {config.iterations}: a run needs at least 10")
    return config


_RATES_FOR = 3000
"""Steps of the run that the rates in TrainConfig are for."""


def _rates_for(config: TrainConfig) -> None:
    """Scales the Gaussians' rates, and how often they multiply, to the length of the run."""
    scale = min(max(math.sqrt(_RATES_FOR / max(1, config.iterations)), 0.3), 1.5)
    for name in ("lr_means", "lr_means_end", "lr_scales", "lr_quats", "lr_sh0", "lr_sh_rest"):
        setattr(config, name, getattr(config, name) * scale)
    config.densify.every = min(100, max(50, round(config.iterations / 30)))


_STATIC, _MOST_STATIC = 0.2, 600
"""Share of a run with a gate that stays static, and its most steps. In more of them Gaussians paint what moves as
ghosts that fit one view each, far behind it, and no field puts them right (docs/decisions.md, "Gate and field")."""
_MOST_PER_DEGREE = 1350
"""Most steps between two raises of the SH degree. A long run needs no more; in a short one each degree has fewer, and
needs them, or none seems worth its while."""


def _gate_for(config: TrainConfig) -> None:
    """Opens the gate sooner than published; the trial is as long as it was, anchors and price begin with it."""
    if config.method != "auto" or config.host_config == "reference":
        return
    gate, anchors, steps = config.gate, config.supervision, max(1, config.iterations)
    sooner = gate.start - min(_STATIC, _MOST_STATIC / steps)
    config.sh_every = min(config.sh_every, _MOST_PER_DEGREE / steps)
    gate.start, gate.harden, anchors.start = gate.start - sooner, gate.harden - sooner, anchors.start - sooner


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """Plain types for config.json."""
    plain = dataclasses.asdict(config)
    if not config.plates:  # part of the run's key: runs that are older than this choice keep their key
        del plain["plates"]
    return plain


def _as_tuple(value: Any) -> Any:
    """A tuple of what JSON keeps as a list."""
    return tuple(cast(list[Any], value)) if isinstance(value, list) else value


def config_from_json(data: Mapping[str, Any]) -> TrainConfig:
    """Inverse of `config_to_json`; ValueError names an unknown field."""
    nested = {
        "init": InitConfig, "densify": DensifyConfig, "gate": GateConfig,
        "supervision": SupervisionConfig, "exposure": ExposureConfig, "needs": StoppingConfig,
        "poses": PosesConfig,
    }  # fmt: skip
    values: dict[str, Any] = dict(data)
    try:
        nested["field"] = host(values["host"]).settings
        for name, cls in nested.items():
            inner: dict[str, Any] = {k: _as_tuple(v) for k, v in values[name].items()}
            values[name] = cls(**inner)
        return TrainConfig(**values)
    except (TypeError, KeyError, AttributeError) as error:
        raise UserError(f"the run's config.json does not fit this version: {error}") from error
