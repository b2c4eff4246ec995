"""What better surfaces would be worth: `python -m benchmarks.detail_ceiling SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic, DIR what `benchmarks.detail_truth` was given: its trained run is used. Of the
pixels that move in the clip and that plate t* shows, seen from the other poses, printed are means of PSNR in dB: the
splats; plate t* carried there by the true depth, and by the splats' own; splats and what they missed of plate t*,
by either depth. And how far the splats' depth misplaces plate t*, in pixels.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.detail_truth import trained
from benchmarks.sources import Log, load_source
from benchmarks.synthetic.folder import SyntheticScene
from torch_backend.contract import JobError
from torch_backend.freeze.frozen import freeze_at, render_frozen, span_of
from torch_backend.freeze.views.reproject import look_up, pixel_centres, project, unproject
from torch_backend.native import default_threads
from torch_backend.report.evaluate import freeze_run, plate_detail
from torch_backend.report.metrics import psnr_of
from torch_backend.report.truth import TruthScene
from torch_backend.scene import Scene, load_scene
from torch_backend.train import LoadedRun, load_run

_FEWEST = 20
"""Pixels of a pose below which it tells nothing."""


def scale_of(rendered: SyntheticScene, scene: Scene) -> float:
    """Scene units per metre."""
    true_centres = np.stack([-m[:3, :3].T @ m[:3, 3] for m in (rendered.world_to_camera[f] for f in scene.frames)])
    solved_centres = -torch.einsum("nji,nj->ni", scene.viewmats[:, :3, :3], scene.viewmats[:, :3, 3]).numpy()
    return float(
        np.linalg.norm(solved_centres - solved_centres.mean(0)) / np.linalg.norm(true_centres - true_centres.mean(0))
    )


def judge(rendered: SyntheticScene, truth: TruthScene, run: LoadedRun, every: int) -> list[dict[str, float]]:
    """One row per pose and instant: see the module."""
    scene, size = load_scene(truth.shot), (run.width, run.height)
    plates, Ks = plate_detail(truth.shot, run, scene, Log()).plates, scene.camera_at(*size)
    scale, rows = scale_of(rendered, scene), []
    for t_star in truth.t_stars:
        frozen, plate = freeze_run(run, scene, t_star, "nearest"), plates.display(t_star)
        missed = plate - frozen.view(t_star)
        still = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run))
        for pose in [pose for pose in truth.poses(t_star, []) if pose != t_star][::every]:
            regions, target = truth.regions(t_star, pose, *size), truth.truth(t_star, pose, *size)
            where = regions["moving"] & regions["seen"]
            if int(where.sum()) < _FEWEST:
                continue
            i, j = scene.frames.index(pose), scene.frames.index(t_star)

            def carried(depth: Tensor, i: int = i, j: int = j) -> Tensor:
                points = unproject(pixel_centres(*size), depth, scene.viewmats[i], Ks[i])
                return project(points, scene.viewmats[j], Ks[j])[0]

            true = torch.from_numpy(rendered.regions(t_star, pose).depth).float() * scale
            right = carried(torch.where(torch.isfinite(true), true, 1e10))
            ours = carried(render_frozen(still, scene.viewmats[i], Ks[i], *size).depth)
            splats = frozen.view(pose)
            pictures = {
                "splats": splats,
                "plate t*, true depth": look_up(plate, right, "bicubic"),
                "plate t*, splats' depth": look_up(plate, ours, "bicubic"),
                "splats + missed, true depth": splats + look_up(missed, right, "bicubic"),
                "splats + missed, splats' depth": splats + look_up(missed, ours, "bicubic"),
            }
            off = (right - ours).norm(dim=-1)[where]
            errors = {"misplaced, median px": float(off.median()), "90 % px": float(off.quantile(0.9))}
            scores = {
                name: psnr_of(float((picture.clamp(0, 1) - target)[where].square().mean()))
                for name, picture in pictures.items()
            }
            rows.append({**scores, **errors})
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th pose")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    args = parser.parse_args(argv)
    torch.set_num_threads(default_threads())
    for folder in args.scenes:
        try:
            source = f"exact:{folder.absolute()}"
            truth = load_source(source, args.results.absolute())
            run = load_run(truth.shot, trained(truth, source, args), torch.device("cpu"))
            rows = judge(SyntheticScene.load(folder), truth, run, args.every)
        except (FileNotFoundError, JobError, RuntimeError, ValueError) as error:
            print(f"Error: {error}", file=sys.stderr)
            return 1
        print(f"{truth.name}, {len(rows)} poses")
        for name in rows[0] if rows else ():
            print(f"  {name}: {statistics.fmean(row[name] for row in rows):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
