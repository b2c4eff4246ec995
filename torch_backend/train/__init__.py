"""Training of a run: presets, schedules, the training loop, checkpoints and metrics."""

from .config import PRESETS, TrainConfig, config_from_params
from .device import choose_device
from .loaded import LoadedRun, load_run
from .run import train_shot
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
