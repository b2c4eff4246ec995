"""Paths as a .blend holds them."""

from __future__ import annotations

import os
from pathlib import Path

import bpy


def blend_path(path: Path) -> str:
    """`path` as a .blend should hold it: relative to the file if it is saved and on the same drive."""
    absolute = os.path.abspath(path)
    if not bpy.data.filepath:
        return absolute
    try:
        return bpy.path.relpath(absolute)
    except ValueError:  # another drive on Windows
        return absolute


def absolute(path: str) -> str:
    """A path of the settings, absolute; empty if there is none."""
    return os.path.abspath(bpy.path.abspath(path)) if path else ""
