"""Host A: a HexPlane field and five heads (4DGaussians; figures and differences in docs/architecture.md).

Changes to the published code: Time is mapped to the whole plane. The heads' last layers start at zero. Learning rates
do not depend on the scene's extent, because the scene is normalised. Smoothness acts along both axes of a spatial
plane. The activation is SiLU. Sampling coordinates are detached. Axes are stretched around the Gaussians. `published`
reverts all of these changes.

The trainer implements the following for every host, which differs from the published code: one image per step (2 to 4),
the loss, learning rates and densification of the Gaussians, and one optimiser for both stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..torch_types import unflatten
from . import network, planes_cuda
from . import planes as compiled
from .protocol import Deformation, Deltas, HostConfig, HostSpec, Start, rate_scale

_SPATIAL = ((0, 1), (0, 2), (1, 2))
PUBLISHED_ITERATIONS = 33_000
# Scene extent (1.1 camera extents) by which the published code multiplies its rates. Our camera extent is 1.
_EXTENT = 1.1
_WIDTHS = {"means": 3, "quats": 4, "log_scales": 3, "opacity_logits": 1, "sh0": 3}


@dataclass
class HexPlaneConfig(HostConfig):
    """Sizes, learning rates and regularisers. 4DGaussians' values are in brackets (arguments/__init__.py)."""

    features: int = 16
    """Number of channels per plane (dynerf: 16)."""
    resolution: int = 32
    """Number of nodes per spatial axis of the coarsest level (64)."""
    levels: tuple[int, ...] = (1, 2)
    """Multiplier of the spatial resolution for each level (dynerf: 1, 2)."""
    time_nodes: int = 0
    """Number of nodes on the time axis (150); 0: chosen by the run, or about half the number of training frames."""
    width: int = 64
    """Width of the trunk and the heads (64)."""
    lr_grid: float = 3e-2
    """Initial learning rate of the planes (1.6e-3 times the scene's extent)."""
    lr_heads: float = 1e-3
    """Initial learning rate of trunk and heads (1.6e-4 times the scene's extent)."""
    lr_end: float = 0.1
    """Final learning rates as a share of the initial ones (0.1)."""
    smooth_space: float = 2e-3
    """Weight of the squared second difference along both axes of the spatial planes (2e-4)."""
    smooth_time: float = 2e-3
    """Weight of the squared second difference along time on the time planes (1e-3)."""
    time_l1: float = 0.0
    """Weight of mean |1 - plane| on the time planes (1e-4). With heads that start at zero, it would dominate the first
    steps: the planes become 1 and the field stays static."""
    space_range: tuple[float, float] = (0.5, 1.5)
    """Range of the spatial planes' initial values (0.1 to 0.5, for which products of three planes are very small)."""
    time_spread: float = 0.1
    """Largest deviation of the time planes' initial values from 1 (0)."""
    until: float = 1.0
    """Share of the run at which the learning rates reach their final values."""
    stretch: float = 2.0
    """Half-width of the region with almost evenly spaced nodes around the median of the Gaussians, in units of their
    median distance from it. Outside, nodes become sparser (asinh). 0: even spacing everywhere, as published."""
    silu: bool = True
    """Whether the activation is SiLU (off: ReLU)."""
    published: bool = False
    """Whether to use the published variant (on): times in [0, 1] for a sampler of [-1, 1], heads that start as noise,
    smoothness along H only (never along x), the bounds of the solve's points, axes that are not stretched, deltas of
    all SH coefficients, and gradients to the means through sampling."""

    def row_bytes(self) -> int:
        """See `HostConfig.row_bytes`: features and gradients (all samples and products for torch operators), layers of
        trunk and heads before and after the activation, and gradients of three layers."""
        kept = 12 if planes_cuda.refused else 2
        return 4 * (kept * self.features * len(self.levels) + self.width * (2 * (1 + len(_WIDTHS)) + 3))


def _reference(iterations: int) -> HexPlaneConfig:
    """Published host in the size of its Splannequin configuration: 3000 static steps, then 30,000 with the field."""
    scale, total_steps = _EXTENT * rate_scale(PUBLISHED_ITERATIONS, iterations), float(PUBLISHED_ITERATIONS)
    return HexPlaneConfig(
        start=3000 / total_steps,
        time_nodes=150,
        width=128,
        lr_grid=1.6e-3 * scale,
        lr_heads=1.6e-4 * scale,
        resolution=64,
        smooth_space=2e-4,
        smooth_time=1e-3,
        time_l1=1e-4,
        space_range=(0.1, 0.5),
        time_spread=0.0,
        silu=False,
        until=23_000 / total_steps,
        stretch=0.0,
        published=True,
    )


class _InOrder(NamedTuple):
    """Parameters of a field in the order of their use."""

    planes: list[Tensor]
    """Per level: three spatial planes, then three time planes."""
    trunk: network.Layer
    heads: list[tuple[network.Layer, network.Layer]]


class HexPlane(Deformation):
    """HexPlane deformation field. It is created on the CPU, so that a seed gives the same start on every device.

    box: [2, 3] bounds of the planes; outside, features are those of the border.
    harmonics: number of SH bases beyond the constant one that the published field moves.
    around: [2, 3] centre of the stretched axes, and distance up to which nodes are almost evenly spaced, in scene
        units; None: axes are not stretched.
    """

    def __init__(
        self, config: HexPlaneConfig, box: Tensor, generator: torch.Generator, harmonics: int = 0,
        around: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        if not bool((box[1] > box[0]).all()):
            bounds = [[float(v) for v in row] for row in box]
            raise ValueError(f"box {bounds} should have its maximum above its minimum on every axis")
        self.config = config
        self.box: Tensor
        self.register_buffer("box", box.float().cpu())
        if around is not None and not (around.shape == (2, 3) and bool((around[1] > 0).all())):
            raise ValueError(f"around has shape {tuple(around.shape)}: it should be [2, 3], with distances above 0")
        self.around: Tensor | None
        self.register_buffer("around", None if around is None else around.float().cpu())
        self._rim: Tensor
        self.register_buffer("_rim", self._stretched(self.box), persistent=False)
        self.spatial, self.temporal = nn.ParameterList(), nn.ParameterList()
        for level in config.levels:
            nodes = config.resolution * level
            for _ in _SPATIAL:
                plane = torch.empty(1, config.features, nodes, nodes, device="cpu")
                plane.uniform_(*config.space_range, generator=generator)
                self.spatial.append(_plane(plane))
            for _ in range(3):
                still = torch.ones(1, config.features, config.time_nodes, nodes, device="cpu")
                if config.time_spread > 0:
                    low, high = 1.0 - config.time_spread, 1.0 + config.time_spread
                    still.uniform_(low, high, generator=generator)
                self.temporal.append(_plane(still))
        self.trunk = _linear(config.features * len(config.levels), config.width, generator)
        widths = {**_WIDTHS, "shN": 3 * harmonics} if config.published and harmonics else _WIDTHS
        self.hidden = nn.ModuleDict({name: _linear(config.width, config.width, generator) for name in widths})
        self.out = nn.ModuleDict({n: nn.Linear(config.width, size, device="cpu") for n, size in widths.items()})
        self._cached: _InOrder | None = None
        # At zero, the field starts as the identity.
        for head in self.out.values():
            if config.published:
                nn.init.xavier_uniform_(head.weight, generator=generator)  # type: ignore[arg-type]
            else:
                nn.init.zeros_(head.weight)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]

    def features_at(self, means: Tensor, times: Tensor) -> Tensor:
        """[M, features * levels] products of the samples of six planes, concatenated over levels."""
        # Detached, so that no gradient moves the means through the sampling of the planes.
        means = means if self.config.published else means.detach()
        low, high = self._rim
        positions = 2.0 * (self._stretched(means) - low) / (high - low) - 1.0
        # The published code samples [-1, 1] at times in [0, 1], and so uses half of each time plane.
        plane_times = (times if self.config.published else 2.0 * times - 1.0).expand(len(means))
        planes = self._by_level()
        if compiled.supports(planes) and positions.dtype == torch.float32:
            return compiled.features(torch.cat([positions, plane_times[:, None]], dim=1), planes)
        parts: list[Tensor] = []
        for level in range(len(self.config.levels)):
            product = positions.new_ones(())
            for k, (a, b) in enumerate(_SPATIAL):
                product = product * _sample(self.spatial[3 * level + k], positions[:, a], positions[:, b])
            for axis in range(3):
                product = product * _sample(self.temporal[3 * level + axis], positions[:, axis], plane_times)
            parts.append(product)
        return torch.cat(parts, dim=1)

    def _stretched(self, places: Tensor) -> Tensor:
        """Positions [P, 3] in the stretched coordinates in which the planes' nodes are evenly spaced."""
        # Background behind a mover makes the box large: evenly spaced nodes would leave a person a few nodes wide.
        return places if self.around is None else torch.asinh((places - self.around[0]) / self.around[1])

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """See `Deformation.load_state`."""
        super().load_state(tensors)
        self._rim.copy_(self._stretched(self.box))

    def forward(self, means: Tensor, times: Tensor, host_params: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians; means [M, 3] scene units (detached unless `published`), times [M] or [1] in [0, 1]."""
        out = dict(zip(self.out, self._network(self.features_at(means, times)), strict=True))
        return Deltas(
            means=out["means"],
            quats=out["quats"],
            log_scales=out["log_scales"],
            opacity_logits=out["opacity_logits"][:, 0],
            sh0=out["sh0"][:, None, :],
            shN=unflatten(out["shN"], 1, (-1, 3)) if "shN" in out else None,
        )

    @property
    def recordable(self) -> bool:
        """True: a step draws no random numbers, and all kernels can be recorded."""
        return True

    def _network(self, features: Tensor) -> tuple[Tensor, ...]:
        """Outputs of the heads for features [M, features * levels]."""
        _, trunk, heads = self._in_order()
        if self.config.silu and network.supports(features, trunk, heads):
            return network.network(features, trunk, heads)
        # With ReLU, the whole trunk often dies in the first steps, and the field stays constant.
        bent = F.silu if self.config.silu else F.relu
        hidden = bent(F.linear(features, *trunk))
        return tuple(F.linear(bent(F.linear(hidden, *first)), *last) for first, last in heads)

    def _by_level(self) -> list[Tensor]:
        """Planes in the order of `_InOrder.planes`."""
        return self._in_order().planes

    def _in_order(self) -> _InOrder:
        """Cached parameter lists."""
        # Lookups by name in torch's lists took 1/15 of the CPU time of a step on a GPU.
        if self._cached is None or self._cached.trunk.weight is not self.trunk.weight:
            levels = range(0, len(self.spatial), 3)
            self._cached = _InOrder(
                [plane for n in levels for plane in (*self.spatial[n : n + 3], *self.temporal[n : n + 3])],
                _layer(self.trunk),
                [(_layer(self.hidden[name]), _layer(self.out[name])) for name in self.out],
            )
        return self._cached

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Two groups: planes and network. In the published configuration, their schedule begins with the field."""
        c = self.config
        span = {"since": c.start if c.published else 0.0, "until": c.until}
        planes = [*self.spatial, *self.temporal]
        known = {id(p) for p in planes}
        heads = [p for p in self.parameters() if id(p) not in known]
        return [
            {"params": planes, "lr": c.lr_grid, "lr_end": c.lr_grid * c.lr_end, "name": "field", **span},
            {"params": heads, "lr": c.lr_heads, "lr_end": c.lr_heads * c.lr_end, "name": "heads", **span},
        ]

    def regularisation(self, progress: float = 1.0, generator: torch.Generator | None = None) -> Tensor:
        """Weighted penalties on non-smooth planes and on time planes that differ from 1, summed over planes."""
        c, planes = self.config, self._by_level()
        along = 0.0 if c.published else c.smooth_space
        if compiled.supports(planes):
            space, time = (c.smooth_space, along, 0.0), (c.smooth_time, 0.0, c.time_l1)
            return compiled.penalty(planes, [*[space] * 3, *[time] * 3] * len(c.levels))
        space = torch.stack([c.smooth_space * _bend(p, 2) + along * _bend(p, 3) for p in self.spatial]).sum()
        time = torch.stack([_bend(p, 2) for p in self.temporal]).sum()
        still = torch.stack([(1.0 - p).abs().mean() for p in self.temporal]).sum()
        return space + c.smooth_time * time + c.time_l1 * still


def _plane(values: Tensor) -> nn.Parameter:
    """Parameter of a plane [1, C, H, W] in channels-last memory layout."""
    return nn.Parameter(values.contiguous(memory_format=torch.channels_last))


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(inputs, outputs, device="cpu")
    nn.init.xavier_uniform_(layer.weight, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


def _layer(linear: nn.Module) -> network.Layer:
    assert isinstance(linear, nn.Linear)
    return network.Layer(linear.weight, linear.bias)


def _sample(plane: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Bilinear samples [M, C] of a plane [1, C, R_second, R_first] at coordinates in [-1, 1], clamped to the border."""
    grid = torch.stack([first, second], dim=1)[None, None]
    return F.grid_sample(plane, grid, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0].T


def _bend(plane: Tensor, axis: int) -> Tensor:
    """Mean squared second difference of a plane along `axis`."""
    count = plane.shape[axis]
    if count < 3:
        return plane.new_zeros(())
    before, middle, after = (plane.narrow(axis, start, count - 2) for start in (0, 1, 2))
    return (before - 2.0 * middle + after).square().mean()


def _create(config: HexPlaneConfig, start: Start) -> HexPlane:
    nodes = config.time_nodes or start.time_nodes() or max(4, round(start.frames / 2))
    config = replace(config, time_nodes=nodes)
    box = start.box
    if config.published:
        box = torch.stack([start.points.amin(0), start.points.amax(0)])
        box[1] = torch.maximum(box[1], box[0] + 1e-3)
    return HexPlane(config, box, start.generator, start.harmonics, _around(start.means, box, config.stretch))


def _around(means: Tensor, box: Tensor, stretch: float) -> Tensor | None:
    """Argument `around` [2, 3] of `HexPlane` for moving Gaussians with means [M, 3], or for `box` if there are none."""
    if stretch <= 0:
        return None
    if not len(means):
        means = box
    middle = means.median(0).values
    spread = (means - middle).abs().median(0).values
    return torch.stack([middle, stretch * spread.clamp_min(1e-3)])


def _restore(config: HexPlaneConfig, tensors: dict[str, Tensor]) -> HexPlane:
    config = replace(config, time_nodes=tensors["field.temporal.0"].shape[2])
    around = tensors["field.around"] if config.stretch > 0 else None
    harmonics = len(tensors["field.out.shN.bias"]) // 3 if "field.out.shN.bias" in tensors else 0
    field = HexPlane(
        config,
        tensors["field.box"],
        torch.Generator(device="cpu").manual_seed(0),
        harmonics,
        around,
    )
    field.load_state(tensors)
    return field


def _warm_up(config: HexPlaneConfig) -> None:
    if config.features % compiled.LANES == 0:
        compiled.warm_up(config.features)
        network.warm_up(config.features * len(config.levels), config.width, len(_WIDTHS))


HOST = HostSpec("hexplane", HexPlaneConfig, _reference, _create, _restore, _warm_up)
