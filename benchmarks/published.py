"""Compares frozen frames of the product with published ones of the same clip: `python -m benchmarks.published ...`.

The page of the Splannequin paper's user study shows clips of the Mannequin Challenge. Each clip is frozen at one
instant by several methods: one frozen frame per frame of the clip, seen from that frame's camera. A shot imported from
the same clip has cameras for the same frames, so its take at the same instant is comparable. These videos may not be
distributed with the product: docs/benchmarks.md says where they are.

    python -m benchmarks.published SHOT TAKE CLIP VIDEO [VIDEO ...] [--half right] [--results FILE]

SHOT is solved from CLIP, TAKE is a take of it. Every VIDEO has a frame for each of CLIP's; with --half, in one half of
its width. Prints means over the take's frames, for the take, its Gaussians alone, and each video:

* whole, best 90 %: PSNR in dB against the clip's own frame. A frozen frame should equal that frame wherever nothing
  moves; the best 90 % leaves the worst tenth of the pixels to movers. The take is compared without lens distortion, as
  solved; a video is compared unchanged. Each method is thus compared with its own footage.
* gradient: mean gradient magnitude relative to the clip's frame; 1 is as sharp as the plate.

A method that returns the clip unchanged would score perfectly. Check by eye whether movers stand as they did at the
instant. (The share of pixels that move against the cameras does not show it: flow noise hides it in every eighth
frame.)
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.report.metrics import best_share_psnr, gradient_magnitude, psnr_of
from benchmarks.sources import in_words
from torch_backend.cameras.stored import load_cameras
from torch_backend.contract import JobError
from torch_backend.footage import load_frames
from torch_backend.footage.display import display_of
from torch_backend.footage.images import read_png
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.shot import Shot, write_json
from torch_backend.torch_types import from_numpy

Picture = NDArray[np.uint8]
"""[H, W, 3] picture."""
FIGURES = ("whole", "best_90", "gradient")


def video_frames(path: Path, wanted: Sequence[int], size: tuple[int, int], half: str = "") -> Iterator[Picture]:
    """Yields frames of a video by ascending index, each at `size` (width, height). JobError if one is missing."""
    with av.open(str(path)) as video:
        left = list(wanted)
        for place, frame in enumerate(video.decode(video=0)):
            if left and place == left[0]:
                left.pop(0)
                pixels = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                middle = pixels.shape[1] // 2
                pixels = pixels[:, middle:] if half == "right" else pixels[:, :middle] if half == "left" else pixels
                yield fitted(np.ascontiguousarray(pixels), size)
    if left:
        raise JobError(f"{path} has no frame {left[0]}.", "It should have a frame for each of the clip's.")


def fitted(pixels: Picture, size: tuple[int, int]) -> Picture:
    """A picture resized to (width, height)."""
    if pixels.shape[1::-1] == size:
        return pixels
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def compared(picture: Picture, plate: Picture) -> dict[str, float]:
    """`FIGURES` of a frozen frame against the plate of its pose."""
    one, second = (from_numpy(p).float() / 255.0 for p in (picture, plate))
    return {
        "whole": psnr_of(float((one - second).double().square().mean())),
        "best_90": best_share_psnr(one, second),
        "gradient": gradient_magnitude(one) / max(gradient_magnitude(second), 1e-9),
    }


def judged(shot: Shot, take: str, clip: Path, videos: Sequence[Path], half: str) -> dict[str, dict[str, float]]:
    """Name -> mean of `FIGURES` over the take's frames, for the take, its Gaussians alone, and each video."""
    files = sorted(path for path in (shot.takes / take).glob("*.exr") if path.stem.isdigit())
    frames = [int(path.stem) for path in files]
    if not frames:
        raise JobError(f"{shot.root.name} has no frames of a take {take!r}.", "Freeze it first.")
    delivered = [int(row["frame"]) for row in load_frames(shot)["frames"]]
    places = [delivered.index(frame) for frame in frames]
    path, display = load_cameras(shot), display_of(load_frames(shot))
    size = path.width, path.height

    def ours(splats: bool) -> Iterator[Picture]:
        for file in files:
            frame = read_frozen_exr(file)
            if splats and frame.detail is None:
                raise JobError(f"{file} has no splats alone.", "Freeze with detail on.")
            light = frame.detail.splat if splats and frame.detail is not None else frame.rgba
            shown = display.from_light(np.asarray(light, np.float32)[..., :3])
            yield fitted(np.rint(np.clip(shown, 0.0, 1.0) * 255.0).astype(np.uint8), size)

    def plates() -> Iterator[Picture]:
        for frame in frames:
            pixels = read_png(shot.plate(frame))
            yield fitted(pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8), size)

    pairs = {"take": (ours(splats=False), plates()), "splats": (ours(splats=True), plates())}
    for file in videos:
        truth = video_frames(clip, places, size, "left" if clip == file else "")
        pairs[file.stem] = video_frames(file, places, size, half), truth
    found: dict[str, dict[str, float]] = {}
    for name, (pictures, truth) in pairs.items():
        rows = [compared(*pair) for pair in zip(pictures, truth, strict=True)]
        found[name] = {figure: statistics.fmean(row[figure] for row in rows) for figure in FIGURES}
    return found


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Prints a row for the take, its Gaussians alone and each video."""
    parser = argparse.ArgumentParser(description="Compares our frozen frames with published ones of the same clip.")
    parser.add_argument("shot", type=Path)
    parser.add_argument("take")
    parser.add_argument("clip", type=Path, help="video from which the shot was imported")
    parser.add_argument(
        "videos", type=Path, nargs="+", help="videos of published frozen frames, one frame per frame of the clip"
    )
    parser.add_argument(
        "--half",
        choices=("left", "right"),
        default="",
        help="half of the video picture that shows the frozen frame (default: all of it)",
    )
    parser.add_argument("--results", type=Path, help="JSON file to write the figures to")
    args = parser.parse_args(argv)
    found = judged(Shot.open(args.shot), args.take, args.clip, args.videos, args.half)
    for name, row in found.items():
        print(f"{name}: " + ", ".join(f"{figure} {value:.4f}" for figure, value in row.items()))
    if args.results:
        write_json(args.results, {"version": 1, "figures": found})


if __name__ == "__main__":
    sys.exit(main())
