# pyright: reportMissingTypeStubs=false
"""Nearest neighbours among points of space, by SciPy's tree, which has no types of its own."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree


def nearest(
    points: NDArray[Any], queries: NDArray[Any], count: int, workers: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The points [N, D] nearest to queries [Q, D], nearest first: (distances [Q, count], index [Q, count]).

    Where there are fewer points than `count`, distances are infinite and the index is N. `workers`: threads; -1: all.
    """
    found: Any = cast(Any, KDTree)(points).query(queries, k=count, workers=workers)
    shape = (len(queries), count)
    return cast(NDArray[np.float64], found[0].reshape(shape)), cast(NDArray[np.int64], found[1].reshape(shape))
