"""Typed access to safetensors files, whose package has incomplete type annotations."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol, cast

import safetensors
import safetensors.torch
from torch import Tensor

from ..contract import LONGEST_CHECKPOINT, regular_file


class StoredTensors(Protocol):
    """An open, memory-mapped file of tensors."""

    def keys(self) -> list[str]:
        """Names of the tensors."""
        ...

    def get_tensor(self, name: str) -> Tensor:
        """Tensor `name` on the CPU, as a view of the mapped file."""
        ...

    def metadata(self) -> dict[str, str] | None:
        """Metadata of the file."""
        ...


def open_stored(path: Path) -> AbstractContextManager[StoredTensors]:
    """Opens a safetensors file. SafetensorError, OSError or UnreadableFile if it cannot be read."""
    opened: Any = cast(Any, safetensors).safe_open(regular_file(path, LONGEST_CHECKPOINT), framework="pt", device="cpu")
    return opened


def write_stored(tensors: Mapping[str, Tensor], path: Path, metadata: dict[str, str]) -> None:
    """Writes contiguous CPU tensors. SafetensorError, with the system's error in its message, if that fails."""
    cast(Any, safetensors.torch).save_file(dict(tensors), str(path), metadata=metadata)
