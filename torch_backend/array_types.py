# pyright: reportMissingTypeStubs=false
"""Typed wrappers for untyped functions of NumPy and SciPy: each is one call and a cast, as in `torch_types`."""

from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy import sparse


class SparseMatrix(Protocol):
    """A matrix [R, C] of float32 of which most entries are zero."""

    def __matmul__(self, dense: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Product [R, N] with a dense matrix [C, N]."""
        ...


def sparse_rows(
    weights: NDArray[np.float32], columns: NDArray[np.integer[Any]], starts: NDArray[np.integer[Any]], width: int
) -> SparseMatrix:
    """Sparse matrix [R, width] from its rows. Row r has the values `weights[starts[r]:starts[r + 1]]` in the columns
    `columns[starts[r]:starts[r + 1]]`."""
    return cast(Any, sparse).csr_array((weights, columns, starts), shape=(len(starts) - 1, width))


def sparse_entries(
    weights: NDArray[np.float32],
    rows: NDArray[np.integer[Any]],
    columns: NDArray[np.integer[Any]],
    shape: tuple[int, int],
) -> SparseMatrix:
    """Sparse matrix from its entries, in any order. Entries at the same position are added."""
    library = cast(Any, sparse)
    return library.csr_array(library.coo_array((weights, (rows, columns)), shape=shape))


def pieces(first: NDArray[np.integer[Any]], second: NDArray[np.integer[Any]], count: int) -> NDArray[np.int32]:
    """Connected component of each node of a graph, [count] labels from 0. Edges join `first` [E] with `second` [E]."""
    from scipy.sparse import csgraph

    graph = sparse_entries(np.ones(len(first), np.float32), first, second, (count, count))
    return np.asarray(cast(Any, csgraph).connected_components(graph, directed=False)[1], np.int32)


def meshgrid(x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """`np.meshgrid` of two axes [W] and [H]: x and y at each place, [H, W] each."""
    return cast(tuple[NDArray[Any], NDArray[Any]], np.meshgrid(x, y))


def between_nodes(
    nodes: tuple[NDArray[np.float64], NDArray[np.float64]],
    values: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Cubic spline interpolation of the grid `values` [y, x] at the coordinates `x` and `y`: [len(y), len(x)].

    `nodes`: x and y coordinates of the grid, ascending, at least four each."""
    from scipy import interpolate  # takes a second to import; only the lens of an ST map needs it

    spline = cast(Any, interpolate).RectBivariateSpline(nodes[1], nodes[0], values)
    return np.asarray(spline(y, x), np.float64)


def save_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """`np.savez` of a dictionary, whose keys a type checker would take for parameters of `np.savez`."""
    entries: Any = arrays
    np.savez(path, **entries)


def linear_solution(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution x of matrix [K, K] @ x = right [K, M], as `np.linalg.solve`. LinAlgError if the matrix is singular."""
    return np.asarray(cast(Any, np.linalg).solve(matrix, right))
