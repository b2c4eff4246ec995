# pyright: reportMissingTypeStubs=false
"""Typed access to SciPy's k-d tree for nearest neighbours."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree


def nearest(
    points: NDArray[Any], queries: NDArray[Any], count: int, workers: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(distances [Q, count], indices [Q, count]) of the points [N, D] nearest to queries [Q, D], nearest first.

    If there are fewer points than `count`, missing distances are infinite and their index is N.
    workers: number of threads; -1: all cores.
    """
    found: Any = cast(Any, KDTree)(points).query(queries, k=count, workers=workers)
    shape = (len(queries), count)
    return cast(NDArray[np.float64], found[0].reshape(shape)), cast(NDArray[np.int64], found[1].reshape(shape))
