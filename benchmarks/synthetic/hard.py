"""Things of the hard scenes: their position, motion and triangles.

`glass`: a window with a pane and a mirror in the wall ahead. `swinging`: an apple on a thread, with 2 % of the
picture's width. `arm`: a person stands still and one arm waves (even seeds) or points (odd). `hair`: loose strands on a
head in front of a bright window. Metres, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torch_backend.footage.images import write_png

from .cameras import FOCAL_PER_WIDTH
from .geometry import Builder, Mesh
from .noise import Array, fractal, stream, wander
from .places import FrontWall, Keepout
from .textures import hsv

if TYPE_CHECKING:
    from .people import Bodies, Body

APPLE_SHARE = 0.02
"""Width of the apple relative to the picture's, from the middle of the camera's path."""
APPLE_HEIGHT, THREAD_TOP, THREAD_RADIUS = 1.35, 3.1, 0.0015
"""Metres: apple's height above the floor, height of the thread's upper end (at or above every ceiling), its radius."""
SWING_METRES = (0.25, 0.05)
"""Amplitude of the swing to the side and in depth, in metres."""
GRAVITY = 9.81
BRIGHT_WINDOW, BRIGHT_SKY = 3.4, 3.5
"""Width in metres of the window behind the hair, and strength of its sky (other rooms: 1.6). The sky is near white but
mostly not clipped; otherwise only a strand that covers most of a pixel would be visible."""
EVENING_SKY = 0.5
"""Strength of the sky behind glass. The sky is as bright as the room, so that reflections are visible."""
STRANDS, STRAND_STEPS, STRAND_SIDES = 800, 6, 3
STRAND_METRES, STRAND_RADIUS = (0.1, 0.3), 0.0008
"""Shortest and longest strand, and its radius at the root in metres: a tenth of a pixel wide at `quick`."""
_HEAD_HEIGHT, _BACK_WALL = 1.6, 3.8
"""Approximate height of heads, and y of the wall ahead, in metres."""


@dataclass
class Staging:
    """Requirements of a hard scene on its place, fixed before furniture and other people are placed."""

    front_wall: FrontWall | None = None
    first: tuple[float, float] | None = None
    """Position of the first person, whose arm or hair is the scene's thing."""
    apple: tuple[float, float] | None = None
    """x, y of the hanging apple."""
    clear: list[Keepout] = field(default_factory=list)
    """Areas kept free of people and furniture, which would hide the thing."""


@dataclass
class SceneObject:
    """The thing of a hard scene, as triangles of one mover."""

    name: str
    """Name of its mask: swinging, arm or hair."""
    mover: str
    faces: NDArray[np.bool_]
    """[F] triangles of the mover in the mask."""
    gone: NDArray[np.bool_]
    """[F] triangles removed for pictures of the background; if all are False, no such pictures are made."""


def share_in_view(views: Array, point: Array) -> float:
    """Share of world-to-camera poses [C, 4, 4] in which a point is well inside the width of the picture."""
    local = views[:, :3, :3] @ point + views[:, :3, 3]
    return float(((local[:, 2] > 0.5) & (np.abs(local[:, 0]) * FOCAL_PER_WIDTH < 0.42 * local[:, 2])).mean())


def stage(kind: str, seed: int, path: Array, views: Array) -> Staging:
    """Places the things of a hard scene. `path` [P, 2]: x, y of the camera; `views` [C, 4, 4]: world-to-camera."""
    side = float(stream(seed, "staging").choice([-1.0, 1.0]))
    if kind == "glass":
        front_wall = FrontWall(0.95 * side, mirror_x=-1.15 * side, glazed=True, garden=True, sky_strength=EVENING_SKY)
        targets = [(front_wall.window_x, _BACK_WALL), (-1.15 * side, _BACK_WALL)]
        return Staging(front_wall, clear=[k for t in targets for k in _line_of_sight(path, t, (30,))])
    if kind == "swinging":
        apple = _in_view(path, views, lambda x, y: 0.0, 1.3)
        return Staging(apple=apple, clear=[Keepout(*apple, 0.35), *_line_of_sight(path, apple)])
    if kind == "arm":
        first = _in_view(path, views, lambda x, y: 0.0, 1.4)
        return Staging(first=first, clear=_line_of_sight(path, first))
    if kind == "hair":
        front_wall = FrontWall(0.0, window_width=BRIGHT_WINDOW, sky_strength=BRIGHT_SKY)
        first = _in_view(path, views, lambda x, y: _before_window(path, x, y, BRIGHT_WINDOW), 1.4)
        return Staging(
            front_wall, first, clear=[*_line_of_sight(path, first), *_line_of_sight(path, (0.0, _BACK_WALL))]
        )
    return Staging()


def _in_view(
    path: Array, views: Array, better: Callable[[float, float], float], from_path: float
) -> tuple[float, float]:
    """x, y that most views show, at least `from_path` metres from the camera's path but close to it."""
    best, found = -np.inf, (0.0, 1.0)
    for x in np.arange(-1.5, 1.55, 0.1):
        for y in np.arange(-1.0, 2.65, 0.1):
            distance = np.hypot(path[:, 0] - x, path[:, 1] - y)
            if distance.min() < from_path:
                continue
            score = share_in_view(views, np.array([x, y, 1.3])) + better(x, y) - 0.03 * distance.mean()
            if score > best:
                best, found = score, (float(x), float(y))
    return found


def _before_window(path: Array, x: float, y: float, width: float) -> float:
    """Share of the path's camera positions that see a head at x, y in front of the window in the wall ahead."""
    reach = (_BACK_WALL - path[:, 1]) / np.maximum(y - path[:, 1], 0.1)
    behind = path[:, 0] + (x - path[:, 0]) * reach
    return float((np.abs(behind) < width / 2 - 0.25).mean())


def _line_of_sight(path: Array, target: tuple[float, float], at: tuple[int, ...] = (12, 30, 48)) -> list[Keepout]:
    """Discs between some points of the path and a target, ending 0.5 m before both."""
    discs = []
    for eye in path[list(at)]:
        offset = np.asarray(target) - eye
        length = float(np.hypot(*offset))
        points = eye + offset * np.arange(0.5, length - 0.5, 0.3)[:, None] / length
        discs += [Keepout(float(x), float(y), 0.25) for x, y in points]
    return discs


# ------------------------------------------------------------------------------------------------- what is in them


def apple(
    folder: Path, seed: int, seconds: Array, place: tuple[float, float], path: Array
) -> tuple[Array, Mesh, SceneObject]:
    """(vertices [T, V, 3], mesh, thing) of an apple swinging on its thread; writes textures/apple.png."""
    rng = stream(seed, "apple")
    write_png(folder / "textures" / "apple.png", _apple_skin(rng))
    diameter = APPLE_SHARE / FOCAL_PER_WIDTH * float(np.hypot(*(path[len(path) // 2] - place)))
    length = THREAD_TOP - APPLE_HEIGHT
    builder = Builder([0.0])
    radius = diameter / 2
    builder.ball([0.0, 0.0, -length], [radius, radius, 0.92 * radius], 0, 20, 12)
    of_apple = len(builder.materials)
    builder.cylinder([0.0, 0.0, -length + 0.8 * radius], THREAD_RADIUS, length - 0.8 * radius, 0, 5)
    mesh = builder.mesh()
    faces = np.arange(len(mesh.triangles)) < of_apple
    mesh.uv[~faces] = 0.02  # the texture's dark corner, for the thread
    turn, phase = 2 * np.pi * seconds / (2 * np.pi * np.sqrt(length / GRAVITY)), rng.uniform(0.0, 2 * np.pi, 2)
    sideways, deep = (m / length * np.sin(turn + p) for m, p in zip(SWING_METRES, phase, strict=True))
    turns = _turns((2, 0), sideways) @ _turns((1, 2), deep)
    vertices = np.einsum("tij,vj->tvi", turns, mesh.vertices) + np.array([*place, THREAD_TOP])
    return vertices, mesh, SceneObject("swinging", "apple", faces, np.ones(len(faces), bool))


def _turns(axes: tuple[int, int], angles: Array) -> Array:
    """[T, 3, 3] rotations by angles [T] in radians, from the first of two axes towards the second."""
    a, b = axes
    matrices = np.tile(np.eye(3), (len(angles), 1, 1))
    matrices[:, a, a] = matrices[:, b, b] = np.cos(angles)
    matrices[:, b, a] = np.sin(angles)
    matrices[:, a, b] = -matrices[:, b, a]
    return matrices


def _apple_skin(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Texture of an apple: red with a yellow cheek, and a dark corner."""
    cheek = np.clip(2.5 * (fractal(rng, 128, 1.8) - 0.65), 0.0, 1.0)[..., None]
    skin = hsv(0.0, 0.85, 0.75) * (1 - cheek) + hsv(0.13, 0.7, 0.85) * cheek
    skin = skin * (0.85 + 0.3 * fractal(rng, 128, 0.8))[..., None]
    skin[-8:, :8] = 0.06
    return np.round(255.0 * np.clip(skin, 0.0, 1.0)).astype(np.uint8)


def arm_of(bodies: Bodies, name: str) -> SceneObject:
    """A person's right arm: triangles that mostly follow its bones."""
    faces = bodies.influence["right_arm"][bodies.triangles].mean(axis=1) > 0.5
    return SceneObject("arm", name, faces, faces)


def hair_of(folder: Path, bodies: Bodies, body: Body, seed: int, seconds: Array) -> tuple[Array, Mesh, SceneObject]:
    """(vertices [T, V, 3], mesh, thing) of loose strands that follow a head; writes textures/hair.png."""
    rng = stream(seed, "hair")
    tone = hsv(rng.uniform(0.04, 0.11), rng.uniform(0.3, 0.7), rng.uniform(0.15, 0.55))
    write_png(folder / "textures" / "hair.png", np.tile(np.round(255 * tone).astype(np.uint8), (8, 8, 1)))
    start = body.vertices[0].astype(np.float64)
    head = bodies.influence["head"] > 0.9
    roots, out = _roots(bodies, start, head, rng)
    spines = _spines(roots, out, rng)  # [N, S + 1, 3]
    share = np.linspace(0.0, 1.0, STRAND_STEPS + 1)
    ring = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2 * np.pi * np.arange(STRAND_SIDES) / STRAND_SIDES])
    radius = STRAND_RADIUS * (1.0 - 0.7 * share)
    still_vertices = spines[:, :, None] + radius[None, :, None, None] * ring  # [N, S + 1, sides, 3]
    loose = np.broadcast_to((share**2)[None, :, None, None], still_vertices.shape).reshape(-1, 3)
    sway = 0.012 * wander(rng, seconds, 2.0, 3)
    vertices = np.empty((len(seconds), loose.shape[0], 3))
    for t in range(len(seconds)):
        rotation, moved = _rigid(start[head], body.vertices[t, head].astype(np.float64))
        vertices[t] = still_vertices.reshape(-1, 3) @ rotation.T + moved + loose * sway[t]
    triangles = _tubes(len(roots))
    uv = np.full((len(triangles), 3, 2), 0.5, np.float32)
    mesh = Mesh(vertices[0].astype(np.float32), triangles, uv, np.zeros(len(triangles), np.int32))
    every = np.ones(len(triangles), bool)
    return vertices, mesh, SceneObject("hair", "hair", every, ~every)


def _roots(bodies: Bodies, start: Array, head: NDArray[np.bool_], rng: np.random.Generator) -> tuple[Array, Array]:
    """([N, 3] points on the scalp, [N, 3] unit directions of hair at these points)."""
    scalp = bodies.triangles[(bodies.regions["hair"][bodies.triangles] > 0.5).all(axis=1)]
    a, b, c = (start[scalp[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    picked = rng.choice(len(scalp), STRANDS, p=area / area.sum())
    u, v = np.sort(rng.uniform(size=(2, STRANDS)), axis=0)[..., None]
    roots = a[picked] * u + b[picked] * (v - u) + c[picked] * (1.0 - v)
    out = roots - start[head].mean(axis=0) + [0.0, 0.0, 0.03]
    return roots, out / np.linalg.norm(out, axis=1, keepdims=True)


def _spines(roots: Array, out: Array, rng: np.random.Generator) -> Array:
    """[N, S + 1, 3] points of strands: away from the scalp, then down, with random variation."""
    length = rng.uniform(*STRAND_METRES, len(roots))[:, None] / STRAND_STEPS
    heading, at = out.copy(), roots - 0.004 * out
    points = [at]
    weight = rng.uniform(0.25, 0.6, (len(roots), 1))
    for _ in range(STRAND_STEPS):
        heading = heading + weight * [0.0, 0.0, -1.0] + 0.18 * rng.normal(size=heading.shape)
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
        at = at + length * heading
        points.append(at)
    return np.stack(points, axis=1)


def _tubes(strands: int) -> NDArray[np.int32]:
    """[F, 3] triangles of the strands' sides; vertices are ordered by strand, ring and side."""
    side = np.arange(STRAND_SIDES)
    quads = []
    for step in range(STRAND_STEPS):
        low, high = step * STRAND_SIDES + side, (step + 1) * STRAND_SIDES + side
        low_next, high_next = np.roll(low, -1), np.roll(high, -1)
        quads += [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]
    one = np.concatenate(quads)
    offset = np.arange(strands)[:, None, None] * (STRAND_STEPS + 1) * STRAND_SIDES
    return (one[None] + offset).reshape(-1, 3).astype(np.int32)


def _rigid(source: Array, target: Array) -> tuple[Array, Array]:
    """(rotation [3, 3], translation [3]) that maps points [P, 3] to others with the least error (Kabsch 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, b - rotation @ a
