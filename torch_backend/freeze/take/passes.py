"""Passes of a frozen frame, computed from its depth: motion vectors of the camera move, normals and positions.

The world is static, so the motion of a pixel is that of its surface point between the cameras of two frames. The
layout of the passes is that of a Cycles render with bpy 5.0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...cameras.placement import Similarity
from ...contract import NO_DEPTH
from ...scene import Scene
from ...torch_types import floats
from ..exr import LazyLayer
from ..frozen import OutputFrame

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_NEAREST = 1e-6
"""Depth in scene units of the model below which a point counts as behind a camera."""
_VECTOR_SIGNS = np.array([1.0, 1.0, -1.0, -1.0], np.float32)
"""Signs of Blender's Vector pass: its second half points from the next frame to this frame."""


@dataclass(frozen=True)
class Passes:
    """Computes the passes of a take's frames."""

    frames: Sequence[OutputFrame]
    """All frames of the take, ascending."""
    scene: Scene
    """The shot's cameras and frames."""
    to_scene: Similarity
    """Similarity from solve units to the axes and units of Blender's scene."""

    def facts(self, output: OutputFrame) -> list[Any]:
        """Inputs of a frame's passes for its key, in addition to the inputs of its picture."""
        near = [
            (frame.frame, floats(frame.viewmat.flatten()), floats(frame.K.flatten()))
            for frame in self._adjacent(output)
            if frame is not None
        ]
        return [self.to_scene.matrix.flatten().tolist(), near]

    def of(self, output: OutputFrame, K: Tensor, depth: Tensor) -> dict[str, LazyLayer]:
        """The layers of a frame by name, computed some rows at a time.

        Args:
            output: the frame.
            K: [3, 3] intrinsics of the frame in pixels of `depth`, overscan included.
            depth: [H, W] along the camera's axis, scene units of the model; `NO_DEPTH` without a surface.

        Returns:
            Vector: [H, W, 4] pixels, x right and y up: the point's position in the previous frame minus that in this
            frame; then its position in this frame minus that in the next frame. 0 at the ends of the take.
            forward: [H, W, 2] pixels, x right and y up: the point's position in the next frame minus that in this one.
            backward: [H, W, 2] the same for the previous frame; both as Nuke's VectorBlur reads them.
            Normal: [H, W, 3] unit vectors facing the camera, in the scene's axes.
            Position: [H, W, 3] in the scene's axes and units.
            All layers are 0 without a surface.
        """
        height, width = depth.shape
        lens = K.double().numpy()

        def seen(rows: slice) -> tuple[Array, Mask]:
            return _unprojected(depth[rows].double().numpy(), rows.start, output, lens)

        @functools.lru_cache(maxsize=1)  # three layers use the same band
        def moves(top: int, end: int) -> NDArray[np.float32]:
            return self._moves(*seen(slice(top, end)), output, lens, top)

        def moved(rows: slice) -> NDArray[np.float32]:
            return moves(rows.start, rows.stop)

        def layer(channels: int, rows: Callable[[slice], NDArray[np.float32]]) -> LazyLayer:
            return LazyLayer((height, width, channels), rows)

        return {
            "Vector": layer(4, lambda rows: moved(rows) * _VECTOR_SIGNS),
            "forward": layer(2, lambda rows: moved(rows)[..., 2:]),
            "backward": layer(2, lambda rows: moved(rows)[..., :2]),
            "Normal": layer(3, lambda rows: self._normals(seen, rows, height)),
            "Position": layer(3, lambda rows: self._positions(*seen(rows))),
        }

    def _adjacent(self, output: OutputFrame) -> tuple[OutputFrame | None, OutputFrame | None]:
        """(previous, next) frame of the take; None if missing."""
        at = {frame.frame: frame for frame in self.frames}
        return at.get(output.frame - 1), at.get(output.frame + 1)

    def _positions(self, points: Array, is_solid: Mask) -> NDArray[np.float32]:
        solve = points / self.scene.scale + self.scene.centre
        return np.where(is_solid[..., None], self.to_scene.points(solve), 0.0).astype(np.float32)

    def _normals(
        self, seen: Callable[[slice], tuple[Array, Mask]], rows: slice, height: int
    ) -> NDArray[np.float32]:  # fmt: skip
        """[h, W, 3] normals from the nearer horizontal and vertical neighbour of each point, to ignore depth steps."""
        padded = slice(max(0, rows.start - 1), min(height, rows.stop + 1))
        inner = slice(rows.start - padded.start, rows.stop - padded.start)
        points, is_solid = seen(padded)
        normals = np.cross(_slope(points, is_solid, 0), _slope(points, is_solid, 1))[inner]
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        has_normal = is_solid[inner][..., None] & (lengths > 0.0)
        units = normals / np.where(has_normal, lengths, 1.0) @ self.to_scene.rotation.T
        return np.where(has_normal, units, 0.0).astype(np.float32)

    def _moves(
        self, points: Array, is_solid: Mask, output: OutputFrame, lens: Array, top: int
    ) -> NDArray[np.float32]:  # fmt: skip
        """[h, w, 4] image motion in pixels, x right and y up: to the previous frame, then to the next frame."""
        found = np.zeros((*is_solid.shape, 4), np.float32)
        x, y = _centres(is_solid.shape, top)
        for at, neighbour in zip((0, 2), self._adjacent(output), strict=True):
            if neighbour is None:
                continue
            its_lens = neighbour.K.double().numpy().copy()
            its_lens[:2, 2] += (lens - output.K.double().numpy())[:2, 2]  # the same overscan as this frame
            viewmat = neighbour.viewmat.double().numpy()
            local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            is_in_front = is_solid & (local[..., 2] > _NEAREST)
            safe_z = np.where(is_in_front, local[..., 2], 1.0)
            across = its_lens[0, 0] * local[..., 0] / safe_z + its_lens[0, 2] - x
            down = its_lens[1, 1] * local[..., 1] / safe_z + its_lens[1, 2] - y
            found[..., at] = np.where(is_in_front, across, 0.0)
            found[..., at + 1] = np.where(is_in_front, -down, 0.0)
        return found


def _centres(shape: tuple[int, ...], top: int) -> tuple[Array, Array]:
    """(x [w], y [h, 1]) of pixel centres; the rows start at row `top`."""
    x, y = np.arange(shape[1], dtype=np.float64), np.arange(top, top + shape[0], dtype=np.float64)
    half = np.float64(0.5)
    return x + half, y[:, None] + half


def _unprojected(depth: Array, top: int, output: OutputFrame, lens: Array) -> tuple[Array, Mask]:
    """(points [h, w, 3] in scene units of the model, bool [h, w] True on surfaces) of rows of depth [h, w]."""
    x, y = _centres(depth.shape, top)
    is_solid = depth < NO_DEPTH
    solid = np.where(is_solid, depth, 1.0)
    local = np.stack([(x - lens[0, 2]) / lens[0, 0] * solid, (y - lens[1, 2]) / lens[1, 1] * solid, solid], axis=-1)
    viewmat = output.viewmat.double().numpy()
    return (local - viewmat[:3, 3]) @ viewmat[:3, :3], is_solid


def _slope(points: Array, is_solid: Mask, axis: int) -> Array:
    """[h, w, 3] difference along an axis (0 down, 1 across) to the nearer of two neighbours; 0 without neighbours."""
    steps = np.diff(points, axis=axis)
    has_both = np.take(is_solid, range(1, is_solid.shape[axis]), axis) & np.take(
        is_solid, range(is_solid.shape[axis] - 1), axis
    )
    steps[~has_both] = np.inf
    edge = np.full_like(np.take(points, [0], axis), np.inf)
    forward, backward = np.concatenate([steps, edge], axis), np.concatenate([edge, steps], axis)
    is_forward = np.linalg.norm(forward, axis=-1) <= np.linalg.norm(backward, axis=-1)
    nearer = np.where(is_forward[..., None], forward, backward)
    return np.where(np.isfinite(nearer), nearer, 0.0)
