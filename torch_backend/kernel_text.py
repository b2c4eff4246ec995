"""Text of a kernel file: `kernels/*.cpp` and `*.cu` beside the modules that use them.

A kernel file is a body of C++ for `warp.func_native`, or a part of one. Its head, the lines of `//` before the first
other line, says what it is and is not compiled; everything after it is, to the letter, because Warp's cache of compiled
kernels goes by the text. A line `#include "PATH"` stands for such a file, seen from the folder of the line, without its
head. The module that uses the file replaces names between @ signs (`@LOW_PASS@`).
"""

import functools
import re
from pathlib import Path

_HEAD = re.compile(r"(?://.*\n)+")
_INCLUDE = re.compile(r'^#include "([\w./]+)"\n', re.MULTILINE)


@functools.cache
def kernel_text(path: Path) -> str:
    """What is compiled of a file and of those it includes. ValueError if one has no head, OSError if one is missing."""
    text = path.read_text(encoding="utf-8")
    head = _HEAD.match(text)
    if head is None:
        raise ValueError(f"{path}: a kernel file begins with // and what it is")
    return _INCLUDE.sub(lambda include: kernel_text(path.parent / include.group(1)), text[head.end() :])
