"""What better surfaces would be worth: `python -m benchmarks.detail_ceiling SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic, DIR what `benchmarks.detail_truth` was given: its trained run is used. Of the
pixels that move in the clip and that plate t* shows, seen from the other poses, printed are means of PSNR in dB: the
splats; plate t* carried there by the true depth, and by the splats' own; splats and what they missed of plate t*,
by either depth. And how far the splats' depth misplaces plate t*, in pixels.

`--labels`: what the best choice between the sources of a pixel is worth, on developed instants. Truth picks for each
pixel, or for each block of 8 x 8 pixels, one of `SOURCES`; printed are means of PSNR in dB by region. No labelling of
these sources can be better than the first.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.ablate.instants import Instants
from benchmarks.ablate.measures import FrameMaker, shown
from benchmarks.ablate.switches import replaced
from benchmarks.detail_clip import DetailClip, over
from benchmarks.detail_truth import trained
from benchmarks.sources import Log, load_source
from benchmarks.synthetic.folder import SyntheticScene
from torch_backend.contract import JobError
from torch_backend.freeze.composite.primary_source import PrimaryMatte
from torch_backend.freeze.frozen import FrozenImage, freeze_at, render_frozen, span_of
from torch_backend.freeze.views.reproject import inside, look_up, pixel_centres, project, unproject
from torch_backend.native import default_threads
from torch_backend.report.evaluate import freeze_run, plate_detail
from torch_backend.report.metrics import psnr_by_region, psnr_of
from torch_backend.report.truth import TruthScene
from torch_backend.scene import Scene, load_scene
from torch_backend.train import LoadedRun, load_run

_FEWEST = 20
"""Pixels of a pose below which it tells nothing."""
SOURCES = ("own plate", "plate t*", "splats with residuals", "splats")
"""From which a pixel may come. Plate t* is carried by the developed splats' depth."""
CHOICES = {
    "all four": SOURCES,
    "without splats": SOURCES[:3],
    "without splats and plate t*": (SOURCES[0], SOURCES[2]),
    "without own plate": SOURCES[1:],
}
"""Name of a set of labels -> its sources."""
BLOCK = 8
"""Side in pixels of the blocks that get one label each: seams as coarse as those of a smooth labelling."""


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


def judge_labels(
    truth: TruthScene, run: LoadedRun, every: int, kept: Path
) -> list[dict[str, dict[str, float | None]]]:  # fmt: skip
    """One row per pose and instant: {picture or choice: {region: dB}}. Developed instants are kept in a folder."""
    clip, rows = DetailClip(truth.shot, run.folder.name, run.width), list[dict[str, dict[str, float | None]]]()
    size = clip.width, clip.height
    for t_star in truth.t_stars:
        maker = FrameMaker(clip, t_star, Instants(clip, t_star, kept).make(frozenset()))
        for pose in [pose for pose in truth.poses(t_star, []) if pose != t_star][every // 2 :: every]:
            target, regions = truth.truth(t_star, pose, *size), truth.regions(t_star, pose, *size)
            sources, delivered = _sources(maker, pose)
            pictures = {**sources, "delivered": delivered}
            for name, labels in CHOICES.items():
                of = torch.stack([sources[label] for label in labels])
                pictures[f"{name}, each pixel"] = chosen(of, target, 1)
                pictures[f"{name}, blocks"] = chosen(of, target, BLOCK)
            rows.append({name: psnr_by_region(picture, target, regions) for name, picture in pictures.items()})
    return rows


def chosen(sources: Tensor, truth: Tensor, block: int) -> Tensor:
    """[H, W, 3]: of sources [S, H, W, 3] the one nearest to the truth in each block of `block` x `block` pixels."""
    error = (sources - truth).square().mean(-1)
    height, width = truth.shape[:2]
    pad = torch.nn.functional.pad(error[:, None], (0, -width % block, 0, -height % block))
    best = torch.nn.functional.avg_pool2d(pad, block).argmin(0)[0]
    label = best.repeat_interleave(block, 0).repeat_interleave(block, 1)[:height, :width]
    return sources.gather(0, label[None, ..., None].expand(1, height, width, 3))[0]


def _sources(maker: FrameMaker, pose: int) -> tuple[dict[str, Tensor], Tensor]:
    """(each of `SOURCES`, what is delivered), [H, W, 3] in 0..1."""
    clip, image = maker.clip, maker.image(pose)
    delivered = shown(maker.make(pose, frozenset())[0])
    with replaced("composite.compositor", "primary_matte", lambda made: lambda *args: _given_up(made(*args))):
        residuals = shown(maker.make(pose, frozenset({"plate t*'s pixels"}))[0])
    carried, seen = _carried(clip, pose, maker.t_star, image)
    splats = over(image.color, image.alpha)
    pictures = clip.plate(pose), torch.where(seen[..., None], carried, residuals), residuals, splats
    return dict(zip(SOURCES, pictures, strict=True)), delivered


def _given_up(made: PrimaryMatte) -> PrimaryMatte:
    """The primary plate's matte with nothing in it."""
    return replace(made, matte=torch.zeros_like(made.matte))


def _carried(clip: DetailClip, pose: int, t_star: int, image: FrozenImage) -> tuple[Tensor, Tensor]:
    """([H, W, 3] plate t* where a pose sees the frozen scene, by its depth; [H, W] where that is in the plate)."""
    viewmat, K = clip.camera(pose)
    points = unproject(pixel_centres(clip.width, clip.height), image.depth, viewmat, K)
    places, _ = project(points, *clip.camera(t_star))
    at = look_up(clip.plate(t_star), places, "bicubic").clamp(0.0, 1.0)
    return at, inside(places, clip.width, clip.height, 1.0) > 0.0


def labels_table(rows: Sequence[dict[str, dict[str, float | None]]]) -> list[str]:
    """Markdown: mean dB by picture and region."""
    regions = ("whole", "never_seen", "moving", "static")
    lines = [f"| dB | {' | '.join(regions)} |", "|---|" + "---:|" * len(regions)]
    for name in rows[0] if rows else ():
        cells = [[value for row in rows if (value := row[name].get(region)) is not None] for region in regions]
        told = [f"{statistics.fmean(values):.2f}" if values else "–" for values in cells]
        lines.append(f"| {name} | {' | '.join(told)} |")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--t-star", type=int, nargs="+", metavar="N", help="only these")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th pose")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--labels", action="store_true", help="the best choice between the sources of a pixel")
    args = parser.parse_args(argv)
    torch.set_num_threads(default_threads())
    for folder in args.scenes:
        try:
            source = f"exact:{folder.absolute()}"
            truth = load_source(source, args.results.absolute())
            truth.t_stars = args.t_star or truth.t_stars
            run = load_run(truth.shot, trained(truth, source, args), torch.device("cpu"))
            if args.labels:
                found = judge_labels(truth, run, args.every, args.results / "ablate" / "instants")
                print("\n".join(["", f"{truth.name}, {len(found)} poses", "", *labels_table(found)]), flush=True)
                continue
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
