"""Evaluates a trained run against a scene with truth: freezes it at every t*, scores every pose, saves pictures."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_backend.contract import CHECKPOINT_FILE, METRICS_FILE, SUMMARY_FILE, JobError, Reporter, read_json
from torch_backend.footage.images import write_png
from torch_backend.footage.plates import Plates
from torch_backend.freeze.composite.compositor import Compositor
from torch_backend.freeze.frozen import FrozenGaussians, FrozenImage, OutputFrame, freeze_at, render_frozen, span_of
from torch_backend.freeze.instant.instants import Instants
from torch_backend.motion_search import find_motion
from torch_backend.scene import Scene, evenly_spaced, load_scene, read_image, split_frames
from torch_backend.shot import Shot
from torch_backend.train import LoadedRun, load_run
from torch_backend.train.checkpoint import load_checkpoint
from torch_backend.train.model import render

from .colorvideovdp import sequence_jod
from .metrics import best_share_psnr, gradient_energy, missing_metrics, psnr_by_region, score
from .records import DELIVERED, DEVELOPED, PICTURES, SPLATS, WITHHELD, Detailed, FrameScore, HeldOut, Picture
from .things import matte_on_panes, opened_on, recall_of
from .truth import PANES, TruthScene

KEPT = 6
"""Number of pictures saved for every run, of the same frames for all runs of a scene."""
WORST = 4
"""Number of pictures saved of a run's worst frames."""


@dataclass
class Frozen:
    """A run frozen at one instant, ready to render."""

    run: LoadedRun
    scene: Scene
    t_star: int
    gaussians: FrozenGaussians
    compositor: Compositor | None = None
    """Compositor of plate detail; None for Gaussians alone."""
    developed: FrozenGaussians | None = None
    """The developed instant; None to composite on `gaussians`."""

    def view(self, pose: int, shown: str = SPLATS) -> Tensor:
        """[H, W, 3] in [0, 1] over grey, from the pose of frame `pose` and with its exposure."""
        viewmat, K = self._camera(pose)
        gaussians = self.gaussians if shown == SPLATS or self.developed is None else self.developed
        image = self._splats(pose, gaussians)
        color, alpha = image.color, image.alpha
        if shown in (WITHHELD, DELIVERED) and self.compositor is not None:
            output = OutputFrame(pose, viewmat, K, float(self.t_star), float(pose))
            withheld = (pose,) if shown == WITHHELD else ()
            composite = self.compositor.frame(output, gaussians, image, self.run.width, self.run.height, withheld)
            color, alpha = composite.color, composite.alpha
        return (color + (1.0 - alpha[..., None]) * 0.5).clamp(0.0, 1.0).cpu()

    def motion(self, pose: int) -> Tensor:
        """[H, W] in [0, 1] from the pose of frame `pose`: share of each pixel that the model moves in the clip."""
        return self._splats(pose, self.gaussians).motion.cpu()

    def _camera(self, pose: int) -> tuple[Tensor, Tensor]:
        index = self.scene.frames.index(pose)
        return self.scene.viewmats[index], self.scene.camera_at(self.run.width, self.run.height)[index]

    def _splats(self, pose: int, gaussians: FrozenGaussians) -> FrozenImage:
        run, exposed_at = self.run, self.scene.time_of_frame(pose)
        where = self._camera(pose)
        return render_frozen(gaussians, *where, run.width, run.height, run.model.exposure, exposed_at)


def plate_detail(shot: Shot, run: LoadedRun, scene: Scene, report: Reporter) -> Compositor:
    """Compositor of plate detail at the run's size. Computes the shot's motion mattes if missing.

    JobError if the footage cannot be read.
    """
    find_motion(shot, report)
    return Compositor(run, scene, Plates(shot, (run.width, run.height)))


def evaluate_run(
    truth: TruthScene, run_name: str, query: str, results: Path, run_id: str, report: Reporter, device: str = "cpu"
) -> dict[str, Any]:
    """Everything in a `RunRecord` that comes from the trained run, by field name.

    Args:
        truth: the scene; its shot holds the run.
        run_name: folder in the shot's runs/.
        query: time query of Gaussians at t*: nearest or plain.
        results: folder of the records; pictures go to its `PICTURES`.
        run_id: name of this run's pictures.
        device: device for rendering.

    JobError without such a run; `Cancelled` if a stop was requested.
    """
    run, scene = load_run(truth.shot, run_name, device), load_scene(truth.shot)
    held_out = held_out_frames(run, scene)
    missing, compositor, kinds = missing_metrics(), None, [SPLATS, DEVELOPED]
    try:
        compositor = plate_detail(truth.shot, run, scene, report)
        kinds += [WITHHELD, DELIVERED]
    except JobError as error:
        missing["detail"] = f"Plate detail of {truth.name} was not judged: {error.message}"
    matte = {}
    if compositor is not None and truth.kind == "synthetic":
        matte = matte_on_panes(truth, [scene.frames[i] for i in scene.solved], run.width, run.height)
    frozen = {
        t_star: freeze_run(
            run, scene, t_star, query, compositor, develop_run(truth.shot, run, scene, t_star, query, report)
        )
        for t_star in truth.t_stars
    }
    shown = {name: _shown(truth, frozen, held_out, name, report) for name in kinds}
    for name, of in shown.items():
        if name != WITHHELD:  # its speed equals that of DELIVERED, and its pictures are not shown
            of.frozen_fps = _fps(next(iter(frozen.values())), scene, name)
            _Keeper(truth, frozen, (run.width, run.height), results, run_id, name).keep(of)
    plates = _Keeper(truth, frozen, (run.width, run.height), results, run_id).plates(shown[SPLATS].two_instants)
    summary = read_json(run.folder / SUMMARY_FILE)
    tensors, _ = load_checkpoint(run.folder / CHECKPOINT_FILE)
    return {
        **{name: summary[name] for name in ("iterations", "train_seconds", "gaussians", "moving_share")},
        "step_ms": last_third_step_ms(run.folder / METRICS_FILE, summary["iterations"]),
        "heldout_psnr_db": summary["heldout_psnr_db"],
        "heldout": [_of_frame(truth, run, scene, frame) for frame in held_out],
        "width": run.width,
        "height": run.height,
        "model_bytes": sum(v.nbytes for k, v in tensors.items() if not k.startswith("adam.")),
        **vars(shown.pop(SPLATS)),
        "detailed": shown,
        "plates": plates,
        "matte": matte,
        "missing": missing,
    }


def _shown(
    truth: TruthScene, frozen: Mapping[int, Frozen], held_out: Sequence[int], shown: str, report: Reporter
) -> Detailed:
    """Scores every pose of every instant in one variant of the frame against the truth.

    The delivered frame at the pose of t* is plate t*, which is the truth. It gets no row, as it would raise the means.
    """
    rows: list[FrameScore] = []
    jod: dict[str, float | None] = {}
    for n, (t_star, at) in enumerate(frozen.items()):
        ours, theirs = list[Tensor](), list[Tensor]()
        poses = truth.poses(t_star, held_out)
        for m, pose in enumerate(poses):
            report.check_cancelled()
            report.progress(f"scoring {shown}", n + m / len(poses), len(frozen), f"t* {t_star}, pose {pose}")
            image, target = at.view(pose, shown), truth.truth(t_star, pose, at.run.width, at.run.height)
            if shown != DELIVERED or pose != t_star:
                rows.append(_score(truth, at, pose, shown, pose in held_out, image, target))
            ours.append(image)
            theirs.append(target)
        steady = truth.fps > 0 and len(ours) > 1
        jod[str(t_star)] = sequence_jod(torch.stack(ours), torch.stack(theirs), truth.fps) if steady else None
    return Detailed(rows, jod)


def held_out_frames(run: LoadedRun, scene: Scene) -> list[int]:
    """Frame numbers held out of the run's training."""
    _, test = split_frames(scene.solved, run.config.holdout, run.config.holdout_phase)
    return [scene.frames[i] for i in test]


def freeze_run(
    run: LoadedRun, scene: Scene, t_star: int, query: str, compositor: Compositor | None = None,
    developed: FrozenGaussians | None = None,
) -> Frozen:  # fmt: skip
    """The run frozen at frame `t_star`. `compositor`: from `plate_detail`, or None for Gaussians alone. `developed`:
    from `develop_run`, or None for the undeveloped run."""
    frozen = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run), query)
    return Frozen(run, scene, t_star, frozen, compositor, developed)


def develop_run(shot: Shot, run: LoadedRun, scene: Scene, t_star: int, query: str, report: Reporter) -> FrozenGaussians:
    """The scene from which a take of frame `t_star` is rendered, developed if the run trained on that frame.

    The scene is saved with the run. The shot needs motion mattes, which `plate_detail` computes.
    """
    return Instants(shot, run, scene, query, [float(t_star)]).at(float(t_star), report)


@torch.no_grad()
def _of_frame(truth: TruthScene, run: LoadedRun, scene: Scene, frame: int) -> HeldOut:
    """Scores a held-out frame of the clip, rendered by the run at its own time, against its plate."""
    index, time_of = scene.frames.index(frame), scene.time_of_frame(frame)
    model, size = run.model, (run.width, run.height)
    where = (scene.viewmats[index].to(model.device), scene.camera_at(*size)[index].to(model.device))
    background = torch.full((3,), 0.5, device=model.device)
    out = render(
        model.state_at(time_of), model.sh_degree, *where, *size,
        background=background, with_depth=False, with_contributions=False,
    )  # fmt: skip
    image = model.exposure.apply(out.colors[0], time_of).cpu()
    plate = read_image(truth.shot.plate(frame), *size, scene.display)
    return HeldOut(frame, psnr_by_region(image, plate, truth.frame_regions(frame, *size)))


def last_third_step_ms(path: Path, iterations: int) -> float | None:
    """Mean wall milliseconds per step over the last third of a run, from its metrics.jsonl; None with too few lines.

    An interrupted run repeats some measurements; then the later line counts.
    """
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    seconds = {row["iteration"]: row["seconds"] for row in map(json.loads, lines)}
    late = sorted(iteration for iteration in seconds if iteration >= iterations * 2 / 3)
    if len(late) < 2 or seconds[late[-1]] <= seconds[late[0]]:
        return None
    return 1000.0 * (seconds[late[-1]] - seconds[late[0]]) / (late[-1] - late[0])


def _score(
    truth: TruthScene, at: Frozen, pose: int, shown: str, held_out: bool, image: Tensor, target: Tensor
) -> FrameScore:
    height, width = target.shape[:2]
    t_star = at.t_star
    regions = truth.regions(t_star, pose, width, height)
    paned = shown == SPLATS and not regions.keys().isdisjoint(PANES)
    judged = regions.get(truth.judged)
    energy = gradient_energy(target, judged)
    return FrameScore(
        t_star,
        pose,
        held_out,
        score(image, target, regions),
        best_share_psnr(image, target),
        gradient_energy(image, judged) / energy if energy > 0 else None,
        recall_of(truth.behind(t_star, pose, width, height), image, target, regions),
        opened_on(at.motion(pose), regions) if paned else {},
    )


def _fps(frozen: Frozen, scene: Scene, shown: str) -> float:
    """Frames per second of one frozen instant along the clip's poses, after one warm-up frame.

    Uses at most 40 poses, or 8 with plate detail. Each pose counts with the fastest of three rounds, which other load
    on the machine affects least.
    """
    most = min(40 if shown == SPLATS else 8, len(scene.frames))
    poses = [scene.frames[int(i)] for i in np.linspace(0, len(scene.frames) - 1, most)]
    frozen.view(poses[0], shown)
    rounds: list[list[float]] = []
    for _ in range(3):
        seconds: list[float] = []
        for pose in poses:
            since = time.perf_counter()
            frozen.view(pose, shown)
            seconds.append(time.perf_counter() - since)
        rounds.append(seconds)
    return 1.0 / float(np.median(np.min(rounds, axis=0)))


class _Keeper:
    """Writes the pictures for the report."""

    def __init__(
        self,
        truth: TruthScene,
        frozen: Mapping[int, Frozen],
        size: tuple[int, int],
        results: Path,
        run_id: str,
        shown: str = SPLATS,
    ) -> None:
        self._truth, self._frozen, self._size, self._shown = truth, frozen, size, shown
        self._results = results
        self._run_pictures = f"{PICTURES}/{run_id}" + (f"/{shown}" if shown != SPLATS else "")
        self._common = f"{PICTURES}/{truth.key}-{size[0]}"

    def keep(self, of: Detailed) -> None:
        """Sets the pictures of `of` for its rows."""
        of.pictures, of.two_instants = self.pictures(of.rows), self.two_instants(of.rows)

    def pictures(self, rows: list[FrameScore]) -> list[Picture]:
        """Pictures of evenly spaced frames and of the worst frames, worst first."""
        ranked = sorted(rows, key=lambda row: _rank(self._truth, row))
        spread = evenly_spaced(len(rows), KEPT)
        picked = {(row.t_star, row.pose): row for row in [*ranked[:WORST], *(rows[i] for i in spread)]}
        return [self._picture(row) for row in ranked if (row.t_star, row.pose) in picked]

    def two_instants(self, rows: list[FrameScore]) -> list[Picture]:
        """Pictures of one pose at two instants, the farthest apart among instants that share a pose."""
        by_pose: dict[int, list[FrameScore]] = {}
        for row in rows:
            by_pose.setdefault(row.pose, []).append(row)
        if not by_pose:
            return []
        middle = float(np.median([row.pose for row in rows]))

        def spread_key(pose: int) -> tuple[int, float]:
            instants = [row.t_star for row in by_pose[pose]]
            return max(instants) - min(instants), -abs(pose - middle)

        shared = sorted(by_pose[max(by_pose, key=spread_key)], key=lambda row: row.t_star)
        return [self._picture(row) for row in ([shared[0], shared[-1]] if len(shared) > 1 else [])]

    def plates(self, pair: Sequence[Picture]) -> dict[str, str]:
        """Frame number -> plate of the instants of these pictures."""
        return {str(picture.t_star): self._plate(picture.t_star) for picture in pair}

    def _picture(self, row: FrameScore) -> Picture:
        name = f"{row.t_star:06d}_{row.pose:06d}.png"
        ours, theirs = f"{self._run_pictures}/{name}", f"{self._common}/{name}"
        self._write(ours, self._frozen[row.t_star].view(row.pose, self._shown))
        if not (self._results / theirs).is_file():
            self._write(theirs, self._truth.truth(row.t_star, row.pose, *self._size))
        return Picture(row.t_star, row.pose, ours, theirs, _rank(self._truth, row))

    def _plate(self, frame: int) -> str:
        path = f"{self._common}/plate_{frame:06d}.png"
        if not (self._results / path).is_file():
            self._write(path, read_image(self._truth.shot.plate(frame), *self._size))
        return path

    def _write(self, path: str, image: Tensor) -> None:
        write_png(self._results / path, (image * 255.0 + 0.5).clamp(0, 255).to(torch.uint8).contiguous().numpy())


def _rank(truth: TruthScene, row: FrameScore) -> float:
    """PSNR in dB for ranking frames: of the judged region, or of the whole frame if that region is empty."""
    value = row.value("psnr_db", truth.judged)
    whole = row.value("psnr_db")
    assert whole is not None  # the whole frame is never empty
    return whole if value is None else value
