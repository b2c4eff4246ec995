"""A run, an instant t* and a camera path into frozen frames: EXR, mattes, previews, video, PLY."""

from .frozen import FrozenGaussians, freeze_at
from .parts import finish_take, freeze_part, open_take
from .take import freeze_shot

__all__ = [
    "FrozenGaussians", "finish_take", "freeze_at", "freeze_part", "freeze_shot", "open_take",
]  # fmt: skip
