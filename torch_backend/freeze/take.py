"""The freeze station: renders a take, frame by frame, and writes what leaves for Blender and for the artist's eyes."""

from __future__ import annotations

import dataclasses
import functools
import shutil
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contract import (
    CONTACT_SHEET_FILE,
    NO_DEPTH,
    PLY_FILE,
    TAKE_FILE,
    TAKE_NEXT_FOLDER,
    TAKE_PREVIEW_FOLDER,
    TAKE_REDISTORT,
    TAKE_STATE_FILE,
    VIDEO_FILE,
    ExitCode,
    FreezeParams,
    JobError,
    Reporter,
    Verdict,
    frame_file,
    frame_number,
    is_half_written,
    later,
    parse_timecode,
    read_json,
    replace_file,
    sweep_half_written,
    verdict_of,
)
from ..footage.color import LIGHTS, on_straight_colour
from ..footage.display import PLAIN, Display
from ..footage.images import read_png, write_png
from ..footage.importing import load_frames
from ..footage.plates import Plates
from ..gaussians.ply import write_ply
from ..scene import Scene, frame_table, load_scene
from ..shot import Shot, content_key, disk_error, is_disk_full, make_folder, need_disk, write_json
from ..solve.motion import find_motion, motion_key
from ..solve.stmap import margin, write_take_map
from ..torch_types import floats, from_numpy
from ..train import LoadedRun, choose_device, load_run
from ..train.anew import SUMMARY_FILE
from .bands import bands
from .contact_sheet import write_contact_sheet
from .detail import DetailedFrame, Detailer
from .developed_instants import Instants
from .exr import DetailLayers, FrameMetadata, Made, read_frozen_exr, read_key, write_frozen_exr
from .footage_facts import footage_facts, footage_light
from .frozen import FrozenGaussians, FrozenImage, OutputFrame, render_frozen, suggest_t_star
from .grain import Brush, Grain, measure_plate
from .reproject import resized
from .take_cameras import in_range, intrinsics, output_size, plan
from .transfer import to_display
from .verdict import judge_take, unsure
from .video import write_video
from .warp import FOLDER as WARPS
from .warp import WarpMetadata, write_warp
from .write_beside import WriteBeside

TAKE_VERSION = 1
"""Rises when frames rendered before must not stand beside new ones."""
DETAIL_VERSION = 8
"""The same, of frames made of plates."""


def freeze_shot(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Renders a take of a run and writes EXRs, previews, contact sheet, video and PLY into takes/<name>.

    Returns the take's figures (also in take.json). JobError in words if it cannot be done.
    """
    take = planned(shot, params, report)
    frames = in_range(take.whole, params)
    place = _place(take, params)
    done = place.right_here | place.right_beside
    make_ready(take, frames, done, report)  # what can fail, or be cancelled, before anything of before goes
    if place.beside is None:
        _clear(take, done)
    shares = render_frames(dataclasses.replace(take, folder=place.folder), frames, done, report)
    if place.beside is not None:
        _take_over(take, place)
    frames_on_disk = done | {f.frame for f in frames}
    facts = finish(shot, params, take, [f for f in take.whole if f.frame in frames_on_disk], shares, report)
    shot.update(t_star=take.t_star)
    if take.spec.run.stale:
        report.warning(
            "The run was trained while it was frozen: the take shows what it was before.", "Freeze it again."
        )
    return facts


@dataclass
class FrameSpec:
    """What every frame of a take has in common."""

    run: LoadedRun
    """The run that is frozen."""
    instants: Instants
    """Its scenes at the take's instants."""
    query: str
    """As in `FreezeParams`."""
    size: tuple[int, int]
    """Width and height of the frames in pixels, without overscan."""
    beyond: tuple[int, int]
    """Pixels beyond the frame on the left and right, and above and below: overscan."""
    grain: Grain | None
    """The plate's, None if it is not wanted."""
    grain_size: tuple[int, int]
    """Width and height in pixels at which a frame's grain is drawn, without overscan."""
    detail: Detailer | None = None
    """Makes the frames of plates; None: splats alone."""
    detail_key: str = ""
    """Identifies the plates and mattes that it uses; empty without it."""
    light: str = LIGHTS[0]
    """Primaries of the light in which frames leave, one of `LIGHTS`: the footage's own."""
    start: tuple[str, int, float] = ("", 0, 0.0)
    """Timecode of one of the clip's frames, that frame's number, and frames per second; no code: the clip has none."""

    def timecode(self, frame: int) -> str:
        """Of a frame, as its file carries it: empty without one, and beyond 40 frames per second, which EXR cannot."""
        code, at, fps = self.start
        return later(code, frame - at, fps) if code and 1 <= round(fps) <= 40 else ""

    @property
    def whole(self) -> tuple[int, int]:
        """Width and height of the frames in pixels, with overscan."""
        return self.size[0] + 2 * self.beyond[0], self.size[1] + 2 * self.beyond[1]

    @property
    def whole_grain_size(self) -> tuple[int, int]:
        """Width and height in pixels at which a frame's grain is drawn, with overscan."""
        width, height = (n * w / s for n, w, s in zip(self.grain_size, self.whole, self.size, strict=True))
        return round(width), round(height)

    def key(self, output: OutputFrame) -> str:
        """Identifies what a frame shows and from what, to tell stale frames from good ones."""
        return content_key(
            TAKE_VERSION,
            self.run.stamp,
            self.query,
            self.size,
            None if self.grain is None else [self.grain.to_json(), self.grain_size],
            output.t_star,
            output.exposed_like,
            floats(output.viewmat.flatten()),
            floats(output.K.flatten()),
            *([self.beyond] if any(self.beyond) else []),
            *([self.detail_key] if self.detail_key else []),
            *([self.light] if self.light != LIGHTS[0] else []),
            *([self.instants.keys[output.t_star]] if output.t_star in self.instants.keys else []),
        )


@dataclass(frozen=True)
class PlannedTake:
    """What a take will show, before any of it is rendered."""

    folder: Path
    """takes/NAME."""
    scene: Scene
    """Of the shot."""
    t_star: int
    """Frame at which time stands still."""
    whole: list[OutputFrame]
    """All frames that it can have."""
    spec: FrameSpec
    """What they have in common."""
    keys: dict[int, str]
    """Frame -> `FrameSpec.key`."""
    key: str
    """`take_key`."""


def planned(shot: Shot, params: FreezeParams, report: Reporter, t_star: int | None = None) -> PlannedTake:
    """What `params` ask for. Nothing of the take is written; motion mattes are, if the shot has none.

    `t_star`: the instant, where it is settled already; None: as `params` say, or suggested. JobError in words if it
    cannot be done.
    """
    run = load_run(shot, params.run, choose_device(params.device, report, "Freezing"))
    scene = load_scene(shot)
    if t_star is None:
        t_star = choose_t_star(shot, scene, run, params, report)
    width, height = output_size(shot, scene, params)
    whole = plan(scene, params, t_star, width, height)
    folder = shot.own(shot.take(params.take))
    for inner in (TAKE_PREVIEW_FOLDER, TAKE_REDISTORT.parent, WARPS, TAKE_NEXT_FOLDER):
        shot.own(folder / inner)
    beyond = margin(shot, params, width, height, intrinsics(whole))
    grain = plate_grain(shot, scene) if params.grain else None
    # Grain belongs to the plate's pixels; a camera of the artist's own has their scale, and its own shape.
    plate = (shot.info().width, round(shot.info().width * height / width))
    if params.detail == "on" or params.develop == "on":
        find_motion(shot, report)  # of shots solved before the solve looked for it
    detail = plate_detail(shot, scene, run, params, whole[0], (width, height), report)
    instants = Instants(shot, run, scene, params.query, (f.t_star for f in whole), params.develop == "on")
    spec = FrameSpec(
        run, instants, params.query, (width, height), beyond, grain, plate, detail, detail_key(shot, detail),
        footage_light(shot),
        _start(shot),
    )  # fmt: skip
    keys = {f.frame: spec.key(f) for f in whole}
    key = take_key(run, params, t_star, width, height, beyond, sorted(instants.keys.values()))
    return PlannedTake(folder, scene, t_star, whole, spec, keys, key)


def plate_detail(
    shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, first: OutputFrame, size: tuple[int, int],
    report: Reporter,
) -> Detailer | None:  # fmt: skip
    """What makes a take's frames of plates; None where `params` wants splats alone. `first` is any frame of the take.
    The shot's motion mattes must have been found.

    Plates are read at the scale of the frames, so that one pixel answers one: at their own size by default.
    """
    if params.detail == "off":
        return None
    plates = Plates(shot)
    scale = float(first.K[0, 0]) / float(scene.Ks[0, 0, 0] * plates.width / scene.width)
    if not params.camera_path and size != (plates.width, plates.height):
        plates = Plates(shot, size)
    elif params.camera_path and scale < 0.99:
        plates = Plates(shot, (max(16, round(plates.width * scale)), max(16, round(plates.height * scale))))
    if plates.note:
        report.warning(plates.note)
    return Detailer(run, scene, plates)


def detail_key(shot: Shot, detail: Detailer | None) -> str:
    """Identifies what plate detail is made of, beside the run; empty without it."""
    if detail is None or not isinstance(detail.plates, Plates):
        return ""
    return content_key(DETAIL_VERSION, detail.plates.key, motion_key(shot), dataclasses.asdict(detail.config))


def plate_grain(shot: Shot, scene: Scene) -> Grain:
    """Grain of the shot's undistorted frames, which frozen ones are mixed with."""
    files = [shot.plate(n) for n in scene.frames]
    return measure_plate([path for path in files if path.is_file()], scene.display)


def choose_t_star(shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, report: Reporter) -> int:
    """The frame to freeze at, snapped to a trained one: a time that no frame constrains is a guess."""
    trained = np.array(run.train_frames)
    if params.t_star is None:
        table = frame_table(shot)
        sharpness = np.array([table[int(f)]["sharpness"] if int(f) in table else 0.0 for f in trained])
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


def _start(shot: Shot) -> tuple[str, int, float]:
    """See `FrameSpec.start`."""
    record = load_frames(shot)
    return parse_timecode(str(record.get("timecode", ""))), int(record["frames"][0]["frame"]), float(record["fps"])


def take_key(
    run: LoadedRun, params: FreezeParams, t_star: int, width: int, height: int, beyond: tuple[int, int] = (0, 0),
    developed: Sequence[str] = (),
) -> str:  # fmt: skip
    """Identifies what a take shows. The frame range is not part of it. Frames have keys of their own, see
    `FrameSpec.key`; this one tells about frames that were rendered before they had. `developed`: keys of the instants
    that are."""
    path = Path(params.camera_path) if params.camera_path else ""
    return content_key(
        TAKE_VERSION,
        run.stamp,
        t_star,
        params.t_star_per_frame,
        params.query,
        width,
        height,
        path,
        *([beyond] if any(beyond) else []),
        *([list(developed)] if developed else []),
    )


@dataclass(frozen=True)
class _Place:
    """Where a take's frames are rendered to."""

    folder: Path
    """The take's own; or `beside`."""
    beside: Path | None
    """A folder in it, as long as another take of that name stands there whole: that one stays until this is done."""
    right_here: set[int]
    """Frames in the take's own folder that are as they would be rendered now."""
    right_beside: set[int]
    """Those in `beside`: it was begun before."""


def _place(take: PlannedTake, params: FreezeParams) -> _Place:
    """Makes the folder that the take is rendered to, and finds the frames that are right.

    One that is not asked for now is among them: a part of the range does not undo the rest of the take.
    """
    folder, with_warps = take.folder, take.spec.detail is not None
    make_folders(folder, with_warps)
    here, beside = _right_frames(take, folder, params), folder / TAKE_NEXT_FOLDER
    there = _right_frames(take, beside, params) if beside.is_dir() else set[int]()
    for n in set(frames_in([*beside.glob("*.exr"), *(beside / TAKE_PREVIEW_FOLDER).glob("*.png")])) - there:
        for file in files_of(beside, n):
            file.unlink(missing_ok=True)
    stands = (folder / TAKE_FILE).is_file() and bool(set(frames_in(folder.glob("*.exr"))) - here)
    if not stands:
        place = _Place(folder, beside, here, there)
        if beside.is_dir():  # killed while it took over
            _take_over(take, place)
        return _Place(folder, None, here | there, set())
    for used in (beside, beside / TAKE_PREVIEW_FOLDER, *([beside / WARPS] if with_warps else [])):
        make_folder(used)
        sweep_half_written(used)
    return _Place(beside, beside, here, there)


def _right_frames(take: PlannedTake, folder: Path, params: FreezeParams) -> set[int]:
    """The frames in a folder that are as they would be rendered now, and whole; none if all are to be made anew."""
    keys, with_warps = take.keys, take.spec.detail is not None
    state = folder / TAKE_STATE_FILE
    # Frames without a key of their own are of before grain, too.
    old_are_right = not params.grain and not with_warps and state.is_file() and read_json(state).get("key") == take.key
    right: set[int] = set()
    for n in frames_in(folder.glob("*.exr")) if params.only_missing else ():
        stored_key = read_key(folder / frame_file(n, ".exr"))
        known = n in keys and (stored_key == keys[n] or (stored_key == "" and old_are_right))
        if known and is_whole(folder, n, with_warps):
            right.add(n)
    return right


def _clear(take: PlannedTake, done: Set[int]) -> None:
    """Removes all frames of before but those that are `done`: nobody shall take old ones for a part of this take."""
    folder = take.folder
    pictures = [*folder.glob("*.exr"), *(folder / TAKE_PREVIEW_FOLDER).glob("*.png")]
    stale = set(frames_in(pictures)) - done
    for old in [folder / TAKE_FILE, *(file for n in stale for file in files_of(folder, n))] if stale else ():
        old.unlink(missing_ok=True)
    write_json(folder / TAKE_STATE_FILE, {"version": 1, "key": take.key})


def _take_over(take: PlannedTake, place: _Place) -> None:
    """The frames rendered beside a take of before stand in its place. Killed meanwhile, the next freeze goes on."""
    assert place.beside is not None
    _clear(take, place.right_here)
    for file in sorted(place.beside.rglob("*"), key=lambda file: file.parent == place.beside):  # a frame's EXR is last
        if file.is_file() and not is_half_written(file.name):
            target = take.folder / file.relative_to(place.beside)
            make_folder(target.parent)
            replace_file(file, target)
    shutil.rmtree(place.beside, ignore_errors=True)


def files_of(folder: Path, frame: int) -> list[Path]:
    """All files that a frame of a take has: EXR, warp, preview."""
    exr, preview = frame_file(frame, ".exr"), frame_file(frame, ".png")
    return [folder / exr, folder / WARPS / exr, folder / TAKE_PREVIEW_FOLDER / preview]


def make_folders(folder: Path, with_warps: bool) -> None:
    """Makes a take's folder. JobError if it holds frames of someone else's."""
    pictures = [*folder.glob("*.exr"), *(folder / TAKE_PREVIEW_FOLDER).glob("*.png")]
    if not (folder / TAKE_STATE_FILE).is_file() and frames_in(pictures):
        raise JobError(
            f"{folder} holds numbered pictures that were not made here.",
            "Name another take, or move them away.",
            ExitCode.FREEZE,
        )
    for used in (folder, folder / TAKE_PREVIEW_FOLDER, *([folder / WARPS] if with_warps else [])):
        make_folder(used)
        sweep_half_written(used)


def is_whole(folder: Path, frame: int, with_warps: bool) -> bool:
    """True if what belongs beside a frame of a take is there."""
    warped = not with_warps or (folder / WARPS / frame_file(frame, ".exr")).is_file()
    return warped and (folder / TAKE_PREVIEW_FOLDER / frame_file(frame, ".png")).is_file()


def frames_in(paths: Iterable[Path]) -> list[int]:
    """Numbers of those files that are frames, ascending."""
    return sorted(n for p in paths if (n := frame_number(p.stem)) is not None)


def make_ready(take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter) -> None:
    """Develops the instants of those of `frames` that are not done. JobError if the disk has no room for the frames."""
    spec, missing = take.spec, [f for f in frames if f.frame not in done]
    each = spec.whole[0] * spec.whole[1] * (20.0 + (6.0 if spec.grain else 0.0) + (24.0 if spec.detail else 0.0))
    need_disk(take.folder, len(missing) * each, "the take")
    spec.instants.prepare((f.t_star for f in missing), report)


def render_frames(
    take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter
) -> dict[int, Tensor]:  # fmt: skip
    """Renders and writes those of `frames` that are not done, if the disk has room for them.

    Returns frame number -> [h, w] share of plate, small, of those rendered. JobError if the disk is full.
    """
    make_ready(take, frames, done, report)
    try:
        return _render_all(take, frames, done, report)
    except OSError as error:
        raise (disk_error(take.folder) if is_disk_full(error) else error) from error


def _render_all(take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter) -> dict[int, Tensor]:
    folder, scene, spec, keys = take.folder, take.scene, take.spec, take.keys
    shares: dict[int, Tensor] = {}
    with WriteBeside() as out:
        for n, output in enumerate(frames):
            report.check_cancelled()
            report.progress("freezing", n, len(frames), f"frame {output.frame}")
            if output.frame in done:
                continue
            image = _render(output, scene, spec, report)
            if isinstance(image, DetailedFrame):
                shares[output.frame] = small_share(image.plate, image.support)
            write = functools.partial(_write, folder, output, image, scene, spec, keys[output.frame])
            out.write(write, sum(value.nbytes for value in vars(image).values() if isinstance(value, Tensor)))
            del image, write  # at 4K the next frame needs their gigabyte
    report.progress("freezing", len(frames), len(frames), f"{len(frames)} frames")
    return shares


def _render(output: OutputFrame, scene: Scene, spec: FrameSpec, report: Reporter) -> FrozenImage | DetailedFrame:
    """A frame of the take, of splats or of plates."""
    frozen = spec.instants.at(output.t_star, report)
    exposed_at = scene.time_of_frame(output.exposed_like)
    K = output.K.clone()
    K[:2, 2] += torch.tensor(spec.beyond, dtype=K.dtype, device="cpu")  # the same camera, with more pixels around
    image = render_frozen(frozen, output.viewmat, K, *spec.whole, spec.run.model.exposure, exposed_at)
    return image if spec.detail is None else spec.detail.frame(output, frozen, image, *spec.size)


def _write(
    folder: Path, output: OutputFrame, image: FrozenImage | DetailedFrame, scene: Scene, spec: FrameSpec, key: str
) -> None:
    """All files of a frame, the EXR last: a frame that has one has the others."""
    if isinstance(image, DetailedFrame):
        _write_warp(folder, output, image, spec, key)
    _write_frame(folder, output, image, scene, spec, key)


def _write_frame(
    folder: Path, output: OutputFrame, image: FrozenImage | DetailedFrame, scene: Scene, spec: FrameSpec, key: str
) -> None:
    """Preview and EXR. What the layers are made of is in memory, they themselves only some rows at a time."""
    write_png(folder / TAKE_PREVIEW_FOLDER / frame_file(output.frame, ".png"), _preview(image, spec))
    viewmat = output.viewmat.double().clone()
    viewmat[:3, 3] = viewmat[:3, 3] / scene.scale - viewmat[:3, :3] @ from_numpy(scene.centre)
    size = tuple(image.alpha.shape)
    alpha = image.alpha.numpy()

    def depth(rows: slice) -> np.ndarray:
        return torch.where(image.depth[rows] < NO_DEPTH, image.depth[rows] / scene.scale, NO_DEPTH).numpy()

    def rgba(rows: slice) -> np.ndarray:
        if isinstance(image, DetailedFrame):
            return np.concatenate([image.linear[rows].numpy(), alpha[rows][..., None]], axis=2)
        return scene_linear(image.color[rows].numpy(), alpha[rows], scene.display)

    layers = None
    if isinstance(image, DetailedFrame):
        splat, covered = image.splat.numpy(), image.splat_alpha.numpy()
        shown = Made((*size, 4), lambda rows: scene_linear(splat[rows], covered[rows], scene.display))
        layers = DetailLayers(shown, image.plate, image.source)
    write_frozen_exr(
        folder / frame_file(output.frame, ".exr"),
        Made((*size, 4), rgba),
        Made(size, depth),
        image.support.numpy(),
        image.motion.numpy(),
        FrameMetadata(
            output.frame,
            output.t_star,
            viewmat.float().numpy(),
            output.K.numpy(),
            timecode=spec.timecode(output.frame),
            key=key,
            light=spec.light,
        ),
        spec.beyond,
        None if spec.grain is None else _grain(spec.grain, output.frame, image, spec, scene.display),
        layers,
    )


def _grain(
    grain: Grain, frame: int, image: FrozenImage | DetailedFrame, spec: FrameSpec, display: Display
) -> Made:  # fmt: skip
    """The layer of a frame's grain, [H, W, 3] scene-linear, premultiplied. It was measured on sRGB, whatever `display`
    the frame's splats are shown on."""
    brush = Brush(grain, frame, image.alpha.shape, spec.whole_grain_size)

    def drawn(rows: slice) -> np.ndarray:
        colour = to_display(image.linear[rows], PLAIN) if isinstance(image, DetailedFrame) else image.color[rows]
        shown = torch.cat([colour, image.alpha[rows][..., None]], dim=2).numpy()
        if display.bends and not isinstance(image, DetailedFrame):
            shown = on_straight_colour(shown, lambda x: display.straightened(np.asarray(x, np.float32)))
        made = brush.rows(rows, shown)
        if isinstance(image, DetailedFrame):  # plates have theirs
            made = made * (1.0 - image.plate[rows].numpy()[..., None])
        return made

    return Made((*image.alpha.shape, 3), drawn)


def _display(image: FrozenImage | DetailedFrame, rows: slice) -> Tensor:
    """[h, W, 3] some rows of a frame, premultiplied, on the scene's display."""
    return to_display(image.linear[rows], image.display) if isinstance(image, DetailedFrame) else image.color[rows]


def _preview(image: FrozenImage | DetailedFrame, spec: FrameSpec) -> np.ndarray:
    """[H, W, 3] uint8 the frame without overscan as it stands over the plate; so contact sheet and video show it."""
    (width, height), (left, top) = spec.size, spec.beyond
    out = np.empty((height, width, 3), np.uint8)
    for part in bands(height, width):
        rows = slice(part.start + top, part.stop + top)
        shown = _display(image, rows) + (1.0 - image.alpha[rows][..., None]) * 0.5
        shown = shown[:, left : left + width].clamp(0.0, 1.0) * 255.0 + 0.5
        out[part] = shown.to(torch.uint8).numpy()
    return out


def _write_warp(folder: Path, output: OutputFrame, made: DetailedFrame, spec: FrameSpec, key: str) -> None:
    """Before its frame: a frame that is there has its warp."""
    assert spec.detail is not None
    plates = spec.detail.plates
    write_warp(
        folder / WARPS / frame_file(output.frame, ".exr"),
        made.st,
        made.matte,
        made.fill,
        made.alpha,
        WarpMetadata(output.frame, made.leading, output.t_star, plates.width, plates.height, key, light=spec.light),
        spec.beyond,
    )


def small_share(plate: Tensor, support: Tensor) -> Tensor:
    """[H, W] share of plate, averaged to a picture about 160 pixels wide, for figures.

    A plate that shows what nobody saw near t* is none for the instant, by so much as `support` [H, W] says.
    """
    plate = torch.minimum(plate, support)
    height, width = plate.shape
    small = min(width, 160)
    return resized(plate, small, max(4, round(height * small / width)))


def detail_facts(shares: dict[int, Tensor]) -> dict[str, Any]:
    """What a take's frames are made of, for take.json: means over frames, and each frame with a grid of regions.

    `plate_share` is the mean share of plate; `invented_share` the share of pixels of which splats invented more than
    half; `regions` the same on a grid of 4 x 4, rows from the top.
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


def scene_linear(color: np.ndarray, alpha: np.ndarray, display: Display) -> np.ndarray:
    """Premultiplied colour [H, W, 3] of a display and alpha [H, W] -> premultiplied scene-linear RGBA [H, W, 4].

    Splats blend in display space; the conversion acts on the colour that is seen, so it goes through straight alpha.
    """
    # Beyond what any frame of the clip shows there was nothing to match in training: overshoot is noise, which at the
    # end of a shoulder would be many times as bright.
    capped = np.clip(color, 0.0, alpha[..., None] * np.float32(display.most))
    return display.premultiplied_to_light(np.concatenate([capped, alpha[..., None]], axis=2))


def finish(
    shot: Shot, params: FreezeParams, take: PlannedTake, frames: list[OutputFrame], shares: dict[int, Tensor],
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Contact sheet, video, PLY and take.json of all frames that the take has by now; they are on disk.

    Returns what take.json holds. `shares` as `render_frames` gives them. JobError if the disk is full.
    """
    try:
        return _finish(shot, params, take, frames, shares, report)
    except OSError as error:
        raise (disk_error(take.folder) if is_disk_full(error) else error) from error


def _finish(
    shot: Shot, params: FreezeParams, take: PlannedTake, frames: list[OutputFrame], shares: dict[int, Tensor],
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    folder, scene, t_star, spec = take.folder, take.scene, take.t_star, take.spec
    run, size = spec.run, spec.size
    numbers = [f.frame for f in frames]
    report.progress("finishing the take", 0, 3, "contact sheet")
    previews = [folder / TAKE_PREVIEW_FOLDER / frame_file(n, ".png") for n in numbers]
    made_of = _made_of(folder, numbers, spec, shares)
    inputs = {"t_star_per_frame": params.t_star_per_frame, "camera_path": params.camera_path}
    verdict = judge_take({"t_star_frame": t_star, **inputs, "detail": made_of.get("detail")}, run_verdict(run))
    info = shot.info()
    title = f"{info.name}, {Path(info.source).name}: t* = frame {t_star}, run {params.run}"
    sheet = _contact_sheet(shot, params, numbers, previews, title, t_star, verdict)
    report.check_cancelled()
    report.progress("finishing the take", 1, 3, "video")
    note = write_video(folder / VIDEO_FILE, (read_png(p) for p in previews), info.fps or 24.0)
    if note:
        report.warning(note)
    report.progress("finishing the take", 2, 3, "PLY")
    _write_ply(folder / PLY_FILE, spec.instants.at(float(t_star), report), scene)
    redistort = _redistort(shot, folder, size, spec.beyond, intrinsics(frames), report)
    facts = {
        "version": 1,
        "key": take.key,
        "take": params.take,
        "run": params.run,
        "t_star_frame": t_star,
        "t_star_per_frame": params.t_star_per_frame,
        "camera_path": params.camera_path,
        "query": params.query,
        **({"developed": spec.instants.frames} if params.develop == "on" else {}),
        "width": size[0],
        "height": size[1],
        "overscan": params.overscan,
        "margin": list(spec.beyond),
        "redistort": str(redistort or ""),
        "first": numbers[0],
        "last": numbers[-1],
        "frames": len(numbers),
        "fps": shot.info().fps,
        "scale": scene.scale,
        "grain": None if spec.grain is None else spec.grain.to_json(),
        "footage": footage_facts(shot, folder),
        "exr_dir": str(folder),
        "contact_sheet": str(sheet),
        "video": str(folder / VIDEO_FILE),
        "ply": str(folder / PLY_FILE),
        **made_of,
        **({} if verdict is None else {"verdict": vars(verdict)}),
    }
    write_json(folder / TAKE_FILE, facts)
    report.image("contact sheet", sheet)
    report.progress("finishing the take", 3, 3, "done")
    return facts


def run_verdict(run: LoadedRun) -> Verdict | None:
    """The verdict on the run as it was trained last; None if its summary has none, or cannot be read."""
    try:
        return verdict_of(read_json(run.folder / SUMMARY_FILE))
    except (OSError, ValueError):
        return None


def _made_of(folder: Path, numbers: list[int], spec: FrameSpec, shares: dict[int, Tensor]) -> dict[str, Any]:
    """What take.json says of plate detail; {} without it. `shares` are of the frames that this job rendered."""
    if spec.detail is None:
        return {}
    for n in (n for n in numbers if n not in shares):
        frame = read_frozen_exr(folder / frame_file(n, ".exr"))
        if frame.detail is not None:
            plate, support = (np.asarray(layer, np.float32) for layer in (frame.detail.plate, frame.support))
            shares[n] = small_share(from_numpy(plate), from_numpy(support))
    return {"detail": detail_facts(shares), "warp_dir": str(folder / WARPS)}


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
    shot: Shot, params: FreezeParams, numbers: list[int], previews: list[Path], title: str, t_star: int,
    verdict: Verdict | None,
) -> Path:  # fmt: skip
    seen = [i for i, n in enumerate(numbers) if shot.plate(n).is_file()]  # all but those that the footage lacks
    own_poses = not params.camera_path and bool(seen)
    if own_poses:
        previews, numbers = [previews[i] for i in seen], [numbers[i] for i in seen]
    plates = [shot.plate(n) for n in numbers]
    path = shot.take(params.take) / CONTACT_SHEET_FILE
    note, doubt = ("", set[int]()) if verdict is None else (" ".join(verdict.lines()), unsure(verdict, numbers))
    write_contact_sheet(
        path, plates if own_poses else None, previews, numbers, title, mark=t_star, note=note, unsure=doubt
    )
    return path


def _write_ply(path: Path, frozen: FrozenGaussians, scene: Scene) -> None:
    """The frozen instant in solve units, as every splat viewer reads it."""
    s = {name: value.cpu() for name, value in frozen.state.items()}
    means = s["means"].double() / scene.scale + from_numpy(scene.centre)
    sh = torch.cat([s["sh0"], s["shN"]], dim=1)
    write_ply(
        path, means.float().numpy(), s["quats"].numpy(), (s["log_scales"] - float(np.log(scene.scale))).numpy(),
        s["opacity_logits"].numpy(), sh.numpy(),
    )  # fmt: skip
