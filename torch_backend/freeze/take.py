"""The freeze station: renders a take, frame by frame, and writes what leaves for Blender and for the artist's eyes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contract import NO_DEPTH, CameraPath, ExitCode, FreezeParams, JobError, Reporter, frame_file, read_json
from ..footage.color import premultiplied_srgb_to_linear
from ..footage.images import read_png
from ..gaussians.ply import write_ply
from ..scene import Scene, load_scene
from ..shot import Shot, content_key, disk_error, is_disk_full, need_disk, write_json
from ..solve.stmap import TAKE_REDISTORT, margin, write_take_map
from ..train import LoadedRun, choose_device, load_run
from ..train.run import save_png
from .contact_sheet import write_contact_sheet
from .exr import FrameMetadata, write_frozen_exr
from .query import FrozenGaussians, FrozenImage, freeze_at, render_frozen, suggest_t_star
from .video import write_video

TAKE_VERSION = 1
"""Rises when frames rendered before must not stand beside new ones."""
_FRAME = re.compile(r"-?\d+")


@dataclass
class OutputFrame:
    """One frame to render."""

    frame: int
    """Number in the clip."""
    viewmat: Tensor
    """[4, 4] world-to-camera, scene units."""
    K: Tensor
    """[3, 3] pixels of the output size, without overscan."""
    t_star: float
    """Frame number at which time stands still."""
    exposed_like: float
    """Frame number whose exposure the camera has: its own on the clip's poses, t* on a path of its own."""


def freeze_shot(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Renders a take of a run and writes EXRs, previews, contact sheet, video and PLY into takes/<name>.

    Returns the take's figures (also in take.json). JobError in words if it cannot be done.
    """
    run = load_run(shot, params.run, choose_device(params.device))
    scene = load_scene(shot)
    t_star = choose_t_star(shot, scene, run, params, report)
    width, height = output_size(scene, run, params)
    frames = plan(scene, params, t_star, width, height)
    folder = shot.take(params.take)
    beyond = margin(shot, params, width, height, intrinsics(frames))
    key = take_key(run, params, t_star, width, height, frames, beyond)
    done = _prepare(folder, key, params.only_missing)
    pixels = (width + 2 * beyond[0]) * (height + 2 * beyond[1])
    need_disk(folder, (len(frames) - len(done)) * pixels * 20.0, "the take")
    try:
        _render_all(folder, frames, done, scene, run, params.query, (width, height), beyond, report)
        return _finish(shot, scene, run, params, t_star, frames, (width, height), beyond, key, report)
    except OSError as error:
        raise (disk_error(folder) if is_disk_full(error) else error) from error


def choose_t_star(shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, report: Reporter) -> int:
    """The frame to freeze at, snapped to a trained one: a time that no frame constrains is a guess."""
    trained = np.array(run.train_frames)
    if params.t_star is None:
        table = {row["frame"]: row for row in read_json(shot.frames / "frames.json")["frames"]}
        sharpness = np.array([float(table[int(f)].get("sharpness", 0.0)) for f in trained])
        times = np.array([scene.time_of_frame(f) for f in trained])
        return int(trained[suggest_t_star(run.model, times, sharpness)])
    if not scene.frames[0] <= params.t_star <= scene.frames[-1]:
        raise JobError(
            f"t* is frame {params.t_star}, the shot has frames {scene.frames[0]} to {scene.frames[-1]}.",
            "Choose a frame of the shot.",
            ExitCode.FREEZE,
        )
    nearest = int(trained[np.abs(trained - params.t_star).argmin()])
    if nearest != params.t_star:
        report.warning(
            f"Frame {params.t_star} was not trained on: time stands still at frame {nearest}, the nearest that was."
        )
    return nearest


def output_size(scene: Scene, run: LoadedRun, params: FreezeParams) -> tuple[int, int]:
    """(width, height) of the frozen frames: as wide as trained unless asked otherwise, shaped like clip or path."""
    if params.width <= 0 and not params.camera_path:
        return run.width, run.height
    width = min(max(16, params.width or run.width), 16_384)
    shape = CameraPath.load(params.camera_path) if params.camera_path else scene
    return width, max(16, round(shape.height * width / shape.width))


def plan(scene: Scene, params: FreezeParams, t_star: int, width: int, height: int) -> list[OutputFrame]:
    """The frames of a take: the clip's own poses, or a camera path in solve units."""
    if params.camera_path:
        viewmats, Ks, numbers = _path_cameras(scene, CameraPath.load(params.camera_path), width, height)
    else:
        viewmats, Ks, numbers = scene.viewmats, scene.camera_at(width, height), scene.frames
    first = numbers[0] if params.first is None else params.first
    last = numbers[-1] if params.last is None else params.last
    ramp = {int(k): float(v) for k, v in params.t_star_per_frame.items()}
    frames = []
    for i, n in enumerate(numbers):
        if first <= n <= last:
            at = ramp.get(n, float(t_star))
            frames.append(OutputFrame(n, viewmats[i], Ks[i], at, at if params.camera_path else float(n)))
    if not frames:
        raise JobError(
            f"No frame lies between {first} and {last}.", f"The path has frames {numbers[0]} to {numbers[-1]}.",
            ExitCode.FREEZE,
        )  # fmt: skip
    return frames


def intrinsics(frames: list[OutputFrame]) -> np.ndarray:
    """[F, 4]: fx, fy, cx, cy of the frames, pixels of the output size."""
    return np.array([[f.K[0, 0], f.K[1, 1], f.K[0, 2], f.K[1, 2]] for f in frames], np.float64)


def _path_cameras(scene: Scene, path: CameraPath, width: int, height: int) -> tuple[Tensor, Tensor, list[int]]:
    """A Blender path, in solve units and its own resolution, as scene cameras of the output size."""
    if not path.frames:
        raise JobError("The camera path has no frames.", "Send at least one pose.", ExitCode.FREEZE)
    viewmats = np.array([f.viewmat for f in path.frames], dtype=np.float64).reshape(-1, 4, 4)
    x, y = width / path.width, height / path.height
    Ks = [[[f.K[0] * x, 0, f.K[2] * x], [0, f.K[1] * y, f.K[3] * y], [0, 0, 1]] for f in path.frames]
    return scene.from_solve(viewmats), torch.tensor(Ks, device="cpu").float(), [f.frame for f in path.frames]


def take_key(
    run: LoadedRun, params: FreezeParams, t_star: int, width: int, height: int, frames: list[OutputFrame],
    beyond: tuple[int, int] = (0, 0),
) -> str:  # fmt: skip
    """Identifies what a take shows, to tell stale frames from good ones. The frame range is not part of it."""
    path = Path(params.camera_path) if params.camera_path else ""
    return content_key(
        TAKE_VERSION,
        run.folder / "checkpoint.safetensors",
        t_star,
        params.t_star_per_frame,
        params.query,
        width,
        height,
        path,
        *([beyond] if any(beyond) else []),
    )


def _prepare(folder: Path, key: str, only_missing: bool) -> set[int]:
    """Makes the take's folder; returns the frames in it that are already right. Stale frames are removed."""
    (folder / "preview").mkdir(parents=True, exist_ok=True)
    state = folder / "state.json"
    same = state.is_file() and read_json(state).get("key") == key
    if same and only_missing:
        have = {int(p.stem) for p in folder.glob("*.exr") if _FRAME.fullmatch(p.stem)}
        return {n for n in have if (folder / "preview" / frame_file(n, ".png")).is_file()}
    stale = [p for p in [*folder.glob("*.exr"), *(folder / "preview").glob("*.png")] if _FRAME.fullmatch(p.stem)]
    for old in [folder / "take.json", *stale]:
        old.unlink(missing_ok=True)
    write_json(state, {"version": 1, "key": key})
    return set()


def _render_all(
    folder: Path, frames: list[OutputFrame], done: set[int], scene: Scene, run: LoadedRun, query: str,
    size: tuple[int, int], beyond: tuple[int, int], report: Reporter,
) -> None:  # fmt: skip
    whole = (size[0] + 2 * beyond[0], size[1] + 2 * beyond[1])
    frozen: FrozenGaussians | None = None
    at = float("nan")
    for n, output in enumerate(frames):
        report.check_cancelled()
        report.progress("freezing", n, len(frames), f"frame {output.frame}")
        if output.frame in done:
            continue
        if frozen is None or output.t_star != at:
            frozen, at = (
                freeze_at(run.model, scene.time_of_frame(output.t_star), span_of(scene, run), query),
                output.t_star,
            )
        exposed_at = scene.time_of_frame(output.exposed_like)
        K = output.K.clone()
        K[:2, 2] += torch.tensor(beyond, dtype=K.dtype)  # the same camera, with more pixels around
        image = render_frozen(frozen, output.viewmat, K, *whole, run.model.exposure, exposed_at)
        _write_frame(folder, output, image, scene, beyond)
    report.progress("freezing", len(frames), len(frames), f"{len(frames)} frames")


def span_of(scene: Scene, run: LoadedRun) -> float:
    """Seconds between the first and the last trained frame."""
    at = {frame: second for frame, second in zip(scene.frames, scene.seconds, strict=True)}
    return max(1e-6, float(at[run.train_frames[-1]] - at[run.train_frames[0]]))


def _write_frame(folder: Path, output: OutputFrame, image: FrozenImage, scene: Scene, beyond: tuple[int, int]) -> None:
    shown = image.color + (1.0 - image.alpha[..., None]) * 0.5
    height, width = shown.shape[0] - 2 * beyond[1], shown.shape[1] - 2 * beyond[0]
    # Previews, and so contact sheet and video, show the frame as it stands over the plate.
    shown = shown[beyond[1] : beyond[1] + height, beyond[0] : beyond[0] + width]
    save_png(folder / "preview" / frame_file(output.frame, ".png"), shown)
    viewmat = output.viewmat.double().clone()
    viewmat[:3, 3] = viewmat[:3, 3] / scene.scale - viewmat[:3, :3] @ torch.from_numpy(scene.centre)
    depth = torch.where(image.depth < NO_DEPTH, image.depth / scene.scale, NO_DEPTH)
    write_frozen_exr(
        folder / frame_file(output.frame, ".exr"),
        scene_linear(image.color.numpy(), image.alpha.numpy()),
        depth.numpy(),
        image.support.numpy(),
        image.motion.numpy(),
        FrameMetadata(output.frame, output.t_star, viewmat.float().numpy(), output.K.numpy()),
        beyond,
    )


def scene_linear(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Premultiplied display-referred colour [H, W, 3] and alpha [H, W] -> premultiplied scene-linear RGBA [H, W, 4].

    Splats blend in display space; the conversion acts on the colour that is seen, so it goes through straight alpha.
    """
    # Beyond white there is no plate to match: the model was trained on [0, 1], overshoot is noise.
    capped = np.clip(color, 0.0, alpha[..., None])
    return premultiplied_srgb_to_linear(np.concatenate([capped, alpha[..., None]], axis=2))


def _finish(
    shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, t_star: int, frames: list[OutputFrame],
    size: tuple[int, int], beyond: tuple[int, int], key: str, report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Contact sheet, video, PLY and take.json; the frames are on disk."""
    folder = shot.take(params.take)
    report.progress("finishing the take", 0, 3, "contact sheet")
    numbers = [f.frame for f in frames]
    previews = [folder / "preview" / frame_file(n, ".png") for n in numbers]
    sheet = _contact_sheet(
        shot, params, numbers, previews, f"{shot.info().name}: t* = frame {t_star}, run {params.run}", t_star
    )
    report.check_cancelled()
    report.progress("finishing the take", 1, 3, "video")
    note = write_video(folder / "video.mp4", (read_png(p) for p in previews), shot.info().fps or 24.0)
    if note:
        report.warning(note)
    report.progress("finishing the take", 2, 3, "PLY")
    frozen = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run), params.query)
    _write_ply(folder / "frozen.ply", frozen, scene)
    redistort = _redistort(shot, folder, size, beyond, intrinsics(frames), report)
    facts = {
        "version": 1,
        "key": key,
        "take": params.take,
        "run": params.run,
        "t_star_frame": t_star,
        "t_star_per_frame": params.t_star_per_frame,
        "camera_path": params.camera_path,
        "query": params.query,
        "width": size[0],
        "height": size[1],
        "overscan": params.overscan,
        "margin": list(beyond),
        "redistort": str(redistort or ""),
        "first": numbers[0],
        "last": numbers[-1],
        "frames": len(numbers),
        "fps": shot.info().fps,
        "scale": scene.scale,
        "exr_dir": str(folder),
        "contact_sheet": str(sheet),
        "video": str(folder / "video.mp4"),
        "ply": str(folder / "frozen.ply"),
    }
    write_json(folder / "take.json", facts)
    shot.update(t_star=t_star)
    report.image("contact sheet", sheet)
    report.progress("finishing the take", 3, 3, "done")
    return facts


def _redistort(
    shot: Shot, folder: Path, size: tuple[int, int], beyond: tuple[int, int], Ks: np.ndarray, report: Reporter
) -> Path | None:
    """The map back through the lens over overscanned frames; None where the shot's own map fits, or none does."""
    (folder / TAKE_REDISTORT).unlink(missing_ok=True)
    if not any(beyond):
        return None
    try:
        return write_take_map(shot, folder, *size, beyond, Ks)
    except JobError as error:
        if error.exit_code != ExitCode.SOLVE:
            raise
        report.warning(f"{error.message} The take has no ST map.", error.hint)
        return None


def _contact_sheet(
    shot: Shot, params: FreezeParams, numbers: list[int], previews: list[Path], title: str, t_star: int
) -> Path:
    plates = [shot.frames / frame_file(n, ".png") for n in numbers]
    own_poses = not params.camera_path and all(p.is_file() for p in plates)
    path = shot.take(params.take) / "contact_sheet.png"
    write_contact_sheet(path, plates if own_poses else None, previews, numbers, title, mark=t_star)
    return path


def _write_ply(path: Path, frozen: FrozenGaussians, scene: Scene) -> None:
    """The frozen instant in solve units, as every splat viewer reads it."""
    s = {name: value.cpu() for name, value in frozen.state.items()}
    means = s["means"].double() / scene.scale + torch.from_numpy(scene.centre)
    sh = torch.cat([s["sh0"], s["shN"]], dim=1)
    write_ply(
        path, means.float().numpy(), s["quats"].numpy(), (s["log_scales"] - float(np.log(scene.scale))).numpy(),
        s["opacity_logits"].numpy(), sh.numpy(),
    )  # fmt: skip
