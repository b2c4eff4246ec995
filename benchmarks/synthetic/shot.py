"""Makes shot folders of the product from a synthetic scene, with cameras solved by COLMAP or with exact ones.

`solved_shot` uses the product's import and solve. Its freezes are rendered at the solved poses of the clip's frames, as
in the product, and compared with the truth of the same frames. `SolvedPixels` applies the undistortion of the clip's
frames to the truth's pictures and maps. `similarity_to_exact` measures the difference of solved and exact cameras.

`exact_shot` writes the same folder from the exact cameras, in metres. COLMAP triangulates its points with fixed poses
(triangulate.py, a child process). If it finds too few (`tiny`), points are sampled from the exact surfaces visible in
some frames, displaced by half a pixel of noise. `points_from` in solve.json names the source.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_backend.cameras.poses import camera_centre
from torch_backend.contract import CameraFrame, CameraPath, Reporter, frame_file, python_child, read_json
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.lens.undistort import Undistorter
from torch_backend.sfm.points import LEAST_POINTS, filter_points
from torch_backend.sfm.solving import SOLVE_VERSION, SolveConfig, SolveResult, solve_shot
from torch_backend.sfm.verdict import quality_words
from torch_backend.shot import Shot, atomic_path, content_key, write_atomic, write_json

from .folder import Regions, SyntheticScene
from .noise import stream

SURFACE_FRAMES = 6
SURFACE_POINTS = 3000
SURFACE_NOISE_PX = 0.5


@dataclass(frozen=True)
class Similarity:
    """x_exact = scale * rotation @ x_solved + translation."""

    scale: float
    """Metres per solve unit."""
    rotation: NDArray[np.float64]
    """[3, 3]."""
    translation: NDArray[np.float64]
    """[3] metres."""
    rms: float
    """Root mean square distance in metres of the mapped solved camera centres from the exact ones."""
    rotation_error_deg: float
    """Median angle in degrees between the mapped solved orientations and the exact ones."""


def import_clip(scene: SyntheticScene, folder: str | Path, report: Reporter) -> Shot:
    """A shot with the clip's frames imported; every frame is solved and used for training."""
    shot = Shot.create(folder, scene.name)
    import_footage(shot, str(scene.root / "frames"), FootageConfig(step=1, fps=scene.fps), report)
    return shot


def solved_shot(scene: SyntheticScene, folder: str | Path, report: Reporter) -> Shot:
    """A shot with cameras solved by COLMAP. JobError if the solve fails."""
    shot = import_clip(scene, folder, report)
    solve_shot(shot, SolveConfig(), report)
    return shot


def exact_shot(scene: SyntheticScene, folder: str | Path, report: Reporter) -> Shot:
    """A shot with the exact cameras, in metres; an existing one is kept."""
    shot = import_clip(scene, folder, report)
    frames = load_frames(shot)
    # With the product's key, the product's solve step accepts this shot as solved and keeps it.
    key = content_key(SOLVE_VERSION, SolveConfig(), frames["key"])
    record = shot.solve / "solve.json"
    if record.is_file() and read_json(record).get("key") == key and read_json(record).get("cameras") == "exact":
        return shot
    record.unlink(missing_ok=True)
    names = [Path(f["file"]).name for f in frames["frames"]]
    for name in names:
        write_atomic(shot.frames / name, (shot.frames / "raw" / name).read_bytes())
    points, origin = _triangulated(scene, shot, names), "triangulation"
    if points is None or len(points["xyz"]) < LEAST_POINTS:
        points, origin = surface_points(scene), "surfaces"
    with atomic_path(shot.solve / "points.npz") as partial:
        np.savez(partial, xyz=points["xyz"], rgb=points["rgb"], error=points["error"], track=points["track"])
    write_json(shot.solve / "cameras.json", exact_cameras(scene).to_json())
    error = float(points["error"].mean())
    result = SolveResult(
        frames=len(names),
        solved_frames=len(names),
        registered=len(names),
        localised=0,
        interpolated=0,
        reprojection_error_px=round(error, 4),
        points=len(points["xyz"]),
        focal_px=float(scene.K[0, 0]),
        quality=quality_words(len(names), len(names), error),
    )
    about: dict[str, Any] = {
        "version": SOLVE_VERSION,
        "key": key,
        "cameras": "exact",
        "points_from": origin,
        "total_frames": len(names),
        "camera_model": "PINHOLE",
        "distortion": [],
        "warnings": [],
        **{k: result[k] for k in ("registered", "solved_frames", "reprojection_error_px", "points", "focal_px")},
        "quality": result["quality"],
        "result": result,
    }
    write_json(record, about)
    return shot


def exact_cameras(scene: SyntheticScene, similarity: Similarity | None = None) -> CameraPath:
    """The exact cameras of the clip in metres, or in the solve units of the shot of `similarity`."""
    intrinsics = [scene.K[0, 0], scene.K[1, 1], scene.K[0, 2], scene.K[1, 2]]
    cameras = []
    for frame in scene.frames:
        matrix = scene.world_to_camera[frame].copy()
        if similarity is not None:
            # camera = R_e (s R x + t) + t_e, in units of s metres
            turned, moved = matrix[:3, :3] @ similarity.rotation, matrix[:3, :3] @ similarity.translation
            matrix[:3, 3] = (moved + matrix[:3, 3]) / similarity.scale
            matrix[:3, :3] = turned
        cameras.append(CameraFrame(frame, matrix.ravel().tolist(), [float(v) for v in intrinsics], "registered"))
    return CameraPath(scene.width, scene.height, cameras)


def similarity_to_exact(scene: SyntheticScene, shot: Shot) -> Similarity:
    """The similarity that maps a solved shot to the exact world, from its registered cameras.

    Scale and translation fit the centres (Umeyama, PAMI 1991). The rotation fits the orientations, because the centres
    of a camera that walks straight ahead leave the rotation about this line undetermined.
    """
    solved = [c for c in CameraPath.load(shot.solve / "cameras.json").frames if c.source == "registered"]
    views = np.array([c.viewmat for c in solved]).reshape(-1, 4, 4)
    source = np.array([camera_centre(v) for v in views])
    exact = np.array([scene.world_to_camera[c.frame] for c in solved])
    target = np.array([camera_centre(v) for v in exact])
    u, _, vt = np.linalg.svd(np.einsum("nki,nkj->ij", exact[:, :3, :3], views[:, :3, :3]))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    a, b = (source - source.mean(axis=0)) @ rotation.T, target - target.mean(axis=0)
    scale = float((a * b).sum() / (a**2).sum())
    translation = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    rms = np.sqrt(((source @ (scale * rotation).T + translation - target) ** 2).sum(axis=1).mean())
    traces = np.einsum("nij,nij->n", views[:, :3, :3], exact[:, :3, :3] @ rotation)
    angles = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    return Similarity(scale, rotation, translation, float(rms), float(np.median(angles)))


class SolvedPixels:
    """The resampling of the clip's frames by a solve, for the truth's pictures and maps."""

    def __init__(self, shot: Shot) -> None:
        """ValueError unless the shot was solved with SIMPLE_RADIAL or has exact cameras."""
        record = read_json(shot.solve / "solve.json")
        if record["camera_model"] not in ("SIMPLE_RADIAL", "PINHOLE"):
            raise ValueError(f"the undistortion of {record['camera_model']} is not known here, only SIMPLE_RADIAL's")
        path = CameraPath.load(shot.solve / "cameras.json")
        fx, fy, cx, cy = path.frames[0].K
        k = record["distortion"][0] if record["distortion"] else 0.0
        x, y = np.meshgrid(np.arange(path.width) + 0.5, np.arange(path.height) + 0.5)
        u, v = (x - cx) / fx, (y - cy) / fy
        # K belongs to the undistorted frames, `focal_px` to the original clip.
        focal = record["focal_px"]
        radial = 1.0 + k * (u**2 + v**2)
        where = np.stack([cx + focal * u * radial, cy + focal * v * radial], axis=-1)
        self._resample = Undistorter(where.astype(np.float32))
        self._column = np.clip(np.floor(where[..., 0]).astype(np.int64), 0, path.width - 1)
        self._row = np.clip(np.floor(where[..., 1]).astype(np.int64), 0, path.height - 1)

    def picture(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[H, W, 3] picture resampled like the clip's frames in the solve."""
        return self._resample(pixels)

    def regions(self, regions: Regions) -> Regions:
        """The maps resampled by nearest pixel."""
        at = self._row, self._column
        objects = {name: mask[at] for name, mask in regions.objects.items()}
        return Regions(regions.depth[at], regions.moving[at], regions.seen[at], objects)


def _triangulated(scene: SyntheticScene, shot: Shot, names: list[str]) -> dict[str, NDArray] | None:
    """The arrays of points.npz from the child process, filtered as in the product; None if it found no points."""
    scratch = shot.solve / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    config = SolveConfig()
    request = {
        "images": str(shot.frames / "raw"),
        "solved": names,
        "others": [],
        "camera_model": "PINHOLE",
        "neighbours": 0,
        "threads": max(1, min(os.cpu_count() or 1, 16)),
        **{name: value for name, value in asdict(config).items() if name in ("overlap", "features")},
        "K": [float(scene.K[0, 0]), float(scene.K[1, 1]), float(scene.K[0, 2]), float(scene.K[1, 2])],
        "width": scene.width,
        "height": scene.height,
        "cameras": {frame_file(f, ".png"): scene.world_to_camera[f].tolist() for f in scene.frames},
    }
    path = scratch / "request.json"
    path.write_text(json.dumps(request), encoding="utf-8")
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "PYTHONSAFEPATH": "1"}
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        with open(shot.solve / "colmap.log", "wb") as log:
            command = python_child(sys.executable, "benchmarks.synthetic.triangulate", str(path.absolute()))
            with subprocess.Popen(**command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment) as child:
                code = child.wait()
        if code != 0 or not (scratch / "points.npz").is_file():
            return None
        with np.load(scratch / "points.npz", allow_pickle=False) as data:
            return filter_points({name: data[name] for name in data.files}, scene.centres())
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def surface_points(scene: SyntheticScene) -> dict[str, NDArray]:
    """Points on surfaces seen in some frames, with half a pixel of noise: xyz [P, 3] metres, rgb, error px, track."""
    rng = stream(scene.seed, "surface points")
    chosen = [scene.frames[i] for i in np.linspace(0, len(scene.frames) - 1, SURFACE_FRAMES).round().astype(int)]
    xyz, rgb = [], []
    for frame in chosen:
        depth, picture = scene.frame_depth(frame), scene.frame(frame)
        rows, columns = np.nonzero(np.isfinite(depth))
        picked = rng.choice(len(rows), min(len(rows), SURFACE_POINTS // SURFACE_FRAMES), replace=False)
        rows, columns = rows[picked], columns[picked]
        pixels = np.stack([columns, rows], 1) + 0.5 + rng.normal(0.0, SURFACE_NOISE_PX, (len(rows), 2))
        rays = np.column_stack([(pixels - scene.K[:2, 2]) / scene.K[[0, 1], [0, 1]], np.ones(len(rows))])
        matrix = scene.world_to_camera[frame]
        xyz.append((rays * depth[rows, columns, None] - matrix[:3, 3]) @ matrix[:3, :3])
        rgb.append(picture[rows, columns])
    count = sum(map(len, xyz))
    return {
        "xyz": np.concatenate(xyz).astype(np.float32),
        "rgb": np.concatenate(rgb),
        "error": np.full(count, SURFACE_NOISE_PX, np.float32),
        "track": np.full(count, SURFACE_FRAMES, np.uint16),
    }
