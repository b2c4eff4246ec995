"""Small tables of numbers that stay the same for a run, on the device that reads them: sent once."""

import functools

import torch
from torch import Tensor


@functools.lru_cache(maxsize=4096)
def small_table(rows: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """[rows, columns] on the device, the same tensor for the same numbers: not to be written to.

    Kept for thousands of others: a recorded step reads them where they lie (`train.recorder`).
    """
    values = torch.tensor(rows, dtype=dtype, device="cpu", pin_memory=device.type == "cuda")
    return values.to(device, non_blocking=True)
