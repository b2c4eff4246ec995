"""The job template of Open Job Description (2023-09), as JSON, and its parameters.

Each shot has a separate chain of steps, so that a failure does not stop other shots. A step has a task for each instant
and each part of its frames. Commands contain no paths of the submitting computer, so that the engine's path mapping
applies to all paths. Shots and clips are task parameters of type PATH. The program's folder and paths in options are
job parameters of type PATH.

Source: https://github.com/OpenJobDescription/openjd-specifications/wiki/2023-09-Template-Schemas
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..contract import STEP_PARAMS, ExitCode, JobError, write_json
from ..contract.option_table import MASK_ALPHA, MASK_FOUND, ignored_path, mask_path, options_of
from .request import VERSION as REQUEST_VERSION
from .shots import FarmShot
from .work import STEPS, Step

VERSION = "jobtemplate-2023-09"
TEMPLATE_FILE, PARAMETERS_FILE, VALUES_FILE = "template.json", "parameters.json", "parameter_values.json"
"""The template; its parameters for `openjd run --job-param file://...`; its parameters for a Deadline Cloud bundle."""
MOST_LETTERS = 1024
"""Largest length of a path in Open Job Description, in characters."""
NOTIFY_SECONDS = 60
"""Seconds that a cancelled training has for its checkpoint."""
_DESCRIPTIONS = {
    "import": "Imports the footage into the shot folder",
    "solve": "Solves the cameras and finds what moves",
    "train": "Trains Gaussians and their motion",
    "open": "Chooses and develops the instant, which all parts of a take share",
    "freeze": "Freezes frames, one part of a take per task",
    "finish": "Writes the contact sheet, video, PLY and take.json of the whole take",
    "bake": "Renders frames through Blender's compositor, one part of a take per task",
    "deliver": "Writes shot.blend and summary.json of the bake",
}


@dataclass(frozen=True)
class Needs:
    """Requirements of a step's tasks on a host."""

    memory_mib: int
    """Memory in MiB."""
    gpu: bool
    """True if the host needs a graphics card that the backend can use."""
    cores: int = 1
    """Processor cores."""


def job_template(name: str, steps: Sequence[Step], needs: dict[str, Needs], bake: bool) -> dict[str, Any]:
    """The template of a job.

    Args:
        name: name of the job.
        steps: steps of all shots; those of one shot in order.
        needs: kind of step -> its requirements.
        bake: True if takes are baked, for which hosts need Blender.

    Raises:
        JobError: a path is not valid in a template.
    """
    paths = paths_of([step.shot for step in steps])
    parameters: list[dict[str, Any]] = [
        _parameter("Splannequin", "Folder of Splannequin on the hosts, with splannequin.py in it", "IN"),
        _parameter("HostPython", "Any Python from 3.8 on the hosts, used to start"),
        _parameter(
            "BackendPython", "Python with Splannequin's packages on the hosts; empty: it is set up automatically"
        ),
        _parameter("Home", "Folder on the hosts for this set-up, made once; empty: Splannequin's folder"),
    ]
    if bake:
        parameters += [
            _parameter(
                "Blender", "Path of Blender on the hosts; empty: a bpy wheel is set up, or Blender is on the PATH"
            ),
            _parameter("OutputFolder", "Output folder of the bake: SHOT/TAKE/composited", "OUT"),
        ]
    parameters += [_parameter(option, f"Path of the option {option}", "IN", "FILE") for option in sorted(paths)]
    return {
        "specificationVersion": VERSION,
        "name": _refused(name),
        "description": "Frozen frames by Splannequin. Every task can run twice, even at once, or after a kill.",
        "parameterDefinitions": parameters,
        "jobEnvironments": [_environment(bake)],
        "steps": [_step(step, before, needs[step.kind], paths, bake) for step, before in _chained(steps)],
    }


def job_values(software: Path, shots: Sequence[FarmShot], output: Path, bake: bool) -> dict[str, str]:
    """Values of a template's job parameters on the submitting computer. JobError names a path that the engine would
    refuse."""
    values = {"Splannequin": str(software), "HostPython": "python3", "BackendPython": "", "Home": ""}
    if bake:
        values |= {"Blender": "", "OutputFolder": str(output)}
    values |= paths_of(shots)
    return {name: _refused_value(value) for name, value in values.items()}


def write_job(folder: Path, template: dict[str, Any], values: dict[str, str]) -> list[Path]:
    """Writes the files of a job into a folder, which is made; returns them. OSError if it cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    bundle = {"parameterValues": [{"name": name, "value": value} for name, value in values.items()]}
    files = {TEMPLATE_FILE: template, PARAMETERS_FILE: values, VALUES_FILE: bundle}
    for name, data in files.items():
        write_json(folder / name, data)
    return [folder / name for name in files]


def paths_of(shots: Sequence[FarmShot]) -> dict[str, str]:
    """Job parameter -> path, for each option of the shots' steps that names files."""
    found: dict[str, str] = {}
    for shot in shots:
        for kind, values in shot.requests.items():
            for field in _path_fields(kind):
                if values[field] not in _NO_FILES and (kind, field) not in _PER_SHOT_PATHS:
                    found[_parameter_name(kind, field)] = values[field]
    return found


_MASKS = mask_path, ignored_path
_NO_FILES = "", MASK_ALPHA, MASK_FOUND
"""Values of such options that are not files."""
_PER_SHOT_PATHS = {("import", "source"), ("freeze", "camera_path")}
"""Options whose path differs between shots: a task parameter, and a file in the shot."""


def _path_fields(kind: str) -> list[str]:
    return [one.name for one, spec in options_of(STEP_PARAMS[kind]) if spec.is_path or spec.parse in _MASKS]


def _parameter_name(kind: str, field: str) -> str:
    return "".join(word.capitalize() for word in [kind, *field.split("_")])


def _parameter(name: str, text: str, flow: str = "", of: str = "DIRECTORY") -> dict[str, Any]:
    if flow:
        return {"name": name, "type": "PATH", "objectType": of, "dataFlow": flow, "description": text}
    default = "python3" if name == "HostPython" else ""
    return {"name": name, "type": "STRING", "default": default, "description": text}


def _environment(bake: bool) -> dict[str, Any]:
    """Environment that a host enters once per session. Its packages are pinned, and stay installed between sessions."""
    words = ["--python", "{{Param.BackendPython}}", "--home", "{{Param.Home}}"]
    words += ["--blender", "{{Param.Blender}}", "--bake"] if bake else []
    enter = {"command": "{{Param.HostPython}}", "args": [_LAUNCHER, "farm-host", *words]}
    return {"name": "Splannequin", "script": {"actions": {"onEnter": enter}}}


_LAUNCHER = "{{Param.Splannequin}}/splannequin.py"


def _chained(steps: Sequence[Step]) -> list[tuple[Step, str]]:
    """Each step with the name of the previous step of its shot, for which it waits; empty for a shot's first step."""
    last: dict[str, str] = {}
    found: list[tuple[Step, str]] = []
    for step in sorted(steps, key=lambda step: STEPS.index(step.kind)):
        found.append((step, last.get(step.shot.name, "")))
        last[step.shot.name] = step.name
    return found


def _step(step: Step, before: str, needs: Needs, paths: dict[str, str], bake: bool) -> dict[str, Any]:
    shot, kind = step.shot, step.kind
    words = [_LAUNCHER, "farm-task", kind, "--shot", "{{Task.Param.Shot}}", "--request", "{{Task.File.Request}}"]
    words += ["--path-rules", "{{Session.PathMappingRulesFile}}"]
    space: list[dict[str, Any]] = [{"name": "Shot", "type": "PATH", "range": [_refused(str(shot.root))]}]
    path_words: list[str] = []
    if kind == "import":
        space.append({"name": "Clip", "type": "PATH", "range": [_refused(shot.clip)]})
        path_words.append("import.source={{Task.Param.Clip}}")
    for field in _path_fields(kind) if kind in STEP_PARAMS else ():
        name = _parameter_name(kind, field)
        if name in paths and shot.requests[kind][field] == paths[name]:
            path_words.append(f"{kind}.{field}={{{{Param.{name}}}}}")
    if path_words:
        words += ["--paths", *path_words]
    if any(step.t_stars):
        space.append({"name": "TStar", "type": "INT", "range": [int(t) for t in step.t_stars]})
        words.append("--t-star={{Task.Param.TStar}}")  # with =, a negative number is not read as an option
    if step.starts:
        space.append({"name": "First", "type": "INT", "range": step.starts})
        words += ["--first={{Task.Param.First}}", "--frames", str(step.part)]
    if kind in ("bake", "deliver"):
        words += ["--output", "{{Param.OutputFolder}}"]
    action = {
        "command": "{{Param.HostPython}}",
        "args": words,
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTIFY_SECONDS},
    }
    request = _request(step)
    template: dict[str, Any] = {"name": step.name, "description": f"{_DESCRIPTIONS[kind]}."}
    if before:
        template["dependencies"] = [{"dependsOn": before}]
    amounts: list[dict[str, Any]] = [{"name": "amount.worker.vcpu", "min": needs.cores}]
    amounts.append({"name": "amount.worker.memory", "min": needs.memory_mib})
    if needs.gpu:
        amounts.append({"name": "amount.worker.gpu", "min": 1})
    template["hostRequirements"] = {"amounts": amounts}
    template["parameterSpace"] = {"taskParameterDefinitions": space}
    files = [{"name": "Request", "type": "TEXT", "filename": "request.json", "data": request}]
    template["script"] = {"actions": {"onRun": action}, "embeddedFiles": files}
    return template


def _request(step: Step) -> str:
    """Text of the file with a task's request: parameters without paths, and the takes' names."""
    shot, kind = step.shot, step.kind
    params_kind = kind if kind in STEP_PARAMS else "freeze"
    values = dict(shot.requests[params_kind])
    for field in _path_fields(params_kind):
        if values[field] not in _NO_FILES and (params_kind, field) != ("freeze", "camera_path"):
            values[field] = ""
    amounts = {str(start): round(amount, 4) for start, amount in step.amounts.items()}
    request: dict[str, Any] = {
        "version": REQUEST_VERSION,
        "name": shot.name,
        "output": shot.output,
        "amounts": amounts,
        params_kind: values,
    }
    if params_kind == "freeze":
        request |= {"takes": shot.takes, "first": shot.first, "last": shot.last}
    # Two braces begin or end a reference, so they are escaped in text. JSON with an indent has no two braces in a row
    # outside text. DEL is the only control character that JSON does not escape.
    text = json.dumps(request, indent=1, sort_keys=True)
    for mark, escaped in (("{{", "{\\u007b"), ("}}", "}\\u007d"), ("\x7f", "\\u007f")):
        text = text.replace(mark, escaped)
    return text


def _refused(text: str) -> str:
    """`text`, a path or name for the template. JobError if the engine would refuse it, or find a reference in it."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    if "{{" in text or "}}" in text:
        raise JobError(
            f"{printable} cannot be used in a job template, where two braces mark a reference.",
            "Rename it without {{ and }}.",
            ExitCode.USAGE,
        )
    return _refused_value(text)


def _refused_value(text: str) -> str:
    """`text`, a path for a value in the files of parameters. JobError if the engine would refuse it."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    if len(text) > MOST_LETTERS:
        raise JobError(
            f"{printable[:100]}... has {len(text)} characters, but a render farm's job allows {MOST_LETTERS}.",
            "Move it to a folder with a shorter path.",
            ExitCode.USAGE,
        )
    if re.search(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]", text):
        raise JobError(
            f"{printable} cannot be used in a job template: its name contains control characters or is not UTF-8.",
            "Rename it.",
            ExitCode.USAGE,
        )
    return text
