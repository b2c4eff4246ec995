"""Host C: sparse control points (nodes) that move nearby Gaussians (SC-GS).

A small network of position and time moves the nodes. A Gaussian follows its 3 nearest nodes, in a space of position and
learnt hyper-coordinates; each node rotates it about the node. Changes to the published code: nodes are sampled from the
moving Gaussians, so no separate stage is needed and the host works with the gate. Scales change in the log. A node has
one rotation, for positions and orientations of its Gaussians. Positions are detached everywhere, as published.

`reference` is the published host with these exceptions. Nodes are not densified and pruned at 10,000 steps of stage
two: the trainer does not pass on the screen gradients for it, its threshold is for the published rates of the
Gaussians, and sampling by farthest paths has just spread the nodes. Optional losses on optical flow or masks are left
out. Surrogates are split by a schedule, not by a threshold. Node positions stay fixed after stage one. As for every
host, the trainer implements losses, learning rates and densification of the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..gaussians.model import SH_C0
from ..gaussians.rotations import rotation_matrices
from ..torch_types import backward, norm, split, unflatten, unique_with_inverse
from .geometry import farthest_points, near_identity, nearest
from .geometry import warm_up as warm_up_nearest
from .mlp import Trunk, blurred, linear
from .node_energies import acceleration_energy, arap_energy, elastic_energy
from .protocol import Deformation, Deltas, HostConfig, HostSpec, Owned, Rehearsal, Start, add_to_scale, turn

PUBLISHED_ITERATIONS = 80_000
_FOLLOWED = 3
"""Number of nodes that a Gaussian follows (K)."""
_WINDOW = 0.05
"""ARAP: largest distance of the two times, in normalised time."""
_SURROGATES = 16
"""Pre-training: maximum number of surrogate points per node."""
_PRUNED = 0.005
"""Pre-training: opacity below which surrogates are pruned."""
_INSTANTS = 16
"""Number of times at which a trajectory is sampled."""


@dataclass
class ControlPointsConfig(HostConfig):
    """Sizes, learning rates and weights. SC-GS' values are in brackets (arguments/__init__.py, utils/time_utils.py)."""

    still: float = 0.1
    """See `HostConfig`. This host is smooth by design and bends few walls; a full price would keep it from moving
    people."""
    nodes: int = 192
    """Maximum number of nodes (512); fewer if few Gaussians move."""
    hyper: int = 2
    """Number of hyper-coordinates (8; its readme advises 2 for large real scenes)."""
    depth: int = 4
    """Number of layers of the nodes' network (8)."""
    width: int = 128
    """Width of the layers (256)."""
    position_frequencies: int = 6
    """Octaves of the position encoding (10). Synthetic scene `quick` 0, all Gaussians move, 1500 steps, one seed:
    23.9 dB on moving pixels of held-out frames, 23.6 with 3 octaves, 22.0 for a static model."""
    time_frequencies: int = 4
    """Octaves of the time encoding (10)."""
    published: bool = False
    """Whether to use the published variant (on): coordinates are not normalised, scale deltas are added after
    activation, rotations are added to raw quaternions, and nodes have a separate rotation for positions."""
    lr: float = 5e-4
    """Initial learning rate of the network (8e-4)."""
    lr_end: float = 2e-5
    """Final learning rate of the network (1.6e-6)."""
    until: float = 1.0
    """Share of the run at which the network's rate reaches its final value."""
    lr_nodes: float = 1e-3
    """Learning rate of radii, weights and hyper-coordinates of nodes (8e-4, constant)."""
    lr_hyper: float = 2.5e-3
    """Learning rate of the Gaussians' hyper-coordinates (2.5e-3)."""
    arap: float = 1e-3
    """Initial weight of the as-rigid-as-possible (ARAP) energy (1e-4)."""
    arap_end: float = 1e-4
    """Final weight of the ARAP energy (1e-5)."""
    arap_fall: tuple[float, float] = (0.5, 1.0)
    """Shares of the run between which the ARAP weight falls log-linearly (5000 and 10,000 of stage two)."""
    arap_until: float = 1.0
    """Share of the run after which the ARAP energy is off (20,000 of stage two)."""
    noise: float = 0.0
    """Initial standard deviation, in frames, of noise on training times; it falls linearly to 0 (0.1)."""
    noise_until: float = 0.5
    """Share of the run at which that noise reaches 0."""
    rehearsal: float = 0.0
    """Share of the run for pre-training of the nodes (10,000 of 80,000); 0: nodes are sampled from moving Gaussians."""

    def row_bytes(self) -> int:
        """See `HostConfig.row_bytes`: indices, shares and parameters of the nodes of a Gaussian, and the blend."""
        return 4 * (_FOLLOWED * (3 * (self.hyper + 2) + 4) + 40)


def _reference(iterations: int) -> ControlPointsConfig:
    """Configuration of the published host: stage one takes 10,000 of 80,000 steps; rates as published (see Host B)."""
    total_steps = float(PUBLISHED_ITERATIONS)
    return ControlPointsConfig(
        start=0.0,
        detached=13_000 / total_steps,
        nodes=512,
        hyper=8,
        depth=8,
        width=256,
        position_frequencies=10,
        time_frequencies=10,
        published=True,
        lr=5 * 1.6e-4,
        lr_end=1.6e-6,
        until=50_000 / total_steps,
        lr_nodes=8e-4,
        lr_hyper=2.5e-3,
        arap=1e-4,
        arap_end=1e-5,
        arap_fall=(15_000 / total_steps, 20_000 / total_steps),
        arap_until=30_000 / total_steps,
        noise=0.1,
        noise_until=30_000 / total_steps,
        rehearsal=10_000 / total_steps,
    )


class _Motion(NamedTuple):
    """Motion of R rows, each a node at a time: shift [R, 3], frame [R, 4], quats [R, 4], log_scales [R, 3]."""

    shift: Tensor
    frame: Tensor
    quats: Tensor
    log_scales: Tensor


class ControlPoints(Deformation):
    """Deformation field of M nodes: canonical places [M, 3] (scene units), hyper [M, H], log_radii [M], weights [M]."""

    def __init__(
        self, config: ControlPointsConfig, places: Tensor, box: Tensor, frames: int, generator: torch.Generator
    ):
        super().__init__()
        if not len(places):
            raise ValueError("control points need at least one place to stand")
        self.config, count = config, len(places)
        self.box: Tensor
        self.frames: Tensor
        self.places: Tensor
        self.register_buffer("box", box.float().cpu())
        self.register_buffer("frames", torch.tensor(float(frames), device="cpu"))
        self.frame_count = float(frames)  # value of `frames` in host memory, which avoids a GPU synchronisation
        self.register_buffer("places", places.float())
        self.hyper = nn.Parameter(places.new_full((count, config.hyper), 1e-2))
        self.log_radii = nn.Parameter(_radii(places, config.published).log())
        self.weights = nn.Parameter(places.new_zeros(count))
        octaves = (config.position_frequencies, config.time_frequencies)
        self.trunk = Trunk(config.depth, config.width, octaves, generator, kaiming=True)
        stds = {"means": (3, 1e-5), "quats": (4, 1e-5), "log_scales": (3, 1e-8)}
        if config.published:
            stds["frame"] = (4, 1e-4)
        self.heads = nn.ModuleDict({n: linear(config.width, size, generator, std) for n, (size, std) in stds.items()})
        # The published host adds its rotation to the raw quaternion, as is done without a rule.
        self.rules = {"log_scales": add_to_scale} if config.published else {"quats": turn}
        self.owned = {"hyper": Owned((config.hyper,), -1e-2, config.lr_hyper, 0.1 * config.lr_hyper)}

    @property
    def has_separate_calls(self) -> bool:
        """True: Gaussians at one time share the motion of the nodes, which is computed once per node."""
        return True

    @property
    def rehearsal(self) -> float:
        """Share of the run for pre-training of the nodes."""
        return self.config.rehearsal

    # ------------------------------------------------------------------ motion

    def forward(self, means: Tensor, times: Tensor, host_params: Mapping[str, Tensor] | None = None) -> Deltas:
        """Deltas of M Gaussians; means [M, 3] in scene units (detached), times [M] or [1] in [0, 1].

        host_params: hyper [M, H]; without it, every Gaussian has the initial value.
        """
        x = means.detach()
        hyper = (host_params or {}).get("hyper")
        if hyper is None:
            hyper = x.new_full((len(x), self.config.hyper), self.owned["hyper"].value)
        index, share = self._skin(x, hyper)
        places, motion, at = self._motions(index, times)
        # Blends R - I instead of R, so that a node without motion does not move distant Gaussians by rounding errors.
        turned = rotation_matrices(near_identity(motion.frame)) - torch.eye(3, device=x.device)
        offset = motion.shift - (turned @ places[..., None])[..., 0]
        rows = torch.cat([turned.flatten(1), offset, motion.quats, motion.log_scales], dim=1)
        blend = F.embedding_bag(at, rows, per_sample_weights=share, mode="sum")
        turned, offset, quats, log_scales = split(blend, (9, 3, 4, 3), 1)
        means = (unflatten(turned, 1, (3, 3)) * x[:, None, :]).sum(2) + offset
        return Deltas(means=means, quats=quats, log_scales=log_scales)

    def _skin(self, x: Tensor, hyper: Tensor) -> tuple[Tensor, Tensor]:
        """(nodes followed [M, K], weights [M, K]) of Gaussians at x [M, 3] with hyper [M, H]. Weights sum to 1."""
        with torch.no_grad():
            joint, nodes = torch.cat([x, hyper], dim=1), torch.cat([self.places, self.hyper], dim=1)
            index = nearest(joint, nodes, min(_FOLLOWED, len(nodes)))
            squared_distance = (x[:, None] - self.places[index]).square().sum(2)
        reach, weight = -0.5 * torch.exp(-2.0 * self.log_radii), torch.sigmoid(self.weights)
        node_params = F.embedding(index, torch.cat([self.hyper, reach[:, None], weight[:, None]], dim=1))
        squared = squared_distance + (hyper[:, None] - node_params[..., :-2]).square().sum(2)
        share = torch.exp(squared * node_params[..., -2]) * node_params[..., -1] + 1e-7
        return index, share / share.sum(1, keepdim=True)

    def _motions(self, index: Tensor, times: Tensor) -> tuple[Tensor, _Motion, Tensor]:
        """(places [R, 3], their motions, row of each node [M, K]) for nodes `index` [M, K] at times [M] or [1].

        On the CPU, each pair of node and time is computed once.
        """
        if times.shape[0] == 1:
            return self.places, self.node_motion(self.places, times), index
        if index.device.type != "cpu":
            # Removing duplicates would synchronise with the GPU. `has_separate_calls` keeps these rows few.
            rows = torch.arange(index.numel(), device=index.device).view_as(index)
            places = self.places[index.flatten()]
            return places, self.node_motion(places, times.repeat_interleave(index.shape[1])), rows
        instants, which = unique_with_inverse(times)
        pairs, at = unique_with_inverse(index * len(instants) + which[:, None])
        places = self.places[pairs // len(instants)]
        return places, self.node_motion(places, instants[pairs % len(instants)]), at

    def node_motion(self, places: Tensor, times: Tensor) -> _Motion:
        """Motion of nodes at places [R, 3] (detached) and times [R] or [1], by the network."""
        positions = places.detach()
        if not self.config.published:
            positions = 2.0 * (positions - self.box[0]) / (self.box[1] - self.box[0]) - 1.0
            times = 2.0 * times - 1.0
        hidden = self.trunk(positions, times)
        out = {name: head(hidden) for name, head in self.heads.items()}
        return _Motion(out["means"], out.get("frame", out["quats"]), out["quats"], out["log_scales"])

    def trajectories(self, places: Tensor, times: Tensor) -> Tensor:
        """[T, R, 3] positions at times [T] of nodes at places [R, 3]."""
        rows = places.detach().repeat(len(times), 1)
        shift = self.node_motion(rows, times.repeat_interleave(len(places))).shift
        return places + shift.view(len(times), len(places), 3)

    def training_time(self, time: float, progress: float, generator: torch.Generator) -> float:
        """`time` with noise as in Host B (`mlp.blurred`)."""
        return blurred(time, self.frame_count, progress, self.config.noise, self.config.noise_until, generator)

    # ------------------------------------------------------------------ training

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Two groups: the nodes and the network. In the published configuration, the nodes' rate does not decay."""
        c = self.config
        nodes = [self.hyper, self.log_radii, self.weights]
        network = [*self.trunk.parameters(), *self.heads.parameters()]
        end = c.lr_nodes if c.published else 0.1 * c.lr_nodes
        return [
            {"params": nodes, "lr": c.lr_nodes, "lr_end": end, "name": "nodes"},
            {
                "params": network,
                "lr": c.lr,
                "lr_end": c.lr_end,
                "since": c.rehearsal,
                "until": c.until,
                "name": "field",
            },
        ]

    def regularisation(self, progress: float = 1.0, generator: torch.Generator | None = None) -> Tensor:
        """ARAP energy of at most 512 nodes at two near times, weighted by the schedule."""
        weight = self._arap_weight(progress)
        if weight <= 0.0 or len(self.places) < 2:
            return self.places.new_zeros(())
        places = self.places
        if len(places) > 512:
            sample = torch.randperm(len(places), generator=generator, device="cpu")[:512]
            places = places[sample.to(places.device, non_blocking=True)]
        times = _near_times(2, _WINDOW, generator).to(places.device, non_blocking=True)
        return weight * arap_energy(*self.trajectories(places, times))

    def _arap_weight(self, progress: float) -> float:
        c = self.config
        if progress > c.arap_until:
            return 0.0
        first, last = c.arap_fall
        share = min(max((progress - first) / max(last - first, 1e-9), 0.0), 1.0)
        return c.arap * (c.arap_end / c.arap) ** share if c.arap > 0 else 0.0

    def paths(self, places: Tensor) -> Tensor:
        """[R, 3 * 16] features of places [R, 3], whose distance is the RMS distance of the places' trajectories."""
        times = torch.linspace(0.0, 1.0, _INSTANTS, device=places.device)
        paths = torch.cat([self.trajectories(chunk, times) for chunk in split(places, 1024)], dim=1)
        return paths.transpose(0, 1).flatten(1) / math.sqrt(_INSTANTS)

    def rehearse(self, stage: Rehearsal) -> None:
        """Runs SC-GS' stage one: trains moving surrogate balls of one size, and samples nodes from them.

        The first fifth of the steps is static. At three quarters, nodes are sampled by farthest trajectories, and are
        trained alone afterwards. Until then, surrogates are split (`_Surrogates`).
        """
        _Surrogates(self, stage).run()

    @torch.no_grad()
    def place(self, places: Tensor) -> None:
        """Sets the nodes to places [M, 3] and resets their parameters. Call it before an optimiser refers to them."""
        self.places = places.detach().clone()
        count = len(places)
        self.hyper = nn.Parameter(self.hyper.new_full((count, self.config.hyper), 1e-2))
        self.log_radii = nn.Parameter(_radii(places, self.config.published).log())
        self.weights = nn.Parameter(self.weights.new_zeros(count))

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `state`, for any number of nodes."""
        self.place(tensors["field.places"])
        super().load_state(tensors)
        self.frame_count = float(self.frames)


def _with_rows(old: nn.Parameter, kept: Tensor | None, fresh: Tensor, optimizer: torch.optim.Optimizer) -> nn.Parameter:
    """Parameter of the rows `kept` [K] of `old` (None: all) and rows `fresh`, which get zero optimiser moments."""

    def rows(values: Tensor) -> Tensor:
        return values if kept is None else values[kept]

    new = nn.Parameter(torch.cat([rows(old.detach()), fresh]))
    state = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {
            key: torch.cat([rows(value), torch.zeros_like(fresh)]) if value.shape == old.shape else value
            for key, value in state.items()
        }
    for group in optimizer.param_groups:
        group["params"] = [new if p is old else p for p in group["params"]]
    return new


# ---------------------------------------------------------------------- penalties


def _near_times(count: int, window: float, generator: torch.Generator | None) -> Tensor:
    """[count] random times in [0, 1] within a window around a random time."""
    draw = torch.rand(1 + count, generator=generator, device="cpu")
    return (draw[0] + window * (draw[1:] - 0.5)).clamp(0.0, 1.0)


def _radii(places: Tensor, published: bool) -> Tensor:
    """[M] initial radii of nodes: published a tenth of the scene's range, ours the mean distance to 3 neighbours."""
    if published or len(places) < 2:
        return torch.full_like(places[:, 0], max(0.1 * float(places.max() - places.min()), 1e-3))
    index = nearest(places, places, min(4, len(places)))[:, 1:]
    return norm(places[index] - places[:, None], dim=2).mean(1).clamp_min(1e-3)


# ---------------------------------------------------------------------- stage one of the published host


class _Surrogates:
    """Surrogate balls of one common size and SH degree 0, which are trained to find the motion for the nodes.

    As published, they are split at every hundredth of the stage from a twentieth on; up to 16 per node.
    """

    def __init__(self, field: ControlPoints, stage: Rehearsal) -> None:
        self.field, self.stage = field, stage
        points, colors = stage.points, stage.colors
        limit = _SURROGATES * field.config.nodes
        if len(points) > limit:
            kept = torch.randperm(len(points), generator=stage.generator, device="cpu")[:limit].to(points.device)
            points, colors = points[kept], colors[kept]
        # Mean spacing of the points: the common size of the balls.
        near = nearest(points, points, min(4, len(points)))[:, 1:]
        spacing = norm(points[near] - points[:, None], dim=2).median().clamp_min(1e-3)
        self.scale = nn.Parameter(spacing.log().reshape(1))
        self.params = {
            "means": nn.Parameter(points.clone()),
            "opacity_logits": nn.Parameter(points.new_full((len(points),), math.log(0.1 / 0.9))),
            "sh0": nn.Parameter(((colors - 0.5) / SH_C0)[:, None, :].clone()),
        }
        self.optimizer = self._optimiser()
        self.pull, self.limit = torch.zeros_like(points[:, 0]), limit

    def run(self) -> None:
        """Runs all steps, then sets the field's nodes."""
        stage, field = self.stage, self.field
        warm, sampling = round(0.2 * stage.steps), round(0.75 * stage.steps)
        # At least 10 steps, so that several frames contribute to a decision.
        first, every = round(0.05 * stage.steps), max(10, round(0.01 * stage.steps))
        for step in range(stage.steps):
            if first < step < sampling and step % every == 0:
                self._multiply(1 + (sampling - 1 - step) // every)
            if step == sampling:
                self._draw_nodes()
            frame = int(torch.randint(len(stage.times), (1,), generator=stage.generator, device="cpu"))
            state = self._state(frame, moving=step >= warm)
            state["means"].retain_grad()
            loss = stage.loss(state, frame)
            if step >= warm:
                loss = loss + self._penalties()
            self.optimizer.zero_grad(set_to_none=True)
            backward(loss)
            if bool(torch.isfinite(loss)):
                self.optimizer.step()
                if state["means"].grad is not None:
                    self.pull += norm(state["means"].grad, dim=1)
        field.place(self.params["means"].detach())

    def _state(self, frame: int, moving: bool) -> dict[str, Tensor]:
        means = self.params["means"]
        if moving:
            time = torch.tensor([self.stage.times[frame]], device=means.device)
            means = means + self.field.node_motion(means, time).shift
        count = len(means)
        quats = means.new_zeros(count, 4)
        quats[:, 0] = 1.0
        return {
            **self.params,
            "means": means,
            "quats": quats,
            "log_scales": self.scale.expand(count, 3),
            "shN": means.new_zeros(count, 0, 3),
        }

    def _penalties(self) -> Tensor:
        generator, means = self.stage.generator, self.params["means"]
        if len(means) > 512:
            means = means[torch.randperm(len(means), generator=generator, device="cpu")[:512].to(means.device)]
        frame = 1.0 / float(self.field.frames)
        middle = _near_times(1, 0.0, generator)
        around = middle + 3.0 * frame * torch.tensor([-1.0, 0.0, 1.0], device="cpu")
        times = torch.cat(
            [_near_times(2, _WINDOW, generator), _near_times(8, frame, generator), around.clamp(0.0, 1.0)]
        )
        paths = self.field.trajectories(means, times.to(means.device))
        return (
            1e-2 * arap_energy(paths[0], paths[1])
            + 1e-3 * elastic_energy(paths[2:10])
            + 1e-5 * acceleration_energy(paths[10:])
        )

    @torch.no_grad()
    def _multiply(self, rounds: int) -> None:
        """Drops transparent surrogates, and adds copies near those with the largest gradients."""
        is_visible = torch.sigmoid(self.params["opacity_logits"]) >= _PRUNED
        kept = (
            torch.nonzero(is_visible).flatten()
            if bool(is_visible.any())
            else torch.arange(len(is_visible), device=is_visible.device)
        )
        # By schedule, because the published threshold is on screen gradients, which this stage does not have.
        more = min(len(kept), max(0, self.limit - len(kept)) // rounds)
        parents = kept[self.pull[kept].topk(more).indices]
        spread = torch.randn(more, 3, generator=self.stage.generator, device="cpu").to(parents.device)
        fresh = {name: value.detach()[parents] for name, value in self.params.items()}
        fresh["means"] = fresh["means"] + self.scale.exp() * spread
        self.params = {n: _with_rows(p, kept, fresh[n], self.optimizer) for n, p in self.params.items()}
        self.pull = torch.zeros_like(self.params["means"][:, 0])

    @torch.no_grad()
    def _draw_nodes(self) -> None:
        rows = farthest_points(self.field.paths(self.params["means"].detach()), self.field.config.nodes)
        self.params = {name: nn.Parameter(value.detach()[rows]) for name, value in self.params.items()}
        self.pull = torch.zeros_like(self.params["means"][:, 0])
        self.optimizer = self._optimiser()

    def _optimiser(self) -> torch.optim.Optimizer:
        network = [p for group in self.field.parameter_groups() if group["name"] == "field" for p in group["params"]]
        groups = [
            {"params": network, "lr": self.field.config.lr},
            {"params": [self.params["means"]], "lr": 8e-4},
            {"params": [self.scale], "lr": 5e-3},
            {"params": [self.params["opacity_logits"]], "lr": 5e-2},
            {"params": [self.params["sh0"]], "lr": 2.5e-3},
        ]
        return torch.optim.Adam(groups, eps=1e-15)


def _create(config: ControlPointsConfig, start: Start) -> ControlPoints:
    """A field whose nodes are the farthest of the moving means. Pre-training, if configured, replaces them later."""
    count = max(1, min(config.nodes, len(start.means) // 8))
    places = start.means[farthest_points(start.means, count)] if len(start.means) else start.box.mean(0)[None]
    return ControlPoints(config, places, start.box, start.frames, start.generator)


def _restore(config: ControlPointsConfig, tensors: dict[str, Tensor]) -> ControlPoints:
    generator = torch.Generator(device="cpu").manual_seed(0)
    field = ControlPoints(config, tensors["field.places"], tensors["field.box"], 1, generator)
    field.load_state(tensors)
    return field


def _warm_up(config: ControlPointsConfig) -> None:
    warm_up_nearest()


HOST = HostSpec("control_points", ControlPointsConfig, _reference, _create, _restore, _warm_up)
