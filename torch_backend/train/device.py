"""Where a run lives: the CPU, or the NVIDIA GPU if torch and Warp can use it and a self-test finds nothing wrong."""

from __future__ import annotations

import torch

from ..cards import why_unused
from ..contract import DEVICES, ExitCode, JobError
from ..native import initialised_warp
from .self_test import card_problem

_HINT = "Choose --device cpu, or auto."
_REPORT = (
    "Update the NVIDIA driver; if it stays, `python3 splannequin.py doctor --gpu` tests the card again and writes what "
    "it found to a file that you can send."
)


def choose_device(requested: str) -> torch.device:
    """The device for `auto`, `cpu` or `cuda`. ValueError for another word, JobError if `cuda` cannot be had.

    The first use of a card on a machine tests it, in seconds, or tens of them where nothing is compiled yet.
    """
    if requested not in DEVICES:
        raise ValueError(f"device is {requested!r}: it should be one of {', '.join(DEVICES)}")
    if requested == "cpu":
        return torch.device("cpu")
    refusal, advice = cuda_refusal(), ""
    if refusal and torch.version.hip is None and not torch.cuda.is_available():
        advice = (why_unused(torch.version.cuda) or ("", ""))[1]
    if not refusal:
        refusal, advice = failed_self_test() or ("", "")
    if requested == "cuda" and refusal:
        raise JobError(refusal, f"{advice} {_HINT}".strip(), ExitCode.TRAIN)
    return torch.device("cpu" if refusal else "cuda")


def cuda_refusal() -> str:
    """Why no NVIDIA GPU can be used, in a sentence; empty if one can."""
    if torch.version.hip is not None:
        return "This PyTorch is built for AMD GPUs, which the rasteriser has no body for."
    if not torch.cuda.is_available():
        reason = why_unused(torch.version.cuda)
        return reason[0] if reason else "PyTorch sees no NVIDIA GPU."
    if not initialised_warp().is_cuda_available():
        return "PyTorch sees the NVIDIA GPU, but Warp does not: update the NVIDIA driver to version 580 or newer."
    if torch.cuda.get_device_capability() < (7, 5):
        return "The NVIDIA GPU is too old: it must be of the Turing generation (compute capability 7.5) or later."
    return ""


def failed_self_test() -> tuple[str, str] | None:
    """What the self-test found wrong with a card that could be used, and what to do about it; None if nothing."""
    problem = card_problem()
    return (f"The graphics card failed its self-test: {problem}.", _REPORT) if problem else None


def unused_card() -> tuple[str, str] | None:
    """Why the NVIDIA card of this machine is not used, and what to do about it; None if it is, or there is none."""
    refusal = cuda_refusal()
    if torch.version.hip is not None:
        return None
    if not refusal:
        return failed_self_test()
    return (refusal, "") if torch.cuda.is_available() else why_unused(torch.version.cuda)
