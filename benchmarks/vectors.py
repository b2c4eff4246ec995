"""Motion vectors of takes against the truth: `python -m benchmarks.vectors SCENE ... --results DIR`.

SCENE and DIR as of `benchmarks.surface`, whose runs and takes are used: exact cameras only, solve units are metres.
Each pixel of a frame that has a truth is followed by the vector into the next frame, as it is made of the take's depth,
and compared with where the next camera sees the true surface. Still world and what moves in the clip apart.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from numpy.typing import NDArray

from benchmarks.detail_truth import scene_arguments, trained
from benchmarks.sources import Log, SyntheticTruth, in_words, load_synthetic
from torch_backend.cameras.placement import Similarity
from torch_backend.contract import FreezeParams
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.take.frames import whole_camera
from torch_backend.freeze.take.passes import Passes
from torch_backend.freeze.take.plan import planned
from torch_backend.torch_types import from_numpy

WANTED = 0.25
"""Pixels that were wanted in the median."""


def off_truth(
    depth: NDArray[Any], before: tuple[NDArray[Any], NDArray[Any]], after: tuple[NDArray[Any], NDArray[Any]],
    vector: NDArray[Any],
) -> NDArray[np.float64]:  # fmt: skip
    """[H, W] pixels between where a vector leads and where the true surface is; inf for sky.

    Args:
        depth: [H, W] true depth in the frame, metres; inf for sky.
        before, after: (viewmat [4, 4], K [3, 3]) of the frame and of the next.
        vector: [H, W, 2] pixels, x right and y up, from the frame to the next.
    """
    (viewmat, K), (later, lens) = before, after
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    known = np.isfinite(depth)
    far = np.where(known, depth, 1.0)
    local = np.stack([(x - K[0, 2]) / K[0, 0] * far, (y - K[1, 2]) / K[1, 1] * far, far], -1)
    world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    seen = world @ later[:3, :3].T + later[:3, 3]
    right = lens[0, 0] * seen[..., 0] / seen[..., 2] + lens[0, 2] - x
    down = lens[1, 1] * seen[..., 1] / seen[..., 2] + lens[1, 2] - y
    return np.where(known, np.hypot(vector[..., 0] - right, vector[..., 1] + down), np.inf)


def judge(truth: SyntheticTruth, run: str, t_star: int) -> dict[str, dict[str, float]]:
    """Part of the pictures -> pixels, median and ninth tenth of what they are off, share within `WANTED`."""
    params = FreezeParams(run=run, take=f"surface-{run}-{t_star}", t_star=t_star)
    take = planned(truth.shot, params, Log())
    outputs = {output.frame: output for output in take.whole}
    passes, scale = Passes(take.whole, take.scene, Similarity(np.eye(3), 1.0, np.zeros(3))), take.scene.scale
    off: dict[str, list[NDArray[np.float64]]] = {"still": [], "moving": []}
    for pose in truth.poses(t_star, []):
        file = take.folder.frame(pose)
        if not file.is_file() or pose + 1 not in outputs:
            continue
        frame, output = read_frozen_exr(file), outputs[pose]
        height, width = frame.depth.shape
        depth = from_numpy(frame.depth * scale)
        made = passes.of(output, whole_camera(output, take.spec), depth)["forward"][slice(0, height)]
        cameras: list[tuple[NDArray[Any], NDArray[Any]]] = []
        for one in (output, outputs[pose + 1]):
            viewmat = one.viewmat.double().numpy().copy()  # in metres about the solve's own origin:
            viewmat[:3, 3] = viewmat[:3, 3] / scale - viewmat[:3, :3] @ take.scene.centre
            cameras.append((viewmat, one.K.double().numpy()))
        found = off_truth(truth.depth(t_star, pose, width, height).numpy(), cameras[0], cameras[1], made)
        moves = frame.motion > 0.5
        off["still"].append(found[~moves & np.isfinite(found)])
        off["moving"].append(found[moves & np.isfinite(found)])
    told: dict[str, dict[str, float]] = {}
    for part, pieces in off.items():
        all_of = np.concatenate(pieces) if pieces else np.zeros(0)
        if len(all_of):
            told[part] = {
                "pixels": float(len(all_of)),
                "median": float(np.median(all_of)),
                "ninth tenth": float(np.quantile(all_of, 0.9)),
                "within": float((all_of <= WANTED).mean()),
            }
    return told


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    args = parser.parse_args(argv)
    print("| scene | t* | part | pixels | median, px | ninth tenth, px | within 0.25 px, % |", flush=True)
    print("|---|---:|---|---:|---:|---:|---:|", flush=True)
    for folder in args.scenes:
        truth, source = load_synthetic(folder, args.results), f"exact:{folder.absolute()}"
        run = trained(truth, source, argparse.Namespace(**{**vars(args), "seed": 0}))
        for t_star in args.t_star or truth.t_stars:
            for part, of in judge(truth, run, t_star).items():
                cells = f"{of['median']:.3f} | {of['ninth tenth']:.3f} | {100 * of['within']:.1f}"
                print(f"| {truth.name} | {t_star} | {part} | {of['pixels']:.0f} | {cells} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
