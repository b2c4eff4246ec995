"""Canonical Gaussians: parameters, optimiser state and per-Gaussian state, which are resized together.

One function, `rebuild`, clones, splits and prunes, by the parent row of each new Gaussian. Children inherit
per-Gaussian state (the gate, the support bitmap), as the support preset requires (docs/architecture.md).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

PARAM_NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic: colour = 0.5 + SH_C0 * sh0 + ..."""


def sh_bases(degree: int) -> int:
    """Number of spherical harmonics up to a degree."""
    return (degree + 1) ** 2


class Gaussians:
    """N Gaussians in scene units. Scales are stored as logs, opacities as logits, quaternions as unnormalised wxyz.

    params: means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh0 [N, 1, 3], shN [N, K - 1, 3],
        followed by parameters of the host, [N, ...] each (see `adopt`).
    open: bool [N] gate: Gaussians that the deformation moves.
    support: bool [N, B] time bins in which a Gaussian contributed to a training frame.
    hidden: bool [N, B] time bins in which it was out of the frame or occluded at the last check.
    """

    def __init__(self, params: dict[str, Tensor], bins: int) -> None:
        count = params["means"].shape[0]
        for name in PARAM_NAMES:
            if params[name].shape[0] != count:
                raise ValueError(f"{name} has {params[name].shape[0]} rows, means has {count}")
        names = [*PARAM_NAMES, *(name for name in params if name not in PARAM_NAMES)]
        self.params = {name: nn.Parameter(params[name].contiguous()) for name in names}
        device = params["means"].device
        self.open = torch.zeros(count, dtype=torch.bool, device=device)
        self.support = torch.zeros(count, bins, dtype=torch.bool, device=device)
        self.hidden = torch.zeros(count, bins, dtype=torch.bool, device=device)

    def __len__(self) -> int:
        return self.params["means"].shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest degree that shN can hold."""
        return math.isqrt(1 + self.params["shN"].shape[1]) - 1

    def adopt(self, name: str, shape: tuple[int, ...], value: float) -> nn.Parameter:
        """Adds a host's parameter [N, *shape] with the initial value `value`. ValueError if the name is in use."""
        if name in self.params:
            raise ValueError(f"the Gaussians have a parameter {name!r} already")
        self.params[name] = nn.Parameter(self.params["means"].new_full((len(self), *shape), value))
        return self.params[name]

    def host_params(self, rows: Tensor) -> dict[str, Tensor]:
        """Host parameters of the Gaussians `rows` [M], by name."""
        return {name: p[rows] for name, p in self.params.items() if name not in PARAM_NAMES}

    @torch.no_grad()
    def rebuild(self, parent: Tensor, fresh: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Replaces row i by a copy of row `parent[i]` [M]. Rows set in `fresh`, bool [M], get zero optimiser moments.

        If memory runs out, nothing is changed.
        """
        rebuilt = {name: nn.Parameter(old.detach()[parent].contiguous()) for name, old in self.params.items()}
        is_open, support, hidden = self.open[parent], self.support[parent], self.hidden[parent]
        states: dict[str, dict[str, Tensor]] = {}
        for name, old in self.params.items():
            state: dict[str, Tensor] = dict(optimizer.state.get(old, {}))
            for key, value in state.items():
                if value.shape == old.shape:
                    state[key] = value[parent].contiguous()
                    state[key][fresh] = 0.0
            states[name] = state
        replaced: dict[int, nn.Parameter] = {}
        for name, old in self.params.items():
            if optimizer.state.pop(old, None) is not None:
                optimizer.state[rebuilt[name]] = states[name]
            replaced[id(old)] = self.params[name] = rebuilt[name]
        for group in optimizer.param_groups:
            group["params"] = [replaced.get(id(p), p) for p in group["params"]]
        self.open, self.support, self.hidden = is_open.contiguous(), support.contiguous(), hidden.contiguous()

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint, with bitmaps packed to bytes."""
        tensors = {f"gaussians.{name}": p.detach() for name, p in self.params.items()}
        tensors["gaussians.open"] = self.open
        tensors["gaussians.support"] = pack_bits(self.support)
        tensors["gaussians.hidden"] = pack_bits(self.hidden)
        return tensors

    def to(self, device: torch.device) -> Gaussians:
        """Copy of the model on `device`; the model itself if it is already there."""
        if self.open.device == device:
            return self
        model = Gaussians({name: p.detach().to(device) for name, p in self.params.items()}, self.support.shape[1])
        model.open, model.support, model.hidden = (t.to(device) for t in (self.open, self.support, self.hidden))
        return model

    @staticmethod
    def from_state(tensors: dict[str, Tensor], bins: int) -> Gaussians:
        """Inverse of `state`; KeyError names a missing tensor."""
        flags = ("open", "support", "hidden")
        names = [name.removeprefix("gaussians.") for name in tensors if name.startswith("gaussians.")]
        host_names = [name for name in names if name not in (*PARAM_NAMES, *flags)]
        model = Gaussians({name: tensors[f"gaussians.{name}"] for name in (*PARAM_NAMES, *host_names)}, bins)
        model.open = tensors["gaussians.open"].clone()
        model.support = unpack_bits(tensors["gaussians.support"], bins)
        if "gaussians.hidden" in tensors:  # earlier versions did not store it
            model.hidden = unpack_bits(tensors["gaussians.hidden"], bins)
        return model


@torch.no_grad()
def covering(model: Gaussians, count: int) -> Tensor:
    """Rows int64 [count], ascending, of the Gaussians with the largest opacity times area of their two longest axes."""
    area = model.params["log_scales"].topk(2, dim=1).values.sum(1)
    weight = torch.nn.functional.logsigmoid(model.params["opacity_logits"]) + area
    return weight.topk(count).indices.sort().values


def _weights(device: torch.device) -> Tensor:
    return 2 ** torch.arange(8, dtype=torch.uint8, device=device)


def pack_bits(flags: Tensor) -> Tensor:
    """bool [N, B] -> uint8 [N, ceil(B / 8)], lowest bit first."""
    padded = torch.nn.functional.pad(flags, (0, -flags.shape[1] % 8)).view(flags.shape[0], -1, 8)
    return (padded * _weights(flags.device)).sum(-1, dtype=torch.uint8)


def unpack_bits(packed: Tensor, bins: int) -> Tensor:
    """Inverse of `pack_bits`."""
    flags = (packed[:, :, None] & _weights(packed.device)) != 0
    return flags.reshape(packed.shape[0], -1)[:, :bins].contiguous()
