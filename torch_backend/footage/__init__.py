"""Footage: a video or an image sequence into the working frames of a shot."""

from .importing import FootageConfig, import_footage, load_frames

__all__ = ["FootageConfig", "import_footage", "load_frames"]
