"""Short trainings of the tiny world, step by step or whole, and their comparison."""

from pathlib import Path

import torch

from torch_backend.contract import TrainParams
from torch_backend.train.checkpoint import CHECKPOINT_FILE, load_checkpoint
from torch_backend.train.events import schedule_events
from torch_backend.train.trainer import Trainer


def short(run: str, **changes) -> TrainParams:
    return TrainParams(run=run, iterations=60, max_gaussians=1500, **changes)


def take_steps(trainer: Trainer, count: int) -> torch.Tensor | None:
    """Loss of the last of `count` steps of the loop of `Trainer.run`, without checkpoints."""
    loss = None
    for _ in range(count):
        schedule_events(trainer)
        loss = trainer.step()
        trainer.iteration += 1
    return loss


def assert_same_run(first: Path, second: Path, rtol: float = 1e-4, atol: float = 1e-5) -> None:
    """Assert that the checkpoints of two runs are equal."""
    (one, facts), (two, other) = (load_checkpoint(folder / CHECKPOINT_FILE) for folder in (first, second))
    assert one.keys() == two.keys() and facts["iteration"] == other["iteration"]
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, rtol=rtol, atol=atol, msg=name)
