"""Text of kernel files: `kernels/*.cpp` and `*.cu` next to the modules that use them.

A kernel file is a C++ body for `warp.func_native`, or a part of one. It begins with a head of `//` lines, which
describe the kernel and are not compiled. The rest is compiled unchanged, because Warp's cache of compiled kernels is
keyed by the text. A line `#include "PATH"` inserts another kernel file without its head; PATH is relative to the folder
of the including file. The module that uses the file replaces names between @ signs (`@LOW_PASS@`).
"""

import functools
import re
from pathlib import Path

_HEAD = re.compile(r"(?://.*\n)+")
_INCLUDE = re.compile(r'^#include "([\w./]+)"\n', re.MULTILINE)


@functools.cache
def kernel_text(path: Path) -> str:
    """Text of a file and its includes, without heads. ValueError if a file has no head, OSError if one is missing."""
    text = path.read_text(encoding="utf-8")
    head = _HEAD.match(text)
    if head is None:
        raise ValueError(f"{path}: a kernel file begins with // and what it is")
    return _INCLUDE.sub(lambda include: kernel_text(path.parent / include.group(1)), text[head.end() :])
