"""How long the lists of hits are, so that no call of the CUDA rasteriser reads anything back.

A list has a fixed capacity per call, so that nothing is read back. The first call of a device, camera
count and image size waits for the number of its hits: no guess would do, from 4 tiles a Gaussian to 40. From then on
the device keeps the most hits that such a call ever wanted, and sends the figure to the host without anyone waiting for
it; more Gaussians than before are given as many each. A call with more hits than its list holds is slower, never wrong:
its tiles then search all Gaussians in depth order (see `cuda_source.py`), and a later call has a larger list. A list
takes a quarter of the card's free memory at most. `RasterOutput.hits` says, on the device, how many hits a call had and
how many its list held.
"""

import threading

import torch
from torch import Tensor

from .settings import Scene

HITS_MAX = 2**27
HITS_STEP = 2**12
_FULL = 0.9
"""Share of a list from which on it is made larger."""
HIT_BYTES = 40
"""Bytes of one hit: its tile and slot, both sorted, the order that sorts them, and the sort's own scratch."""
_lock = threading.RLock()
_demands: dict[tuple[torch.device, int, int, int], "Demand"] = {}


class Demand:
    """How many hits calls of one shape want: a running maximum on the device, and its echo on the host."""

    def __init__(self, device: torch.device):
        # Made for all later calls, so not a tensor of the inference mode that the first one may be in.
        with torch.inference_mode(False):
            self.most = torch.zeros(1, dtype=torch.int64, device=device)
            self.echo = torch.zeros(1, dtype=torch.int64, pin_memory=device.type == "cuda")
        self.host = self.echo.numpy()
        self.capacity = self.slots = 0

    def grow(self, hit_count: Tensor) -> None:
        """Room for a third more than was wanted so far; before that is known, than the hits of this call, which are
        waited for. hit_count: int32 [slots] on the device."""
        slots = hit_count.shape[0]
        demand = int(self.host[0]) if self.capacity else int(hit_count.sum(dtype=torch.int64))
        if self.slots and slots > self.slots:
            demand = demand * slots // self.slots
        self.slots = max(self.slots, slots)
        if self.capacity == 0 or demand > _FULL * self.capacity:
            wanted = max(demand * 4 // 3, self.capacity, 1)
            most = max(min(_hits_at_most(self.most.device), HITS_MAX), self.capacity, HITS_STEP)
            self.capacity = min(-(-wanted // HITS_STEP) * HITS_STEP, most)

    def report(self) -> None:
        """Sends the maximum to the host after the work queued so far; until it arrives, the previous value is read."""
        if not _capturing(self.most.device):
            self.echo.copy_(self.most, non_blocking=True)


def _hits_at_most(device: torch.device) -> int:
    """Hits whose list fits a quarter of what is free on the device."""
    if device.type != "cuda":
        return HITS_MAX
    free, _ = torch.cuda.mem_get_info(device)
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return max(1, free // 4 // HIT_BYTES)


def forget_demands() -> None:
    """Drops the lists' sizes: each is requested anew, by the memory that is free then."""
    with _lock:
        _demands.clear()


def outgrown(device: torch.device, cameras: int, width: int, height: int) -> int:
    """Hits that calls of this device and size came to want, as far as the host knows, if that is more than they have
    room for with a margin; else 0."""
    demand = _demands.get((device, cameras, width, height))
    wanted = 0 if demand is None else int(demand.host[0])
    return wanted if demand is not None and wanted > _FULL * demand.capacity else 0


def listed(device: torch.device, cameras: int, width: int, height: int) -> int:
    """Hits that calls of this device and size have room for now."""
    demand = _demands.get((device, cameras, width, height))
    return 0 if demand is None else demand.capacity


def report_demands(device: torch.device) -> None:
    """Has the host told what calls came to want: those that a CUDA graph carries out do not tell it themselves."""
    with _lock:
        for (of, *_), demand in _demands.items():
            if of == device:
                demand.report()


def _capturing(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def demand_of(scene: Scene, hit_count: Tensor) -> Demand:
    """The demand of calls like this one, of hit_count int32 [slots], brought up to date."""
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
