"""What a checkpoint says of itself, read without torch: the facts in the header of a safetensors file."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from .files import is_json_object, open_regular

_LONGEST = 1 << 22
"""Bytes of a header that are read."""


def checkpoint_facts(path: Path) -> dict[str, Any]:
    """The facts that a run stored with its checkpoint; empty if the file is none of ours.

    OSError if it is not there or cannot be opened, ValueError if something else than a file is.
    """
    with open_regular(path) as source:
        try:
            (length,) = struct.unpack("<Q", source.read(8))
            header: dict[str, Any] = json.loads(source.read(length)) if length < _LONGEST else {}
            facts = json.loads(header["__metadata__"]["splannequin"])
        except (ValueError, KeyError, TypeError, RecursionError, struct.error):
            return {}
    return facts if is_json_object(facts) else {}
