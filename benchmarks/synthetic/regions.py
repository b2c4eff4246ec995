"""Exact masks of each picture from geometry: depth, points seen at t*, and moving points.

Rays through the pixel centres are cast at the triangles of the frozen scene. A pixel of the truth is *seen* if its
surface point is inside the clip's own frame t* and unoccluded there (sky: if its direction is in the frame and
unoccluded). It *moves* if, at any frame of the clip, its surface point projects in this view farther than MOVING_PX
from its place at t*. A still wall behind a mover does not move. Shadows, exposure and the rolling shutter do not count
as motion. Views are those of the exact cameras, with all rows at the frame's time.

In a mirror the reflected point counts: it is seen at t* if the mirror shows it there, and moves as its image moves. On
glass either layer may move; *seen* refers to the point behind the glass. Depth is the mirror's own, and that of the
point behind glass.

Hard scenes have masks of objects (`Regions.objects`). `glass` and `mirror` are the pixels of panes in which nothing
moves, `wall` those of the surrounding still wall within `WALL_METRES` of a pane. `swinging`, `arm` and `hair` are the
pixels whose centre shows the thing. Hair is thinner than a pixel: a pixel is hair if at least `HAIR_SHARE` of
`HAIR_RAYS` squared rays through it hit a strand. Scenes of kind `held` have a mask per held thing, and the region
`held`: see `held_change_mask`.
"""

from __future__ import annotations

import functools
import itertools
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
from .panes import MIRROR, Pane
from .rays import Hits, RayScene
from .sizes import HELD, MOVING_PX, OBJECT_PREFIX, Size

DEPTH_STEPS_PER_METRE = 1000.0
HAIR_RAYS, HAIR_SHARE = 4, 0.15
NUDGE = 1e-4
"""Offset in metres of a reflected ray's origin in front of the pane."""
STILL_SECONDS = 0.5
"""Seconds before and after a plate without motion in a pixel of the region `held`."""
DISPLACED_METRES, SWAY_METRES = 0.04, 0.02
"""Displacements in metres: above the first a surface point counts as elsewhere, up to the second as still. See
docs/synthetic.md for the sway of people who hold still."""
WALL_METRES, WALL_DEPTH = 0.6, 0.04
"""Distances in metres: around a pane within which its wall counts, and greatest distance of a wall point from the
pane's plane. `WALL_DEPTH` includes pictures on the wall, but no furniture."""


@dataclass
class Geometry:
    """All triangles of a scene over its clip."""

    static: NDArray[np.float32]
    """[S, 3] vertices of static objects."""
    moving: NDArray[np.float32]
    """[T, M, 3] vertices of movers, numbered after the static ones."""
    triangles: NDArray[np.int32]
    """[F, 3]."""
    panes: list[Pane]
    """Panes, which are not among the triangles."""
    objects: dict[str, NDArray[np.bool_]]
    """{name of a hard scene's thing: [F] mask of its triangles}."""

    @classmethod
    def load(cls, folder: Path) -> Geometry:
        """Loads the visible geometry written by generate.write_geometry."""
        plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        with np.load(folder / "geometry" / "static.npz", allow_pickle=False) as data:
            static, triangles = data["vertices"], [data["triangles"]]
        moving, at = [], len(static)
        objects, starts, faces = _object_faces(folder, plan), {}, len(triangles[0])
        for mover in plan["movers"]:
            if not mover["in_view"]:
                continue
            vertices = np.load(folder / "geometry" / f"{mover['name']}.npy", allow_pickle=False)
            with np.load(folder / "geometry" / f"{mover['name']}.npz", allow_pickle=False) as data:
                triangles.append(data["triangles"] + at)
            moving.append(vertices)
            at += vertices.shape[1]
            starts[mover["name"]] = faces
            faces += len(triangles[-1])
        panes = [Pane.from_json(pane) for pane in plan.get("panes", [])]
        its = {name: np.zeros(faces, bool) for name, _, _ in objects}
        for name, mover, chosen in objects:
            its[name][starts[mover] : starts[mover] + len(chosen)] = chosen
        return cls(static, np.concatenate(moving, axis=1), np.concatenate(triangles), panes, its)

    def at(self, index: int) -> RayScene:
        """The scene at a frame."""
        return RayScene(np.concatenate([self.static, self.moving[index]]), self.triangles)


def _object_faces(folder: Path, plan: dict[str, Any]) -> list[tuple[str, str, NDArray[np.bool_]]]:
    """(name, mover, mask of the mover's triangles) of every thing of a hard scene."""
    found: list[tuple[str, str, NDArray[np.bool_]]] = []
    if "thing" in plan:
        with np.load(folder / "geometry" / "thing.npz", allow_pickle=False) as data:
            found.append((plan["thing"]["name"], plan["thing"]["mover"], data["faces"]))
    if "held" in plan:
        with np.load(folder / "geometry" / "held.npz", allow_pickle=False) as data:
            found += [(each["thing"], each["mover"], data[each["thing"]]) for each in plan["held"]]
    return found


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

    def rays(self, dx: float = 0.5, dy: float = 0.5) -> Array:
        """[H*W, 3] world directions of unit depth through the pixels, at offset (dx, dy) in each (default: centre)."""
        x, y = np.meshgrid(np.arange(self.width) + dx, np.arange(self.height) + dy)
        local = np.stack([(x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1], np.ones_like(x)], -1)
        return local.reshape(-1, 3) @ self.matrix[:3, :3]

    def project(self, points: Array, at_infinity: bool = False) -> tuple[Array, Array]:
        """([..., 2] pixels, [...] depth) of world points or, at infinity, of directions."""
        local = points @ self.matrix[:3, :3].T + (0.0 if at_infinity else self.matrix[:3, 3])
        depth = local[..., 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return local[..., :2] / safe[..., None] * self.K[[0, 1], [0, 1]] + self.K[:2, 2], depth

    def shows(self, pixels: Array, depth: Array) -> NDArray[np.bool_]:
        """bool [...]: projected points are inside the picture."""
        inside = (pixels >= 0.0).all(-1) & (pixels[..., 0] <= self.width) & (pixels[..., 1] <= self.height)
        return inside & (depth > 0.0)


def write_regions(folder: Path, seed: int, kind: str, size: Size, progress: Callable[[int, int], None]) -> None:
    """Writes missing masks/NNNNNN.npz for the clip's frames and truth/<t*>/NNNNNN.npz for the truth's."""
    views = views_of(seed, size, kind)
    instants = set(size.t_star_indices())
    todo: dict[int, list[tuple[int | None, Path]]] = {}
    for index in range(size.frames):
        files: list[tuple[int | None, Path]] = [(None, folder / "masks" / frame_name(index))]
        if index in instants:
            files += [(p, folder / "truth" / f"{frame_number(index):06d}" / frame_name(p)) for p in size.pose_indices()]
        missing = [(pose, path.with_suffix(".npz")) for pose, path in files if not path.with_suffix(".npz").exists()]
        if missing:
            todo[index] = missing
    if not todo:
        return
    geometry = Geometry.load(folder)
    standing = functools.lru_cache(maxsize=None)(geometry.at) if kind == "held" else geometry.at
    total, done = sum(map(len, todo.values())), 0
    for index, missing in todo.items():
        scene = standing(index)
        for pose, path in missing:
            frame_view = views[index]
            maps = region_maps(geometry, scene, index, frame_view if pose is None else views[pose], frame_view)
            if pose is None:
                del maps["seen"]
            elif kind == "held":
                window = round(STILL_SECONDS * size.fps)
                maps[OBJECT_PREFIX + HELD] = held_change_mask(geometry, standing, index, pose, views[pose], window)
            with atomic_path(path) as partial:
                np.savez_compressed(partial, **maps)
            done += 1
            progress(done, total)


def views_of(seed: int, size: Size, kind: str = "plain") -> list[View]:
    """The exact cameras of the clip's frames."""
    K = intrinsics(size.width, size.height)
    matrices = camera_of(seed, size, kind).world_to_camera(frame_seconds(size))
    return [View(matrix, K, size.width, size.height) for matrix in matrices]


def region_maps(geometry: Geometry, scene: RayScene, index: int, view: View, frame_view: View) -> dict[str, Any]:
    """depth_mm uint16 [H, W] (0: sky), moving and seen bool [H, W] of the scene of frame `index` from `view`.

    `frame_view` is the clip's camera at that frame.
    """
    rays = view.rays()
    eye = view.eye
    hits = scene.cast(np.broadcast_to(eye, rays.shape), rays)
    sky = hits.face < 0
    # The rays have unit depth, so the distance in ray lengths is the planar depth.
    depth = np.where(sky, 0.0, np.clip(np.round(hits.distance * DEPTH_STEPS_PER_METRE), 1, 65535))
    points = eye + rays * np.where(sky, 1.0, hits.distance)[:, None]
    seen = np.zeros(len(rays), bool)
    solid = ~sky
    pixels, z = frame_view.project(points[solid])
    seen[solid] = frame_view.shows(pixels, z) & scene.sees(frame_view.eye, points[solid])
    if sky.any():
        pixels, z = frame_view.project(rays[sky], at_infinity=True)
        seen[sky] = frame_view.shows(pixels, z) & scene.escapes(frame_view.eye, rays[sky])
    moving = _moving(geometry, hits, index, view.project)
    shown = [show_pane(geometry, scene, pane, hits, index, view, frame_view) for pane in geometry.panes]
    for pane, pane_view in zip(geometry.panes, shown, strict=True):
        moving[pane_view.rays] |= pane_view.moving
        if pane.kind == MIRROR:
            depth[pane_view.rays] = np.round(pane_view.distance * DEPTH_STEPS_PER_METRE)
            moving[pane_view.rays], seen[pane_view.rays] = pane_view.moving, pane_view.seen
    objects = _object_masks(geometry, scene, hits, view, moving, shown)
    maps = {"depth_mm": depth.astype(np.uint16), "moving": moving, "seen": seen}
    maps |= {OBJECT_PREFIX + name: mask for name, mask in objects.items()}
    return {name: values.reshape(view.height, view.width) for name, values in maps.items()}


@dataclass
class Shown:
    """R reflected rays of a pane."""

    rays: NDArray[np.int64]
    """[R] indices of the picture's rays that hit the pane."""
    distance: Array
    """[R] depth of the pane."""
    moving: NDArray[np.bool_]
    """[R] whether the reflected image ever moves in the pane."""
    seen: NDArray[np.bool_]
    """[R] whether the pane also shows it in the clip's own frame."""


def show_pane(
    geometry: Geometry, scene: RayScene, pane: Pane, hits: Hits, index: int, view: View, frame_view: View
) -> Shown:
    """Reflections of an unoccluded pane in a view of frame `index`; `hits` are those of the view."""
    rays = view.rays()
    distance = pane.distance_to(view.eye, rays)
    which = np.flatnonzero(distance < hits.distance)
    at = view.eye + rays[which] * distance[which, None]
    back = pane.turned_back(rays[which])
    reflected = scene.cast(at + NUDGE * pane.normal, back)
    hit = reflected.face >= 0

    def image(points: Array) -> tuple[Array, Array]:
        return view.project(pane.mirrored(points))

    points = at + back * np.where(hit, reflected.distance, 0.0)[:, None]
    seen = np.zeros(len(which), bool)
    if hit.any():
        # The image of the point is seen from `own.eye` if the line to it hits the pane and is unoccluded.
        images = pane.mirrored(points[hit])
        offset = images - frame_view.eye
        through = frame_view.eye + offset * pane.distance_to(frame_view.eye, offset)[:, None].clip(max=1.0)
        pixels, z = frame_view.project(images)
        open_way = frame_view.shows(pixels, z) & (pane.distance_to(frame_view.eye, offset) < 1.0)
        open_way &= scene.sees(frame_view.eye, through)
        open_way &= scene.clear(through + NUDGE * pane.normal, points[hit])
        seen[hit] = open_way
    return Shown(which, distance[which], _moving(geometry, reflected, index, image), seen)


def _object_masks(
    geometry: Geometry, scene: RayScene, hits: Hits, view: View, moving: NDArray[np.bool_], shown: list[Shown]
) -> dict[str, NDArray[np.bool_]]:
    """Masks [R] of a hard scene's things, as described in this module."""
    masks: dict[str, NDArray[np.bool_]] = {}
    of_panes = np.zeros(len(hits.face), bool)
    for pane, pane_view in zip(geometry.panes, shown, strict=True):
        masks.setdefault(pane.kind, np.zeros(len(hits.face), bool))[pane_view.rays] = ~moving[pane_view.rays]
        of_panes[pane_view.rays] = True
    if geometry.panes:
        still = (hits.face >= 0) & ~moving & ~of_panes
        points = view.eye + view.rays() * np.where(still, hits.distance, 0.0)[:, None]
        near = [p.within(points, WALL_METRES) & (np.abs(p.above(points)) < WALL_DEPTH) for p in geometry.panes]
        masks["wall"] = still & np.any(near, axis=0)
    for name, its in geometry.objects.items():
        if name == "hair":
            share = np.zeros(len(hits.face))
            at = (np.arange(HAIR_RAYS) + 0.5) / HAIR_RAYS
            for dx, dy in itertools.product(at, at):
                rays = view.rays(dx, dy)
                face = scene.cast(np.broadcast_to(view.eye, rays.shape), rays).face
                share += (face >= 0) & its[np.maximum(face, 0)]
            masks["hair"] = share >= HAIR_SHARE * HAIR_RAYS**2
        else:
            masks[name] = (hits.face >= 0) & its[np.maximum(hits.face, 0)]
    return masks


def _moving(
    geometry: Geometry, hits: Hits, index: int, show: Callable[[Array], tuple[Array, Array]]
) -> NDArray[np.bool_]:
    """[R] whether the surface hit by each ray ever moves in a view, into which `show` projects."""
    moving = np.zeros(len(hits.face), bool)
    corners = geometry.triangles[np.maximum(hits.face, 0)] - len(geometry.static)
    which = np.flatnonzero((hits.face >= 0) & (corners[:, 0] >= 0))
    if len(which) == 0:
        return moving
    corners, weights = corners[which], hits.barycentric[which].astype(np.float64)

    def project(time: int) -> Array:
        return show(np.einsum("nk,nkd->nd", weights, geometry.moving[time][corners].astype(np.float64)))[0]

    now = project(index)
    farthest = np.zeros(len(which))
    for time in range(len(geometry.moving)):
        farthest = np.maximum(farthest, np.linalg.norm(project(time) - now, axis=1))
    moving[which] = farthest > MOVING_PX
    return moving


def held_change_mask(
    geometry: Geometry, standing: Callable[[int], RayScene], index: int, pose: int, view: View, window: int
) -> NDArray[np.bool_]:
    """[H, W] still pixels in which plate `pose` shows another state than the scene of frame `index`.

    The surface of the truth was elsewhere at the plate's time, or the plate's surface is elsewhere in the truth. In
    addition, neither surface of the pixel moves in any frame up to `window` before or after the plate.

    Args:
        standing: returns the scene of a frame.
        view: the camera of frame `pose`.
    """
    rays = view.rays()
    origins = np.broadcast_to(view.eye, rays.shape)
    truth, plate = (standing(time).cast(origins, rays) for time in (index, pose))
    mask = _displaced(geometry, truth, index, pose) > DISPLACED_METRES
    mask |= _displaced(geometry, plate, pose, index) > DISPLACED_METRES
    which = np.flatnonzero(mask)
    plate = Hits(plate.distance[which], plate.face[which], plate.barycentric[which])
    for time in range(max(0, pose - window), min(len(geometry.moving), pose + window + 1)):
        near = standing(time).cast(origins[which], rays[which])
        moves = _displaced(geometry, plate, pose, time) > SWAY_METRES
        mask[which] &= ~(moves | (_displaced(geometry, near, time, pose) > SWAY_METRES))
    return mask.reshape(view.height, view.width)


def _displaced(geometry: Geometry, hits: Hits, time: int, target_time: int) -> Array:
    """[R] distance in metres of surface points hit by rays at frame `time` from their positions at `target_time`."""
    corners = geometry.triangles[np.maximum(hits.face, 0)] - len(geometry.static)
    which = np.flatnonzero((hits.face >= 0) & (corners[:, 0] >= 0))
    moved = np.zeros(len(hits.face))
    if len(which):
        shift = geometry.moving[target_time][corners[which]] - geometry.moving[time][corners[which]]
        moved[which] = np.linalg.norm(np.einsum("nk,nkd->nd", hits.barycentric[which], shift), axis=1)
    return moved
