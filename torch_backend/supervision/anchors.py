"""Anchoring losses: the anchored states, their references and weights.

`support` needs no rendering: deltas of an unsupported (Gaussian, time) pair are pulled to those of its nearest
supported bins. `paper` is the rule of the Splannequin paper (section "Temporally-Anchored Regularization"): hidden
states are anchored to the past and defective states to the future, over activated parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ..contract import DETECTORS
from ..deformation import Deformation, Deltas
from ..gaussians import Gaussians
from ..small_tables import small_table
from .support import SEEN_WEIGHT, nearest_supported


@dataclass
class SupervisionConfig:
    """Settings and weights of the anchoring losses. Shares are of the run's length."""

    preset: str = "support"
    """Anchoring rule: support, paper or none."""
    start: float = 1.0 / 3.0
    """Share of the run at which anchoring begins (paper: iteration 10,000 of 30,000)."""
    switch: float = 2.0 / 3.0
    """`paper`: share at which the loss changes from L2 to L1 (paper: 20,000 of 30,000)."""
    every: int = 10
    """`paper`: interval in iterations (paper: 10)."""
    tau: float = 5.0
    """`paper`: decay of the confidence with normalised time (paper: 5)."""
    weight_hidden: float = 10.0
    """`paper`: lambda_hidden (paper: 10)."""
    weight_defective: float = 10.0
    """`paper`: lambda_defective (paper: 10)."""
    defective_gradient: float = 1e-9
    """`paper`: a visible Gaussian with a screen gradient of at most this is defective (paper: 1e-9)."""
    detector: str = "grad_norm"
    """`paper`: test for Gaussians that an image supervises. grad_norm: norm of the screen gradient, as in the paper;
    grad_signed: its signed sum over x and y, as in the published code; weight: the contribution to the image."""
    pulls: str = "field"
    """`paper`: parameters that get its gradient. field: the deformation field only. all: also canonical parameters. The
    published code does so: it detaches the reference state, but not the canonical parameters that both states share.
    Published configurations (`host_config`) set all."""
    support_every: int = 4
    """`support`: interval in iterations."""
    support_weight: float = 0.2
    """`support`: weight of the whole term (docs/decisions.md)."""
    support_samples: int = 1024
    """`support`: number of (Gaussian, time) pairs per step."""
    support_seconds: float = 4.0
    """`support`: time constant in seconds with which the confidence in an anchor decays, exp(-|dt| / constant)."""
    anchor: str = "hidden"
    """`support`: (Gaussian, time) pairs without contribution that are anchored. hidden: pairs outside the frame or
    behind a surface. unsupported: all pairs."""
    look_every: int = 4
    """`support` with anchor `hidden`: interval in iterations at which hidden Gaussians of the frame are marked."""

    still_weight: float = 22.0
    """`support`: weight of `stillness`, the price of motion, relative to the photometric loss."""
    still_scale: float = 0.15
    """`support`: change above which the price is logarithmic instead of linear; 0.15 is a shift of 0.03 scene units."""
    still_ramp: float = 0.2
    """`support`: share of the run, from `start` on, over which `still_weight` grows from 0. With the full price at once
    the field would learn no motion."""
    still_knee: float = 2e-3
    """`support`: shift in scene units below which the price is quadratic instead of linear."""

    def __post_init__(self) -> None:
        if self.anchor not in ("hidden", "unsupported"):
            raise ValueError(f"anchor is {self.anchor!r}: it should be hidden or unsupported")
        if self.pulls not in ("all", "field"):
            raise ValueError(f"pulls is {self.pulls!r}: it should be all or field")

    def is_hidden_step(self, iteration: int) -> bool:
        """True if hidden Gaussians of the frame are marked at this step."""
        return self.preset == "support" and self.anchor == "hidden" and iteration % self.look_every == 0

    def is_anchor_step(self, iteration: int, progress: float) -> bool:
        """True if `support` anchors at this step. `progress` is the share of the run that is done."""
        return self.preset == "support" and progress >= self.start and iteration % self.support_every == 0

    def is_paper_step(self, iteration: int, progress: float) -> bool:
        """True if `paper` acts at this step."""
        return self.preset == "paper" and progress >= self.start and iteration % self.every == 0


# Weights of the attributes in `support`, chosen so that typical deltas of all attributes have similar weight. Means are
# in scene units.
_ATTRIBUTE_WEIGHTS = {"means": 5.0, "quats": 0.2, "log_scales": 0.2, "opacity_logits": 0.1, "sh0": 0.2, "shN": 0.2}
# Weights of the attributes in `stillness`. Opacity and colour weigh more: they let a Gaussian become another object.
_STILL_WEIGHTS = {"means": 5.0, "quats": 0.5, "log_scales": 0.5, "opacity_logits": 1.0, "sh0": 1.0, "shN": 0.5}
_KNEE = 0.02
"""Below this the support loss is quadratic, above it linear (Charbonnier)."""


@dataclass
class Anchored:
    """(Gaussian, time) pairs to anchor, which no frame supports or contradicts."""

    rows: Tensor
    """[S] int64 rows of the model."""
    bins: Tensor
    """[S] int64 time bins."""
    weights: Tensor
    """[S] 1 for pairs that count, 0 for others."""


@dataclass
class Draws:
    """Random numbers that select the pairs to anchor. They are always drawn on the CPU."""

    picked: Tensor
    """[P] int64 indices into the open rows. The last `support_samples` are near pairs, with a bin near support; the
    others have any bin."""
    anywhere: Tensor
    """[P - support_samples] int64 time bins of the pairs with any bin."""
    start: Tensor
    """[support_samples] float32 in [0, 1): selects a supported bin of the row for each near pair."""
    step: Tensor
    """[support_samples] int64 signed distance in bins of a near pair from that bin."""

    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors in a fixed order."""
        return self.picked, self.anywhere, self.start, self.step


def draw(rows: int, bins: int, config: SupervisionConfig, generator: torch.Generator) -> Draws:
    """Random draws for `rows` open Gaussians and `bins` time bins."""
    count = config.support_samples
    far = _FAR * count
    picked = torch.randint(rows, (far + count,), generator=generator, device="cpu")
    anywhere = torch.randint(bins, (far,), generator=generator, device="cpu")
    start, reach = torch.rand(2, count, generator=generator, device="cpu")
    step = torch.exp(reach * math.log(max(bins, 2))).long()
    sign = 2 * torch.randint(2, (count,), generator=generator, device="cpu") - 1
    return Draws(picked, anywhere, start, sign * step)


def anchored_pairs(model: Gaussians, rows: Tensor, draws: Draws, config: SupervisionConfig) -> Anchored | None:
    """Pairs that `draws` select among the open `rows` [M]; None if no pair needs an anchor. On a GPU, pairs that need
    no anchor stay with weight 0."""
    support = model.support[rows]
    # A Gaussian in plain view that does not contribute is contradicted by the frame: it faded, or its object left.
    lacking = ~support & model.hidden[rows] if config.anchor == "hidden" else ~support
    picked, bins, valid = _pairs(support, lacking, draws)
    rows = rows[picked]
    if rows.device.type == "cpu":
        rows, bins = rows[valid], bins[valid]
        return Anchored(rows, bins, torch.ones(len(rows), device="cpu")) if len(rows) else None
    # To drop pairs, the CPU would have to wait for their number.
    return Anchored(rows, bins, valid.float())


def support_loss(
    model: Gaussians,
    field: Deformation,
    pairs: Anchored,
    deltas: Deltas,
    centres: Tensor,
    seconds: float,
    config: SupervisionConfig,
) -> Tensor:
    """Loss that pulls deltas at unsupported times to deltas interpolated between the nearest supported bins, 0-dim.

    Args:
        deltas: the field's deltas of `pairs`, with gradient.
        centres: [B] normalised times of the bins.
        seconds: length of the trained range, so that confidence decays in seconds.
    """
    rows, bins = pairs.rows, pairs.bins
    left, has_left, right, has_right = nearest_supported(model.support[rows], bins)
    with torch.no_grad():
        # Anchors are targets: they get no gradient, and canonical parameters stay.
        means = model.params["means"][rows]
        host_params = model.host_params(torch.cat([rows, rows]))
        anchors = field(torch.cat([means, means]), torch.cat([centres[left], centres[right]]), host_params)
        near_left = (centres[bins] - centres[left]) * seconds
        near_right = (centres[right] - centres[bins]) * seconds
        share = (near_left / (near_left + near_right).clamp_min(1e-6)).clamp(0.0, 1.0)
        share = torch.where(has_left & has_right, share, torch.where(has_right, 1.0, 0.0))
        distance = torch.minimum(
            torch.where(has_left, near_left, torch.inf), torch.where(has_right, near_right, torch.inf)
        )
        # In seconds, so that confidence does not depend on the length of the clip.
        confidence = torch.exp(-distance / config.support_seconds)
    columns, widths = _columns(anchors)
    first, second = columns.reshape(2, len(rows), -1)
    gap = _columns(deltas)[0] - torch.lerp(first, second, share[:, None])
    weights = tuple((_ATTRIBUTE_WEIGHTS[name],) for name, width in widths for _ in range(width))
    weight = small_table(weights, torch.float32, gap.device)
    total = ((torch.sqrt(gap.square() + _KNEE**2) - _KNEE) @ weight)[:, 0]
    return config.support_weight * (pairs.weights * confidence * total).sum() / pairs.weights.sum().clamp_min(1.0)


def _columns(deltas: Deltas) -> tuple[Tensor, list[tuple[str, int]]]:
    """([M, C] deltas concatenated along columns, name and width of each attribute). One operator on it replaces
    many."""
    parts = {name: value.flatten(1) if value.dim() > 1 else value[:, None] for name, value in deltas.moved().items()}
    return torch.cat(list(parts.values()), dim=1), [(name, part.shape[1]) for name, part in parts.items()]


def still_weight(progress: float, config: SupervisionConfig) -> float:
    """Weight of `stillness` at a share `progress` of the run."""
    return config.still_weight * min(max((progress - config.start) / max(config.still_ramp, 1e-6), 0.0), 1.0)


def stillness(deltas: Deltas, count: int, error: Tensor, weight: Tensor, config: SupervisionConfig) -> Tensor:
    """Price of motion of one frame's `deltas` [M] in a model of `count` Gaussians.

    Each time is seen by one camera only. No other frame penalises a delta that overfits this camera's frame, but the
    error is visible when the instant is seen from another view. Motion must therefore improve the image by more than
    this price.

    Args:
        error: the frame's photometric loss, 0-dim; it scales the price.
        weight: 0-dim, `still_weight` at the run's progress.
    """
    moved, widths = _columns(deltas)
    names = [name for name, _ in widths]
    member = tuple(tuple(float(name == of) for name in names) for of, width in widths for _ in range(width))
    shares = tuple((_STILL_WEIGHTS[name],) for name in names)
    knees = (tuple(config.still_knee * _STILL_WEIGHTS["means"] / _STILL_WEIGHTS[name] for name in names),)
    group, share, knee = (small_table(rows, torch.float32, moved.device) for rows in (member, shares, knees))
    total = ((torch.sqrt(moved.square() @ group + knee.square()) - knee) @ share)[:, 0]
    # Starting to move costs most, moving farther costs little.
    price = config.still_scale * torch.log1p(total / config.still_scale)
    # An image that is harder to fit gains more from any motion, also from a false one. Divided by all Gaussians, so
    # that the price does not depend on how many may move.
    return weight * error.detach() * price.sum() / max(1, count)


# Number of pairs with any bin per near pair. Near pairs are used only if too few of the others are valid.
_FAR = 4


def _pairs(support: Tensor, lacking: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
    """(row, bin, valid) of the drawn pairs. A pair is valid where `lacking` [M, B] is set, in a row with any `support`
    [M, B]. The number of valid pairs is limited to the number of near pairs.

    The first pairs have any bin; the last (near) pairs have a bin at a log-uniform distance from support.
    """
    bins, count, picked = support.shape[1], len(draws.start), draws.picked
    # The k-th supported bin of a row is where the running count first exceeds k.
    seen = support[picked[len(picked) - count :]].cumsum(1)
    near = (seen <= (draws.start * seen[:, -1]).long()[:, None]).sum(1) + draws.step
    chosen = torch.cat([draws.anywhere, near])
    valid = (chosen >= 0) & (chosen < bins)
    chosen = chosen.clamp(0, bins - 1)
    at = (picked, chosen)
    valid &= support.any(1)[picked] & lacking[at]
    # Far pairs come first and fill the limit. Near pairs pull hardest, also on Gaussians whose object left: with
    # weight 1, equal shares gave 22.96 dB, far pairs first 24.39 (bundled clip, held out).
    return picked, chosen, valid & (valid.cumsum(0) <= count)


@dataclass
class PaperView:
    """One of the two views that the paper's rule compares, with the Gaussians' states and supervision."""

    time: float
    """Normalised time."""
    state: dict[str, Tensor]
    """Deformed parameters of M Gaussians (means, quats, log_scales, opacity_logits, sh0)."""
    inside: Tensor
    """bool [M] True if the centre is inside the camera's frustum. The paper calls the other Gaussians `hidden`;
    `Gaussians.hidden` also holds occluded ones."""
    supervised: Tensor
    """bool [M] True if the view's image supervises the Gaussian (`well_supervised`)."""


def well_supervised(
    config: SupervisionConfig, weight: Tensor, norm: Tensor, pull: Tensor, K: Tensor, viewmat: Tensor, means: Tensor,
    size: tuple[int, int],
) -> Tensor:  # fmt: skip
    """bool [M] Gaussians that an image supervises, by the configured detector. Others in its frustum are *defective*.

    Args:
        weight: [M] sum of alpha * T over the image.
        norm: [M] norm of the screen gradient of the image's loss, 1/px.
        pull: [M, 3] gradient of the image's loss in the means.
        K: [3, 3] px; viewmat: [4, 4]; means: [M, 3]; size: (width, height) px of the image.
    """
    if config.detector == "weight":
        return weight > SEEN_WEIGHT
    if config.detector == "grad_norm":
        return norm > config.defective_gradient
    if config.detector != "grad_signed":
        raise ValueError(f"detector is {config.detector!r}: it should be one of {', '.join(DETECTORS)}")
    # The rasteriser returns only the norm of the screen gradient. Its components follow from the gradient of the means
    # across the line of sight, to first order in size over depth.
    across = pull @ viewmat[:3, :3].T
    depth = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
    ndc = [0.5 * size[axis] * across[:, axis] * depth / K[axis, axis] for axis in (0, 1)]
    # As the published code adds them, with sign: about half of the supervised Gaussians fail.
    return ndc[0] + ndc[1] > config.defective_gradient


def paper_loss(first: PaperView, second: PaperView, progress: float, config: SupervisionConfig) -> Tensor | None:
    """Sum of the paper's two terms for a pair of views, 0-dim; None if there is no valid anchor.

    Hidden Gaussians of the later view are anchored to the earlier view. Defective Gaussians of the earlier view are
    anchored to the later view. The reference is detached and must be well supervised: inside the frustum, and
    supervised by the image. Each term is averaged over the Gaussians and summed over the attributes.
    """
    early, late = (first, second) if first.time < second.time else (second, first)
    if early.time == late.time:
        return None
    phi = math.exp(-config.tau * (late.time - early.time))
    linear = progress >= config.switch
    # Hidden states are anchored to the past, defective ones to the future (paper, Temporally-Anchored Regularization).
    hidden = ~late.inside & early.inside & early.supervised
    defective = early.inside & ~early.supervised & late.inside & late.supervised
    terms: list[Tensor] = []
    if bool(hidden.any()):
        terms.append(config.weight_hidden * phi * _discrepancy(late.state, early.state, hidden, linear))
    if bool(defective.any()):
        terms.append(config.weight_defective * phi * _discrepancy(early.state, late.state, defective, linear))
    return torch.stack(terms).sum() if terms else None


def _discrepancy(target: dict[str, Tensor], reference: dict[str, Tensor], chosen: Tensor, linear: bool) -> Tensor:
    """D(theta_A, theta_B) over activated parameters: L1, or squared L2, averaged over the chosen Gaussians."""
    a = _activated(target, chosen)
    b = _activated({k: v.detach() for k, v in reference.items()}, chosen)
    # q and -q are the same rotation: compare with the nearer one.
    b["quats"] = torch.where((a["quats"] * b["quats"]).sum(1, keepdim=True) < 0, -b["quats"], b["quats"])
    gaps = torch.cat([a[k] - b[k] for k in a], dim=1)
    return (gaps.abs() if linear else gaps.square()).sum(1).mean()


def _activated(state: dict[str, Tensor], chosen: Tensor) -> dict[str, Tensor]:
    return {
        "means": state["means"][chosen],
        "log_scales": state["log_scales"][chosen],
        "quats": F.normalize(state["quats"][chosen], dim=1),
        "opacities": torch.sigmoid(state["opacity_logits"][chosen])[:, None],
        "sh": state["sh0"][chosen].flatten(1),
    }
