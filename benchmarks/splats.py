"""Do the splats of a take lie on its camera? Files that left, read back, against the frames of the take.

    python -m benchmarks.splats SHOT... --take NAME

Of each take: frozen.ply and frozen.usdc, the camera of the stage, and camera.chan and camera.nk as they are exported
now. All figures are medians over all frames of the take.

    _px      distance in pixels of a mean seen by an exported camera from where the take's own camera sees it
    _own     relative difference of the splats' depth by the exported camera from their depth in the take's own render
    _Z       signed relative difference of the splats' depth by the exported camera from the frame's Z
    points_Z the same of the solve's points, placed: Z and the splats are two measurements of one surface, by plates
             and by Gaussians, and differ by more than where they stand
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torch_backend.cameras.nuke import Y_UP, chan_text, nk_text
from torch_backend.cameras.placement import Similarity
from torch_backend.cameras.stored import load_points
from torch_backend.contract import NO_DEPTH, CameraPath, TakeFolder, placement_of, read_json
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.placed import placed
from torch_backend.freeze.take.splats import camera_path_of
from torch_backend.freeze.usd import CAMERA, SPLATS
from torch_backend.gaussians.ply import PlyGaussians, read_ply
from torch_backend.raster import rasterize
from torch_backend.shot import Shot

# usd-core has no types: everything of it is Any.
Usd, UsdGeom, UsdVol = (importlib.import_module(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdVol"))

SHOWN = 0.5
"""Weight in some pixel from which a Gaussian counts as what that pixel shows."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shots", nargs="+", type=Path)
    parser.add_argument("--take", default="freeze")
    args = parser.parse_args()
    for shot in args.shots:
        print(json.dumps({"shot": shot.name, **measured(Shot.open(shot), args.take)}), flush=True)
    return 0


def measured(shot: Shot, take: str) -> dict[str, float]:
    """Medians of a take, by name; `_px` in pixels of the frame, others relative."""
    folder = TakeFolder(shot.take(take))
    facts = read_json(folder.facts)
    where, path = Similarity.of(placement_of(facts)), camera_path_of(shot, str(facts["camera_path"]))
    size = int(facts["width"]), int(facts["height"])
    stage = Usd.Stage.Open(str(folder.usd))
    splats = {"ply": read_ply(folder.ply), "usd": splats_of(stage)}
    found: dict[str, list[np.ndarray]] = {}
    sparse = where.points(load_points(shot)["xyz"])
    frames = [frame for frame in path.frames if folder.frame(frame.frame).is_file()]
    with tempfile.TemporaryDirectory() as scratch:
        (Path(scratch) / "a.chan").write_text(chan_text(path, where, "a"))
        rows = {int(row[0]): row[1:] for row in np.loadtxt(Path(scratch) / "a.chan", ndmin=2)}
    nodes = nk_cameras(nk_text(path, where, "a"), path, size)
    for frame in frames:
        image = read_frozen_exr(folder.frame(frame.frame))
        truth = np.reshape(frame.viewmat, (4, 4)), resized(frame.K, path, size)
        cameras = {
            "usd_camera": usd_camera(stage, frame.frame, size),
            "chan": chan_camera(rows[frame.frame], size, frame.K[0] / frame.K[1]),
            "nk": nodes[frame.frame],
        }
        for name, gaussians in splats.items():
            at, depth = projected(where.inverse().points(gaussians.means), *truth)
            seen = (depth > 0) & (at >= 0).all(1) & (at < size).all(1)
            for program, camera in cameras.items():
                pixels, _ = projected(gaussians.means.astype(np.float64), *camera)
                found.setdefault(f"{name}_by_{program}_px", []).append(np.linalg.norm(pixels - at, axis=1)[seen])
            viewmat, K = cameras["usd_camera"]
            alpha, rendered, weight = painted(gaussians, viewmat, K, size)
            _, own, _ = painted(placed(gaussians, where.inverse()), *truth, size)
            solid = (alpha > 0.9) & (image.rgba[..., 3] > 0.9)
            found.setdefault(f"{name}_own", []).append(np.abs(rendered / where.scale / own - 1.0)[solid])
            found.setdefault(f"{name}_rendered_Z", []).append((rendered / where.scale / image.depth - 1.0)[solid])
            shown = gaussians.means[seen & (weight > SHOWN)].astype(np.float64)
            found.setdefault(f"{name}_means_Z", []).append(beside_z(shown, (viewmat, K), image.depth, where.scale))
        points = beside_z(sparse, cameras["usd_camera"], image.depth, where.scale)
        found.setdefault("points_Z", []).append(points)
    result = {"frames": float(len(frames)), "scale": where.scale, "gaussians": float(len(splats["ply"].means))}
    result |= {name: round(float(np.median(np.concatenate(parts))), 6) for name, parts in found.items()}
    return result


def beside_z(points: np.ndarray, camera: tuple[np.ndarray, np.ndarray], z: np.ndarray, scale: float) -> np.ndarray:
    """Signed relative difference of the depth of points [P, 3] of the scene from a frame's Z [H, W]; of those seen."""
    pixels, depth = projected(points, *camera)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < (z.shape[1], z.shape[0])).all(1)
    x, y = np.floor(pixels[inside]).astype(int).T
    known = z[y, x] < NO_DEPTH / 10.0
    return (depth[inside] / scale / z[y, x] - 1.0)[known]


def projected(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [P, 2] and depths [P] of points [P, 3]."""
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2], local[:, 2]


def painted(
    gaussians: PlyGaussians, viewmat: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, ...]:
    """Alpha and median depth [H, W] of splats through a camera, and each Gaussian's largest weight [N]."""
    # Single precision wants the camera near the origin: a floor may have been moved far away.
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    near = np.eye(4)
    near[:3, :3] = viewmat[:3, :3]
    state = [torch.from_numpy(np.asarray(part, np.float32)) for part in gaussians]
    state[0] = torch.from_numpy((gaussians.means - eye).astype(np.float32))
    seen = rasterize(
        *state[:4], sh=state[4], viewmats=torch.from_numpy(near).float()[None], Ks=torch.from_numpy(K).float()[None],
        width=size[0], height=size[1], with_depth=True, with_contributions=True,
    )  # fmt: skip
    assert seen.depth_expected is not None and seen.weight_max is not None
    return seen.alphas[0].numpy(), seen.depth_expected[0].numpy(), seen.weight_max[0].numpy()


def resized(K: list[float], path: CameraPath, size: tuple[int, int]) -> np.ndarray:
    """[3, 3] of fx, fy, cx, cy of a path, for frames of another size."""
    x, y = size[0] / path.width, size[1] / path.height
    return np.array([[K[0] * x, 0, K[2] * x], [0, K[1] * y, K[3] * y], [0, 0, 1]])


def usd_camera(stage: Any, frame: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(viewmat OpenCV, K) of the stage's camera, by USD's own frustum."""
    frustum = UsdGeom.Camera.Get(stage, CAMERA).GetCamera(Usd.TimeCode(frame)).frustum
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.array(frustum.ComputeViewMatrix()).T
    (left, bottom), (right, top) = tuple(frustum.GetWindow().GetMin()), tuple(frustum.GetWindow().GetMax())
    fx, fy = size[0] / (right - left), size[1] / (top - bottom)
    return viewmat, np.array([[fx, 0, -left * fx], [0, fy, top * fy], [0, 0, 1]])


def splats_of(stage: Any) -> PlyGaussians:
    """The splats of a stage, as a PLY has them."""
    field = UsdVol.ParticleField3DGaussianSplat.Get(stage, SPLATS)
    means = np.array(field.GetPositionsAttr().Get(), np.float32)
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()], np.float32)
    opacities = np.clip(np.array(field.GetOpacitiesAttr().Get(), np.float64), 1e-7, 1 - 1e-7)
    sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(), np.float32).reshape(len(means), -1, 3)
    scales = np.log(np.array(field.GetScalesAttr().Get(), np.float32))
    return PlyGaussians(means, quats, scales, np.log(opacities / (1 - opacities)).astype(np.float32), sh)


def nuke_viewmat(place: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """World-to-camera, OpenCV, of the scene (z up), of a camera of Nuke's world: rotation Ry Rx Rz."""
    turn = np.eye(3)
    for axis in (1, 0, 2):
        c, s = np.cos(np.radians(degrees[axis])), np.sin(np.radians(degrees[axis]))
        one = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        one[i, i] = one[j, j] = c
        one[i, j], one[j, i] = -s, s
        turn = turn @ one
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = turn, place
    return np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(world) @ Y_UP.matrix


def chan_camera(row: np.ndarray, size: tuple[int, int], tall: float) -> tuple[np.ndarray, np.ndarray]:
    """(viewmat, K) of a line of a .chan; the lens is centred, for the format has no other."""
    fy = size[1] / 2 / np.tan(np.radians(row[6]) / 2)
    return nuke_viewmat(row[:3], row[3:6]), np.array([[fy * tall, 0, size[0] / 2], [0, fy, size[1] / 2], [0, 0, 1]])


def nk_cameras(text: str, path: CameraPath, size: tuple[int, int]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Frame -> (viewmat, K) of a .nk script, by nukescripts.snap3d's projection."""
    camera = text.partition("Axis2")[0]

    def curves(knob: str) -> np.ndarray:
        line = re.search(rf"^ {knob} \{{(.*)\}}$", camera, re.MULTILINE)
        assert line is not None
        found = [re.findall(r"x\d+ (\S+)", curve) for curve in re.findall(r"\{([^}]*)\}", line[1])]
        return np.array(found, np.float64).T

    aperture = re.search(r"haperture (\S+)", camera)
    assert aperture is not None
    places, turns, offsets, focal = (curves(knob) for knob in ("translate", "rotate", "win_translate", "focal"))
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for n, frame in enumerate(path.frames):
        tall = frame.K[0] / frame.K[1]
        fx = focal[n, 0] / float(aperture[1]) * size[0]
        cx, cy = (1 - offsets[n, 0]) * size[0] / 2, size[1] / 2 + offsets[n, 1] * size[0] / 2 / tall
        found[frame.frame] = nuke_viewmat(places[n], turns[n]), np.array([[fx, 0, cx], [0, fx / tall, cy], [0, 0, 1]])
    return found


if __name__ == "__main__":
    sys.exit(main())
