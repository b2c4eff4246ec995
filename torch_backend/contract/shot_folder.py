"""The shot folder: paths of all files of a shot. The rest of the project uses this module, not the file names.

shot.json                        facts of the shot
lock.json                        the process that writes into the shot
frames/NNNNNN.png                undistorted plates
frames/frames.json, frames/raw/  listing of the imported frames, and these frames
solve/                           cameras.json, solve.json, points.npz, colmap/, colmap.log, ST maps of the lens
solve/motion/                    detected motion mattes, points of still surfaces; motion_paint/: painted mattes
solve/ignore/, solve/people/     masks for the solve, undistorted; masks/: the same as drawn in Blender
runs/NAME/                       a run: `RunFolder`
takes/NAME/                      frozen frames: `TakeFolder`
jobs/ID/                         requests, status and results of jobs: `jobs`
placement.json                   transform of the solve into Blender's scene
paths/, tracking/                cameras that Blender sent
farm/                            time and memory that render farm tasks took
trash/                           removed files that are being deleted
replaced/NNN/                    work that an import of other frames replaced, as a complete shot folder
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from .errors import ExitCode, JobError
from .files import checked_name, frame_file, is_link

SHOT_SUFFIX = ".splannequin"
"""Suffix of a shot folder's name."""
INFO_FILE, WRITER_FILE = "shot.json", "lock.json"
PLACEMENT_FILE = "placement.json"
"""Transform of the solve into Blender's scene, a `Placement`."""
FRAMES_FOLDER, SOLVE_FOLDER, RUNS_FOLDER, TAKES_FOLDER, JOBS_FOLDER = "frames", "solve", "runs", "takes", "jobs"
FRAMES_FILE, RAW_FOLDER, BURNT_IN_FILE = "frames.json", "raw", "burnt_in.png"
UNPUBLISHED_FILE = "unpublished.json"
"""File in the frames folder: facts of these frames that shot.json does not have yet."""
CAMERAS_FILE, SOLVE_FILE, POINTS_FILE = "cameras.json", "solve.json", "points.npz"
COLMAP_FOLDER, COLMAP_LOG = "colmap", "colmap.log"
STMAP_FILES = ("stmap_undistort.exr", "stmap_redistort.exr")
"""ST maps of the solve: from the distorted frames to the undistorted ones, and back."""
MOTION_FOLDER, MOTION_FILE, MOTION_UNFINISHED_FILE = "motion", "motion.json", "unfinished.json"
PAINTED_FOLDER = "motion_paint"
MASK_KINDS = ("ignore", "people")
"""Kinds of masks for a solve: regions that are not part of the scene, and the only regions that may move."""
DRAWN_FOLDER = "masks"
CHECKPOINT_FILE, EXTENSION_FILE = "checkpoint.safetensors", "extension.safetensors"
"""Checkpoints of a run: the run itself, and unfinished steps that are being added to it."""
CONFIG_FILE, METRICS_FILE, SUMMARY_FILE = "config.json", "metrics.jsonl", "summary.json"
DEPTH_FILE = "depth.safetensors"
"""File in a run's folder: the artist's depth sequence, fitted to the solve."""
PREVIEWS_FOLDER, NEXT_FOLDER, DEVELOPED_FOLDER = "previews", "next", "developed"
"""Folders in a run's folder: pictures of the training, trainings that will replace the run, developed instants."""
TAKE_FILE, TAKE_STATE_FILE = "take.json", "state.json"
TAKE_PREVIEW_FOLDER, WARP_FOLDER, DEEP_FOLDER, TAKE_NEXT_FOLDER = "preview", "warp", "deep", ".next"
CONTACT_SHEET_FILE, VIDEO_FILE, PLY_FILE = "contact_sheet.png", "video.mp4", "frozen.ply"
USD_FILE, SURFACE_FILE = "frozen.usdc", "surface.ply"
"""Files of a take: the splats with the animated camera; the frozen scene as a mesh."""
LIGHT_FOLDER = "panorama"
"""Folder in a take's folder: panoramas of its light by their keys, and the facts of each."""
TAKE_REDISTORT = Path("stmap") / "redistort.exr"
"""ST map of a take with overscan that puts the lens distortion back."""
TAKE_UNDISTORT = Path("stmap") / "undistort.exr"
"""ST map of a take from the original footage to the undistorted plate, at the size of the footage."""
MATTES_FOLDER, MATTES_FILE, DRAWN_FILE = "mattes", "mattes.json", "drawn.json"
"""In a take's folder: mattes of lassoed things, their lassos, and the lassos that Blender sent last."""
CRYPTOMATTE_FOLDER, MATTE_FOLDER = "cryptomatte", "single"
"""In a take's folder of mattes: one sequence with all mattes, and a sequence for each matte."""
LIVE_LOG = "live.log"
FARM_FOLDER, TRASH_FOLDER, TRACKING_FOLDER, PATHS_FOLDER = "farm", "trash", "tracking", "paths"
REPLACED_FOLDER = "replaced"
SHOT_NAMES = frozenset({
    INFO_FILE, WRITER_FILE, FRAMES_FOLDER, SOLVE_FOLDER, RUNS_FOLDER, TAKES_FOLDER, JOBS_FOLDER, PAINTED_FOLDER,
    DRAWN_FOLDER, FARM_FOLDER, TRASH_FOLDER, TRACKING_FOLDER, PATHS_FOLDER, REPLACED_FOLDER, PLACEMENT_FILE,
})  # fmt: skip
"""Names of all files and folders in a shot folder."""
PICTURE, LAYERS, SURFACE = ".png", ".exr", ".npz"
"""Suffixes of plates, mattes and previews; of frozen frames; of points of still surfaces."""


class ShotFolder:
    """Paths in a shot folder. Holds no state; the paths need not exist."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).absolute()

    @property
    def info_path(self) -> Path:
        return self.root / INFO_FILE

    @property
    def frames(self) -> Path:
        return self.root / FRAMES_FOLDER

    @property
    def listing(self) -> Path:
        """Listing of the imported frames."""
        return self.frames / FRAMES_FILE

    @property
    def raw(self) -> Path:
        """Frames as imported, with the lens's distortion."""
        return self.frames / RAW_FOLDER

    @property
    def burnt_in(self) -> Path:
        """Mask of what is burnt into the clip, such as a logo; exists if the import found something."""
        return self.frames / BURNT_IN_FILE

    def plate(self, frame: int) -> Path:
        """The undistorted plate of a frame."""
        return self.frames / frame_file(frame, PICTURE)

    @property
    def solve(self) -> Path:
        return self.root / SOLVE_FOLDER

    @property
    def cameras(self) -> Path:
        """A `CameraPath` of all frames. If this file exists, the shot is solved."""
        return self.solve / CAMERAS_FILE

    @property
    def solve_record(self) -> Path:
        """Figures of the solve."""
        return self.solve / SOLVE_FILE

    @property
    def points(self) -> Path:
        return self.solve / POINTS_FILE

    @property
    def colmap(self) -> Path:
        """The solver's model."""
        return self.solve / COLMAP_FOLDER

    @property
    def colmap_log(self) -> Path:
        return self.solve / COLMAP_LOG

    @property
    def motion(self) -> Path:
        """Detected motion mattes."""
        return self.solve / MOTION_FOLDER

    def matte(self, frame: int) -> Path:
        """Detected motion matte of a frame."""
        return self.motion / frame_file(frame, PICTURE)

    def surface(self, frame: int) -> Path:
        """Points of the still surfaces of a key frame, found with its matte."""
        return self.motion / frame_file(frame, SURFACE)

    @property
    def painted(self) -> Path:
        """Painted motion mattes."""
        return self.root / PAINTED_FOLDER

    def painted_matte(self, frame: int) -> Path:
        """Painted motion matte of a frame."""
        return self.painted / frame_file(frame, PICTURE)

    def masks(self, kind: str) -> Path:
        """Masks of one of `MASK_KINDS`, undistorted as the plates are."""
        return self.solve / kind

    def mask(self, kind: str, frame: int) -> Path:
        """The mask of a frame."""
        return self.masks(kind) / frame_file(frame, PICTURE)

    def drawn_masks(self, kind: str) -> Path:
        """Masks of one of `MASK_KINDS` as drawn in Blender, over the original footage."""
        return self.root / DRAWN_FOLDER / kind

    @property
    def runs(self) -> Path:
        return self.root / RUNS_FOLDER

    @property
    def takes(self) -> Path:
        return self.root / TAKES_FOLDER

    @property
    def jobs(self) -> Path:
        return self.root / JOBS_FOLDER

    @property
    def live_log(self) -> Path:
        """Log of the last live session."""
        return self.jobs / LIVE_LOG

    @property
    def placement(self) -> Path:
        """Transform of the solve into Blender's scene, as Blender wrote it last."""
        return self.root / PLACEMENT_FILE

    @property
    def lock(self) -> Path:
        return self.root / WRITER_FILE

    @property
    def farm(self) -> Path:
        """Records of render farm tasks."""
        return self.root / FARM_FOLDER

    @property
    def trash(self) -> Path:
        """Removed files, until they are deleted."""
        return self.root / TRASH_FOLDER

    @property
    def replaced(self) -> Path:
        """Contains a shot folder for each import that replaced frames on which work had been done."""
        return self.root / REPLACED_FOLDER

    @property
    def tracking(self) -> Path:
        """Cameras of Blender's own tracking, as a transforms.json."""
        return self.root / TRACKING_FOLDER / "transforms.json"

    def camera_path(self, take: str) -> Path:
        """Camera that Blender sent for a take."""
        return self.root / PATHS_FOLDER / f"{take}.json"

    def run(self, name: str) -> Path:
        """Folder of a run; ValueError if the name could leave it."""
        return self.runs / checked_name(name, "run")

    def take(self, name: str) -> Path:
        """Folder of a take; ValueError if the name could leave it."""
        return self.takes / checked_name(name, "take")

    def own(self, folder: Path) -> Path:
        """`folder` of this shot, checked before files in it are written or removed.

        JobError if `folder` is not a folder. JobError if it, or one of its parents in the shot, is a link.
        """
        path = self.root
        for part in folder.relative_to(self.root).parts:
            path = path / part
            # A shot may come from anywhere: a link in it must not lead writes to other files.
            if is_link(path):
                raise JobError(
                    f"{path} is a link to {os.path.realpath(path)}. This shot must not change files there.",
                    "Remove the link, or put a folder of that name in its place, then start again.",
                    ExitCode.USAGE,
                )
            if os.path.lexists(path) and not path.is_dir():
                raise JobError(
                    f"{path} is not a folder.", "Move it somewhere else: the shot needs a folder there.", ExitCode.USAGE
                )
        return folder


@dataclass(frozen=True)
class RunFolder:
    """Paths in the folder of a run, or of a training that will replace it."""

    root: Path
    """runs/NAME, or runs/NAME/next/KEY."""

    @property
    def checkpoint(self) -> Path:
        return self.root / CHECKPOINT_FILE

    @property
    def extension(self) -> Path:
        """Checkpoint of unfinished steps that are being added to the run."""
        return self.root / EXTENSION_FILE

    @property
    def config(self) -> Path:
        return self.root / CONFIG_FILE

    @property
    def depth(self) -> Path:
        """The artist's depth sequence, fitted to the solve; exists if the run was trained with one."""
        return self.root / DEPTH_FILE

    @property
    def metrics(self) -> Path:
        """Measurements, one per line."""
        return self.root / METRICS_FILE

    @property
    def summary(self) -> Path:
        """Figures of the run. Written last, so the run is finished if this file exists."""
        return self.root / SUMMARY_FILE

    @property
    def previews(self) -> Path:
        return self.root / PREVIEWS_FOLDER

    @property
    def next(self) -> Path:
        """Trainings that will replace the run when they are finished, by key."""
        return self.root / NEXT_FOLDER

    @property
    def developed(self) -> Path:
        """Developed instants, by frame."""
        return self.root / DEVELOPED_FOLDER


@dataclass(frozen=True)
class TakeFolder:
    """Paths in the folder of a take."""

    root: Path
    """takes/NAME, or its folder `next`."""

    @property
    def next(self) -> TakeFolder:
        """Frames that will replace the previous ones when all of them are finished."""
        return TakeFolder(self.root / TAKE_NEXT_FOLDER)

    @property
    def facts(self) -> Path:
        """Facts of the take. Written last, so the take is finished if this file exists."""
        return self.root / TAKE_FILE

    @property
    def state(self) -> Path:
        """Key of the inputs from which the take is being made."""
        return self.root / TAKE_STATE_FILE

    def frame(self, number: int) -> Path:
        """A frozen frame with its layers."""
        return self.root / frame_file(number, LAYERS)

    @property
    def previews(self) -> Path:
        return self.root / TAKE_PREVIEW_FOLDER

    def preview(self, number: int) -> Path:
        """A frozen frame as displayed, a PNG."""
        return self.previews / frame_file(number, PICTURE)

    @property
    def warps(self) -> Path:
        return self.root / WARP_FOLDER

    def warp(self, number: int) -> Path:
        """Warp from the plate of a frame to its frozen frame."""
        return self.warps / frame_file(number, LAYERS)

    @property
    def deeps(self) -> Path:
        return self.root / DEEP_FOLDER

    def deep(self, number: int) -> Path:
        """A frozen frame as a deep picture."""
        return self.deeps / frame_file(number, LAYERS)

    @property
    def mattes(self) -> Path:
        """Mattes of lassoed things."""
        return self.root / MATTES_FOLDER

    @property
    def mattes_record(self) -> Path:
        """Names and lassos of the mattes, and whether all of their files are written."""
        return self.mattes / MATTES_FILE

    @property
    def drawn_lassos(self) -> Path:
        """Lassos that were drawn in Blender, as the last job received them."""
        return self.mattes / DRAWN_FILE

    @property
    def cryptomattes(self) -> Path:
        """All mattes of each frame, as a Cryptomatte."""
        return self.mattes / CRYPTOMATTE_FOLDER

    def cryptomatte(self, number: int) -> Path:
        """All mattes of a frame."""
        return self.cryptomattes / frame_file(number, LAYERS)

    @property
    def single_mattes(self) -> Path:
        """A folder for each matte."""
        return self.mattes / MATTE_FOLDER

    def matte_frames(self, name: str) -> Path:
        """Frames of one matte; ValueError if its name could leave the folder."""
        return self.single_mattes / checked_name(name, "matte")

    @property
    def contact_sheet(self) -> Path:
        return self.root / CONTACT_SHEET_FILE

    @property
    def video(self) -> Path:
        return self.root / VIDEO_FILE

    @property
    def ply(self) -> Path:
        """The frozen Gaussians, for other programs."""
        return self.root / PLY_FILE

    @property
    def usd(self) -> Path:
        """The frozen Gaussians and the camera, as one USD stage."""
        return self.root / USD_FILE

    @property
    def surface(self) -> Path:
        """The frozen scene as a mesh."""
        return self.root / SURFACE_FILE

    def light(self, key: str) -> Path:
        """A panorama of the frozen scene's light; ValueError if its key could leave the folder."""
        return self.root / LIGHT_FOLDER / f"{checked_name(key, 'light')}{LAYERS}"

    def light_facts(self, key: str) -> Path:
        """Facts of a panorama; ValueError as `light`."""
        return self.root / LIGHT_FOLDER / f"{checked_name(key, 'light')}.json"

    @property
    def redistort(self) -> Path:
        """ST map that puts the lens distortion back, for a take with overscan."""
        return self.root / TAKE_REDISTORT
