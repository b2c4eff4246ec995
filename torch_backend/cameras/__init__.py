"""Cameras and points of a solve: storage, placement in a scene, import from and export to other programs."""
