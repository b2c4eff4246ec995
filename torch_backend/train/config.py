"""Training configuration: the presets and all parameters of a run."""

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
    """Parameters of one run. Learning rates assume a camera extent of 1 scene unit; shares are of the run's length.

    The Gaussians' learning rates are for a run of 3000 steps, tuned on the bundled clip (docs/decisions.md).
    `config_from_params` scales them by the square root of 3000 / `iterations`.
    """

    preset: str = "preview"
    """Name of the preset that the parameters come from."""
    iterations: int = 2000
    """Training steps; each step uses one image."""
    width: int = 320
    """Width in pixels of the training images. It is limited to the width of the working frames, or of the source if
    `plates` is set. 0: that limit."""
    holdout: int = 8
    """Interval, in solved frames, at which a frame is held out (first and last excluded); 0: no held-out frames."""
    holdout_phase: int = 0
    """Offset of the held-out frames within each interval. 0 for reported figures; tuning uses another offset, so that
    it does not see the frames that results are reported on."""
    method: str = "auto"
    """Which Gaussians move. auto: those selected by the gate. A host's name: all Gaussians. static: none."""
    host: str = "hexplane"
    """Name of the host, the deformation model that moves Gaussians (`deformation.registry`)."""
    host_config: str = "default"
    """Initial values of the host's configuration `field`: default (ours) or reference (published)."""
    seed: int = 0
    """Seed of the random number generator."""
    dssim: float = 0.2
    """Weight of D-SSIM in the photometric loss; L1 has the rest (3DGS: 0.2)."""
    sh_degree: int = 2
    """Highest SH degree."""
    sh_every: float = 0.15
    """Share of the run after which the SH degree rises by one."""
    lr_means: float = 1.6e-3
    """Initial learning rate of means. 3DGS uses 1.6e-4 over 30,000 steps; shorter runs need larger steps."""
    lr_means_end: float = 8e-5
    """Final learning rate of means."""
    lr_means_reach: float = 5.0
    """Distance from the cameras' centre, in scene units, at which a mean is trained with exactly these rates. The rate
    is proportional to a mean's distance (at least 1 unit), so that near and far means move by equally many pixels.
    0: one rate for all means, as in 3DGS."""
    lr_scales: float = 2.8e-2
    """Learning rate of log-scales (3DGS: 5e-3)."""
    lr_quats: float = 5.6e-3
    """Learning rate of quaternions (3DGS: 1e-3)."""
    lr_opacities: float = 6e-2
    """Learning rate of opacity logits (3DGS: 5e-2)."""
    lr_sh0: float = 1e-2
    """Learning rate of the constant colour (3DGS: 2.5e-3)."""
    lr_sh_rest: float = 5e-3
    """Learning rate of the higher SH coefficients (3DGS: 2.5e-3 / 20)."""
    lr_end: float = 0.2
    """Final value of each learning rate, except that of means, as a share of its initial value."""
    soft_movers: float = 0.2
    """Share of the run, starting when the gate opens, in which pixels that the motion mattes mark as moving are
    trained on low-resolution images (`softened.py`). 0: never, as published."""
    soft_block: float = 8.0
    """Side of a pixel of those low-resolution images, in pixels of an image 640 wide."""
    average: float = 0.1
    """Share of the run, at its end, over which the parameters are averaged (`average.py`); 0: no averaging."""
    opacity_weight: float = 2e-3
    """Weight of the mean opacity in the loss, which fades Gaussians that no image needs (3DGS-MCMC: 1e-2)."""
    scale_weight: float = 2e-3
    """Weight in the loss of the Gaussians' mean standard deviation in scene units (3DGS-MCMC: 1e-2)."""
    field_every: int = 4
    """Interval in steps at which the field's regularisers are evaluated. Their weight is multiplied by the interval."""
    evaluate_every: float = 0.1
    """Interval between two evaluations on held-out frames, as a share of the run."""
    checkpoint_seconds: float = 30.0
    """Seconds between two checkpoints."""
    init: InitConfig = dataclasses.field(default_factory=InitConfig)
    """Initialisation of the Gaussians."""
    densify: DensifyConfig = dataclasses.field(default_factory=DensifyConfig)
    """Densification of the Gaussians."""
    field: HostConfig = dataclasses.field(default_factory=HexPlaneConfig)
    """Configuration of the host; its class depends on `host`."""
    gate: GateConfig = dataclasses.field(default_factory=GateConfig)
    """Gate that selects the moving Gaussians."""
    supervision: SupervisionConfig = dataclasses.field(default_factory=SupervisionConfig)
    """Anchor supervision."""
    exposure: ExposureConfig = dataclasses.field(default_factory=ExposureConfig)
    """Correction of brightness and tint that drift along the clip."""
    needs: StoppingConfig = dataclasses.field(default_factory=StoppingConfig)
    """Criteria by which `auto` limits the SH degree, the Gaussians, the time nodes and the steps."""
    poses: PosesConfig = dataclasses.field(default_factory=PosesConfig)
    """Refinement of the solved cameras."""
    plates: bool = False
    """Whether training images may be larger than the working frames; they are then read from the source footage."""

    @property
    def decides(self) -> bool:
        """True if the run limits itself by `needs` and uses the motion mattes. False for published configurations and
        for methods in which all Gaussians move."""
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
"""Preset name -> function that returns a new configuration."""


def _for_card(config: TrainConfig) -> None:
    """Sets the values that the final preset uses on a GPU. Other presets are the same on CPU and GPU."""
    if config.preset == "final":
        config.width, config.plates, config.densify.budget = CARD_WIDTH, True, CARD_GAUSSIANS


def config_from_params(params: TrainParams, on_card: bool = False) -> TrainConfig:
    """Configuration of the preset that `params` names, for GPU or CPU, with the user's changes. UserError (a
    ValueError) names an option that does not exist."""
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
    _adapt_to_length(config)
    config.densify.budget = params.max_gaussians or config.densify.budget
    config.supervision.preset, config.supervision.detector = params.supervision, params.detector
    config.host = params.method if params.method in hosts() else params.host
    config.host_config = params.host_config
    if params.host_config == "reference":
        # The published code detaches the reference state, but not the canonical parameters that both states share.
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


# Length in steps of the run for which the learning rates in TrainConfig were tuned.
_RATES_FOR = 3000


def _adapt_to_length(config: TrainConfig) -> None:
    """Scales the Gaussians' learning rates and the densification interval to the length of the run."""
    scale = min(max(math.sqrt(_RATES_FOR / max(1, config.iterations)), 0.3), 1.5)
    for name in ("lr_means", "lr_means_end", "lr_scales", "lr_quats", "lr_sh0", "lr_sh_rest"):
        setattr(config, name, getattr(config, name) * scale)
    config.densify.every = min(100, max(50, round(config.iterations / 30)))


# Length of the static phase of a gated run, as a share of the run and as a maximum in steps. During a longer phase,
# moving objects are fitted by ghosts: Gaussians far behind the object that each match one view only. The field cannot
# correct them (docs/decisions.md, "Gate and field").
_STATIC, _MOST_STATIC = 0.2, 600
# Maximum number of steps between two raises of the SH degree. Long runs need no more. The smaller interval of a short
# run must not be shortened further, or no degree would gain enough to be kept.
_MOST_PER_DEGREE = 1350


def _gate_for(config: TrainConfig) -> None:
    """Opens the gate earlier than published. The trial keeps its length; anchors and motion price move with it."""
    if config.method != "auto" or config.host_config == "reference":
        return
    gate, anchors, steps = config.gate, config.supervision, max(1, config.iterations)
    sooner = gate.start - min(_STATIC, _MOST_STATIC / steps)
    config.sh_every = min(config.sh_every, _MOST_PER_DEGREE / steps)
    gate.start, gate.harden, anchors.start = gate.start - sooner, gate.harden - sooner, anchors.start - sooner


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """The configuration as JSON-able types, for config.json."""
    plain = dataclasses.asdict(config)
    if not config.plates:  # the run's key is computed from these: runs older than this field keep their key
        del plain["plates"]
    return plain


def _as_tuple(value: Any) -> Any:
    """Converts a JSON list to a tuple; other values are returned unchanged."""
    return tuple(cast(list[Any], value)) if isinstance(value, list) else value


def config_from_json(data: Mapping[str, Any]) -> TrainConfig:
    """Inverse of `config_to_json`. UserError (a ValueError) names an unknown field."""
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
