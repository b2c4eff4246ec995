"""Processes beside Blender: the backend's jobs and what else is started, and the timer that follows them."""
