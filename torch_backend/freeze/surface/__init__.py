"""Fuses the depth of a take's frames to a mesh of the frozen scene's surface."""
