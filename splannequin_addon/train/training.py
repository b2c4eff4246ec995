"""The effect of the Train button: start, resume, add steps, or start again. No bpy."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from ..shot import checkpoints
from ..shot.shot_state import ShotState


@dataclass(frozen=True)
class Plan:
    """Effect of the Train button."""

    kind: str
    """train, resume, extension (resume the addition of steps), extend, or anew."""
    button: str
    """Label of the button."""
    words: str
    """Sentence about the effect; empty if the label is sufficient."""


def plan(state: ShotState | None, run: str, preset: str, depth: str = "") -> Plan:
    """The effect of the Train button on the run of this name with this preset.

    `depth` is the absolute path of the selected depth maps. If empty, the run's depth maps are used, if it has any.
    """
    finished = state.runs.get(run) if state is not None else None
    paused = state.unfinished.get(run) if state is not None else None
    stored = finished or paused
    if stored is None:
        return Plan("train", "Train", "")
    if _can_resume_anew(stored, preset, depth):
        words = "Paused while the run was being retrained. The run does not change until the new training is done."
        return Plan("resume", "Resume", words)
    if stored.get("has_new_cameras"):
        return Plan(
            "anew", "Train from Scratch", "The camera was solved again. Training starts over and replaces this run "
            "when done. Give the run another name to keep it."
        )  # fmt: skip
    if stored.get("preset", preset) != preset:
        return Plan(
            "anew", "Train from Scratch", "This run has a different preset. Training starts over and replaces this run "
            "when done. Give the run another name to keep it."
        )  # fmt: skip
    if not _same_depth(stored, depth):
        return Plan(
            "anew", "Train from Scratch", "This run has a different depth sequence or none. Training starts over and "
            "replaces this run when done. Give the run another name to keep it."
        )  # fmt: skip
    if finished is None:
        return Plan("resume", "Resume", "Paused. Training continues exactly where it stopped.")
    if finished.get("extension") is not None:
        return Plan(
            "extension",
            "Resume",
            "Paused while steps were being added. The run does not change until all steps are done.",
        )
    return Plan(
        "extend", "Continue Training", "Adds these steps to the run. The run does not change until all steps are done."
    )


def _can_resume_anew(stored: dict[str, Any], preset: str, depth: str) -> bool:
    """True if the run's repeated training has this preset, these depth maps and the shot's current cameras."""
    anew = stored.get("anew")
    return (
        anew is not None and anew["preset"] == preset and not anew["has_new_cameras"] and _same_depth(anew, depth)
    )  # fmt: skip


def _same_depth(stored: dict[str, Any], depth: str) -> bool:
    """True if a run has these depth maps, or if none are selected."""
    return not depth or os.path.normcase(stored.get("depth_source", "")) == os.path.normcase(depth)


def params(
    state: ShotState | None, run: str, preset: str, steps: int, device: str, depth: str = ""
) -> contract.TrainParams:
    """Training parameters. `steps` are added if the run is finished. `depth` is as in `plan`."""
    kind = plan(state, run, preset, depth).kind
    if state is not None and kind == "resume":
        # Use the run's settings, not the panel's, so that a run started on the command line also resumes.
        stored = state.runs.get(run) or state.unfinished[run]
        begun = stored["anew"] if _can_resume_anew(stored, preset, depth) else stored
        settings = checkpoints.params_of(begun["config"])
        return contract.TrainParams(run=run, device=device, depth=begun.get("depth_source", ""), **settings)
    extend = 0
    if state is not None and kind == "extension":
        extend = int(state.runs[run]["extension"]["steps"])
    elif kind == "extend":
        extend = steps
    chosen = "" if extend else depth
    return contract.TrainParams(run=run, preset=preset, device=device, extend=extend, depth=chosen)


def history(stored: dict[str, Any], now: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """(seconds, dB) of a run, or of the training that will replace it: stored points, then the job's `now`."""
    before = (stored.get("anew") or stored).get("history", [])
    return [point for point in before if not now or point[0] < now[0][0]] + list(now)


def preview(stored: dict[str, Any], now: str | None) -> Path | None:
    """Latest preview image of a run, or of the training that will replace it: the job's `now`, else a stored one."""
    return Path(now) if now else (stored.get("anew") or stored).get("preview")
