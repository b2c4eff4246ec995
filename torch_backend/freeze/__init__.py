"""A run, an instant t* and a camera path into frozen frames: EXR, mattes, previews, video, PLY."""

from .frozen import FrozenGaussians, freeze_at, suggest_t_star
from .take import freeze_shot

__all__ = ["FrozenGaussians", "freeze_at", "freeze_shot", "suggest_t_star"]
