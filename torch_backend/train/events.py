"""Events between two steps of a run: raising the SH degree, densification, opening and hardening of the gate."""

from __future__ import annotations

from torch import Tensor

from ..deformation import Deformation, Rehearsal, Start, field_box, host
from ..gaussians import PRUNE_STOP
from .losses import photometric
from .movers import close_still, harden, on_trial
from .optimizer import add_field, limit_harmonics
from .repair import drop_displaced
from .trainer import Trainer


def schedule_events(trainer: Trainer) -> None:
    """Runs the events that are due before the next step: SH degree, densification, the gate."""
    if not trainer.extensions:
        _due_events(trainer)
    trainer.model.open_rows()  # updates the cached rows here, so that the step itself does not synchronise with the GPU


def _due_events(trainer: Trainer) -> None:
    c = trainer.config
    for decision in trainer.policy.decide(trainer):
        trainer.model.sh_degree = decision.degree
        limit_harmonics(trainer.model.gaussians, trainer.optimizer, decision.degree)
    degree = min(c.sh_degree, int(trainer.progress / c.sh_every)) if c.sh_every > 0 else c.sh_degree
    trainer.model.sh_degree = trainer.policy.sh_degree(degree)
    if c.poses.on and not trainer.refined and trainer.progress >= c.poses.until:
        trainer.freeze_poses()
    is_due = trainer.iteration > 0 and trainer.iteration % c.densify.every == 0
    if is_due and c.densify.start <= trainer.progress < PRUNE_STOP:
        if trainer.recorder is not None:
            trainer.recorder.forget()  # growth replaces the tensors that recordings use, and needs their memory
        trainer.densifier.step(
            trainer.model.gaussians, trainer.optimizer, trainer.initial, trainer.progress, trainer.policy.growing
        )
        if trainer.policy.facts.hardened is not None:  # not in methods without a gate, which stay as published
            drop_displaced(trainer.model, trainer.optimizer, trainer.densifier, trainer.soundness.memory)
    if c.method == "static":
        return
    if c.method == "auto":
        # Repeated if GPU memory ran out in this step: while there is no field, the gate has not opened.
        if trainer.iteration == round(c.gate.start * c.iterations) and trainer.model.field is None:
            open_gate(trainer)
        elif _trial_is_due(trainer):
            harden_gate(trainer)
        elif trainer.iteration == round(c.densify.stop * c.iterations) and trainer.policy.facts.hardened is not None:
            trainer.inspect_nonfinite()
            close_still(trainer)
    elif trainer.model.field is None and trainer.progress >= c.field.start:
        trainer.model.gaussians.open[:] = True
        _create_field(trainer)


def open_gate(trainer: Trainer) -> None:
    """Opens Gaussians on trial (`movers.on_trial`), and creates the deformation field if there are any."""
    model = trainer.model.gaussians
    model.open |= on_trial(trainer)
    if bool(model.open.any()):
        _create_field(trainer)


def _trial_is_due(trainer: Trainer) -> bool:
    """True if the trial (`movers.on_trial`) is judged at this step.

    That is at `harden`, and then at intervals until a Gaussian moves or the run reaches `give_up`.
    """
    c = trainer.config
    if trainer.model.field is None or trainer.policy.facts.hardened is not None:
        return False
    first, last, every = (round(share * c.iterations) for share in (c.gate.harden, c.gate.give_up, 0.05))
    return first <= trainer.iteration <= last and (
        (trainer.iteration - first) % max(1, every) == 0 or trainer.iteration == last
    )


def harden_gate(trainer: Trainer) -> None:
    """Closes the Gaussians that did not move and those that only lie next to movers. Before `give_up`, the trial
    continues if nothing moves."""
    trainer.inspect_nonfinite()  # a NaN would spread to the decisions on neighbours
    if trainer.model.field is None or not len(trainer.model.open_rows()):
        return
    if harden(trainer):
        close_still(trainer)
        trainer.policy.gate_hardened(trainer.iteration)


def _create_field(trainer: Trainer) -> None:
    trainer.inspect_nonfinite()  # a NaN would spread to the field's bounds
    model, c = trainer.model.gaussians, trainer.config
    means = model.params["means"].detach()[model.open].cpu()
    harmonics = model.params["shN"].shape[1]
    start = Start(
        means, field_box(means), trainer.scene.points, len(trainer.train_ids), harmonics, trainer.generator,
        lambda: trainer.policy.time_nodes(trainer),
    )  # fmt: skip
    field = host(c.host).create(c.field, start).to(trainer.device)
    # With the gate, the opened Gaussians already show where the motion is.
    if field.rehearsal > 0 and c.method != "auto":
        _rehearse(trainer, field)
    for name, owned in field.owned.items():
        if name not in model.params:  # an earlier attempt may have run out of memory after some of them
            model.adopt(name, owned.shape, owned.value)
    trainer.soundness.memory.keep(field, means)
    # From here on, nothing allocates memory. Everything before can be repeated after an out-of-memory error.
    add_field(trainer.optimizer, field, model, c, trainer.soundness.memory.rates)
    trainer.policy.field_opened(trainer.iteration, trainer.trained_seconds)
    trainer.model.field = field


def _rehearse(trainer: Trainer, field: Deformation) -> None:
    """Runs the host's pre-training; its steps count as steps of the run. It restarts if it was interrupted."""
    steps = round(field.rehearsal * trainer.config.iterations)

    def loss(state: dict[str, Tensor], frame: int) -> Tensor:
        trainer.report.check_cancelled()
        out = trainer.render_trained(state, frame, sh_degree=0, with_contributions=False)
        ignored = trainer.ignored_at(trainer.train_ids[frame])
        return photometric(out.colors[0], trainer.image_of(frame), trainer.config.dssim, ignored)

    points, colors = (t.to(trainer.device) for t in (trainer.scene.points, trainer.scene.colors))
    field.rehearse(Rehearsal(points, colors, trainer.times, steps, loss, trainer.generator))
    trainer.iteration += steps
