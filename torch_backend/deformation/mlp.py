"""Host B: one network of encoded position and time (Deformable 3DGS).

It moves means, rotations and scales; opacity and colour stay constant. Changes to the published code: Positions and
times are scaled to [-1, 1] before encoding. Scales change in the log and rotations by a quaternion product, so that
every delta is valid. Heads start near zero, so that the field starts as the identity to about 1e-5. The 6-DoF variant
is finite at angle 0. The network is smaller and its encoding has fewer octaves.

`reference` is the published host. For every host, the trainer implements the loss, the learning rates of the Gaussians
and their densification, for which the published code has a second screen-gradient buffer and a separate threshold.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .geometry import screw
from .protocol import (
    Deformation,
    Deltas,
    HostConfig,
    HostSpec,
    Start,
    add_to_scale,
    add_to_unit_quat,
    turn,
)

PUBLISHED_ITERATIONS = 40_000


@dataclass
class MlpConfig(HostConfig):
    """Sizes and learning rates. Values in brackets: Deformable 3DGS (utils/time_utils.py, arguments/__init__.py)."""

    still: float = 0.1
    """See `HostConfig`. This host is smooth by design and bends few walls; a full price would keep people static."""
    depth: int = 4
    """Number of layers of the trunk, with a skip connection from the input after the middle layer (8)."""
    width: int = 64
    """Width of the layers (256)."""
    position_frequencies: int = 6
    """Octaves of the position encoding (10, of scene units). Synthetic scene `quick` 0, all Gaussians move, 1500 steps,
    one seed, lr 1e-3, width 128: 23.8 dB on moving held-out pixels, 23.3 with 3 octaves, 22.0 for a static model."""
    time_frequencies: int = 4
    """Octaves of the time encoding (10, of times in [0, 1]). Bundled clip with the gate, 240 px, 1200 steps, one seed,
    lr 2e-4: 23.03 dB with 3 (position) and 4 (time) octaves, 22.41 with 6 and 6, 22.86 for a static model."""
    head_std: float = 1e-5
    """Standard deviation of the heads' initial weights; 0: torch's default, so that the field starts as noise (0)."""
    published: bool = False
    """Whether coordinates are not normalised, and deltas and rotations are added after activation (on)."""
    six_dof: bool = False
    """Whether means move by a rigid motion about the centre of the encoded box instead of a translation (off)."""

    def row_bytes(self) -> int:
        """See `HostConfig.row_bytes`: three copies of the encoding, and all layers before and after activation."""
        inputs = 4 + 6 * self.position_frequencies + 2 * self.time_frequencies
        return 4 * (3 * inputs + 2 * self.width * self.depth)

    lr: float = 1e-3
    """Initial learning rate (8e-4). In the synthetic scene above, half of it reached 23.0 dB on moving pixels."""
    lr_end: float = 2e-5
    """Final learning rate (1.6e-6)."""
    until: float = 1.0
    """Share of the run at which the learning rate reaches its final value (1: 40,000 of 40,000)."""
    noise: float = 0.0
    """Initial standard deviation, in frames, of noise on training times; it falls linearly to 0 (0.1)."""
    noise_until: float = 0.5
    """Share of the run at which that noise reaches 0 (0.5: 20,000 of 40,000)."""


def _reference(iterations: int) -> MlpConfig:
    """Configuration of the published host. Warm-up takes 3000 of 40,000 steps; time noise is in training frames.

    Learning rates are as published in runs of any length: each step changes the deltas of all Gaussians, and rates
    above ours gained nothing in short runs.
    """
    return MlpConfig(
        start=3000 / PUBLISHED_ITERATIONS,
        depth=8,
        width=256,
        position_frequencies=10,
        time_frequencies=10,
        head_std=0.0,
        published=True,
        lr=5 * 1.6e-4,
        lr_end=1.6e-6,
        noise=0.1,
    )


def encode(values: Tensor, octaves: int) -> Tensor:
    """[M, D (1 + 2 octaves)] positional encoding: values [M, D], then sin and cos of 2^k * values."""
    angles = values[:, :, None] * 2.0 ** torch.arange(octaves, dtype=values.dtype, device=values.device)
    return torch.cat([values, angles.sin().flatten(1), angles.cos().flatten(1)], dim=1)


def linear(inputs: int, outputs: int, generator: torch.Generator, std: float | None = None) -> nn.Linear:
    """Linear layer with torch's default initialisation (std None), or normal weights with `std` and zero bias."""
    layer = nn.Linear(inputs, outputs, device="cpu")
    with torch.no_grad():
        if std is None:
            bound = 1.0 / math.sqrt(inputs)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)
        else:
            layer.weight.normal_(0.0, std, generator=generator)
            layer.bias.zero_()
    return layer


class Trunk(nn.Module):
    """ReLU layers over encoded position and time, with a skip connection from the input after the middle layer."""

    def __init__(
        self, depth: int, width: int, octaves: tuple[int, int], generator: torch.Generator, kaiming: bool = False
    ) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"depth is {depth}: a trunk has at least 1 layer")
        self.octaves, self.join = octaves, depth // 2
        inputs = 3 * (1 + 2 * octaves[0]) + 1 + 2 * octaves[1]
        sizes = [inputs] + [width + (inputs if n == self.join else 0) for n in range(depth - 1)]
        # SC-GS uses Kaiming initialisation with zero bias; Deformable 3DGS uses torch's default.
        self.layers = nn.ModuleList([linear(size, width, generator) for size in sizes])
        if kaiming:
            for layer in self.layers:
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)  # type: ignore[arg-type]
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """[M, width] features at `positions` [M, 3] and `times` [M] or [1]."""
        moment = encode(times[:, None], self.octaves[1]).expand(len(positions), -1)
        inputs = torch.cat([encode(positions, self.octaves[0]), moment], dim=1)
        hidden = inputs
        for n, layer in enumerate(self.layers):
            hidden = F.relu(layer(hidden))
            if n == self.join and n < len(self.layers) - 1:
                hidden = torch.cat([inputs, hidden], dim=1)
        return hidden


class Mlp(Deformation):
    """Deformation field. `box` [2, 3] are the bounds that are scaled to [-1, 1] for the encoding."""

    def __init__(self, config: MlpConfig, box: Tensor, frames: int, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self.box: Tensor
        self.frames: Tensor
        self.register_buffer("box", box.float().cpu())
        self.register_buffer("frames", torch.tensor(float(frames), device="cpu"))
        self.frame_count = float(frames)  # value of `frames` in host memory, which avoids a GPU synchronisation
        self.trunk = Trunk(
            config.depth, config.width, (config.position_frequencies, config.time_frequencies), generator
        )
        std = config.head_std or None
        widths = {"means": 6 if config.six_dof else 3, "quats": 4, "log_scales": 3}
        self.heads = nn.ModuleDict({n: linear(config.width, size, generator, std) for n, size in widths.items()})
        self.rules = {"quats": add_to_unit_quat, "log_scales": add_to_scale} if config.published else {"quats": turn}

    def forward(self, means: Tensor, times: Tensor, host_params: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians; means [M, 3] in scene units (detached), times [M] or [1] in [0, 1]."""
        # Detached, so that no gradient moves the means through the encoding.
        positions = means.detach()
        if not self.config.published:
            positions = 2.0 * (positions - self.box[0]) / (self.box[1] - self.box[0]) - 1.0
            times = 2.0 * times - 1.0
        hidden = self.trunk(positions, times)
        shift = self.heads["means"](hidden)
        if self.config.six_dof:
            middle = self.box.mean(0)
            place = means.detach() - middle
            shift = screw(place, shift[:, :3], shift[:, 3:]) - place
        return Deltas(means=shift, quats=self.heads["quats"](hidden), log_scales=self.heads["log_scales"](hidden))

    @property
    def recordable(self) -> bool:
        """True: the noise on times is drawn outside of the recording (`training_time`)."""
        return True

    def training_time(self, time: float, progress: float, generator: torch.Generator) -> float:
        """`time` plus normal noise of `noise` frames, which falls linearly to 0 at `noise_until`."""
        return blurred(time, self.frame_count, progress, self.config.noise, self.config.noise_until, generator)

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        super().load_state(tensors)
        self.frame_count = float(self.frames)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One group: the network."""
        c = self.config
        return [{"params": list(self.parameters()), "lr": c.lr, "lr_end": c.lr_end, "until": c.until, "name": "field"}]


def blurred(
    time: float, frames: float, progress: float, noise: float, until: float, generator: torch.Generator
) -> float:
    """`time` plus normal noise of `noise` / frames, which falls linearly to 0 at the share `until` of the run."""
    if noise <= 0.0 or progress >= until:
        return time
    draw = float(torch.randn((), generator=generator, device="cpu"))
    return time + draw * noise * (1.0 - progress / until) / frames


def _create(config: MlpConfig, start: Start) -> Mlp:
    return Mlp(config, start.box, start.frames, start.generator)


def _restore(config: MlpConfig, tensors: dict[str, Tensor]) -> Mlp:
    field = Mlp(config, tensors["field.box"], 1, torch.Generator(device="cpu").manual_seed(0))
    field.load_state(tensors)
    return field


HOST = HostSpec("mlp", MlpConfig, _reference, _create, _restore)
