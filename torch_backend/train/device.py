"""Selects the device of a run: the CPU, or an NVIDIA GPU if torch and Warp support it and it passes the self-test."""

from __future__ import annotations

import torch

from ..cards import why_unused
from ..contract import DEVICES, ExitCode, JobError, Reporter, UserError
from ..deformation import planes_cuda
from ..native import initialised_warp
from . import recorder
from .self_test import SelfTest, card_verdict

_HINT = "Choose --device cpu, or auto."
_REPORT = (
    "Update the NVIDIA driver. If that does not help, run `python3 splannequin.py doctor --gpu`: it tests the card "
    "again and writes a report that you can send."
)


def choose_device(requested: str, report: Reporter | None = None, doing: str = "") -> torch.device:
    """Device for `auto`, `cpu` or `cuda`. UserError (a ValueError) for other values, JobError if `cuda` is unusable.

    The first use of a GPU on a machine runs its self-test: seconds, or tens of seconds if kernels must be compiled.

    Args:
        report: receives a warning if `auto` does not use this machine's GPU, or some kernels; None: no warning.
        doing: first word of the warning: "Training", "Freezing".
    """
    device, unused = decide_device(requested)
    if report is not None and unused is not None:
        report.warning(*unused_warning(unused, doing))
    if report is not None and device.type == "cuda" and planes_cuda.refused:
        report.warning(
            f"{doing} computes motion with PyTorch's own operators, which is slower: the graphics card failed that "
            f"part of its self-test ({planes_cuda.refused}).",
            _REPORT,
        )
    if report is not None and device.type == "cuda" and recorder.refused and doing == "Training":
        report.warning(
            "Training launches every kernel separately, which is slower: the graphics card failed that part of its "
            f"self-test ({recorder.refused}).",
            _REPORT,
        )
    return device


def decide_device(requested: str) -> tuple[torch.device, tuple[str, str] | None]:
    """(device, (reason, advice)): the second item says why `auto` does not use this machine's GPU.

    It is None if the GPU is used, or if there is none. One self-test determines both, since a GPU that does not respond
    takes a long timeout.
    """
    if requested not in DEVICES:
        raise UserError(f"device is {requested!r}: it should be one of {', '.join(DEVICES)}")
    if requested == "cpu":
        return torch.device("cpu"), None
    refusal = cuda_refusal()
    found = None if refusal else card_verdict()
    unused = _unused(refusal) if found is None else _failed(found)
    if found is not None and unused is None:
        planes_cuda.refused, recorder.refused = found.planes, found.recording
        return torch.device("cuda"), None
    if requested == "cuda":
        sentence, advice = unused or (refusal, "")
        raise JobError(sentence, f"{advice} {_HINT}".strip(), ExitCode.ENVIRONMENT)
    return torch.device("cpu"), unused


def unused_warning(unused: tuple[str, str], doing: str) -> tuple[str, str]:
    """(sentence, hint) of a warning that `doing` does not use the GPU, from the second item of `decide_device`."""
    return f"{doing} uses the processor, not the graphics card: {unused[0]}", unused[1]


def cuda_refusal() -> str:
    """Reason why no NVIDIA GPU can be used, as a sentence; empty if one can be used."""
    if torch.version.hip is not None:
        return "This PyTorch is built for AMD GPUs, which the rasteriser does not support."
    if not torch.cuda.is_available():
        reason = why_unused(torch.version.cuda)
        return reason[0] if reason else "PyTorch sees no NVIDIA GPU."
    if not initialised_warp().is_cuda_available():
        return "PyTorch sees the NVIDIA GPU, but Warp does not: update the NVIDIA driver to version 580 or newer."
    if torch.cuda.get_device_capability() < (7, 5):
        return "The NVIDIA GPU is too old: it must be of the Turing generation (compute capability 7.5) or later."
    return ""


def failed_self_test() -> tuple[str, str] | None:
    """(sentence, hint) about a fault found by the GPU's self-test; None if it passed."""
    return _failed(card_verdict())


def _failed(found: SelfTest) -> tuple[str, str] | None:
    """Result of `failed_self_test` for the self-test result `found`."""
    return (f"The graphics card failed its self-test: {found.problem}.", _REPORT) if found.problem else None


def _unused(refusal: str) -> tuple[str, str] | None:
    """(reason, advice) why this machine's NVIDIA GPU is not used, for a `refusal` of `cuda_refusal`; None if the
    machine has no NVIDIA GPU."""
    if torch.version.hip is not None:
        return None
    return (refusal, "") if torch.cuda.is_available() else why_unused(torch.version.cuda)
