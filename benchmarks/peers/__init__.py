"""What a rival must offer to be timed: `python -m benchmarks.raster --peer MODULE`, MODULE being a Python import path.

Such a module has a `NAME`, and two functions with the signatures of `Peer`. `gsplat.py` beside this file is an example.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from benchmarks.workload import Workload


@dataclass(frozen=True)
class Prepared:
    """One workload, ready to be rendered again and again."""

    forward: Callable[[], Tensor]
    """Renders, and returns the image [H, W, 3], float32, black background, with its graph."""
    leaves: dict[str, Tensor]
    """By the names of `rasterize`: the tensors that get gradients, as the peer is parametrised."""


class Peer(Protocol):
    """A module that renders a workload's Gaussians."""

    NAME: str

    def missing(self, device: str) -> str | None:
        """One sentence that says what is missing to run on `device` ('cpu' or 'cuda'); None if all is there."""
        ...

    def prepare(self, work: Workload, device: str) -> Prepared:
        """Put the workload on the device. Torch's number of threads is set already."""
        ...
