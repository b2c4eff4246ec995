"""Interface of a rival renderer for `python -m benchmarks.raster --peer MODULE`; MODULE is a Python import path.

Such a module has a `NAME` and two functions with the signatures of `Peer`. `gsplat.py` in this folder is an example.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from benchmarks.workload import Workload


@dataclass(frozen=True)
class Prepared:
    """One workload, ready for repeated rendering."""

    forward: Callable[[], Tensor]
    """Renders and returns the image [H, W, 3], float32, black background, with its autograd graph."""
    leaves: dict[str, Tensor]
    """Tensors that get gradients, in the peer's parametrisation, by the names of `rasterize`."""


class Peer(Protocol):
    """A module that renders a workload's Gaussians."""

    NAME: str

    def missing(self, device: str) -> str | None:
        """A sentence that names what is missing to run on `device` ('cpu' or 'cuda'); None if nothing is."""
        ...

    def prepare(self, work: Workload, device: str) -> Prepared:
        """Puts the workload on the device. Torch's number of threads is already set."""
        ...
