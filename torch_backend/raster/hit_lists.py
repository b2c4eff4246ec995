"""Capacity of the lists of hits, chosen so that calls of the CUDA rasteriser do not wait for the GPU.

The first call of a device, camera count and image size waits for its number of hits. Afterwards the device keeps the
largest number of hits of such calls and copies it to the host asynchronously. A call with more hits than its list holds
is slower but correct: its tiles search all Gaussians in depth order (see `cuda_source.py`), and a later call has a
larger list. A list takes at most a quarter of the card's free memory. `RasterOutput.hits` holds, on the device, the
number of hits of a call and the capacity of its list.
"""

import threading

import torch
from torch import Tensor

from .settings import Scene

HITS_MAX = 2**27
HITS_STEP = 2**12
# Filled share of a list above which its capacity is raised.
_FULL = 0.9
HIT_BYTES = 40
"""Bytes of one hit: its tile and slot, before and after sorting, the permutation, and scratch memory of the sort."""
_lock = threading.RLock()
_demands: dict[tuple[torch.device, int, int, int], "Demand"] = {}


class Demand:
    """Number of hits of calls of one shape: a running maximum on the device, and its copy on the host."""

    def __init__(self, device: torch.device):
        # Later calls reuse these tensors, so they must not be inference tensors even if the first call is in that mode.
        with torch.inference_mode(False):
            self.most = torch.zeros(1, dtype=torch.int64, device=device)
            self.echo = torch.zeros(1, dtype=torch.int64, pin_memory=device.type == "cuda")
        self.host = self.echo.numpy()
        self.capacity = self.slots = 0

    def grow(self, hit_count: Tensor) -> None:
        """Raise the capacity to a third more than the largest number of hits so far.

        The first call waits for its hits, int32 `hit_count` [slots] on the device, and uses their number instead.
        """
        slots = hit_count.shape[0]
        # The first call has to wait: a Gaussian has from 4 to 40 tiles, so a guess is not possible.
        demand = int(self.host[0]) if self.capacity else int(hit_count.sum(dtype=torch.int64))
        if self.slots and slots > self.slots:
            # The measured demand belongs to fewer Gaussians.
            demand = demand * slots // self.slots
        self.slots = max(self.slots, slots)
        if self.capacity == 0 or demand > _FULL * self.capacity:
            capacity = max(demand * 4 // 3, self.capacity, 1)
            most = max(min(_hits_at_most(self.most.device), HITS_MAX), self.capacity, HITS_STEP)
            self.capacity = min(-(-capacity // HITS_STEP) * HITS_STEP, most)

    def report(self) -> None:
        """Copy the maximum to the host, behind the work queued so far. Until then the host reads the previous value."""
        if not _capturing(self.most.device):
            self.echo.copy_(self.most, non_blocking=True)


def _hits_at_most(device: torch.device) -> int:
    """Number of hits whose list takes a quarter of the device's free memory."""
    if device.type != "cuda":
        return HITS_MAX
    free, _ = torch.cuda.mem_get_info(device)
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return max(1, free // 4 // HIT_BYTES)


def forget_demands() -> None:
    """Drop all capacities, so that the next calls choose them anew by the memory that is free then."""
    with _lock:
        _demands.clear()


def outgrown(device: torch.device, cameras: int, width: int, height: int) -> int:
    """Largest known number of hits of calls of this device and size if the list's capacity must grow for it; else 0."""
    demand = _demands.get((device, cameras, width, height))
    hits = 0 if demand is None else int(demand.host[0])
    return hits if demand is not None and hits > _FULL * demand.capacity else 0


def listed(device: torch.device, cameras: int, width: int, height: int) -> int:
    """Current capacity of the list for calls of this device and size; 0 before the first call."""
    demand = _demands.get((device, cameras, width, height))
    return 0 if demand is None else demand.capacity


def report_demands(device: torch.device) -> None:
    """Copy the device's maxima to the host, which calls replayed by a CUDA graph do not do."""
    with _lock:
        for (of, *_), demand in _demands.items():
            if of == device:
                demand.report()


def _capturing(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def demand_of(scene: Scene, hit_count: Tensor) -> Demand:
    """The demand for calls of this scene's shape, updated with `hit_count`, int32 [slots]."""
    device, cameras = scene.means.device, scene.viewmats.shape[0]
    with _lock:
        key = (device, cameras, scene.width, scene.height)
        if key not in _demands:
            if _capturing(device):
                raise RuntimeError(
                    "capture a rasterize call as a CUDA graph only after one of the same device, image "
                    "size and number of cameras outside the capture"
                )
            _demands[key] = Demand(device)
        _demands[key].grow(hit_count)
        return _demands[key]
