"""Optimiser of a run: parameter groups and learning rates."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import nn

from ..deformation import Deformation, GateConfig
from ..gaussians import Gaussians, sh_bases
from .adam import FusedAdam
from .config import TrainConfig
from .model import DynamicModel
from .poses import Poses

# Published share of the run at which the field is added, for which the hosts' learning rates are tuned.
_USUAL = GateConfig().start
_LOG_SCALE_RANGE = (math.log(1e-5), math.log(50.0))


def optimizer_of(model: DynamicModel, poses: Poses, config: TrainConfig) -> FusedAdam:
    """Adam over the Gaussians, the exposure and, if they are refined, the poses. `add_field` adds a field later."""
    c, p = config, model.gaussians.params
    rates = {
        "means": (c.lr_means, c.lr_means_end),
        "quats": (c.lr_quats, c.lr_end * c.lr_quats),
        "log_scales": (c.lr_scales, c.lr_end * c.lr_scales),
        "opacity_logits": (c.lr_opacities, c.lr_end * c.lr_opacities),
        "sh0": (c.lr_sh0, c.lr_end * c.lr_sh0),
        "shN": (c.lr_sh_rest, c.lr_end * c.lr_sh_rest),
    }
    groups: list[dict[str, Any]] = [
        {"params": [p[name]], "lr": start, "lr_start": start, "lr_end": end, "name": name, "rows": True}
        for name, (start, end) in rates.items()
    ]
    groups[list(rates).index("log_scales")]["clamp"] = _LOG_SCALE_RANGE
    groups[list(rates).index("means")]["lr_unit_distance"] = c.lr_means_reach
    lr = c.exposure.lr
    groups.append({"params": [model.exposure.values], "lr": lr, "lr_start": lr, "lr_end": 0.1 * lr})
    if c.poses.on:
        lr = c.poses.lr
        groups.append({"params": [poses.values], "lr_start": lr, "lr_end": 0.1 * lr, "until": c.poses.until})
    # As in 3DGS: gradients of single Gaussians are often below torch's default of 1e-8.
    return FusedAdam(groups, eps=1e-15)


def add_field(optimizer: FusedAdam, field: Deformation, model: Gaussians, config: TrainConfig, share: float) -> None:
    """Adds the parameters of a field, at a `share` of its learning rates, and the parameters it owns per Gaussian."""
    joins = config.gate.start if config.method == "auto" else _USUAL
    for group in field.parameter_groups():
        start, end = share * group["lr"], share * group["lr_end"]
        since, until = group.get("since", 0.0), group.get("until", 1.0)
        # Hosts are tuned for a field that is added after a third of the run. A field that is added earlier starts at
        # the rates of that point: at the full rates, two of six runs diverged (docs/decisions.md).
        if joins < _USUAL < until and since < _USUAL:
            start *= (end / start) ** ((_USUAL - since) / (until - since))
            since = joins
        optimizer.add_param_group({**group, "lr": start, "lr_start": start, "lr_end": end, "since": since})
    for name, owned in field.owned.items():
        rates = {"lr": owned.lr, "lr_start": owned.lr, "lr_end": owned.lr_end}
        optimizer.add_param_group({"params": [model.params[name]], "name": name, "rows": True, **rates})


def schedule_rates(optimizer: FusedAdam, progress: float) -> None:
    """Sets log-linear learning rates between `since` and `until` of each group (3DGS get_expon_lr_func)."""
    for group in optimizer.param_groups:
        since, until = group.get("since", 0.0), group.get("until", 1.0)
        share = min(max((progress - since) / (until - since), 0.0), 1.0)
        group["lr"] = group["lr_start"] * (group["lr_end"] / group["lr_start"]) ** share


def limit_harmonics(model: Gaussians, optimizer: torch.optim.Optimizer, degree: int) -> None:
    """Removes the SH coefficients above `degree` from shN, with their moments."""
    old, bases = model.params["shN"], sh_bases(degree) - 1
    new = nn.Parameter(old.detach()[:, :bases].contiguous())
    state = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {k: v[:, :bases].contiguous() if v.shape == old.shape else v for k, v in state.items()}
    for group in optimizer.param_groups:
        group["params"] = [new if p is old else p for p in group["params"]]
    model.params["shN"] = new
