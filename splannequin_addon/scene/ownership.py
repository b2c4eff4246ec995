"""What marks a data-block, node or object as ours, and an output path."""

from __future__ import annotations

TAG = "splannequin"
MATTE_SHOT = "splannequin_matte_shot"
"""Property of an image that a motion matte is painted on: its shot's folder, as a .blend holds it."""
BAKES = "bake"
"""Folder in a shot that takes are rendered into, if the scene names no other."""
DIGITS = "######"
"""Name of the pictures that a bake makes: their frame."""
