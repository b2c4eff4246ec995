"""The lens of an ST map as a polynomial: maps pixels both ways, for any picture size, also past the map's edge.

A map samples a smooth function, often with the rounding of 16-bit floats. It often ends at the border of the
undistorted picture, but redistortion reads beyond that border. Therefore a polynomial in x and y replaces the map.
`map_reading` fits the lowest degree that matches every sample, in the direction that needs the lower degree. Most lens
models are such polynomials in one direction, and extrapolate past the edge as the lens does. The code uses numpy only,
in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ..array_types import between_nodes, linear_solution, meshgrid
from ..contract import ExitCode, JobError

ST_MAP = "ST_MAP"
"""Name of this lens model in solve.json, in the place of COLMAP's model names."""
_ROWS = 64
# Spacing in pixels of the grid on which the inverse is solved; minimum number of intervals along a side.
_NODE_PX, _LEAST_NODES = 8.0, 40
_MOST_STEPS = 60
# Errors in pixels: below the first, Newton's method stops; above the second, it has failed.
_DONE_PX, _WRONG_PX = 1e-9, 1e-6
_BEYOND = 0.5
"""Margin around the polynomial's box for the inversion, as a share of the box."""
# Largest shift in pixels of a map that counts as no distortion.
_NONE_PX = 1e-3
_GRID = 33
"""Points along each side of the grid in the test for a fold."""
# Tolerance for pixels of the plate outside of the original picture: maps are not more accurate.
_SLACK_PX = 0.02
_LEAST_WINDOW, _MOST_WINDOW = 0.1, 2.0


@dataclass(frozen=True)
class Polynomial:
    """A smooth mapping from one plane to another: two polynomials in x and y, in the Chebyshev basis."""

    degree: int
    """Maximum total degree: the sum of the exponents of x and y."""
    box: tuple[float, float, float, float]
    """Minimum x, minimum y, maximum x, maximum y: the region that is scaled to [-1, 1] for the basis."""
    terms: tuple[float, ...]
    """[2, K] coefficients, flattened: first of the resulting x, then of y, in the order of `exponents`."""

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps points [N, 2] to points [N, 2]."""
        return self._values(points, self._tables)

    def slopes(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The Jacobian [N, 2, 2] at points [N, 2]: row result, column input."""
        x, y = self._derived
        return np.stack([self._values(points, x), self._values(points, y)], axis=-1)

    def of_grid(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mapped points [len(y), len(x), 2] of the grid of x and y. Much faster than single points."""
        left, above = self._vanders(x, y)
        return np.stack([above @ table @ left.T for table in self._tables], axis=-1)

    @cached_property
    def _tables(self) -> NDArray[np.float64]:
        """Coefficients [2, degree + 1, degree + 1], indexed by result, exponent of y, exponent of x."""
        tables = np.zeros((2, self.degree + 1, self.degree + 1))
        x, y = exponents(self.degree)
        tables[:, y, x] = np.reshape(self.terms, (2, -1))
        return tables

    @cached_property
    def _derived(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coefficients of the derivatives by x and by y, in the layout of `_tables`."""
        if not self.degree:
            return np.zeros_like(self._tables), np.zeros_like(self._tables)
        found = [chebyshev.chebder(self._tables, axis=axis) for axis in (2, 1)]
        along, down = np.pad(found[0], ((0, 0), (0, 0), (0, 1))), np.pad(found[1], ((0, 0), (0, 1), (0, 0)))
        width, height = self.box[2] - self.box[0], self.box[3] - self.box[1]
        return np.asarray(along * 2.0 / width, np.float64), np.asarray(down * 2.0 / height, np.float64)

    def _values(self, points: NDArray[np.float64], tables: NDArray[np.float64]) -> NDArray[np.float64]:
        left, above = self._vanders(points[:, 0], points[:, 1])
        return np.stack([((above @ table) * left).sum(1) for table in tables], axis=-1)

    def _vanders(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        u = (x - self.box[0]) * (2.0 / (self.box[2] - self.box[0])) - 1.0
        v = (y - self.box[1]) * (2.0 / (self.box[3] - self.box[1])) - 1.0
        one, two = (chebyshev.chebvander(axis, self.degree) for axis in (u, v))
        return np.asarray(one, np.float64), np.asarray(two, np.float64)


def exponents(degree: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Exponents of x and of y of all terms up to a total degree, [K] each."""
    x, y = np.meshgrid(np.arange(degree + 1), np.arange(degree + 1))
    kept = (x + y <= degree).ravel()
    return x.ravel()[kept], y.ravel()[kept]


def fitted(points: NDArray[np.float64], values: NDArray[np.float64], degree: int, box: Sequence[float]) -> Polynomial:
    """Least-squares fit of a polynomial of total degree `degree` that maps `points` [N, 2] to `values` [N, 2]."""
    full = Polynomial(degree, (box[0], box[1], box[2], box[3]), ())
    left, above = full._vanders(points[:, 0], points[:, 1])  # pyright: ignore[reportPrivateUsage]
    x, y = exponents(degree)
    terms = np.linalg.lstsq(left[:, x] * above[:, y], values, rcond=None)[0]
    return Polynomial(degree, full.box, tuple(float(term) for term in terms.T.ravel()))


@dataclass(frozen=True)
class MapLens:
    """The lens of an ST map, and the window of the map's undistorted picture that the undistorted frames show.

    The polynomial maps between two planes with coordinates from 0 to 1, x to the right, y down. One plane is the
    original frame. The other is the map's undistorted picture; the undistorted frames are a window in its middle.
    """

    width: int
    """Pixels of the working frames, original and undistorted."""
    height: int
    """Pixels."""
    bend: Polynomial
    """Mapping between the two planes, in the direction of `forward`."""
    forward: bool = True
    """True if `bend` goes from the undistorted picture to the original."""
    window: tuple[float, float] = (1.0, 1.0)
    """Width and height of the undistorted frames as shares of the map's undistorted picture."""
    intrinsics: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    """fx, fy, cx, cy of the undistorted frames, pixels. Placeholders before the solve."""

    @property
    def params(self) -> list[float]:
        """All fields except size and intrinsics as a list of numbers, for solve.json."""
        head = [float(self.forward), float(self.bend.degree), *self.window, *self.bend.box]
        return [*head, *self.bend.terms]

    @classmethod
    def from_params(
        cls, width: int, height: int, params: Sequence[float], K: Sequence[float] = (1.0, 1.0, 0.0, 0.0)
    ) -> MapLens:
        """The lens stored as `params`, for frames of a size in pixels with intrinsics `K`.

        Raises ValueError if `params` is malformed.
        """
        values = [float(value) for value in params]
        forward, degree = (int(value) for value in values[:2])
        terms = tuple(values[8:])
        if forward not in (0, 1) or not 0 <= degree < 100 or len(terms) != (degree + 1) * (degree + 2):
            raise ValueError(f"{len(values)} numbers of an ST map's lens do not match its degree")
        bend = Polynomial(degree, (values[4], values[5], values[6], values[7]), terms)
        return cls(width, height, bend, bool(forward), (values[2], values[3]), (K[0], K[1], K[2], K[3]))

    @cached_property
    def is_none(self) -> bool:
        """True if original and undistorted frames are the same."""
        border_points = _border_points(self.width, self.height)
        return bool(np.abs(self.to_original(border_points) - border_points).max() < _NONE_PX)

    @property
    def slopes_in_the_middle(self) -> tuple[float, float]:
        """Pixels of the original frame per pixel of the undistorted frame, at the middle, along x and y."""
        middle = np.array([[0.5 * self.width, 0.5 * self.height]])
        ends = self.to_original(middle + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]]))
        return float(ends[1, 0] - ends[0, 0]), float(ends[3, 1] - ends[2, 1])

    def to_original(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps pixels [N, 2] of the undistorted frame to pixels of the original frame.

        Raises JobError (SOLVE) if the inversion fails.
        """
        points = self.map_of_plate(pixels)
        at = self.bend(points) if self.forward else self._inverse(points)
        return at * (self.width, self.height)

    def to_plate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps pixels [N, 2] of the original frame to pixels of the undistorted frame, also beyond its border.

        Raises JobError (SOLVE) if the inversion fails.
        """
        points = pixels / (self.width, self.height)
        at = self._inverse(points) if self.forward else self.bend(points)
        return ((at - 0.5) / self.window + 0.5) * (self.width, self.height)

    def where(self, width: int, height: int) -> NDArray[np.float32]:
        """Position [height, width, 2] in the original picture of each pixel of the undistorted plate of the same size.

        x and y in pixels, centres at +0.5. Raises JobError as `to_original` does.
        """
        ratio = np.array([width / self.width, height / self.height])
        x, y = (np.arange(width) + 0.5) / ratio[0], (np.arange(height) + 0.5) / ratio[1]
        if not self.forward:
            return self._where_between(x, y, ratio)
        out = np.empty((height, width, 2), np.float32)
        for top in range(0, height, _ROWS):
            rows = y[top : top + _ROWS]
            corner = self.map_of_plate(np.stack([x, np.zeros_like(x)], 1))
            side = self.map_of_plate(np.stack([np.zeros_like(rows), rows], 1))
            at = self.bend.of_grid(corner[:, 0], side[:, 1]) * (self.width, self.height)
            out[top : top + _ROWS] = at * ratio
        return out

    def _where_between(
        self, x: NDArray[np.float64], y: NDArray[np.float64], ratio: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """`where` by Newton's method at every eighth pixel, interpolated smoothly."""
        # 0.5 s for HD; 11 s at every pixel.
        nodes = [
            np.linspace(0.0, length, max(_LEAST_NODES, math.ceil(length * scale / _NODE_PX)) + 1)
            for length, scale in zip((self.width, self.height), ratio, strict=True)
        ]
        grid = np.stack(meshgrid(nodes[0], nodes[1]), -1)
        at = self.to_original(grid.reshape(-1, 2)).reshape(grid.shape) * ratio
        planes = [between_nodes((nodes[0], nodes[1]), at[..., n], x, y) for n in (0, 1)]
        return np.stack(planes, axis=-1).astype(np.float32)

    def check(self) -> None:
        """Raises JobError (SOLVE) if the lens folds over within the original frame or within the undistorted one."""
        x, y = np.linspace(0.0, self.width, _GRID), np.linspace(0.0, self.height, _GRID)
        original = np.stack(meshgrid(x, y), -1).reshape(-1, 2)
        if self.forward:
            seen = self.map_of_plate(np.concatenate([original, self.to_plate(original)]))
        else:
            seen = np.concatenate([original, self.to_original(original)]) / (self.width, self.height)
        if not np.linalg.det(self.bend.slopes(seen)).min() > 0.0:
            raise _folded()

    def map_of_plate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps pixels [N, 2] of the undistorted frame to the map's undistorted picture, 0 to 1, y down."""
        return (pixels / (self.width, self.height) - 0.5) * self.window + 0.5

    def _inverse(self, target: NDArray[np.float64]) -> NDArray[np.float64]:
        """The points that `bend` maps to `target` [N, 2], by Newton's method, with an error below 1e-6 px.

        Raises JobError if the iteration does not converge.
        """
        size = np.array([self.width, self.height])
        low, high = np.array(self.bend.box[:2]), np.array(self.bend.box[2:])
        reach = _BEYOND * (high - low)
        at = self._start(target)
        error = np.inf
        with np.errstate(all="ignore"):
            for _ in range(_MOST_STEPS):
                offset = self.bend(at) - target
                error = float(np.abs(offset * size).max(initial=0.0))
                if not error > _DONE_PX:  # converged, or NaN
                    break
                (a, b), (c, d) = np.moveaxis(self.bend.slopes(at), 0, -1)
                det = a * d - b * c
                at[:, 0] -= (d * offset[:, 0] - b * offset[:, 1]) / det
                at[:, 1] -= (a * offset[:, 1] - c * offset[:, 0]) / det
                at = np.clip(at, low - reach, high + reach)
        if not error < _WRONG_PX:
            raise _folded()
        return at

    def _start(self, target: NDArray[np.float64]) -> NDArray[np.float64]:
        """Initial guess for `_inverse`: inverts the linear approximation at the middle."""
        middle = np.array([[0.5, 0.5]])
        return 0.5 + linear_solution(self.bend.slopes(middle)[0], (target - self.bend(middle)).T).T


def widest(lens: MapLens, shape: float, known: Sequence[float] | None = None) -> MapLens:
    """The same lens with the widest window whose pixels all lie within the original frames.

    If the window nearly equals the map's whole picture, it becomes the whole picture, so that the pixels coincide.

    Args:
        lens: lens with any window.
        shape: width over height of the map's undistorted picture.
        known: minimum x, minimum y, maximum x, maximum y of the part of that picture that the map defines; None: all.

    Raises:
        JobError: (SOLVE) even the smallest window extends beyond the original frames.
    """
    ratio = lens.width / lens.height / shape
    sides = np.array([min(1.0, ratio), min(1.0, 1.0 / ratio)])
    border = _border_points(lens.width, lens.height)
    size = np.array([lens.width, lens.height])

    def tried(share: float) -> MapLens:
        x, y = sides * share
        return replace(lens, window=(float(x), float(y)))

    def inside(share: float) -> bool:
        candidate = tried(share)
        points = candidate.map_of_plate(border)
        if known is not None and not ((points > known[:2]) & (points < known[2:])).all():
            return False
        try:
            at = candidate.to_original(border)
        except JobError:
            return False
        return bool(((at > 0.5 - _SLACK_PX) & (at < size - 0.5 + _SLACK_PX)).all())

    low, high = _LEAST_WINDOW, _MOST_WINDOW
    if not inside(low):
        raise JobError(
            "The ST map leaves no usable part of the picture.",
            "Check that it is for this lens, and its direction (--st-map-way).",
            ExitCode.SOLVE,
        )
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if inside(middle) else (low, middle)
    # The outermost pixel centres lie half a pixel inside the picture, so `low` can slightly exceed 1.
    return tried(1.0 if 1.0 <= low <= 1.0 + 3.0 / min(lens.width, lens.height) else low)


def _border_points(width: int, height: int) -> NDArray[np.float64]:
    """Pixel centres [N, 2] of a picture's border, and of its middle row and column."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    lines = [np.stack([x, np.full_like(x, at)], 1) for at in (y[0], y[len(y) // 2], y[-1])]
    lines += [np.stack([np.full_like(y, at), y], 1) for at in (x[0], x[len(x) // 2], x[-1])]
    return np.concatenate(lines).astype(np.float64, copy=False)


def _folded() -> JobError:
    return JobError(
        "The lens of the ST map folds over towards the picture's corners, so its distortion cannot be inverted.",
        "Use a map with overscan, or the map for the other direction (--st-map-way), which may cover more.",
        ExitCode.SOLVE,
    )
