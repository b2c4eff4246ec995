"""Paths as a .blend holds them."""

from __future__ import annotations

import os
from pathlib import Path

import bpy


def blend_path(path: Path) -> str:
    """`path` as a .blend should hold it: relative to the file if it is saved and on the same drive."""
    absolute = os.path.abspath(path)
    return relative(absolute, os.path.dirname(bpy.data.filepath)) if bpy.data.filepath else absolute


def relative(path: str, base: str) -> str:
    """An absolute path as a .blend in the folder `base` should hold it; as it is on another drive. With slashes, which
    every system reads."""
    try:
        return bpy.path.relpath(path, start=base).replace(os.sep, "/")
    except ValueError:  # another drive on Windows
        return path


def same(one: str, other: str) -> bool:
    """True if two absolute paths are one as the system writes them: on Windows `c:` is `C:`."""
    return os.path.normcase(one) == os.path.normcase(other)


def absolute(path: str) -> str:
    """A path of the settings, absolute; empty if there is none."""
    return os.path.abspath(bpy.path.abspath(path)) if path else ""
