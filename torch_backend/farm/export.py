"""`farm export`: looks at the shots, estimates, writes the job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import ExitCode, JobError
from . import cost, rates, shots, template, work

RATES_FILE = "rates.json"
SOFTWARE = Path(__file__).resolve().parent.parent.parent
"""Folder of Splannequin on this computer."""


@dataclass(frozen=True)
class Asked:
    """What `farm export` was asked for, besides the steps' parameters; see `contract.verbs.FarmWords`."""

    shots: list[str]
    """Shot folders and clips."""
    output: Path
    """Folder for the job's files."""
    t_star: str = ""
    """Instants with commas; empty: suggested."""
    t_star_list: str = ""
    """File with a line per shot; empty: none."""
    frames: int = 10
    """Frames of a task of freeze and bake."""
    bake: bool = False
    """Takes go through Blender, too."""
    shots_folder: str = ""
    """Where shots of clips are made; empty: beside each."""
    shots_per_job: int = 15
    """Shots of one template, at most."""
    request: str = ""
    """JSON file of parameters; empty: none."""
    rates: str = ""
    """rates.json; empty: `rates.MEASURED`."""
    trains: bool = False
    """An option of the training was given: finished runs are trained again, if it changes them."""


def export(asked: Asked, requests: dict[str, Any]) -> tuple[cost.Estimate, list[Path]]:
    """Writes the job, or several where there are more shots than one may have. Returns its cost, and the files.

    Args:
        asked: what was asked for.
        requests: kind of job -> its dataclass of parameters.

    Raises:
        JobError: what cannot be; OSError: the folder cannot be written.
    """
    for name, value in (("--frames", asked.frames), ("--shots-per-job", asked.shots_per_job)):
        if value < 1:
            raise JobError(f"{name} is {value}.", "It should be 1 or more.", ExitCode.USAGE)
    requests = shots.read_requests(asked.request, requests)
    table = shots.read_instants(asked.t_star_list) if asked.t_star_list else {}
    instants = shots.parse_instants(asked.t_star)
    if requests["freeze"].t_star is not None and not instants:
        instants = [requests["freeze"].t_star]
    requests["train"].run = requests["freeze"].run
    card = requests["freeze"].device == "cuda"
    trains = asked.trains or bool(asked.request and "train" in shots.read_json(asked.request))
    found = shots.gather(asked.shots, requests, instants, table, asked.shots_folder, not trains)
    known = rates.read_rates(asked.rates) if asked.rates else rates.MEASURED
    every = [step for shot in found for step in work.steps_of(shot, asked.frames, asked.bake)]
    told = cost.estimate(every, known, card, asked.bake)
    groups = [found[n : n + asked.shots_per_job] for n in range(0, len(found), asked.shots_per_job)]
    files: list[Path] = []
    for number, group in enumerate(groups, 1):
        names = {shot.name for shot in group}
        steps = [step for step in every if step.shot.name in names]
        largest = max(wide * high / 1e6 for wide, high in map(work.take_size, group))
        job = template.job_template(_name(group), steps, cost.needs(known, card, largest), asked.bake)
        values = template.job_values(SOFTWARE, group, asked.output / "baked", asked.bake)
        folder = asked.output if len(groups) == 1 else asked.output / f"job-{number:03d}"
        files += template.write_job(folder, job, values)
    return told, files


def _name(group: list[shots.FarmShot]) -> str:
    rest = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return f"Splannequin: {group[0].name}{rest}"
