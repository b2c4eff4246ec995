"""A run: presets, schedules, the loop, checkpoints, metrics over time."""

from .config import PRESETS, TrainConfig, config_from_params
from .run import LoadedRun, load_run, train_shot

__all__ = ["PRESETS", "LoadedRun", "TrainConfig", "config_from_params", "load_run", "train_shot"]
