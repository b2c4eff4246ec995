"""safetensors files, typed: what the package's own annotations leave open."""

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
    """An open file of tensors, mapped and not read yet."""

    def keys(self) -> list[str]:
        """Names of the tensors."""
        ...

    def get_tensor(self, name: str) -> Tensor:
        """That tensor on the CPU, a view of the mapped file."""
        ...

    def metadata(self) -> dict[str, str] | None:
        """The words that were stored with them."""
        ...


def open_stored(path: Path) -> AbstractContextManager[StoredTensors]:
    """Opens a file; SafetensorError, OSError or UnreadableFile if it is none."""
    opened: Any = cast(Any, safetensors).safe_open(regular_file(path, LONGEST_CHECKPOINT), framework="pt", device="cpu")
    return opened


def write_stored(tensors: Mapping[str, Tensor], path: Path, metadata: dict[str, str]) -> None:
    """Writes contiguous CPU tensors; SafetensorError with the system's reason in words if that fails."""
    cast(Any, safetensors.torch).save_file(dict(tensors), str(path), metadata=metadata)
