"""Blender's scene: its settings, image sequences, paths, and transactions."""
