"""Which PyTorch a set-up takes: the launcher installs it, and Blender says before where it comes from."""

from __future__ import annotations

import os
import re
from collections.abc import Callable

TORCH_INDEX = "SPLANNEQUIN_TORCH_INDEX"
"""The variable that names another index."""
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"
"""Where torch for NVIDIA cards comes from on Windows, whose PyPI build has no CUDA."""
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""Where torch without CUDA comes from on Linux, whose PyPI build brings 4 GB for a card that is not there."""


def torch_index(system: str, driver: bool, fits: Callable[[], bool]) -> str:
    """Package index, beside pip's own, that torch comes from; empty for none.

    What the variable says; without it, on Windows the one with CUDA where there is a card that can use it, and on Linux
    the one without where there is no NVIDIA driver.

    Args:
        system: `sys.platform`.
        driver: `nvidia-smi` is on the PATH.
        fits: is there a card that CUDA's build can use? Asked only where the answer counts, since it may take seconds.
    """
    if TORCH_INDEX in os.environ:
        return os.environ[TORCH_INDEX]
    if system == "win32":
        return CUDA_INDEX if driver and fits() else ""
    return CPU_INDEX if system == "linux" and not driver else ""


def brings_cuda(index: str, system: str) -> bool:
    """Does torch come with CUDA, of that index beside pip's own? PyPI's own build does on Linux."""
    if re.search(r"\bcu\d+\b", index):
        return True
    return system == "linux" and not re.search(r"\bcpu\b", index)
