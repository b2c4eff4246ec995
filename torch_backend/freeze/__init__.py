"""Renders frozen frames from a run, an instant t* and a camera path: EXR, mattes, previews, video, PLY."""

from .frozen import FrozenGaussians, freeze_at
from .take.job import freeze_shot
from .take.parts import finish_take, freeze_part, open_take

__all__ = [
    "FrozenGaussians", "finish_take", "freeze_at", "freeze_part", "freeze_shot", "open_take",
]  # fmt: skip
