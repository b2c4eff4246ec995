"""What can be known of each picture's pixels: depth, what was in view at t*, what moves. From exact geometry.

Rays through the pixel centres meet the triangles of the frozen scene. A pixel of the truth is *seen* if its surface
point lies inside the clip's own frame t* and nothing stands before it there (sky: if that direction is in the frame
and open). It *moves* if the projection of its surface point into this very view is, at any frame of the clip, farther
than MOVING_PX from where it is at t*: a still wall before which somebody moves does not. Shadows, exposure and the
rolling shutter are no motion in this sense; the views are those of the exact cameras, all rows at the frame's time.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_backend.shot import atomic_path

from .cameras import intrinsics
from .generate import camera_of, frame_name, frame_number, frame_seconds
from .noise import Array
from .rays import Hits, RayScene
from .sizes import MOVING_PX, Size

DEPTH_STEPS_PER_METRE = 1000.0


@dataclass
class Geometry:
    """All triangles of a scene over its clip."""

    static: NDArray[np.float32]
    """[S, 3] vertices that never move."""
    moving: NDArray[np.float32]
    """[T, M, 3] those that may; numbered after the static ones."""
    triangles: NDArray[np.int32]
    """[F, 3]."""

    @classmethod
    def load(cls, folder: Path) -> Geometry:
        """What generate.write_geometry wrote and the camera can see."""
        plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        with np.load(folder / "geometry" / "static.npz", allow_pickle=False) as data:
            static, triangles = data["vertices"], [data["triangles"]]
        moving, at = [], len(static)
        for mover in plan["movers"]:
            if not mover["in_view"]:
                continue
            vertices = np.load(folder / "geometry" / f"{mover['name']}.npy", allow_pickle=False)
            with np.load(folder / "geometry" / f"{mover['name']}.npz", allow_pickle=False) as data:
                triangles.append(data["triangles"] + at)
            moving.append(vertices)
            at += vertices.shape[1]
        return cls(static, np.concatenate(moving, axis=1), np.concatenate(triangles))

    def at(self, index: int) -> RayScene:
        """The scene as it stands at a frame."""
        return RayScene(np.concatenate([self.static, self.moving[index]]), self.triangles)


@dataclass
class View:
    """A pinhole camera: world-to-camera [4, 4], K [3, 3] in pixels, centres at +0.5."""

    matrix: Array
    K: Array
    width: int
    height: int

    @property
    def eye(self) -> Array:
        return -self.matrix[:3, :3].T @ self.matrix[:3, 3]

    def rays(self) -> Array:
        """[H*W, 3] world directions through the pixel centres, of unit depth."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        local = np.stack([(x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1], np.ones_like(x)], -1)
        return local.reshape(-1, 3) @ self.matrix[:3, :3]

    def project(self, points: Array, at_infinity: bool = False) -> tuple[Array, Array]:
        """([..., 2] pixels, [...] depth) of world points, or of directions."""
        local = points @ self.matrix[:3, :3].T + (0.0 if at_infinity else self.matrix[:3, 3])
        depth = local[..., 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return local[..., :2] / safe[..., None] * self.K[[0, 1], [0, 1]] + self.K[:2, 2], depth

    def shows(self, pixels: Array, depth: Array) -> NDArray[np.bool_]:
        """[...] whether projected points fall into the picture."""
        inside = (pixels >= 0.0).all(-1) & (pixels[..., 0] <= self.width) & (pixels[..., 1] <= self.height)
        return inside & (depth > 0.0)


def write_regions(folder: Path, seed: int, kind: str, size: Size, progress: Callable[[int, int], None]) -> None:
    """masks/NNNNNN.npz for the clip's frames and truth/<t*>/NNNNNN.npz for the truth's; what exists is left alone."""
    views = views_of(seed, size, kind)
    instants = set(size.t_star_indices())
    todo: dict[int, list[tuple[int | None, Path]]] = {}
    for index in range(size.frames):
        wanted: list[tuple[int | None, Path]] = [(None, folder / "masks" / frame_name(index))]
        if index in instants:
            wanted += [
                (p, folder / "truth" / f"{frame_number(index):06d}" / frame_name(p)) for p in size.pose_indices()
            ]
        missing = [(pose, path.with_suffix(".npz")) for pose, path in wanted if not path.with_suffix(".npz").exists()]
        if missing:
            todo[index] = missing
    if not todo:
        return
    geometry = Geometry.load(folder)
    total, done = sum(map(len, todo.values())), 0
    for index, missing in todo.items():
        scene = geometry.at(index)
        for pose, path in missing:
            own = views[index]
            maps = region_maps(geometry, scene, index, own if pose is None else views[pose], own)
            if pose is None:
                del maps["seen"]
            with atomic_path(path) as beside:
                np.savez_compressed(beside, **maps)
            done += 1
            progress(done, total)


def views_of(seed: int, size: Size, kind: str = "plain") -> list[View]:
    """The exact cameras of the clip's frames."""
    K = intrinsics(size.width, size.height)
    matrices = camera_of(seed, size, kind).world_to_camera(frame_seconds(size))
    return [View(matrix, K, size.width, size.height) for matrix in matrices]


def region_maps(geometry: Geometry, scene: RayScene, index: int, view: View, own: View) -> dict[str, Any]:
    """depth_mm uint16 [H, W] (0: sky), moving and seen bool [H, W] of the scene of frame `index` from `view`.

    `own` is the clip's camera at that frame.
    """
    rays = view.rays()
    eye = view.eye
    hits = scene.cast(np.broadcast_to(eye, rays.shape), rays)
    sky = hits.face < 0
    # The rays have unit depth, so the distance in ray lengths is the planar depth.
    depth = np.where(sky, 0.0, np.clip(np.round(hits.distance * DEPTH_STEPS_PER_METRE), 1, 65535))
    points = eye + rays * np.where(sky, 1.0, hits.distance)[:, None]
    seen = np.zeros(len(rays), bool)
    there = ~sky
    pixels, z = own.project(points[there])
    seen[there] = own.shows(pixels, z) & scene.sees(own.eye, points[there])
    if sky.any():
        pixels, z = own.project(rays[sky], at_infinity=True)
        seen[sky] = own.shows(pixels, z) & scene.escapes(own.eye, rays[sky])
    shape = view.height, view.width
    return {
        "depth_mm": depth.astype(np.uint16).reshape(shape),
        "moving": _moving(geometry, hits, index, view).reshape(shape),
        "seen": seen.reshape(shape),
    }


def _moving(geometry: Geometry, hits: Hits, index: int, view: View) -> NDArray[np.bool_]:
    """[R] whether the surface that each ray met is ever elsewhere in this view."""
    moving = np.zeros(len(hits.face), bool)
    corners = geometry.triangles[np.maximum(hits.face, 0)] - len(geometry.static)
    which = np.flatnonzero((hits.face >= 0) & (corners[:, 0] >= 0))
    if len(which) == 0:
        return moving
    corners, weights = corners[which], hits.barycentric[which].astype(np.float64)

    def project(time: int) -> Array:
        return view.project(np.einsum("nk,nkd->nd", weights, geometry.moving[time][corners].astype(np.float64)))[0]

    here = project(index)
    farthest = np.zeros(len(which))
    for time in range(len(geometry.moving)):
        farthest = np.maximum(farthest, np.linalg.norm(project(time) - here, axis=1))
    moving[which] = farthest > MOVING_PX
    return moving
