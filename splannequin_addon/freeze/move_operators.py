"""Operators for camera moves based on the clip's path. Each adds an ordinary keyed camera under the shot's root."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from mathutils import Vector

from ...torch_backend import contract
from ..access import OperatorBase, Outcome, camera_of, present, scene_in, settings_of
from ..properties import BoolProperty, FloatProperty, IntProperty
from ..scene import axes
from ..shot import inventory, scene_objects, selection
from ..solve import cameras
from ..translations import tr
from ..ui import step_operator
from . import middle_depth, moves


@dataclass(frozen=True)
class ClipPath:
    """The clip's solved camera, with a pose for every frame."""

    shot: Path
    """Shot folder."""
    first: int
    """Number of the first frame."""
    poses: np.ndarray
    """[F, 4, 4] camera-to-world, Blender's camera axes, solve units."""
    lenses: np.ndarray
    """[F, 3] focal length in mm, shift_x, shift_y."""
    solved: contract.CameraPath
    """The solve's camera path, with gaps where the clip has no frames."""

    @property
    def last(self) -> int:
        """Number of the last frame."""
        return self.first + len(self.poses) - 1

    def lenses_at(self, frames: np.ndarray) -> np.ndarray:
        """Lenses [N, 3] at fractional frame numbers [N]."""
        return moves.between(frames, self.first + np.arange(len(self.lenses), dtype=np.float64), self.lenses)


def clip_path(shot: Path) -> ClipPath:
    """The solved camera of a shot. Raises FileNotFoundError or ValueError, which name the file."""
    solved = contract.CameraPath.load(contract.ShotFolder(shot).cameras)
    if not solved.frames:
        raise contract.UserError(f"{shot} has no solved camera. Solve again.")
    numbers = np.array([f.frame for f in solved.frames], dtype=np.float64)
    poses = moves.filled(numbers, axes.poses(solved))
    lenses = moves.between(numbers[0] + np.arange(len(poses), dtype=np.float64), numbers, cameras.lenses_of(solved))
    return ClipPath(shot, int(numbers[0]), poses, lenses, solved)


def add_camera(
    scene: bpy.types.Scene, path: ClipPath, kind: str, poses: np.ndarray, lenses: np.ndarray, fit_range: bool
) -> list[str]:
    """Adds a keyed camera under the shot's root and makes the freeze use it. Returns the changes as sentences.

    Args:
        scene: the scene, with the shot's root.
        path: path of the clip.
        kind: last word of the camera's name.
        poses: [N, 4, 4], one per frame, starting at the clip's first frame.
        lenses: [N, 3].
        fit_range: set the scene's range to those frames.
    """
    root, solved = present(scene_objects.part(scene, path.shot, "root")), scene_objects.part(scene, path.shot, "camera")
    collection = present(scene_objects.of(scene, path.shot)).collection or scene.collection
    name = f"{scene_objects.name_of(path.shot)} {kind}"
    data = bpy.data.cameras.new(name)
    if solved is not None:
        like = camera_of(solved)
        data.clip_start, data.clip_end, data.display_size = like.clip_start, like.clip_end, like.display_size
    camera = bpy.data.objects.new(name, data)
    collection.objects.link(camera)
    camera.parent = root
    frames = range(path.first, path.first + len(poses))
    cameras.key_path(camera, list(frames), poses, lenses, (path.solved.width, path.solved.height))
    settings_of(scene).path_camera = scene.camera = camera
    if fit_range:
        scene.frame_start, scene.frame_end = frames[0], frames[-1]
    return [f"Freeze renders from {camera.name}, frames {frames[0]} to {frames[-1]}."]


class _Move(OperatorBase):
    """Base class of the four moves: reads the clip's path, adds a camera."""

    kind = ""
    if TYPE_CHECKING:
        fit_range: bool

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without the solve in the scene."""
        scene = scene_in(context)
        shot = selection.shot_folder(scene)
        if shot is None or scene_objects.part(scene, shot, "root") is None:
            cls.poll_message_set(tr("Load the camera of this shot first"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds the camera."""
        return step_operator.edit(self, context, "freeze", self._added)

    def _added(self, scene: bpy.types.Scene, shot: Path) -> list[str]:
        path = clip_path(shot)
        poses, lenses = self.moved(scene, path)
        return add_camera(scene, path, self.kind, poses, lenses, self.fit_range)

    def moved(self, scene: bpy.types.Scene, path: ClipPath) -> tuple[np.ndarray, np.ndarray]:
        """Poses [N, 4, 4] and lenses [N, 3] of the move."""
        raise NotImplementedError


_FIT: dict[str, Any] = {
    "name": "Set Frame Range",
    "description": "Set the scene's range to the frames of the move. Freeze renders the scene's range",
    "default": True,
}
_FRAME: dict[str, Any] = {
    "name": "Frame",
    "description": "Frame of the clip at which the camera stops. The default is the current frame",
    "options": {"SKIP_SAVE"},
}
_SMOOTH: dict[str, Any] = {
    "name": "Smooth",
    "description": "Strength with which the clip's path is stabilised first, as in Smooth Move",
    "default": 0.0,
    "min": 0.0,
    "max": 1.0,
    "subtype": "FACTOR",
}
_EASE: dict[str, Any] = {"default": 24, "min": 0, "soft_max": 250, "subtype": "TIME"}


class SPLANNEQUIN_OT_move_smooth(_Move, bpy.types.Operator):
    """Add a camera that follows the clip's path, stabilised, and freeze from it"""

    bl_idname = "splannequin.move_smooth"
    bl_label = "Smooth Move"
    bl_options = {"REGISTER", "UNDO"}
    kind = "smooth"

    position = FloatProperty(
        name="Position",
        description="Strength with which the camera's position is stabilised. 1 removes sway with a period of "
        "up to the clip's length, 0.5 of up to half of it",
        default=0.25,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    rotation = FloatProperty(
        name="Rotation",
        description="0 to 1, as for Position: 1 removes sway with a period up to the clip's length",
        default=0.25,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    fit_range = BoolProperty(**_FIT)

    def moved(self, scene: bpy.types.Scene, path: ClipPath) -> tuple[np.ndarray, np.ndarray]:
        """The smoothed path, with one pose per frame of the clip."""
        return moves.smoothed(path.poses, self.position, self.rotation), path.lenses


class _Stops(_Move):
    """Base class of the three moves with a stop."""

    if TYPE_CHECKING:
        frame: int
        smooth: float

    def stopped(
        self, scene: bpy.types.Scene, path: ClipPath, ease_in: float, hold: float, ease_out: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses [N, 4, 4] and lenses [N, 3] of the path with a stop at `frame`, and `Timing.stop_fraction`."""
        if not self.properties.is_property_set("frame"):
            self.frame = scene.frame_current
        self.frame = min(max(self.frame, path.first), path.last)
        timing = moves.retimed(path.first, path.last, self.frame, ease_in, hold, ease_out)
        poses = moves.at(moves.smoothed(path.poses, self.smooth, self.smooth), timing.frames - path.first)
        return poses, path.lenses_at(timing.frames), timing.stop_fraction


class SPLANNEQUIN_OT_move_retime(_Stops, bpy.types.Operator):
    """Add a camera that follows the clip's path, eases into a stop and out of it, and freeze from it"""

    bl_idname = "splannequin.move_retime"
    bl_label = "Retime Move"
    bl_options = {"REGISTER", "UNDO"}
    kind = "retime"

    frame = IntProperty(**_FRAME)
    ease_in = IntProperty(name="In", description="Frames in which the camera slows down", **_EASE)
    hold = IntProperty(
        name="Hold", description="Frames for which the camera stands still", default=24, min=0, subtype="TIME"
    )
    ease_out = IntProperty(name="Out", description="Frames in which the camera speeds up again", **_EASE)
    smooth = FloatProperty(**_SMOOTH)
    fit_range = BoolProperty(**_FIT)

    def moved(self, scene: bpy.types.Scene, path: ClipPath) -> tuple[np.ndarray, np.ndarray]:
        """Poses and lenses of the path with the stop."""
        return self.stopped(scene, path, self.ease_in, self.hold, self.ease_out)[:2]


_SECONDS: dict[str, Any] = {
    "name": "Seconds",
    "description": "How long the camera leaves the clip's path, in seconds at the scene's frame rate",
    "default": 2.0,
    "min": 0.0,
    "soft_max": 20.0,
}
_EASE_BOTH: dict[str, Any] = {
    "name": "Ease",
    "description": "Frames in which the camera slows down, and in which it speeds up again",
    **_EASE,
}


def _frames(scene: bpy.types.Scene, seconds: float) -> int:
    """Number of whole frames in a duration at the scene's frame rate."""
    return round(seconds * scene.render.fps / scene.render.fps_base)


class SPLANNEQUIN_OT_move_hold(_Stops, bpy.types.Operator):
    """Add a camera that follows the clip's path and holds at a frame for some seconds, and freeze from it"""

    bl_idname = "splannequin.move_hold"
    bl_label = "Hold Move"
    bl_options = {"REGISTER", "UNDO"}
    kind = "hold"

    frame = IntProperty(**_FRAME)
    seconds = FloatProperty(**_SECONDS)
    ease = IntProperty(**_EASE_BOTH)
    smooth = FloatProperty(**_SMOOTH)
    fit_range = BoolProperty(**_FIT)

    def moved(self, scene: bpy.types.Scene, path: ClipPath) -> tuple[np.ndarray, np.ndarray]:
        """Poses and lenses of the path with the stop."""
        return self.stopped(scene, path, self.ease, _frames(scene, self.seconds), self.ease)[:2]


class SPLANNEQUIN_OT_move_orbit(_Stops, bpy.types.Operator):
    """Add a camera that follows the clip's path, orbits the subject in the middle of the image at one frame and
    returns, and freeze from it"""

    bl_idname = "splannequin.move_orbit"
    bl_label = "Orbit Move"
    bl_options = {"REGISTER", "UNDO"}
    kind = "orbit"

    frame = IntProperty(**_FRAME)
    seconds = FloatProperty(**_SECONDS)
    angle = FloatProperty(
        name="Angle",
        description="Angle of the orbit around the scene's vertical axis, to the right; negative: to the left",
        default=math.radians(15.0),
        soft_min=-math.pi,
        soft_max=math.pi,
        subtype="ANGLE",
    )
    rise = FloatProperty(
        name="Rise",
        description="Angle of the orbit upwards; negative: downwards",
        default=0.0,
        min=-math.pi / 2,
        max=math.pi / 2,
        subtype="ANGLE",
    )
    distance = FloatProperty(
        name="Distance",
        description="Depth of the orbit's centre, in scene units. 0: depth of the take in the middle of the image, or "
        "the median depth of the solve's points without a take",
        default=0.0,
        min=0.0,
        subtype="DISTANCE",
        options={"SKIP_SAVE"},
    )
    ease = IntProperty(**_EASE_BOTH)
    smooth = FloatProperty(**_SMOOTH)
    fit_range = BoolProperty(**_FIT)

    def moved(self, scene: bpy.types.Scene, path: ClipPath) -> tuple[np.ndarray, np.ndarray]:
        """Poses and lenses of the path with the orbit during the stop."""
        poses, lenses, stop_fraction = self.stopped(scene, path, self.ease, _frames(scene, self.seconds), self.ease)
        pose = moves.at(moves.smoothed(path.poses, self.smooth, self.smooth), np.array([self.frame - path.first]))[0]
        root = present(scene_objects.part(scene, path.shot, "root"))
        scale = scene_objects.depth_scale(scene, path.shot)
        depth = self.distance / scale if self.distance else found_depth(scene, path, self.frame, pose)
        up = np.array((root.matrix_world.inverted().to_3x3() @ Vector((0.0, 0.0, 1.0))).normalized(), dtype=np.float64)
        pivot = moves.in_the_middle(pose, _lens(path, self.frame), (path.solved.width, path.solved.height), depth)
        # A positive rotation about the camera's right axis moves the camera down, because the camera looks along -z.
        return moves.orbit(poses, stop_fraction, pivot, up, (self.angle, -self.rise)), lenses


def found_depth(scene: bpy.types.Scene, path: ClipPath, frame: int, pose: np.ndarray) -> float:
    """Depth in the middle of the clip's image, solve units: from the selected take's Z, else from the solve's points.

    Args:
        scene: the scene with the selected take.
        path: path of the clip.
        frame: frame number.
        pose: the camera's pose at the frame, [4, 4].

    Raises:
        contract.JobError: neither source has a depth.
    """
    take = settings_of(scene).take_name
    facts = inventory.read(path.shot).takes.get(take)
    if facts is not None and not facts["camera_path"]:
        shown = contract.TakeFolder(contract.ShotFolder(path.shot).take(take)).frame(frame)
        depth = middle_depth.of_frame(shown)
        if depth:
            return depth
    xyz = cameras.points_of(path.shot)[0].astype(np.float64)
    size = path.solved.width, path.solved.height
    depth = moves.depth_of_points(pose, _lens(path, frame), size, xyz)
    if not depth:
        raise contract.JobError(
            f"The depth in the middle of frame {frame} is unknown.",
            "Set Distance, or freeze first.",
            contract.ExitCode.USAGE,
        )
    return depth


def _lens(path: ClipPath, frame: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the solved frame nearest to a frame."""
    K = min(path.solved.frames, key=lambda solved: abs(solved.frame - frame)).K
    return K[0], K[1], K[2], K[3]


CLASSES = (
    SPLANNEQUIN_OT_move_smooth,
    SPLANNEQUIN_OT_move_retime,
    SPLANNEQUIN_OT_move_hold,
    SPLANNEQUIN_OT_move_orbit,
)
