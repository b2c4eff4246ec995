"""The freeze job: renders a take and writes all its files."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...cameras.placement import Similarity, placement_for
from ...contract import (
    ExitCode,
    FreezeParams,
    JobError,
    Reporter,
    TakeFolder,
    Verdict,
    path_error,
)
from ...footage.images import read_png
from ...gaussians.ply import write_ply
from ...lens.stmap import write_take_map
from ...shot import Shot, disk_error, is_disk_full, remove_file, write_json
from ...torch_types import from_numpy
from ..exr import read_frozen_exr
from ..frozen import OutputFrame
from .cameras import in_range, intrinsics
from .contact_sheet import write_contact_sheet
from .folder import clear, outdated, place_of, take_over, unkeyed_warning
from .footage_facts import footage_facts
from .frames import make_ready, small_share
from .plan import FrameSpec, PlannedTake, planned, run_verdict
from .side_by_side import render_side_by_side
from .splats import camera_path_of, placed_splats, write_stage
from .verdict import judge_take, unsure
from .video import write_video


def freeze_shot(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Renders a take of a run and writes EXRs, previews, contact sheet, video and splats into takes/<name>.

    Returns the content of take.json. JobError if the take cannot be rendered.
    """
    take = planned(shot, params, report)
    frames = in_range(take.whole, params)
    place = place_of(take, params)
    if place.has_unkeyed:
        report.warning(*unkeyed_warning(params.take))
    if (warning := outdated(take, place.current | {f.frame for f in frames})) is not None:
        report.warning(*warning)
    done = place.current | place.replacement_current
    make_ready(take, frames, done, report)  # may fail or be cancelled, so it runs before old frames are removed
    if place.replacement is None:
        clear(take, done)
    shares = render_side_by_side(shot, params, dataclasses.replace(take, folder=place.folder), frames, done, report)
    if place.replacement is not None:
        take_over(take, place)
    frames_on_disk = done | {f.frame for f in frames}
    facts = finish(shot, params, take, [f for f in take.whole if f.frame in frames_on_disk], shares, report)
    shot.update(t_star=take.t_star)
    if take.spec.run.stale:
        report.warning("The run was trained during the freeze: the take shows its earlier state.", "Freeze it again.")
    return facts


def finish(
    shot: Shot, params: FreezeParams, take: PlannedTake, frames: list[OutputFrame], shares: dict[int, Tensor],
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Writes contact sheet, video, splats and take.json for `frames`, which are all frames of the take on disk.

    Returns the content of take.json. `shares` is as returned by `render_frames`. JobError if the disk is full.
    """
    try:
        return _finish(shot, params, take, frames, shares, report)
    except OSError as error:
        raise (disk_error(take.folder.root) if is_disk_full(error) else error) from error


def _finish(
    shot: Shot, params: FreezeParams, take: PlannedTake, frames: list[OutputFrame], shares: dict[int, Tensor],
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    folder, scene, t_star, spec = take.folder, take.scene, take.t_star, take.spec
    run, size = spec.run, spec.size
    numbers = [f.frame for f in frames]
    report.progress("finishing the take", 0, 3, "contact sheet")
    previews = [folder.preview(n) for n in numbers]
    detail_record = _detail_record(folder, numbers, spec, shares)
    inputs = {"t_star_per_frame": params.t_star_per_frame, "camera_path": params.camera_path}
    verdict = judge_take({"t_star_frame": t_star, **inputs, "detail": detail_record.get("detail")}, run_verdict(run))
    info = shot.info()
    title = f"{info.name}, {Path(info.source).name}: t* = frame {t_star}, run {params.run}"
    with missable("contact sheet", report):
        _contact_sheet(shot, params, numbers, previews, title, t_star, verdict)
    report.check_cancelled()
    report.progress("finishing the take", 1, 3, "video")
    with missable("video", report):
        note = write_video(folder.video, (read_png(p) for p in previews), info.fps or 24.0)
        if note:
            report.warning(note)
    report.progress("finishing the take", 2, 3, "splats")
    placement = placement_for(shot, params.placement)
    splats = placed_splats(spec.instants.at(float(t_star), report), scene, Similarity.of(placement))
    with missable("PLY", report):
        write_ply(folder.ply, *splats)
    with missable("USD stage", report):
        write_stage(folder.usd, splats, camera_path_of(shot, params.camera_path), placement, info.fps, report)
    redistort = _redistort(shot, folder, size, spec.beyond, intrinsics(frames), report)
    facts = {
        **_facts(shot, params, take),
        "first": numbers[0],
        "last": numbers[-1],
        "frames": len(numbers),
        "redistort": str(redistort or ""),
        "usd": str(folder.usd) if folder.usd.is_file() else "",
        "placement": placement.to_json(),
        **detail_record,
        **({} if verdict is None else {"verdict": vars(verdict)}),
    }
    write_json(folder.facts, facts)
    report.image("contact sheet", folder.contact_sheet)
    report.progress("finishing the take", 3, 3, "done")
    return facts


def _facts(shot: Shot, params: FreezeParams, take: PlannedTake) -> dict[str, Any]:
    """The record of a take in take.json: parameters, plan and paths."""
    folder, spec = take.folder, take.spec
    return {
        "version": 1,
        "key": take.key,
        "take": params.take,
        "run": params.run,
        "checkpoint": spec.run.stamp,
        "t_star_frame": take.t_star,
        "t_star_per_frame": params.t_star_per_frame,
        "camera_path": params.camera_path,
        "query": params.query,
        **({"developed": spec.instants.frames} if params.develop == "on" else {}),
        "width": spec.size[0],
        "height": spec.size[1],
        "overscan": params.overscan,
        "margin": list(spec.beyond),
        "frames_in_all": len(take.whole),
        **({} if params.t_star is None else {"t_star_asked": params.t_star}),
        "fps": shot.info().fps,
        "scale": take.scene.scale,
        "passes": spec.passes is not None,
        "deep": spec.deep is not None,
        "shutter": 0.0 if spec.blur is None else spec.blur.shutter,
        "grain": None if spec.grain is None else spec.grain.to_json(),
        "footage": footage_facts(shot, folder.root),
        "exr_dir": str(folder.root),
        "contact_sheet": str(folder.contact_sheet),
        "video": str(folder.video),
        "ply": str(folder.ply),
    }


@contextlib.contextmanager
def missable(name: str, report: Reporter) -> Generator[None]:
    """Context manager that turns an OSError of writing an optional file into a warning.

    On Windows, a file that a player has open cannot be replaced. A full disk and unknown errors are raised.
    """
    try:
        yield
    except OSError as error:
        known = None if is_disk_full(error) else path_error(error)
        if known is None:
            raise
        report.warning(
            f"The {name} was not written: {known.message}",
            "The frames were written. Close the file, then freeze again.",
        )


def _detail_record(
    folder: TakeFolder, numbers: list[int], spec: FrameSpec, shares: dict[int, Tensor]
) -> dict[str, Any]:
    """Facts on plate detail for take.json; {} without plate detail. `shares` are those of the rendered frames."""
    if spec.detail is None:
        return {}
    for n in (n for n in numbers if n not in shares):
        frame = read_frozen_exr(folder.frame(n))
        if frame.detail is not None:
            plate, support = (np.asarray(layer, np.float32) for layer in (frame.detail.plate, frame.support))
            shares[n] = small_share(from_numpy(plate), from_numpy(support))
    return {"detail": detail_facts(shares), **({"warp_dir": str(folder.warps)} if spec.has_warps else {})}


def _redistort(
    shot: Shot, folder: TakeFolder, size: tuple[int, int], beyond: tuple[int, int], Ks: np.ndarray, report: Reporter
) -> Path | None:
    """Writes the ST map that adds lens distortion to overscanned frames.

    Returns None without overscan, because the shot's own map then fits. If no map can be made, it warns and returns
    None.
    """
    remove_file(folder.redistort)
    if not any(beyond):
        return None
    try:
        return write_take_map(shot, folder.redistort, *size, beyond, Ks)
    except JobError as error:
        if error.exit_code != ExitCode.SOLVE:
            raise
        report.warning(f"{error.message} The take has no ST map.", error.hint)
        return None


def _contact_sheet(
    shot: Shot, params: FreezeParams, numbers: list[int], previews: list[Path], title: str, t_star: int,
    verdict: Verdict | None,
) -> None:  # fmt: skip
    seen = [i for i, n in enumerate(numbers) if shot.plate(n).is_file()]  # frames missing in the footage have no plate
    on_clip_poses = not params.camera_path and bool(seen)
    if on_clip_poses:
        previews, numbers = [previews[i] for i in seen], [numbers[i] for i in seen]
    plates = [shot.plate(n) for n in numbers]
    path = TakeFolder(shot.take(params.take)).contact_sheet
    note, doubt = ("", set[int]()) if verdict is None else (" ".join(verdict.lines()), unsure(verdict, numbers))
    write_contact_sheet(
        path, plates if on_clip_poses else None, previews, numbers, title, mark=t_star, note=note, unsure=doubt
    )


def detail_facts(shares: dict[int, Tensor]) -> dict[str, Any]:
    """Statistics of a take's sources for take.json: means over frames, and the values of each frame.

    `plate_share` is the mean share of plate. `invented_share` is the share of pixels with less than half plate.
    `regions` is `invented_share` on a grid of 4 x 4 cells, rows from the top.
    """
    rows: list[dict[str, Any]] = []
    for frame, share in sorted(shares.items()):
        invented = (share < 0.5).float()
        grid = torch.nn.functional.adaptive_avg_pool2d(invented[None, None], 4)[0, 0]
        rows.append(
            {
                "frame": frame,
                "plate_share": round(float(share.mean()), 4),
                "invented_share": round(float(invented.mean()), 4),
                "regions": [[round(float(v), 3) for v in row] for row in grid],
            }
        )
    means = {name: round(float(np.mean([row[name] for row in rows])), 4) for name in ("plate_share", "invented_share")}
    return {**means, "per_frame": rows}
