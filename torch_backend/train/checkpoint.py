"""Checkpoints: one safetensors file with the whole state of a run. The format cannot contain executable code."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError
from torch import Tensor

from ..contract import CHECKPOINT_FILE as CHECKPOINT_FILE
from ..contract import ExitCode, JobError, check_version
from ..shot import atomic_path
from .stored_tensors import StoredTensors, open_stored, write_stored

CHECKPOINT_VERSION = 1


_DAMAGED = (SafetensorError, KeyError, TypeError, RecursionError, json.JSONDecodeError)
"""Exceptions raised by reading a damaged file, or a file that is not a checkpoint."""


def save_checkpoint(path: Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    """Writes tensors and JSON-able facts to a temporary file, which then replaces `path` atomically.

    OSError if the file cannot be written (errno ENOSPC when the disk is full).
    """
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({"version": CHECKPOINT_VERSION, **meta}, allow_nan=False)
    with atomic_path(path) as partial:
        try:
            write_stored(contiguous, partial, {"splannequin": text})
        except SafetensorError as error:  # the system's error number is only in its message: "... (os error 28)"
            code = int(number[1]) if (number := re.search(r"os error (\d+)", str(error))) else errno.EIO
            windows = (code,) if os.name == "nt" else ()
            raise OSError(code, f"checkpoint not written: {error}", str(path), *windows) from error


MISFITS = (KeyError, TypeError, IndexError, AttributeError, ValueError, RuntimeError)
"""Exceptions raised by a readable checkpoint with unexpected contents, for instance a missing tensor."""


def misfit(path: Path, error: Exception, code: ExitCode) -> Exception:
    """JobError for an exception in `MISFITS`. Errors of the GPU, which the checkpoint did not cause, stay unchanged."""
    if isinstance(error, torch.OutOfMemoryError | torch.AcceleratorError):
        return error
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
    return JobError(
        f"The checkpoint {path} does not fit this version ({reason}).", "Train the run again with --restart.", code
    )


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors, facts) of a checkpoint. JobError if the file is damaged or from a newer version."""
    try:
        with open_stored(path) as stored:
            meta = _facts(stored)
            check_version(meta, str(path), CHECKPOINT_VERSION)
            # Cloned, because Windows cannot replace a file while views of its memory map exist.
            return {name: stored.get_tensor(name).clone() for name in stored.keys()}, meta  # noqa: SIM118 - not a dict
    except _DAMAGED as error:
        raise JobError(
            f"The checkpoint {path} cannot be read ({type(error).__name__}).",
            "Train the run again with --restart.",
            ExitCode.TRAIN,
        ) from error


def read_meta(path: Path) -> dict[str, Any]:
    """The facts of a checkpoint without its tensors; empty if the file is damaged."""
    try:
        with open_stored(path) as stored:
            return _facts(stored)
    except _DAMAGED:
        return {}


def _facts(stored: StoredTensors) -> dict[str, Any]:
    """Facts in the metadata of an open file. Raises one of `_DAMAGED` if they are not a JSON object."""
    facts: object = json.loads((stored.metadata() or {})["splannequin"])
    if not isinstance(facts, dict):
        raise TypeError(f"the facts are a {type(facts).__name__}")
    return cast(dict[str, Any], facts)


def optimizer_state(named: dict[str, Tensor], optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's moments and step counts, named adam.<key>.<parameter>."""
    tensors: dict[str, Tensor] = {}
    for name, parameter in named.items():
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"adam.{key}.{name}"] = value
    return tensors


def restore_optimizer(named: dict[str, Tensor], optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Inverse of `optimizer_state`. Moments get the device, dtype and memory layout of their parameter."""
    for name, parameter in named.items():
        keys = ("step", "exp_avg", "exp_avg_sq")
        stored = {key: tensors.get(f"adam.{key}.{name}") for key in keys}
        state: dict[str, Tensor] = {}
        for key, value in stored.items():
            if value is not None:
                # Converted here, not at the next step: Gaussians and moments may be cloned and dropped before it.
                like = torch.zeros((), device=parameter.device) if key == "step" else parameter.detach()
                state[key] = torch.empty_like(like).copy_(value)
        if len(state) == len(keys):
            optimizer.state[parameter] = state
