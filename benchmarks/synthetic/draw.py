"""Draws a clip by rays, where renders are too slow: `python -m benchmarks.synthetic.draw SCENE --out DIR`.

SCENE is a folder of benchmarks/synthetic with its geometry and textures; nothing has to be rendered in it. DIR gets a
scene with the same geometry, cameras and people, whose frames are textures under one light without shadows, four rays
a pixel, and noise of two of 255. That is enough for figures about outlines; the truth has no pictures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torch_backend.footage.images import read_png, write_png

from .generate import frame_name
from .make import write_record
from .noise import stream
from .rays import RayScene
from .regions import Geometry, views_of
from .sizes import SIZES, Size

LIGHT = np.array([0.3, -0.4, 0.87])
"""Direction to the light; surfaces are lit from both sides."""
AMBIENT = 0.45
NOISE = 2.0
"""Standard deviation of a pixel's noise, of 255."""
SAMPLES = 2
"""Rays a pixel along each axis."""


class Painter:
    """The colour of every triangle of a scene."""

    def __init__(self, folder: Path) -> None:
        plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        files = [material["file"] for material in plan["materials"]]
        with np.load(folder / "geometry" / "static.npz", allow_pickle=False) as data:
            uv, of = [data["uv"]], [data["material"]]
        for mover in plan["movers"]:
            if mover["in_view"]:
                with np.load(folder / "geometry" / f"{mover['name']}.npz", allow_pickle=False) as data:
                    uv.append(data["uv"])
                files.append(mover["texture"])
                of.append(np.full(len(uv[-1]), len(files) - 1))
        self.uv, self.of = np.concatenate(uv), np.concatenate(of)
        self.textures = [read_png(folder / "textures" / file).astype(np.float32) / 255.0 for file in files]

    def paint(self, scene: RayScene, eye: NDArray, rays: NDArray) -> NDArray[np.float32]:
        """[R, 3] in 0..1: what rays from `eye` show; sky is light blue."""
        hits = scene.cast(np.broadcast_to(eye, rays.shape), rays)
        colours = np.tile(np.array([0.75, 0.85, 1.0], np.float32), (len(rays), 1))
        solid = hits.face >= 0
        face = np.maximum(hits.face, 0)
        at = np.einsum("rk,rkd->rd", hits.barycentric, self.uv[face]) % 1.0
        corners = scene.vertices[scene.triangles[face]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        shade = AMBIENT + (1.0 - AMBIENT) * np.abs(normals @ (LIGHT / np.linalg.norm(LIGHT)))
        for texture in np.unique(self.of[face[solid]]):
            which = solid & (self.of[face] == texture)
            picture = self.textures[texture]
            height, width = picture.shape[:2]
            column = np.minimum((at[which, 0] * width).astype(int), width - 1)
            row = np.minimum(((1.0 - at[which, 1]) * height).astype(int), height - 1)
            colours[which] = picture[row, column] * shade[which, None]
        return colours


def draw(source: Path, out: Path, size: Size) -> Path:
    """The folder of the drawn scene, made if it is not there.

    ValueError if `size` has other frames than the scene's geometry.
    """
    plan = json.loads((source / "plan.json").read_text(encoding="utf-8"))
    made, seed, kind = SIZES[source.parent.name], int(plan["seed"]), str(plan["kind"])
    if (size.frames, size.fps) != (made.frames, made.fps):
        raise ValueError(f"{source} moves as size {made.name} does: {size.name} has other frames")
    folder = out / size.name / source.name
    if (folder / "scene.json").is_file():
        return folder
    for name in ("geometry", "textures"):
        shutil.copytree(source / name, folder / name, dirs_exist_ok=True)
    for name in ("plan.json", "meter.json"):
        shutil.copy(source / name, folder / name)
    geometry, painter = Geometry.load(source), Painter(source)
    generator = stream(seed, "drawn noise")
    (folder / "frames").mkdir(exist_ok=True)
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for index, view in enumerate(views_of(seed, size, kind)):
        scene = geometry.at(index)
        parts = [painter.paint(scene, view.eye, view.rays(x, y)) for x in offsets for y in offsets]
        picture = np.mean(parts, axis=0).reshape(view.height, view.width, 3) * 255.0
        noisy = picture + generator.normal(0.0, NOISE, picture.shape)
        write_png(folder / "frames" / frame_name(index), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    write_record(folder, size, seed, kind, plan["key"], {})
    return folder


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--size", choices=tuple(SIZES), help="of the pictures (default: the scene's own)")
    args = parser.parse_args(argv)
    try:
        for scene in args.scenes:
            size = SIZES[args.size or scene.absolute().parent.name]
            print(draw(scene.absolute(), args.out.absolute(), size), flush=True)
    except (FileNotFoundError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
