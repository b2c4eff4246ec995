"""Seeded scenes for the rasteriser's benchmarks.

A workload is a furnished room seen from inside. Its points are on walls, boxes and spheres, with the noise of a solve.
Scales follow the distance to neighbours and are flat along the normal. It has 3 % large background Gaussians and mixed
opacities.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torch_backend.gaussians.neighbours import nearest

WORKLOADS = {
    "W0": (400, 64, 48),
    "W1": (20_000, 320, 180),
    "W2": (50_000, 640, 360),
    "W3": (200_000, 640, 360),
    "W4": (1_000_000, 1920, 1080),
}
"""Name -> (number of Gaussians, width, height)."""


@dataclass
class Workload:
    """Float32 arrays of a scene: linear scales, opacities in (0, 1), colors [N, 3]; g [H, W, 3] is d loss / d image."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    K: np.ndarray
    viewmat: np.ndarray
    g: np.ndarray
    width: int
    height: int


# Rectangles: corner, edge u, edge v, density. The room is x in [-3, 3], y (down) in [-1.4, 1.4], z in [0, 5].
_WALLS = [
    ((-3, -1.4, 0), (6, 0, 0), (0, 0, 5), 1.0),
    ((-3, 1.4, 0), (6, 0, 0), (0, 0, 5), 1.5),
    ((-3, -1.4, 0), (0, 2.8, 0), (0, 0, 5), 1.0),
    ((3, -1.4, 0), (0, 2.8, 0), (0, 0, 5), 1.0),
    ((-3, -1.4, 5), (6, 0, 0), (0, 2.8, 0), 1.5),
    ((-3, -1.4, 0), (6, 0, 0), (0, 2.8, 0), 0.5),
]
# Boxes: centre, size, density. Spheres: centre, radius, density.
_BOXES = [
    ((0.2, 0.9, 2.6), (1.4, 0.08, 0.8), 4.0),
    ((-1.6, 0.8, 3.6), (0.9, 1.2, 0.9), 4.0),
    ((1.9, 0.3, 4.2), (1.0, 2.2, 0.5), 4.0),
    ((0.1, 0.2, 2.5), (0.3, 0.5, 0.3), 8.0),
    ((-0.6, 0.5, 1.9), (0.25, 0.7, 0.25), 8.0),
]
_SPHERES = [((0.7, 0.55, 2.4), 0.25, 8.0), ((-1.5, 0.0, 3.4), 0.35, 8.0), ((-0.3, -0.1, 2.0), 0.2, 10.0)]


def _rectangles() -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """Walls and box faces as (corner, edge u, edge v, density)."""
    faces = [(np.array(o, float), np.array(u, float), np.array(v, float), d) for o, u, v, d in _WALLS]
    for centre, size, density in _BOXES:
        edges = np.diag(size)
        for axis in range(3):
            u, v = edges[(axis + 1) % 3], edges[(axis + 2) % 3]
            for side in (-0.5, 0.5):
                faces.append((np.array(centre) + side * edges[axis] - u / 2 - v / 2, u, v, density))
    return faces


def _surface_points(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals [count, 3] on the room's surfaces, distributed by area times density."""
    faces = _rectangles()
    share = np.array(
        [float(np.linalg.norm(np.cross(u, v))) * d for _, u, v, d in faces]
        + [4 * np.pi * r * r * d for _, r, d in _SPHERES]
    )
    points, normals = [], []
    for i, n in enumerate(rng.multinomial(count, share / share.sum())):
        if i < len(faces):
            corner, u, v, _ = faces[i]
            at = rng.random((n, 2))
            normal = np.cross(u, v)
            points.append(corner + at[:, :1] * u + at[:, 1:] * v)
            normals.append(np.tile(normal / np.linalg.norm(normal), (n, 1)))
        else:
            centre, radius, _ = _SPHERES[i - len(faces)]
            out = rng.normal(size=(n, 3))
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            points.append(np.array(centre) + radius * out)
            normals.append(out)
    return np.concatenate(points), np.concatenate(normals)


def _facing(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Quaternions [N, 4] wxyz that rotate z to the normals, with random spin."""
    z = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    x = rng.normal(size=z.shape)
    x -= (x * z).sum(1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], -1)).as_quat()[:, [3, 0, 1, 2]]


def _camera(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """K and viewmat of a slightly rotated camera near the back wall, with a horizontal angle of 58 degrees."""
    focal, turn, position = 0.9 * width, 0.08, np.array([0.15, -0.1, 0.25])
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return K, viewmat


def room(count: int, width: int, height: int, seed: int = 1234) -> Workload:
    """The workload of `count` Gaussians. Keep the order of the random draws, which determines the scene."""
    rng = np.random.default_rng(seed)
    large = int(0.03 * count)
    n = count - large
    means, normals = _surface_points(n, rng)
    means += rng.normal(size=means.shape) * 0.01
    spacing = np.clip(np.sqrt((nearest(means, means, 4)[0][:, 1:] ** 2).mean(1)), 1e-3, None)
    scales = spacing[:, None] * 0.75 * np.exp(rng.normal(size=(n, 3)) * 0.45)
    scales[:, 2] *= 0.25
    quats = _facing(normals + 0.15 * rng.normal(size=(n, 3)), rng)
    far = np.stack([rng.uniform(-4, 4, large), rng.uniform(-2, 2, large), rng.uniform(4.6, 9, large)], 1)
    means = np.concatenate([means, far])
    scales = np.concatenate([scales, np.exp(rng.uniform(np.log(0.05), np.log(0.45), (large, 3)))])
    quats = np.concatenate([quats, rng.normal(size=(large, 4))])
    quats *= rng.uniform(0.7, 1.4, (count, 1)) / np.linalg.norm(quats, axis=1, keepdims=True)
    kind = rng.random(count)
    faint, middling, solid = rng.beta(1, 6, count), rng.uniform(0.2, 0.95, count), rng.beta(10, 1, count)
    opacities = np.clip(np.where(kind < 0.35, faint, np.where(kind < 0.75, middling, solid)), 0.005, 0.999)
    pattern = 0.5 + 0.3 * np.sin(means * np.array([1.3, 2.1, 0.9]) * 3.0)
    colors = np.clip(pattern + 0.1 * rng.normal(size=(count, 3)), 0, 1)
    order = rng.permutation(count)
    K, viewmat = _camera(width, height)
    g = rng.normal(size=(height, width, 3)) / (height * width)
    arrays = {
        "means": means[order],
        "quats": quats[order],
        "scales": scales[order],
        "opacities": opacities[order],
        "colors": colors[order],
        "K": K,
        "viewmat": viewmat,
        "g": g,
    }
    arrays = {name: np.ascontiguousarray(a, dtype=np.float32) for name, a in arrays.items()}
    return Workload(**arrays, width=width, height=height)
