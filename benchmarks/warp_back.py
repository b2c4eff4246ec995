"""ST map, matte and fill put back together in Blender: `python -m benchmarks.warp_back SHOT --bpy PYTHON ...`.

SHOT is a shot folder with a take of the clip's own poses, frozen with detail. Its undistorted plates are written as
linear EXR files of 32 bits, once as they are and once graded so that their brightest pixel is 50; each PYTHON, which
has a `bpy` wheel, puts the take's warp behind that plate in a scene's compositor and renders. What leaves is compared
with the delivered frame and, for the graded plate, with `freeze.warp.apply_warp`. Nothing is written into the shot.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

if "--inside" not in sys.argv:  # a Python with bpy has no torch
    import torch

_INSIDE = "--inside"
ROOT = Path(__file__).resolve().parents[1]
BRIGHTEST = 50.0
"""Largest value of the graded plate."""
LEAST = 0.01
"""Values below this are compared with it: a difference of nothing is no share of nothing."""


def main() -> int:
    """Writes the plates, has every bpy render, compares. Exit status 0 if all of it holds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("shot", type=Path, help="shot folder with a take")
    parser.add_argument("--take", default="freeze")
    parser.add_argument("--frames", default="", help="numbers with commas (default: first, middle and last)")
    parser.add_argument("--bpy", nargs="+", required=True, help="Pythons that have a bpy wheel")
    args = parser.parse_args()
    held = True
    with tempfile.TemporaryDirectory(prefix="splannequin-warp-") as name:
        work = Path(name)
        frames = _prepare(args.shot.absolute(), args.take, args.frames, work)
        ask = {"shot": str(work / "shot.splannequin"), "take": args.take, "frames": frames, "work": name}
        for python in args.bpy:
            subprocess.run([python, "-P", __file__, _INSIDE, json.dumps(ask)], check=True, cwd=ROOT)
            errors = _compare(frames, work)
            held = held and max(errors["delivered_relative"], errors["graded_relative"]) < 1e-3
            print(json.dumps({"bpy": (work / "version").read_text(), "frames": frames, **errors}), flush=True)
    return 0 if held else 1


def _prepare(folder: Path, take: str, frame_list: str, work: Path) -> list[int]:
    """A light copy of the shot, plates and what is expected of them, under `work`; returns the frame numbers."""
    from torch_backend.footage.plates import Plates
    from torch_backend.freeze.composite.warp import apply_warp, read_warp
    from torch_backend.freeze.exr import read_frozen_exr
    from torch_backend.shot import Shot

    unused = shutil.ignore_patterns("runs", "jobs", "colmap", "motion", "raw", "preview")
    shutil.copytree(folder, work / "shot.splannequin", ignore=unused)
    shot = Shot(folder)
    place, plates = shot.take(take), Plates(shot)
    on_disk = sorted(int(file.stem) for file in (place / "warp").glob("*.exr"))
    if not on_disk:
        raise FileNotFoundError(f"{place} has no warp: freeze the clip's poses with detail")
    frames = (
        [int(n) for n in frame_list.split(",")] if frame_list else [on_disk[0], on_disk[len(on_disk) // 2], on_disk[-1]]
    )
    for frame in frames:
        warp = read_warp(place / "warp" / f"{frame:06d}.exr")
        linear = torch.as_tensor(plates.linear(warp.metadata.primary)).float()
        graded = _graded(linear)
        _write(work / "delivered" / f"{frame:06d}.exr", linear.numpy())
        _write(work / "graded" / f"{frame:06d}.exr", graded.numpy())
        frozen = np.asarray(read_frozen_exr(place / f"{frame:06d}.exr").rgba)[..., :3]
        np.save(work / f"delivered-{frame}-expected.npy", frozen)
        np.save(work / f"graded-{frame}-expected.npy", apply_warp(graded, warp).numpy())
    return frames


def _graded(linear: torch.Tensor) -> torch.Tensor:
    """[H, W, 3] -> the same with another curve for each channel, some of it below 0, the brightest at `BRIGHTEST`."""
    curves = torch.tensor([1.5, 2.0, 2.5], device=linear.device)
    graded = linear.clamp(min=0.0) ** curves - 0.02
    return graded * (BRIGHTEST / graded.max())


def _write(path: Path, pixels: np.ndarray) -> None:
    """[H, W, 3] float32 as an EXR of 32 bits. OSError with OpenImageIO's reason."""
    import OpenImageIO as oiio

    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, _ = pixels.shape
    picture = oiio.ImageBuf(oiio.ImageSpec(width, height, 3, oiio.FLOAT))
    if not (picture.set_pixels(oiio.ROI(), pixels) and picture.write(str(path))):
        raise OSError(f"{path}: {picture.geterror()}")


def _compare(frames: list[int], work: Path) -> dict[str, float]:
    """The largest differences over the frames: as a share of the value, and in 255ths of what is shown."""
    from torch_backend.footage.color import linear_to_srgb

    errors: dict[str, float] = {}
    for name in ("delivered", "graded"):
        pairs = [(np.load(work / f"{name}-{n}.npy"), np.load(work / f"{name}-{n}-expected.npy")) for n in frames]
        share = max(float((np.abs(a - b) / np.maximum(np.abs(b), LEAST)).max()) for a, b in pairs)
        shown = max(float(np.abs(linear_to_srgb(a) - linear_to_srgb(b)).max()) for a, b in pairs)
        errors |= {f"{name}_relative": share, f"{name}_255": round(255.0 * shown, 3)}
        errors |= {f"{name}_least": min(float(a.min()) for a, _ in pairs),
                 f"{name}_most": max(float(a.max()) for a, _ in pairs)}  # fmt: skip
    return errors


# ----------------------------------------------------------------------------------------------------- inside bpy


def inside(ask: dict[str, Any]) -> None:
    """Renders every frame through the group in this Python's bpy; leaves NAME-FRAME.npy in the work folder."""
    spec = importlib.util.spec_from_file_location("run_in_bpy", ROOT / "splannequin_addon" / "run_in_bpy.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    package = module.load_package()
    package.register()
    bpy = importlib.import_module("bpy")
    work = Path(ask["work"])
    for name in ("delivered", "graded"):
        bpy.ops.wm.read_homefile(use_factory_startup=True)
        for frame in ask["frames"]:
            np.save(work / f"{name}-{frame}.npy", _through_the_group(package.__name__, ask, work / name, frame))
    (work / "version").write_text(bpy.app.version_string)
    package.unregister()


def _through_the_group(package: str, ask: dict[str, Any], folder: Path, frame: int) -> np.ndarray:
    """[H, W, 3] float32: a plate of `folder`, warped by the take, as it leaves the compositor."""
    bpy = importlib.import_module("bpy")
    compat, numbered, freeze_group, insertion = (
        importlib.import_module(f"{package}.splannequin_addon.{name}")
        for name in ("compat", "scene.numbered", "bake.freeze_group", "bake.insertion")
    )
    scene = bpy.context.scene
    tree = compat.compositor_tree(scene) or compat.new_compositor_tree(scene, "Artist")
    file = numbered.frame_path(folder, frame, ".exr")
    plate = tree.nodes.new("CompositorNodeImage")
    plate.image = bpy.data.images.load(str(file))
    compat.set_image_colour(plate.image, "linear")
    tree.links.new(plate.outputs["Image"], compat.output_socket(tree) or compat.new_output_node(tree))
    scene.splannequin.clip = str(file)
    scene.frame_set(frame)
    insertion.insert_freeze(scene, Path(ask["shot"]), ask["take"], warp=True)
    node = freeze_group.group_node(tree)
    tree.links.new(plate.outputs["Image"], node.inputs["Image"])
    tree.links.new(node.outputs["Image"], compat.output_socket(tree))
    width, height = plate.image.size
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "IMAGE"
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.filepath = str(folder / f"{frame}-rendered.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(render.filepath)
    image.colorspace_settings.is_data = True
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


if __name__ == "__main__":
    if _INSIDE in sys.argv:
        inside(json.loads(sys.argv[-1]))
    else:
        sys.exit(main())
