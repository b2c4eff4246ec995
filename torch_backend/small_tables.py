"""Small constant tables of numbers on a device, each sent there once."""

import functools

import torch
from torch import Tensor


@functools.lru_cache(maxsize=4096)
def small_table(rows: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Tensor [rows, columns] on the device. Equal numbers share one tensor, so it must not be written to.

    The cache keeps thousands of tables, because a recorded step reads a table at its address (`train.recorder`).
    """
    values = torch.tensor(rows, dtype=dtype, device="cpu", pin_memory=device.type == "cuda")
    return values.to(device, non_blocking=True)
