"""The PyTorch build that a set-up installs. The launcher installs it; Blender shows its source beforehand."""

from __future__ import annotations

import os
import re
from collections.abc import Callable

TORCH_INDEX = "SPLANNEQUIN_TORCH_INDEX"
"""Environment variable that names another index."""
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"
"""Index of torch for NVIDIA cards on Windows, where the PyPI build has no CUDA."""
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""Index of torch without CUDA on Linux, where the PyPI build includes 4 GB for NVIDIA cards."""


def torch_index(system: str, driver: bool, fits: Callable[[], bool]) -> str:
    """Package index of torch in addition to pip's default; empty for none.

    The environment variable takes precedence. Otherwise, Windows with a card that can use CUDA takes the index with
    CUDA, and Linux without an NVIDIA driver takes the index without CUDA.

    Args:
        system: `sys.platform`.
        driver: True if `nvidia-smi` is on the PATH.
        fits: returns True if a card can use the CUDA build. Called only if needed, since it may take seconds.
    """
    if TORCH_INDEX in os.environ:
        return os.environ[TORCH_INDEX]
    if system == "win32":
        return CUDA_INDEX if driver and fits() else ""
    return CPU_INDEX if system == "linux" and not driver else ""


def brings_cuda(index: str, system: str) -> bool:
    """True if torch from this additional index has CUDA. The PyPI build has it on Linux."""
    if re.search(r"\bcu\d+\b", index):
        return True
    return system == "linux" and not re.search(r"\bcpu\b", index)
