"""Reads the facts in the header of a checkpoint, a safetensors file, without torch."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from .files import is_json_object, open_regular

_LONGEST = 1 << 22
"""Largest header that is read, in bytes."""


def checkpoint_facts(path: Path) -> dict[str, Any]:
    """Facts that a run stored with its checkpoint; empty if the file is not a checkpoint of Splannequin.

    OSError if the file is missing or cannot be opened, ValueError if the path is not a file.
    """
    with open_regular(path) as source:
        try:
            (length,) = struct.unpack("<Q", source.read(8))
            header: dict[str, Any] = json.loads(source.read(length)) if length < _LONGEST else {}
            facts = json.loads(header["__metadata__"]["splannequin"])
        except (ValueError, KeyError, TypeError, RecursionError, struct.error):
            return {}
    return facts if is_json_object(facts) else {}
