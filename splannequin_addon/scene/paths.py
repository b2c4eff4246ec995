"""Paths in the form stored in a .blend."""

from __future__ import annotations

import os
from pathlib import Path

import bpy


def blend_path(path: Path) -> str:
    """`path` in the form stored in a .blend: relative to the file if it is saved and on the same drive."""
    absolute = os.path.abspath(path)
    return relative(absolute, os.path.dirname(bpy.data.filepath)) if bpy.data.filepath else absolute


def relative(path: str, base: str) -> str:
    """An absolute path in the form stored in a .blend in the folder `base`. A path on another drive stays absolute.

    Relative paths use slashes, which every system accepts.
    """
    try:
        return bpy.path.relpath(path, start=base).replace(os.sep, "/")
    except ValueError:  # another drive on Windows
        return path


def same(first: str, second: str) -> bool:
    """True if two absolute paths are equal by the system's rules: on Windows `c:` is `C:`."""
    return os.path.normcase(first) == os.path.normcase(second)


def absolute(path: str) -> str:
    """The absolute form of a path from the settings; empty for an empty one."""
    return os.path.abspath(bpy.path.abspath(path)) if path else ""
