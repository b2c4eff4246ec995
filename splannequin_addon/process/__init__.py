"""Processes outside Blender: the backend's jobs and other children, and the timer that monitors them."""
