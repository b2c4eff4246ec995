"""Import of footage: converts a video or an image sequence to the working frames of a shot."""

from .importing import FootageConfig, import_footage, load_frames

__all__ = ["FootageConfig", "import_footage", "load_frames"]
