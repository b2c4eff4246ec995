"""Table at the end of a run: modelled components with their cost and gain."""

from __future__ import annotations

from typing import Any

from ..torch_types import norm
from .trainer import Trainer


def modelled(trainer: Trainer) -> list[dict[str, Any]]:
    """Rows of the end-of-run table, one per modelled component.

    Columns: seconds of training, ms_per_step, bytes of parameters and gain_db on the probe frames; None where not
    measured.
    """
    model, c, policy, facts = trainer.model, trainer.config, trainer.policy, trainer.policy.facts
    count = len(model.gaussians)
    steps, seconds = trainer.iteration, trainer.trained_seconds
    if facts.opened is not None:
        steps, seconds = facts.opened.iteration, facts.opened.seconds
    plain = sum(p[:1].numel() for name, p in model.gaussians.params.items() if name != "shN")
    rows = [
        _row("static world", f"{count} Gaussians; {steps} steps", seconds, steps, 4 * plain * count),
        _row("growth", _growth(trainer), size=4 * (plain + model.gaussians.params["shN"][:1].numel())
             * (count - trainer.initial)),
    ]  # fmt: skip
    for degree in range(1, c.sh_degree + 1):
        gain = policy.degrees.get(degree)
        kept = degree <= model.sh_degree
        detail = "kept" if kept else "dropped" if gain is not None else "not tried"
        size = 4 * count * 3 * (2 * degree + 1) if kept else 0
        rows.append(_row(f"SH degree {degree}", detail, size=size, gain=gain))
    if c.exposure.on:
        values = model.exposure.values
        detail = f"{len(values)} times"
        rows.append(_row("exposure", detail, size=4 * values.numel(), gain=facts.exposure_gain_db))
    if c.poses.on:
        values = trainer.poses.values
        turn = float(norm(values.detach()[:, :3], dim=1).mean()) * float(trainer.Ks[0, 0, 0])
        detail = f"{len(values)} cameras, turned by {turn:.2f} px on average"
        rows.append(_row("poses", detail, size=4 * values.numel(), gain=facts.poses_gain_db))
    if model.field is not None:
        rows.append(_moving(trainer, trainer.iteration - steps, trainer.trained_seconds - seconds))
        if c.supervision.preset != "none":
            rows.append(_row("anchors", c.supervision.preset))
    if policy.stopped is not None:
        end = policy.end
        rows.append(_row("end", f"stopped at step {end} of {c.iterations}: nothing more was gained"))
    rows += [_row("extension", f"{e.steps} steps from step {e.from_iteration} on") for e in trainer.extensions]
    return rows


def _row(
    what: str, detail: str, seconds: float | None = None, steps: int = 0, size: int | None = None,
    gain: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    return {
        "what": what,
        "detail": detail,
        "seconds": None if seconds is None else round(seconds, 2),
        "ms_per_step": None if seconds is None or not steps else round(1000.0 * seconds / steps, 2),
        "bytes": size,
        "gain_db": None if gain is None else round(gain, 3),
    }


def _growth(trainer: Trainer) -> str:
    policy, count = trainer.policy, len(trainer.model.gaussians)
    text = f"{trainer.initial} to {count} Gaussians"
    if policy.growth_ended is not None:
        text += f", ended at step {policy.growth_ended}"
    gain = policy.facts.growth_gain_db
    return text if gain is None else f"{text}; at most {gain:.2f} dB per 10 % more"


def _moving(trainer: Trainer, steps: int, seconds: float) -> dict[str, Any]:
    model, gain = trainer.model, trainer.policy.facts.field_gain_db
    field = model.field
    if field is None:
        raise RuntimeError("nothing moves")
    size = 4 * sum(p.numel() for p in field.parameters())
    moving = len(model.open_rows())
    detail = f"{moving} Gaussians ({100.0 * moving / max(1, len(model.gaussians)):.1f} %), {trainer.config.host}"
    nodes = trainer.policy.facts.time_nodes
    if nodes:
        detail += f", {nodes} time nodes"
    return _row("moving Gaussians", f"{detail}; {steps} steps", seconds, steps, size, gain)
