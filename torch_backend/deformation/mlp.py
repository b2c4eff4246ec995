"""Host B: one network of encoded position and time (Deformable 3DGS).

It moves means, rotations and scales; opacity and colour stay. Corrected against the published code: positions and
times are scaled to [-1, 1] before they are encoded, scales change in the log and rotations by a quaternion product, so
that no delta leaves the domain; heads start near zero, so that the field starts as the identity to about 1e-5; the
6-DoF variant is finite at angle 0. The net is smaller and its encoding has fewer octaves.

`reference` is the published host; what stays the trainer's for every host are the loss, the Gaussians' own rates and
their growth, for which the published code keeps a second screen-gradient buffer and a threshold of its own.
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
    """Sizes and learning rates; Deformable 3DGS' numbers in brackets (utils/time_utils.py, arguments/__init__.py)."""

    still: float = 0.1
    """As in `HostConfig`. Smooth by itself, the host bends few walls, and a full price keeps it from moving people."""
    depth: int = 4
    """Layers of the trunk; the input joins again after the middle one (8)."""
    width: int = 64
    """Width of the layers (256)."""
    position_frequencies: int = 6
    """Octaves of the position's encoding (10, of positions in scene units). Synthetic scene `quick` 0, all move, 1500
    steps, one seed, lr 1e-3, width 128: 23.8 dB on moving pixels of held-out frames, 23.3 with 3; static 22.0."""
    time_frequencies: int = 4
    """Octaves of the time's encoding (10, of times in [0, 1]). Behind the gate of the bundled clip, 240 px, 1200 steps,
    one seed, lr 2e-4: 23.03 dB with 3 and 4 octaves, 22.41 with 6 and 6; static 22.86."""
    head_std: float = 1e-5
    """Standard deviation that the heads start with; 0: torch's default, so that the field starts as noise (0)."""
    published: bool = False
    """Raw coordinates, deltas after activation, rotations added (on)."""
    six_dof: bool = False
    """Means move by a rigid motion about the origin of the encoded box instead of a shift (off)."""

    def row_bytes(self) -> int:
        """The encoding thrice, as it is made and joined, and every layer before and after it bends."""
        inputs = 4 + 6 * self.position_frequencies + 2 * self.time_frequencies
        return 4 * (3 * inputs + 2 * self.width * self.depth)

    lr: float = 1e-3
    """Start learning rate (8e-4). Synthetic scene as above: half of it left the moving pixels at 23.0 dB."""
    lr_end: float = 2e-5
    """End learning rate (1.6e-6)."""
    until: float = 1.0
    """Share of the run at which the learning rate has ended (1: 40,000 of 40,000)."""
    noise: float = 0.0
    """Training times are blurred by this many frames, falling to nothing (0.1)."""
    noise_until: float = 0.5
    """Share of the run at which the blur is gone (0.5: 20,000 of 40,000)."""


def _reference(iterations: int) -> MlpConfig:
    """The published host. Warm-up 3000 of 40,000; the blur is of 1 / (training frames), not of the frames left.

    Rates are as published in runs of any length: a network moves all Gaussians with each step, and higher rates than
    ours did no better in short runs.
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
    """[M, D (1 + 2 octaves)]: values [M, D], then sin and cos of 2^k times them."""
    angles = values[:, :, None] * 2.0 ** torch.arange(octaves, dtype=values.dtype, device=values.device)
    return torch.cat([values, angles.sin().flatten(1), angles.cos().flatten(1)], dim=1)


def linear(inputs: int, outputs: int, generator: torch.Generator, std: float | None = None) -> nn.Linear:
    """A layer that starts as torch's own do (std None), or normal with `std` and without bias."""
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
    """ReLU layers over encoded position and time; the input joins again after the middle layer."""

    def __init__(
        self, depth: int, width: int, octaves: tuple[int, int], generator: torch.Generator, kaiming: bool = False
    ) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"depth is {depth}: a trunk has at least 1 layer")
        self.octaves, self.join = octaves, depth // 2
        inputs = 3 * (1 + 2 * octaves[0]) + 1 + 2 * octaves[1]
        sizes = [inputs] + [width + (inputs if n == self.join else 0) for n in range(depth - 1)]
        # Kaiming for ReLU with zero bias is SC-GS's start; torch's default is Deformable 3DGS'.
        self.layers = nn.ModuleList([linear(size, width, generator) for size in sizes])
        if kaiming:
            for layer in self.layers:
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)  # type: ignore[arg-type]
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, where: Tensor, when: Tensor) -> Tensor:
        """[M, width] at where [M, 3] and when [M] or [1]."""
        moment = encode(when[:, None], self.octaves[1]).expand(len(where), -1)
        inputs = torch.cat([encode(where, self.octaves[0]), moment], dim=1)
        hidden = inputs
        for n, layer in enumerate(self.layers):
            hidden = F.relu(layer(hidden))
            if n == self.join and n < len(self.layers) - 1:
                hidden = torch.cat([inputs, hidden], dim=1)
        return hidden


class Mlp(Deformation):
    """The field. `box` [2, 3] is what the encoding takes for [-1, 1]."""

    def __init__(self, config: MlpConfig, box: Tensor, frames: int, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self.box: Tensor
        self.frames: Tensor
        self.register_buffer("box", box.float().cpu())
        self.register_buffer("frames", torch.tensor(float(frames), device="cpu"))
        self.frame_count = float(frames)  # what `frames` holds: nobody has to ask a GPU for it
        self.trunk = Trunk(
            config.depth, config.width, (config.position_frequencies, config.time_frequencies), generator
        )
        std = config.head_std or None
        widths = {"means": 6 if config.six_dof else 3, "quats": 4, "log_scales": 3}
        self.heads = nn.ModuleDict({n: linear(config.width, size, generator, std) for n, size in widths.items()})
        self.rules = {"quats": add_to_unit_quat, "log_scales": add_to_scale} if config.published else {"quats": turn}

    def forward(self, means: Tensor, times: Tensor, own: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians; means [M, 3] scene units (detached here), times [M] or [1] in [0, 1]."""
        where, when = means.detach(), times
        if not self.config.published:
            where = 2.0 * (where - self.box[0]) / (self.box[1] - self.box[0]) - 1.0
            when = 2.0 * when - 1.0
        hidden = self.trunk(where, when)
        shift = self.heads["means"](hidden)
        if self.config.six_dof:
            middle = self.box.mean(0)
            place = means.detach() - middle
            shift = screw(place, shift[:, :3], shift[:, 3:]) - place
        return Deltas(means=shift, quats=self.heads["quats"](hidden), log_scales=self.heads["log_scales"](hidden))

    @property
    def recordable(self) -> bool:
        """It is: the blur of its times is drawn outside (`training_time`)."""
        return True

    def training_time(self, time: float, progress: float, generator: torch.Generator) -> float:
        """Blurred by normal noise of `noise` frames, falling linearly to nothing at `noise_until`."""
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
    """`time` plus normal noise of `noise` / frames, falling linearly to 0 at the share `until` of the run."""
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
