"""Asks the backend to write a job for a render farm."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from ...torch_backend.contract.files import is_json_object
from ..process import backend, children

REQUEST = "request.json"
"""File name, in the job's folder, of the steps' parameters."""


def begin(words: contract.FarmWords, requests: dict[str, Any]) -> children.Question:
    """Makes the backend write a farm job or report what tasks took, without waiting.

    Args:
        words: the request; its paths are absolute.
        requests: step -> its parameters: an instance of `contract.PARAMS`, or a dict of some of its fields. They are
            written into the job's folder.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
        OSError: the folder cannot be written.
    """
    backend.python()  # fails before anything is written
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
    return backend.ask("farm", *contract.arguments_of(words), *device)


def written(question: children.Question) -> list[str]:
    """The backend's report on the job it wrote, line by line. Raises JobError with the backend's message on failure."""
    return [line.rstrip() for line in question.answer("{}").splitlines() if line.strip()]
