"""Blender's scene: its settings, picture sequences, paths, and changes of it that are whole or nothing."""
