"""`farm export`: collects the shots, estimates the cost, and writes the job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..contract import ExitCode, FarmWords, JobError
from . import cost, rates, shots, template, work

RATES_FILE = "rates.json"
SOFTWARE = Path(__file__).resolve().parent.parent.parent
"""Folder of Splannequin on this computer."""


def export(words: FarmWords, requests: dict[str, Any], trains: bool = False) -> tuple[cost.Estimate, list[Path]]:
    """Writes the job, or several jobs if there are too many shots for one. Returns the cost and the files.

    Args:
        words: arguments of the verb.
        requests: kind of job -> its dataclass of parameters.
        trains: True if an option of the training was passed, so that finished runs may have to be trained again.

    Raises:
        JobError: an argument, a shot or a clip is invalid; OSError: the folder cannot be written.
    """
    for name, value in (("--frames", words.frames), ("--shots-per-job", words.shots_per_job)):
        if value < 1:
            raise JobError(f"{name} is {value}.", "It should be 1 or more.", ExitCode.USAGE)
    requests = shots.read_requests(words.request, requests)
    table = shots.read_instants(words.t_star_list) if words.t_star_list else {}
    instants = shots.parse_instants(words.t_star or "")
    if requests["freeze"].t_star is not None and not instants:
        instants = [requests["freeze"].t_star]
    requests["train"].run = requests["freeze"].run
    card = requests["freeze"].device == "cuda"
    trains = trains or bool(words.request and "train" in shots.read_json(words.request))
    found = shots.gather(words.shots, requests, instants, table, words.shots_folder, not trains)
    output = Path(words.output)
    known = rates.read_rates(words.rates) if words.rates else rates.MEASURED
    all_steps = [step for shot in found for step in work.steps_of(shot, words.frames, words.bake)]
    costs = cost.estimate(all_steps, known, card, words.bake, words.session_tasks)
    groups = [found[n : n + words.shots_per_job] for n in range(0, len(found), words.shots_per_job)]
    files: list[Path] = []
    for number, group in enumerate(groups, 1):
        names = {shot.name for shot in group}
        steps = [step for step in all_steps if step.shot.name in names]
        largest = max(wide * high / 1e6 for wide, high in map(work.take_size, group))
        job = template.job_template(_name(group), steps, cost.needs(known, card, largest), words.bake)
        values = template.job_values(SOFTWARE, group, output / "baked", words.bake)
        folder = output if len(groups) == 1 else output / f"job-{number:03d}"
        files += template.write_job(folder, job, values)
    return costs, files


def _name(group: list[shots.FarmShot]) -> str:
    suffix = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return f"Splannequin: {group[0].name}{suffix}"
