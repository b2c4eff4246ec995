"""Asks the backend to write a job for a render farm."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from ...torch_backend.contract.files import is_json_object
from ..process import backend, children

REQUEST = "request.json"
"""Parameters of the steps, in the job's folder."""


def begin(words: contract.FarmWords, requests: dict[str, Any]) -> children.Question:
    """Has the backend write a job, or what tasks took, without waiting.

    Args:
        words: what is asked for; paths among it are absolute.
        requests: step -> its parameters, those of `contract.PARAMS` or dicts of some of them; written into the job's
            folder.

    Raises:
        contract.JobError: there is no backend, or it cannot be started; OSError: the folder cannot be written.
    """
    backend.python()  # before anything is written
    device: list[str] = []
    if words.action == "export":
        values: dict[str, dict[str, Any]] = {
            kind: params if is_json_object(params) else dataclasses.asdict(params) for kind, params in requests.items()
        }
        request = Path(words.output) / REQUEST
        contract.write_json(request, values)
        words = dataclasses.replace(words, request=str(request))
        if values.get("freeze", {}).get("device"):
            device = ["--device", values["freeze"]["device"]]
    return backend.ask("farm", *contract.said_of(words), *device)


def written(asked: children.Question) -> list[str]:
    """What the backend says of the job that it wrote, line by line. JobError with its own sentence if it failed."""
    return [line.rstrip() for line in asked.answer("{}").splitlines() if line.strip()]
