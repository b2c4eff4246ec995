"""Cameras and points of a solve: stored, placed in a scene, read from and written for other programs."""
