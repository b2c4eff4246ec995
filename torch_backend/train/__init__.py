"""A run: presets, schedules, the loop, checkpoints, metrics over time."""

from .config import PRESETS, TrainConfig, config_from_params
from .device import choose_device
from .run import LoadedRun, load_run, train_shot
from .static_world import static_views

__all__ = [
    "PRESETS",
    "LoadedRun",
    "TrainConfig",
    "choose_device",
    "config_from_params",
    "load_run",
    "static_views",
    "train_shot",
]
