"""Cache of data read from a shot's files, valid until they change. No bpy.

The panel asks every second while a shot grows, and the files of a long shot are large.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
# Maximum number of cached results, enough for the runs and takes of a few shots.
_MOST = 512
_known: OrderedDict[tuple[Any, ...], tuple[tuple[int, ...], Any]] = OrderedDict()


def of(path: Path, read: Callable[..., T], *words: Hashable) -> T:
    """`read(path, *words)`, cached while the file or folder keeps its inode, size and times.

    All callers share the value: do not modify it. Exceptions from `read` are not cached.

    Args:
        path: a file, or a folder if only the names in it matter.
        read: a module-level function, called with the path and the hashable `words`.
    """
    stat = os.stat(path)
    stamp = (stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    key = (os.fspath(path), read, *words)
    found = _known.get(key)
    if found is not None and found[0] == stamp:
        _known.move_to_end(key)
        return found[1]
    value = read(path, *words)
    _known[key] = (stamp, value)
    _known.move_to_end(key)
    while len(_known) > _MOST:
        _known.popitem(last=False)
    return value
