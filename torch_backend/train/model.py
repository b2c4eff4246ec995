"""Dynamic scene model: Gaussians, deformation field and gate, rendered at a given time from a given camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..deformation import Deformation, Deltas, apply_deltas, host
from ..gaussians import Gaussians
from ..raster import RasterOutput, rasterize
from ..torch_types import checkpoint, weighted_gradient
from .config import TrainConfig
from .exposure import Exposure


@dataclass
class DynamicModel:
    """Gaussians in scene units with a deformation field; `field` is None while the model is static."""

    gaussians: Gaussians
    """Canonical Gaussians with gate and support."""
    field: Deformation | None
    """Deformation field of the host; None while the model is static."""
    centres: Tensor
    """[B] normalised times of the support bins."""
    sh_degree: int
    """SH degree in use."""
    exposure: Exposure
    """Exposure correction per time. The Gaussians' colours are those without correction."""
    pieces: int | None = None
    """Number of Gaussians per call of the field, where memory is short; None: all in one call."""
    _rows: tuple[Tensor, int, Tensor] | None = dataclasses.field(default=None, repr=False)

    @property
    def device(self) -> torch.device:
        """Device of all tensors of the model."""
        return self.gaussians.open.device

    def open_rows(self) -> Tensor:
        """Rows int64 [M] of the Gaussians that the field moves."""
        is_open = self.gaussians.open
        if self.field is None:
            return torch.zeros(0, dtype=torch.long, device=is_open.device)
        # `nonzero` synchronises with the GPU. Rows change only between steps, so they are cached.
        if self._rows is None or self._rows[0] is not is_open or self._rows[1] != is_open._version:
            self._rows = (is_open, is_open._version, torch.nonzero(is_open).flatten())
        return self._rows[2]

    def deltas(self, rows: Tensor, times: Tensor) -> Deltas | None:
        """Deltas of the Gaussians `rows` [M] at times [M] or [1]. None without a field or rows."""
        if self.field is None or not len(rows):
            return None
        return self.evaluate(self.field, self.gaussians.params["means"][rows], times, self.gaussians.host_params(rows))

    def evaluate(self, field: Deformation, means: Tensor, times: Tensor, host_params: Mapping[str, Tensor]) -> Deltas:
        """Evaluates `field` at means [M, 3] and times [M] or [1].

        With `pieces` set, the Gaussians are split into chunks that are recomputed in the backward pass (gradient
        checkpointing).
        """
        if self.pieces is None or len(means) <= self.pieces:
            return field(means, times, host_params)
        parts: list[Deltas] = []
        for first in range(0, len(means), self.pieces):
            rows = slice(first, first + self.pieces)
            chunk_times = times if len(times) == 1 else times[rows]
            chunk_params = {name: value[rows] for name, value in host_params.items()}
            parts.append(checkpoint(field, means[rows], chunk_times, chunk_params))
        joined = [None if part[0] is None else torch.cat(part) for part in zip(*parts, strict=True)]
        return Deltas(*joined)  # type: ignore[arg-type]

    def moved(self, rows: Tensor, deltas: Deltas | None) -> dict[str, Tensor]:
        """All parameters after `deltas` have been applied to the Gaussians `rows` [M], with gradients."""
        return apply_deltas(self.gaussians, rows, deltas, None if self.field is None else self.field.rules)

    def state_at(self, time: float, canonical: bool = True) -> dict[str, Tensor]:
        """All parameters at a normalised time. Gradients reach the field, and with `canonical` also the Gaussians."""
        rows, times = self.open_rows(), torch.tensor([time], device=self.device)
        if canonical or self.field is None or not len(rows):
            return self.moved(rows, self.deltas(rows, times))
        deltas = self.field(self.gaussians.params["means"].detach()[rows], times, self.gaussians.host_params(rows))
        return apply_deltas(self.gaussians, rows, deltas, self.field.rules, canonical=False)


def restore_model(
    tensors: dict[str, Tensor], meta: dict[str, Any], config: TrainConfig, device: torch.device | str = "cpu"
) -> DynamicModel:
    """Restores the model of a checkpoint, without its optimiser, on `device`."""
    centres = tensors["centres"].to(device, copy=True)
    gaussians = Gaussians.from_state(tensors, len(centres)).to(torch.device(device))
    field = None
    if any(name.startswith("field.") for name in tensors):
        field = host(config.host).restore(config.field, tensors).to(device)
    exposure = Exposure(centres, config.exposure)
    exposure.values.data.copy_(tensors["exposure"])
    return DynamicModel(gaussians, field, centres, int(meta["sh_degree"]), exposure)


def render(
    state: dict[str, Tensor],
    sh_degree: int,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    **options: Any,
) -> RasterOutput:
    """Rasterises one camera (viewmat [4, 4], K [3, 3]) of a parameter state; `options` go to `rasterize`.

    The background [3] (+ extra channels) is blended in where alpha < 1.
    """
    return rasterize(
        means=state["means"],
        quats=state["quats"],
        log_scales=state["log_scales"],
        opacity_logits=state["opacity_logits"],
        sh=state["sh0"],
        sh_rest=state["shN"] if sh_degree else None,
        sh_degree=sh_degree,
        viewmats=viewmat[None],
        Ks=K[None],
        width=width,
        height=height,
        background=background,
        **options,
    )


def gathered(
    state: Mapping[str, Tensor], viewmat: Tensor, K: Tensor, width: int, height: int, weights: Tensor
) -> Tensor:
    """[N, C] blending weights (alpha * T) of the Gaussians in one camera, summed over pixels with weights [H, W, C]."""
    detached = {name: value.detach() for name, value in state.items()}
    with torch.enable_grad():
        # The gradient of a pixel by a Gaussian's colour is its blending weight: one backward pass sums all of them.
        ink = torch.zeros(len(detached["means"]), weights.shape[2], device=weights.device, requires_grad=True)
        out = render(detached, 0, viewmat, K, width, height, colors=ink, with_contributions=False)
        return weighted_gradient(out.colors[0, ..., 3:], ink, weights.to(ink))
