"""NVIDIA cards of this machine, as nvidia-smi lists them, and reasons why a card cannot be used.

Standard library only: the launcher imports this file before the backend is installed.
"""

from __future__ import annotations

import functools
import os
import subprocess
from dataclasses import dataclass

from .contract import program

NEEDED_DRIVER = 580
"""Oldest NVIDIA driver branch for the CUDA 13 builds of Warp and torch pinned here."""
NEEDED_COMPUTE = 7.5
"""Lowest CUDA compute capability that these builds support."""
_ANSWER_SECONDS = 30.0


@dataclass(frozen=True)
class Card:
    """An NVIDIA card, as its driver describes it."""

    name: str
    """Product name."""
    driver: str
    """Version of the driver, such as 580.65.06."""
    compute: str
    """Compute capability, such as 9.0; empty if the driver is too old to say."""

    @property
    def old_driver(self) -> bool:
        """True if the driver is too old. ValueError if its version is not a number."""
        return int(self.driver.split(".")[0]) < NEEDED_DRIVER

    @property
    def old(self) -> bool:
        """True if the card is too old for any driver. ValueError if its compute capability is not a number."""
        return bool(self.compute) and float(self.compute) < NEEDED_COMPUTE

    @property
    def fits(self) -> bool:
        """True if the card and its driver are new enough."""
        try:
            return not self.old_driver and not self.old
        except ValueError:
            return False


def nvidia_cards() -> tuple[list[Card], str]:
    """Cards of this machine, and the complaint of nvidia-smi if it lists none. Both are empty if it is not installed.

    nvidia-smi runs once per process.
    """
    tool = program("nvidia-smi")
    return _listed(tool) if tool else ([], "")


@functools.cache
def _listed(tool: str) -> tuple[list[Card], str]:
    output = ""
    for fields in ("name,driver_version,compute_cap", "name,driver_version"):  # old drivers do not know compute_cap
        command = [tool, f"--query-gpu={fields}", "--format=csv,noheader"]
        try:
            ran = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=_ANSWER_SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            return [], str(error)
        output = ran.stdout.strip() or ran.stderr.strip()
        count = fields.count(",")
        rows = [row.rsplit(",", count) for row in ran.stdout.splitlines() if row.count(",") >= count]
        if ran.returncode == 0:
            return [Card(*(field.strip() for field in [*row, ""][:3])) for row in rows], ""
        if "compute_cap" not in output:
            break
    return [], "" if "No devices were found" in output else (output.splitlines() or ["it gave no reason"])[0].strip()


def why_unused(torch_cuda: str | None) -> tuple[str, str] | None:
    """Why torch sees no NVIDIA card on this machine, and what to do about it.

    None without a card, or if CUDA_VISIBLE_DEVICES hides it, because that is done on purpose.

    Args:
        torch_cuda: CUDA version that torch was built for; None for its CPU build.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES", "0") in ("", "-1"):
        return None
    cards, trouble = nvidia_cards()
    if trouble:
        sentence = f"The NVIDIA driver does not answer: {trouble}"
        return sentence, "Restart the machine. If that does not help, reinstall the driver."
    if not cards:
        return None
    card = next((card for card in cards if card.fits), cards[0])
    fault = why_unfit(card)
    if fault is not None:
        return fault
    if torch_cuda is None:
        return (
            "PyTorch was installed without CUDA.",
            "Remove the backend's environment and set it up again. This installs PyTorch for CUDA, unless "
            "SPLANNEQUIN_TORCH_INDEX names an index without it.",
        )
    return (
        f"PyTorch does not see {card.name}, although the card and its driver are supported.",
        "Restart the machine if the driver was updated, or close the program that has exclusive use of the card.",
    )


def why_unfit(card: Card) -> tuple[str, str] | None:
    """What is wrong with a card or its driver, and what to do about it; None if nothing is."""
    try:
        if card.old:
            needed = f"{NEEDED_COMPUTE} (Turing) or newer is needed"
            return f"{card.name} has compute capability {card.compute}, and {needed}.", "The processor is used."
        if card.old_driver:
            message = f"{card.name} has driver {card.driver}, and R{NEEDED_DRIVER} or newer is needed."
            return message, "Update the NVIDIA driver and restart the machine."
    except ValueError:
        return (
            f"{card.name} reports driver {card.driver} and compute capability {card.compute}, which Splannequin "
            "cannot interpret."
        ), ""
    return None
