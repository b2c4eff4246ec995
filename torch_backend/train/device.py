"""Where a run lives: the CPU, or the NVIDIA GPU if torch and Warp can use it and a self-test finds nothing wrong."""

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
    "Update the NVIDIA driver; if it stays, `python3 splannequin.py doctor --gpu` tests the card again and writes what "
    "it found to a file that you can send."
)


def choose_device(requested: str, report: Reporter | None = None, doing: str = "") -> torch.device:
    """The device for `auto`, `cpu` or `cuda`. ValueError for another word, JobError if `cuda` cannot be had.

    The first use of a card on a machine tests it, in seconds, or tens of them where nothing is compiled yet.

    Args:
        report: receives one warning that says why `auto` leaves this machine's card unused; None: no warning.
        doing: first word of that sentence: "Training", "Freezing".
    """
    device, unused = decide_device(requested)
    if report is not None and unused is not None:
        report.warning(*unused_words(unused, doing))
    if report is not None and device.type == "cuda" and planes_cuda.refused:
        report.warning(
            f"{doing} computes what moves with PyTorch's own operators, which takes longer: the graphics card failed "
            f"that part of its self-test ({planes_cuda.refused}).",
            _REPORT,
        )
    if report is not None and device.type == "cuda" and recorder.refused and doing == "Training":
        report.warning(
            "Training launches every kernel by itself, which takes longer: the graphics card failed that part of its "
            f"self-test ({recorder.refused}).",
            _REPORT,
        )
    return device


def decide_device(requested: str) -> tuple[torch.device, tuple[str, str] | None]:
    """`choose_device`, and why `auto` leaves this machine's card unused with what to do about it; None if it does not,
    or there is none.

    Both of one look at the card: one that does not answer is waited for once.
    """
    if requested not in DEVICES:
        raise UserError(f"device is {requested!r}: it should be one of {', '.join(DEVICES)}")
    if requested == "cpu":
        return torch.device("cpu"), None
    refusal = cuda_refusal()
    found = None if refusal else card_verdict()  # asked once: a card that does not answer is waited for
    unused = _unused(refusal) if found is None else _failed(found)
    if found is not None and unused is None:
        planes_cuda.refused, recorder.refused = found.planes, found.recording
        return torch.device("cuda"), None
    if requested == "cuda":
        sentence, advice = unused or (refusal, "")
        raise JobError(sentence, f"{advice} {_HINT}".strip(), ExitCode.ENVIRONMENT)
    return torch.device("cpu"), unused


def unused_words(unused: tuple[str, str], doing: str) -> tuple[str, str]:
    """(sentence, hint) that says why `doing` does not use the card, from the answer of `decide_device`."""
    return f"{doing} uses the processor, not the graphics card: {unused[0]}", unused[1]


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
    """(sentence, hint) about the fault that the self-test found in a usable card; None if nothing."""
    return _failed(card_verdict())


def _failed(found: SelfTest) -> tuple[str, str] | None:
    """`failed_self_test`, of what it found."""
    return (f"The graphics card failed its self-test: {found.problem}.", _REPORT) if found.problem else None


def _unused(refusal: str) -> tuple[str, str] | None:
    """Why this machine's NVIDIA card, which `cuda_refusal` refuses so, is not used, and what to do about it; None if
    there is none."""
    if torch.version.hip is not None:
        return None
    return (refusal, "") if torch.cuda.is_available() else why_unused(torch.version.cuda)
