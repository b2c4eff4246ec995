"""What a file is known by: its content, so that a copy is the same file, wherever it lies and whatever its time."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from .files import open_regular

BLOCKS, BLOCK_BYTES = 64, 1 << 14
"""Blocks of a large file that are read, spread evenly from its first to its last byte, and their size. A block is a row
of an uncompressed picture 4K wide; in a compressed file a change moves everything behind it."""
_READERS = 8
"""Files read at once: on a network disk most of the time is waiting."""


def file_digest(path: str | Path) -> str:
    """Hash of a file's size and content; of more than 1 MB, of `BLOCKS` blocks of it. OSError or ValueError as
    `files.open_regular`.

    Read again only when the file's size, time or inode have changed since this process read it last.
    """
    with open_regular(path) as source:
        state = os.fstat(source.fileno())
    return _digest(os.path.abspath(path), state.st_size, state.st_mtime_ns, state.st_ino)


def files_digest(files: Mapping[int, Path]) -> str:
    """Hash of numbered files: their numbers, sizes and contents. A file that cannot be read counts as empty."""
    numbers = sorted(files)
    if len(numbers) == 1:
        digests = [_or_nothing(files[numbers[0]])]
    else:
        with ThreadPoolExecutor(_READERS) as readers:
            digests = list(readers.map(_or_nothing, (files[n] for n in numbers)))
    digest_lines = "".join(f"{number} {digest}\n" for number, digest in zip(numbers, digests, strict=True))
    return hashlib.sha256(digest_lines.encode()).hexdigest()[:32]


def _or_nothing(path: Path) -> str:
    try:
        return file_digest(path)
    except (OSError, ValueError):
        return ""


@functools.lru_cache(maxsize=1 << 14)
def _digest(path: str, size: int, *_state: int) -> str:
    """`file_digest` of a file in the state that it is in."""
    digest = hashlib.sha256(str(size).encode())
    with open_regular(path) as source:
        if size <= BLOCKS * BLOCK_BYTES:
            digest.update(source.read(size + 1))
        else:
            for n in range(BLOCKS):
                source.seek(n * (size - BLOCK_BYTES) // (BLOCKS - 1))
                digest.update(source.read(BLOCK_BYTES))
    return digest.hexdigest()[:32]
