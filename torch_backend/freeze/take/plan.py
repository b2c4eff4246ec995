"""Plans a take before rendering: its instant, its frames, and the key of each frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...cameras.placement import Similarity, placement_for
from ...contract import (
    SUMMARY_FILE,
    ExitCode,
    FreezeParams,
    JobError,
    Reporter,
    TakeFolder,
    Verdict,
    later,
    parse_timecode,
    read_json,
    verdict_of,
)
from ...footage.color import LIGHTS
from ...footage.importing import load_frames
from ...footage.plates import Plates
from ...lens.stmap import margin
from ...motion.mattes import motion_key
from ...motion_search import find_motion
from ...scene import Scene, frame_table, load_scene
from ...shot import Shot, content_key
from ...torch_types import floats
from ...train import LoadedRun, choose_device, load_run
from ..composite.compositor import Compositor
from ..composite.grain import Grain, measure_plate
from ..composite.measured_depth import MeasuredDepths
from ..composite.surface_depth import FrameDepths
from ..frozen import CandidateInstant, OutputFrame, best_instants, rank_instants
from ..instant.instants import Instants
from .cameras import intrinsics, output_size, plan
from .footage_facts import footage_light
from .motion_blur import MotionBlur
from .passes import Passes

TAKE_VERSION = 3
"""Version of frames. Raise it when older frames must not be mixed with new ones."""
COMPOSITE_VERSION = 23
"""Version of frames composited from plates, used like `TAKE_VERSION`."""
DEEP_VERSION = 2
"""Version of deep EXRs, used like `TAKE_VERSION`."""


@dataclass
class FrameSpec:
    """Everything that all frames of a take share."""

    run: LoadedRun
    """The run that is frozen."""
    instants: Instants
    """The run's scenes at the take's instants."""
    query: str
    """As in `FreezeParams`."""
    size: tuple[int, int]
    """Width and height of the frames in pixels, without overscan."""
    beyond: tuple[int, int]
    """Pixels of overscan: (left and right, above and below)."""
    grain: Grain | None
    """Grain of the plates; None: no grain layer is written."""
    grain_size: tuple[int, int]
    """Width and height in pixels at which a frame's grain is drawn, without overscan."""
    depths: FrameDepths
    """Computes the frames' depth."""
    measured: MeasuredDepths
    """The artist's depth maps at the instants."""
    detail: Compositor | None = None
    """Composites frames from plates; None: frames are splats alone."""
    detail_key: str = ""
    """Key of the plates and mattes that the frames use, from `detail_key`."""
    light: str = LIGHTS[0]
    """Primaries of the written frames, one of `LIGHTS`: those of the footage."""
    passes: Passes | None = None
    """Computes motion vectors, normals and positions; None: they are not written."""
    blur: MotionBlur | None = None
    """The camera's motion blur; None: no motion blur."""
    deep: Similarity | None = None
    """Similarity from solve units to Blender's scene, for deep EXRs; None: no deep EXRs are written."""
    debug_terms: Path | None = None
    """Folder for the terms behind each frame's decisions; None: they are not written."""
    start: tuple[str, int, float] = ("", 0, 0.0)
    """Timecode of one of the clip's frames ("" without timecodes), that frame's number, and frames per second."""

    def timecode(self, frame: int) -> str:
        """SMPTE timecode of a frame. Empty without one, and above 40 frames per second, which EXR cannot store."""
        code, at, fps = self.start
        return later(code, frame - at, fps) if code and 1 <= round(fps) <= 40 else ""

    @property
    def has_warps(self) -> bool:
        """True if frames are also written as warps. A frame with motion blur is not a warp of one plate."""
        return self.detail is not None and self.blur is None

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
        """Key of a frame's inputs and settings, to detect outdated frames."""
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
            *([] if self.passes is None else self.passes.facts(output)),
            *([] if self.blur is None else ["blur", self.blur.facts(output)]),
            *([] if self.deep is None else ["deep", DEEP_VERSION, self.deep.matrix.flatten().tolist()]),
            *([self.light] if self.light != LIGHTS[0] else []),
            *([self.instants.keys[output.t_star]] if output.t_star in self.instants.keys else []),
        )


@dataclass(frozen=True)
class PlannedTake:
    """Plan of a take, made before rendering."""

    folder: TakeFolder
    """takes/NAME, or another folder to which its frames are rendered."""
    scene: Scene
    """The shot's cameras and frames."""
    t_star: int
    """Frame number of the frozen instant."""
    whole: list[OutputFrame]
    """All possible frames of the take."""
    spec: FrameSpec
    """Everything that the frames share."""
    keys: dict[int, str]
    """Frame number -> `FrameSpec.key`."""
    key: str
    """The take's key, from `take_key`."""

    @property
    def all_keys(self) -> str:
        """Key of all frames of the take: it changes if the key of any frame changes."""
        return content_key(sorted(self.keys.items()))


def planned(shot: Shot, params: FreezeParams, report: Reporter, t_star: int | None = None) -> PlannedTake:
    """The plan of the take that `params` describe. Missing motion mattes are written, but no file of the take.

    `t_star`: the instant, if already chosen. None: that of `params`, or the best suggestion. JobError if the take
    cannot be rendered.
    """
    run = load_run(shot, params.run, choose_device(params.device, report, "Freezing"))
    scene = load_scene(shot)
    if t_star is None:
        t_star = choose_t_star(shot, scene, run, params, report)
    width, height = output_size(shot, scene, params)
    whole = plan(scene, params, t_star, width, height)
    folder = TakeFolder(shot.own(shot.take(params.take)))
    _refuse_combined(folder)
    for inner in (folder.previews, folder.redistort.parent, folder.warps, folder.next.root):
        shot.own(inner)
    beyond = margin(shot, params, width, height, intrinsics(whole))
    grain = plate_grain(shot, scene) if params.grain else None
    # Grain has the scale of the plate's pixels, also in frames of another aspect from a camera path.
    plate = (shot.info().width, round(shot.info().width * height / width))
    if params.detail == "on" or params.develop == "on":
        find_motion(shot, report)  # for shots solved by versions whose solve did not find motion
    detail = plate_detail(shot, scene, run, params, whole, (width, height), report)
    instants = Instants(shot, run, scene, params.query, (f.t_star for f in whole), params.develop == "on")
    blur, placed = _motion_blur(whole, params, report), Similarity.of(placement_for(shot, params.placement))
    if params.deep and blur is not None:
        raise JobError(
            "A motion-blurred take has no deep EXRs: blurred pixels have no single depth.",
            "Switch off motion blur or Deep EXR.",
            ExitCode.USAGE,
        )
    spec = FrameSpec(
        run, instants, params.query, (width, height), beyond, grain, plate, FrameDepths(run, scene),
        MeasuredDepths(run, scene), detail, detail_key(shot, detail), footage_light(shot),
        Passes(whole, scene, placed) if params.passes else None, blur, placed if params.deep else None,
        Path(params.debug_terms) if params.debug_terms else None, _start(shot),
    )  # fmt: skip
    keys = {f.frame: spec.key(f) for f in whole}
    shutter = 0.0 if spec.blur is None else params.shutter
    key = take_key(run, params, t_star, width, height, beyond, sorted(instants.keys.values()), shutter)
    return PlannedTake(folder, scene, t_star, whole, spec, keys, key)


def _motion_blur(whole: list[OutputFrame], params: FreezeParams, report: Reporter) -> MotionBlur | None:
    """The motion blur of `params`; None on the clip's own path, where the plates have the blur of the real camera."""
    if params.shutter <= 0.0:
        return None
    if not params.camera_path:
        report.warning(
            "No motion blur is added on the clip's own camera path: its plates already have the camera's.",
            "Choose another camera to blur its move.",
        )
        return None
    return MotionBlur(whole, params.shutter)


def _refuse_combined(folder: TakeFolder) -> None:
    """Raises JobError if a take is combined from others, because frozen frames would overwrite it."""
    try:
        is_combined = "combined" in read_json(folder.facts)
    except (OSError, ValueError):
        return
    if is_combined:
        raise JobError(
            f"The take {folder.root.name} is combined from others.",
            "Freeze its parts again and combine them, or choose another name for this take.",
            ExitCode.FREEZE,
        )


def plate_detail(
    shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, frames: Sequence[OutputFrame],
    size: tuple[int, int], report: Reporter,
) -> Compositor | None:  # fmt: skip
    """The compositor of a take; None if `params` selects splats alone. `frames` are all frames of the take.

    The shot's motion mattes must exist. Plates are read at the pixel scale of the frame with the longest lens, by
    default at full size.
    """
    if params.detail == "off":
        return None
    plates = Plates(shot)
    focal = max(float(frame.K[0, 0]) for frame in frames)
    scale = focal / float(scene.Ks[:, 0, 0].min() * plates.width / scene.width)
    if not params.camera_path and size != (plates.width, plates.height):
        plates = Plates(shot, size)
    elif params.camera_path and scale < 0.99:
        plates = Plates(shot, (max(16, round(plates.width * scale)), max(16, round(plates.height * scale))))
    if plates.note:
        report.warning(plates.note)
    return Compositor(run, scene, plates, bars=plates.bars)


def detail_key(shot: Shot, detail: Compositor | None) -> str:
    """Key of the plates, mattes and settings of plate detail, without the run.

    Without plate detail: key of the mattes, outside of which plates still measure the frames' depth.
    """
    if detail is None or not isinstance(detail.plates, Plates):
        return motion_key(shot)
    return content_key(COMPOSITE_VERSION, detail.plates.key, motion_key(shot), dataclasses.asdict(detail.config))


def plate_grain(shot: Shot, scene: Scene) -> Grain:
    """Grain of the shot's undistorted frames."""
    files = [shot.plate(n) for n in scene.frames]
    return measure_plate([path for path in files if path.is_file()], scene.display)


def run_verdict(run: LoadedRun) -> Verdict | None:
    """The verdict on the run's last training; None if its summary has none or cannot be read."""
    try:
        return verdict_of(read_json(run.folder / SUMMARY_FILE))
    except (OSError, ValueError):
        return None


def suggested_instants(shot: Shot, scene: Scene, run: LoadedRun) -> list[tuple[int, CandidateInstant]]:
    """(frame number, scores) of the trained frames that are good instants to freeze, best first.

    Only frames of the span that the run's verdict recommends are suggested: the run fails to reproduce the others.
    """
    trained, table = run.train_frames, frame_table(shot)
    sharpness = np.array([table[f]["sharpness"] if f in table else 0.0 for f in trained])
    ranking = rank_instants(run.model, np.array([scene.time_of_frame(f) for f in trained]), sharpness)
    verdict = run_verdict(run)
    if verdict is not None and len(verdict.instants) == 2:
        first, last = verdict.instants
        # If the verdict recommends none of these frames, because it is about others, all are ranked.
        ranking = [i for i in ranking if first <= trained[i.index] <= last] or ranking
    return [(trained[i.index], i) for i in best_instants(ranking)]


def choose_t_star(shot: Shot, scene: Scene, run: LoadedRun, params: FreezeParams, report: Reporter) -> int:
    """The frame number of t*: the trained frame nearest to `params.t_star`, or the best suggestion.

    Untrained times are not used, because no frame constrains them.
    """
    trained = np.array(run.train_frames)
    if params.t_star is None:
        return suggested_instants(shot, scene, run)[0][0]
    if not scene.frames[0] <= params.t_star <= scene.frames[-1]:
        raise JobError(
            f"t* is frame {params.t_star}, the shot has frames {scene.frames[0]} to {scene.frames[-1]}.",
            "Choose a frame of the shot.",
            ExitCode.FREEZE,
        )
    nearest = int(trained[np.abs(trained - params.t_star).argmin()])
    if nearest != params.t_star:
        report.warning(
            f"Frame {params.t_star} was not trained on: time stands still at frame {nearest}, the nearest training "
            "frame."
        )
    return nearest


def _start(shot: Shot) -> tuple[str, int, float]:
    """See `FrameSpec.start`."""
    record = load_frames(shot)
    return parse_timecode(str(record.get("timecode", ""))), int(record["frames"][0]["frame"]), float(record["fps"])


def take_key(
    run: LoadedRun, params: FreezeParams, t_star: int, width: int, height: int, beyond: tuple[int, int] = (0, 0),
    developed: Sequence[str] = (), shutter: float = 0.0,
) -> str:  # fmt: skip
    """Key of a take's inputs and settings, without the frame range.

    Frames also have keys, see `FrameSpec.key`; this one is for frames of versions that did not store keys.
    `developed`: keys of the developed instants. `shutter`: angle of the motion blur in degrees, 0 without.
    """
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
        *([["shutter", shutter]] if shutter else []),
    )
