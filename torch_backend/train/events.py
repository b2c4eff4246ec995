"""What happens between two steps of a run: harmonics are added, Gaussians multiply, the gate opens and hardens."""

from __future__ import annotations

from torch import Tensor

from ..deformation import Deformation, Rehearsal, Start, field_box, host
from .losses import photometric
from .movers import close_strays, harden, on_trial
from .optimizer import add_field, limit_harmonics
from .repair import drop_thrown
from .trainer import Trainer


def schedule_events(trainer: Trainer) -> None:
    """What happens between steps: SH degree, densification, the gate."""
    if not trainer.extensions:
        _due_events(trainer)
    trainer.model.open_rows()  # asked again where they changed: the step itself shall not wait for a GPU


def _due_events(trainer: Trainer) -> None:
    c = trainer.config
    for decision in trainer.policy.decide(trainer):
        trainer.model.sh_degree = decision.degree
        limit_harmonics(trainer.model.gaussians, trainer.optimizer, decision.degree)
    degree = min(c.sh_degree, int(trainer.progress / c.sh_every)) if c.sh_every > 0 else c.sh_degree
    trainer.model.sh_degree = trainer.policy.sh_degree(degree)
    if c.poses.on and not trainer.refined and trainer.progress >= c.poses.until:
        trainer.freeze_poses()
    due = trainer.iteration > 0 and trainer.iteration % c.densify.every == 0
    if due and c.densify.start <= trainer.progress < 0.9:
        if trainer.recorder is not None:
            trainer.recorder.forget()  # growth takes the place of what they read, and needs the room
        trainer.densifier.step(
            trainer.model.gaussians, trainer.optimizer, trainer.initial, trainer.progress, trainer.policy.growing
        )
        if trainer.policy.facts.hardened is not None:  # bare hosts are as they were published
            drop_thrown(trainer.model, trainer.optimizer, trainer.densifier, trainer.soundness.memory)
    if c.method == "static":
        return
    if c.method == "auto":
        # Once more if a card's memory ended in that step: as long as there is no field the gate did not open.
        if trainer.iteration == round(c.gate.start * c.iterations) and trainer.model.field is None:
            open_gate(trainer)
        elif _on_trial(trainer):
            harden_gate(trainer)
        elif trainer.iteration == round(c.densify.stop * c.iterations) and trainer.policy.facts.hardened is not None:
            trainer.inspect_nonfinite()
            close_strays(trainer)
    elif trainer.model.field is None and trainer.progress >= c.field.start:
        trainer.model.gaussians.open[:] = True
        _create_field(trainer)


def open_gate(trainer: Trainer) -> None:
    """Opens Gaussians on trial (`movers.on_trial`), and creates the deformation field if there are any."""
    model = trainer.model.gaussians
    model.open |= on_trial(trainer)
    if bool(model.open.any()):
        _create_field(trainer)


def _on_trial(trainer: Trainer) -> bool:
    """Is the trial judged now? At `harden`, and as long as nothing has begun to move, again until `give_up`."""
    c = trainer.config
    if trainer.model.field is None or trainer.policy.facts.hardened is not None:
        return False
    first, last, every = (round(share * c.iterations) for share in (c.gate.harden, c.gate.give_up, 0.05))
    return first <= trainer.iteration <= last and (
        (trainer.iteration - first) % max(1, every) == 0 or trainer.iteration == last
    )


def harden_gate(trainer: Trainer) -> None:
    """Closes for good what did not move or only stands beside it. While nothing moves at all, the trial goes on."""
    trainer.inspect_nonfinite()  # one NaN would spoil the neighbours' verdicts
    if trainer.model.field is None or not len(trainer.model.open_rows()):
        return
    if harden(trainer):
        close_strays(trainer)
        trainer.policy.gate_hardened(trainer.iteration)


def _create_field(trainer: Trainer) -> None:
    trainer.inspect_nonfinite()  # and every bound of the field
    model, c = trainer.model.gaussians, trainer.config
    means = model.params["means"].detach()[model.open].cpu()
    harmonics = model.params["shN"].shape[1]
    start = Start(
        means, field_box(means), trainer.scene.points, len(trainer.train_ids), harmonics, trainer.generator,
        lambda: trainer.policy.time_nodes(trainer),
    )  # fmt: skip
    field = host(c.host).create(c.field, start).to(trainer.device)
    # Behind the gate the Gaussians that open say where the motion is.
    if field.rehearsal > 0 and c.method != "auto":
        _rehearse(trainer, field)
    for name, owned in field.owned.items():
        if name not in model.params:  # memory may have ended between two of them
            model.adopt(name, owned.shape, owned.value)
    trainer.soundness.memory.keep(field, means)
    # Takes no memory: what is before it can be done again.
    add_field(trainer.optimizer, field, model, c, trainer.soundness.memory.rates)
    trainer.policy.field_opened(trainer.iteration, trainer.trained_seconds)
    trainer.model.field = field


def _rehearse(trainer: Trainer, field: Deformation) -> None:
    """The host's pre-stage; its steps are steps of the run. Interrupted, it starts again."""
    steps = round(field.rehearsal * trainer.config.iterations)

    def loss(state: dict[str, Tensor], frame: int) -> Tensor:
        trainer.report.check_cancelled()
        out = trainer.render_trained(state, frame, sh_degree=0, with_contributions=False)
        ignored = trainer.ignored_at(trainer.train_ids[frame])
        return photometric(out.colors[0], trainer.image_of(frame), trainer.config.dssim, ignored)

    points, colors = (t.to(trainer.device) for t in (trainer.scene.points, trainer.scene.colors))
    field.rehearse(Rehearsal(points, colors, trainer.times, steps, loss, trainer.generator))
    trainer.iteration += steps
