"""Identity of a file by its content, so that a copy with another path and time counts as the same file."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from .files import open_regular

BLOCKS, BLOCK_BYTES = 64, 1 << 14
"""Number and size in bytes of the blocks that are read of a large file, spread evenly over the file. A block is about
one row of an uncompressed 4K picture. In a compressed file, a change alters everything after it."""
# Number of files read at once, because reading from a network disk is mostly waiting.
_READERS = 8


def file_digest(path: str | Path) -> str:
    """Hash of a file's size and content; for a file over 1 MB, of `BLOCKS` blocks of its content. OSError or ValueError
    as `files.open_regular`.

    Cached in this process until the file's size, time or inode changes.
    """
    with open_regular(path) as source:
        state = os.fstat(source.fileno())
    return _digest(os.path.abspath(path), state.st_size, state.st_mtime_ns, state.st_ino)


def files_digest(files: Mapping[int, Path]) -> str:
    """Hash of numbered files: their numbers, sizes and contents. A file that cannot be read counts as empty."""
    numbers = sorted(files)
    if len(numbers) == 1:
        digests = [_digest_or_empty(files[numbers[0]])]
    else:
        with ThreadPoolExecutor(_READERS) as readers:
            digests = list(readers.map(_digest_or_empty, (files[n] for n in numbers)))
    digest_lines = "".join(f"{number} {digest}\n" for number, digest in zip(numbers, digests, strict=True))
    return hashlib.sha256(digest_lines.encode()).hexdigest()[:32]


def _digest_or_empty(path: Path) -> str:
    try:
        return file_digest(path)
    except (OSError, ValueError):
        return ""


@functools.lru_cache(maxsize=1 << 14)
def _digest(path: str, size: int, *_state: int) -> str:
    """`file_digest` of a file, cached by its path, size and state."""
    digest = hashlib.sha256(str(size).encode())
    with open_regular(path) as source:
        if size <= BLOCKS * BLOCK_BYTES:
            digest.update(source.read(size + 1))
        else:
            for n in range(BLOCKS):
                source.seek(n * (size - BLOCK_BYTES) // (BLOCKS - 1))
                digest.update(source.read(BLOCK_BYTES))
    return digest.hexdigest()[:32]
