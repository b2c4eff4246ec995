"""What the backend is asked for when it is to write a job for a render farm."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from ...torch_backend.contract.files import is_json_object
from ..process import backend, children

REQUEST = "request.json"
"""Parameters of the steps, in the job's folder."""


@dataclass(frozen=True)
class Words:
    """What a job for a farm is asked for, besides the parameters of its steps; as `contract.verbs.FarmWords`."""

    action: str = "export"
    """export or measure."""
    t_star: str = ""
    """Instants with commas; empty: the scene's."""
    t_star_list: str = ""
    """File with instants of each shot; empty: none."""
    frames: int = 10
    """Frames of a task."""
    bake: bool = False
    """Takes go through Blender, too."""
    shots_folder: str = ""
    """Where shots of clips are made; empty: beside each."""
    shots_per_job: int = 0
    """Shots of one template; 0: the backend's own number."""
    rates: str = ""
    """Rates to estimate with; empty: the backend's own."""


def begin(shots: Sequence[str], output: Path, words: Words, requests: dict[str, Any]) -> children.Question:
    """Has the backend write a job, without waiting.

    Args:
        shots: shot folders and clips.
        output: folder for the job.
        words: what it is asked for.
        requests: step -> its parameters, those of `contract.PARAMS` or dicts of some of them; written into `output`.

    Raises:
        contract.JobError: there is no backend, or it cannot be started; OSError: the folder cannot be written.
    """
    backend.python()  # before anything is written
    said = ["farm", words.action, *shots, "--output", str(output)]
    if words.action == "export":
        told: dict[str, dict[str, Any]] = {
            kind: params if is_json_object(params) else dataclasses.asdict(params) for kind, params in requests.items()
        }
        contract.write_json(output / REQUEST, told)
        said += ["--request", str(output / REQUEST), "--frames", str(words.frames)]
        if told.get("freeze", {}).get("device"):
            said += ["--device", told["freeze"]["device"]]
        if words.shots_per_job:
            said += ["--shots-per-job", str(words.shots_per_job)]
        for flag, value in (
            ("--t-star", words.t_star),
            ("--t-star-list", words.t_star_list),
            ("--shots-folder", words.shots_folder),
            ("--rates", words.rates),
        ):
            said += [f"{flag}={value}"] if value else []
        said += ["--bake"] if words.bake else []
    return backend.ask(*said)


def written(asked: children.Question) -> list[str]:
    """What the backend says of the job that it wrote, line by line. JobError with its own sentence if it failed."""
    return [line.rstrip() for line in asked.answer("{}").splitlines() if line.strip()]
