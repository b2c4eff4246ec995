"""Seeded mutations of valid files: bit flips, cuts, splices, and unexpected values."""

from __future__ import annotations

import copy
import json
import random
import struct
from typing import Any

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 1 << 31, 1 << 63, 10**40, -0.5, 1e-320, 1e308, "", "x", "1", "\u0000", "../../x", "a" * 5000,
    [], {}, [[]], [None], {"x": 1}, float("nan"), float("inf"), 2.5,
)  # fmt: skip
"""Replacements for values of a JSON file. JSON does not allow NaN and Infinity, but Python writes them."""
WORDS = (
    struct.pack("<I", 0), struct.pack("<I", 0xFFFFFFFF), struct.pack("<I", 0x7FFFFFFF), struct.pack("<Q", 1 << 40),
    struct.pack("<Q", (1 << 64) - 1), struct.pack("<f", float("nan")), struct.pack("<f", float("inf")),
    struct.pack(">I", 0x7FFFFFFF), b"\0", b"\xff" * 8, b"nan ", b"-1 ", b"1e999 ", b"99999999999 ", b"\n", b"%s",
    b"[" * 3000,
)  # fmt: skip
"""Replacements for bytes of a file."""


def mutated(data: bytes, drawn: random.Random) -> bytes:
    """`data` with one to three mutations; in 60 % of the cases, values of a JSON object are mutated."""
    if data[:1] == b"{" and drawn.random() < 0.6:
        try:
            return _mutated_json(data, drawn)
        except (ValueError, RecursionError):
            pass
    for _ in range(drawn.choice((1, 1, 1, 2, 3))):
        data = drawn.choice((_flip, _flip, _cut, _splice, _overwrite, _overwrite, _remove, _repeat))(data, drawn)
    return data


def _at(data: bytes, drawn: random.Random) -> int:
    """Random position in the file; half of them are among the first bytes, where headers are."""
    return drawn.randrange(max(1, min(len(data), 400) if drawn.random() < 0.5 else len(data)))


def _flip(data: bytes, drawn: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(drawn.choice((1, 1, 4, 32)) if data else 0):
        changed[_at(data, drawn)] ^= 1 << drawn.randrange(8)
    return bytes(changed)


def _cut(data: bytes, drawn: random.Random) -> bytes:
    return data[: _at(data, drawn)]


def _splice(data: bytes, drawn: random.Random) -> bytes:
    start, target, length = _at(data, drawn), _at(data, drawn), drawn.choice((1, 4, 8, 64, 1000))
    return data[:target] + data[start : start + length] + data[target + length :]


def _overwrite(data: bytes, drawn: random.Random) -> bytes:
    at, word = _at(data, drawn), drawn.choice(WORDS)
    return data[:at] + word + data[at + len(word) :]


def _remove(data: bytes, drawn: random.Random) -> bytes:
    at = _at(data, drawn)
    return data[:at] + data[at + drawn.choice((1, 4, 8, 100)) :]


def _repeat(data: bytes, drawn: random.Random) -> bytes:
    at = _at(data, drawn)
    return data[:at] + data[at : at + 64] * drawn.choice((2, 50)) + data[at:]


def _mutated_json(data: bytes, drawn: random.Random) -> bytes:
    root = json.loads(data)
    for _ in range(drawn.choice((1, 1, 2))):
        places = [(holder, key) for holder, key in _places(root)]
        if not places:
            break
        holder, key = drawn.choice(places[:40] if drawn.random() < 0.5 else places)
        action = drawn.random()
        if action < 0.15:
            del holder[key]
        elif action < 0.25 and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[key]))
        elif action < 0.3 and isinstance(holder, dict):
            holder["unknown"] = holder.pop(key)
        else:
            holder[key] = copy.deepcopy(drawn.choice(VALUES))
    return json.dumps(root).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    """(holder, key) of each nested value."""
    found: list[tuple[Any, Any]] = []
    waiting = [value]
    while waiting:
        holder = waiting.pop(0)
        keys = list(holder) if isinstance(holder, dict) else range(len(holder))
        for key in keys:
            found.append((holder, key))
            if isinstance(holder[key], dict | list):
                waiting.append(holder[key])
    return found
