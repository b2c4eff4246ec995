"""Where a run lives: the CPU, or the NVIDIA GPU if torch and Warp can both use it."""

from __future__ import annotations

import torch

from ..cards import why_unused
from ..contract import DEVICES, ExitCode, JobError
from ..native import initialised_warp

_HINT = "Choose --device cpu, or auto."


def choose_device(requested: str) -> torch.device:
    """The device for `auto`, `cpu` or `cuda`. ValueError for another word, JobError if `cuda` cannot be had."""
    if requested not in DEVICES:
        raise ValueError(f"device is {requested!r}: it should be one of {', '.join(DEVICES)}")
    refusal = None if requested == "cpu" else cuda_refusal()
    if requested == "cuda" and refusal:
        raise JobError(refusal, _HINT, ExitCode.TRAIN)
    return torch.device("cpu" if requested == "cpu" or refusal else "cuda")


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


def unused_card() -> tuple[str, str] | None:
    """Why the NVIDIA card of this machine is not used, and what to do about it; None if it is, or there is none."""
    refusal = cuda_refusal()
    if not refusal or torch.version.hip is not None:
        return None
    return (refusal, "") if torch.cuda.is_available() else why_unused(torch.version.cuda)
