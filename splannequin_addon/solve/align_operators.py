"""Aligns a shot in the scene (floor, origin, scale) by points that are clicked in a 3D view.

A click selects the sparse point of the solve whose projection is nearest. All other events are passed on, so that the
view can be rotated in between. Instead of clicks, the operators also accept the locations of selected objects, for
places without points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader  # pyright: ignore[reportUnknownVariableType]

from ...torch_backend import contract
from ..access import OperatorBase, Outcome, mesh_of, present, scene_in
from ..process import job_timer
from ..properties import BoolProperty, FloatProperty, FloatVectorProperty
from ..scene import axes
from ..shot import scene_objects, selection
from ..translations import tr
from . import alignment, cameras, points, scale

REACH_PIXELS = 18.0
"""Maximum distance in pixels between the mouse and a point's projection, at a user interface scale of 1."""


@dataclass
class Picking:
    """State of the selection of a shot's points in a window."""

    shot: Path
    """Shot folder."""
    xyz: np.ndarray
    """All points of the shot, [P, 3] float32, solve units."""
    wanted: int
    """Number of points that the operator needs."""
    picked: list[int] = field(default_factory=list[int])
    """Clicked points as indices into `xyz`."""
    under: int = -1
    """Index of the point under the mouse, or -1."""
    handler: Any = None
    """Draw handler of the points."""


_picking: Picking | None = None


def picking() -> Picking | None:
    """The point selection in progress, or None."""
    return _picking


def _shot_of(scene: bpy.types.Scene) -> Path:
    """The scene's shot, which `poll` has checked."""
    shot = selection.shot_folder(scene)
    assert shot is not None
    return shot


def _centres(scene: bpy.types.Scene, shot: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera positions and upward directions of the shot, [F, 3] each, world."""
    poses = axes.poses(contract.CameraPath.load(contract.ShotFolder(shot).cameras))
    poses = np.array(present(cameras.find(scene, shot, "EMPTY")).matrix_world, dtype=np.float64) @ poses
    return poses[:, :3, 3], poses[:, :3, 1]


class _Aligns(OperatorBase):
    """Base class of the three operators: takes clicks or selected objects, then changes the root."""

    count = 0
    prompt = ""
    if TYPE_CHECKING:
        places: list[float]
        selected: bool

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without the solve in the scene."""
        shot = selection.shot_folder(scene_in(context))
        if shot is None or cameras.find(scene_in(context), shot, "EMPTY") is None:
            cls.poll_message_set(tr("Load the camera of this shot first"))
            return False
        return True

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Tooltip of the button for selected objects."""
        return tr("Use the locations of selected objects, such as empties") if properties.selected else ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Starts the clicking, unless `places` is set or selected objects are used."""
        if self.selected or self.properties.is_property_set("places"):
            return self.ready(context)
        return self._begin(context)

    def ready(self, context: bpy.types.Context) -> Outcome:
        """Continues once the points are known."""
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Applies the change to the root."""
        scene, shot = scene_in(context), _shot_of(scene_in(context))
        context.view_layer.update()
        try:
            notes = scale.move(scene, shot, self.change(scene, shot, self._places(context, shot)))
        except (contract.JobError, OSError, ValueError) as error:
            message = f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()
            self.report({"ERROR"}, tr(message))
            return {"CANCELLED"}
        job_timer.watch_of(shot).notes["solve"] = notes
        for note in notes:
            self.report({"INFO"}, tr(note))
        return {"FINISHED"}

    def change(self, scene: bpy.types.Scene, shot: Path, places: np.ndarray) -> np.ndarray:
        """The change [4, 4] for the points [count, 3], world."""
        raise NotImplementedError

    def _places(self, context: bpy.types.Context, shot: Path) -> np.ndarray:
        """The clicked points, or else the locations of the selected objects, [count, 3], world."""
        if self.properties.is_property_set("places"):
            return np.array(self.places, dtype=np.float64).reshape(self.count, 3)
        ours = [cameras.find(scene_in(context), shot, kind) for kind in ("EMPTY", "CAMERA", "MESH")]
        picked = [o for o in present(context.selected_objects) if o not in ours]
        if len(picked) != self.count:
            raise contract.JobError(
                f"{len(picked)} objects are selected, {self.count} are needed.",
                "Place empties where the points should be and select them.",
                contract.ExitCode.USAGE,
            )
        return np.array([o.matrix_world.translation for o in picked], dtype=np.float64)

    def _begin(self, context: bpy.types.Context) -> Outcome:
        global _picking
        scene, shot = scene_in(context), _shot_of(scene_in(context))
        cloud = cameras.find(scene, shot, "MESH")
        xyz = points.coloured(mesh_of(cloud))[0] if cloud is not None else np.zeros((0, 3), np.float32)
        if bpy.app.background or not len(xyz):
            message = "There are no points to click. Select objects at the positions of the points"
            self.report({"ERROR"}, message)
            return {"CANCELLED"}
        stop()
        _picking = self._active = Picking(shot, xyz, self.count)
        _picking.handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")
        context.window_manager.modal_handler_add(self)
        self._tell(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Handles events: a click selects a point, Backspace removes the last one, Esc or the right button cancels."""
        picked = _picking
        root = cameras.find(scene_in(context), self._active.shot, "EMPTY")
        if picked is None or picked is not self._active or root is None:  # superseded, or the shot was removed
            if picked is self._active:
                self.cancel(context)
            return {"CANCELLED"}
        pressed = event.value in {"PRESS", "DOUBLE_CLICK"}
        if event.type in {"ESC", "RIGHTMOUSE"} and pressed:
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "BACK_SPACE" and pressed:
            if picked.picked:
                picked.picked.pop()
            self._tell(context)
            return {"RUNNING_MODAL"}
        if event.type not in {"MOUSEMOVE", "LEFTMOUSE"} or (event.type == "LEFTMOUSE" and (not pressed or event.alt)):
            return {"PASS_THROUGH"}
        view = view_under(context.window, event.mouse_x, event.mouse_y)
        under = -1
        if view is not None:
            region, data = view
            at = (event.mouse_x - region.x, event.mouse_y - region.y)
            reach = REACH_PIXELS * context.preferences.system.ui_scale
            matrix = np.array(data.perspective_matrix @ root.matrix_world, dtype=np.float64)
            under = alignment.nearest(at, picked.xyz, matrix, (region.width, region.height), reach)
        if under != picked.under:
            picked.under = under
            _redraw(context.window)
        if event.type == "MOUSEMOVE" or view is None:
            return {"PASS_THROUGH"}
        if under < 0:
            self.report({"INFO"}, "There is no point of the solve at this position")
            return {"RUNNING_MODAL"}
        if under not in picked.picked:
            picked.picked.append(under)
        if len(picked.picked) < picked.wanted:
            self._tell(context)
            return {"RUNNING_MODAL"}
        matrix = np.array(root.matrix_world, dtype=np.float64)
        places = picked.xyz[picked.picked].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        self.cancel(context)
        self.places = places.ravel().tolist()
        return self.picked(context)

    def picked(self, context: bpy.types.Context) -> Outcome:
        """Continues after the last click."""
        return self.execute(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Ends the clicking. Blender also calls this when another file is opened."""
        if _picking is self._active:
            stop()
        if context.workspace is not None:
            context.workspace.status_text_set(None)

    def _tell(self, context: bpy.types.Context) -> None:
        """Shows instructions in the status bar."""
        if _picking is None:
            return
        done = f"{len(_picking.picked)} of {_picking.wanted}"
        text = tr(f"{self.prompt}: {done}.  Backspace: remove the last point.  Esc: cancel")
        context.workspace.status_text_set(text)
        _redraw(context.window)


_SELECTED = BoolProperty(
    name="Selected Objects",
    description="Use the locations of the selected objects instead of clicked points",
    default=False,
    options={"SKIP_SAVE", "HIDDEN"},
)


def _places_property(count: int) -> list[float]:
    return FloatVectorProperty(
        name="Points",
        description="Coordinates of the points in the scene, one after the other",
        size=3 * count,
        options={"SKIP_SAVE", "HIDDEN"},
    )


class SPLANNEQUIN_OT_align_floor(_Aligns, bpy.types.Operator):
    """Click three points on the floor. The solve is rotated and moved so that they lie at height 0, with the camera
    above"""

    bl_idname = "splannequin.align_floor"
    bl_label = "Floor from Three Points"
    bl_options = {"REGISTER", "UNDO"}
    count = 3
    prompt = "Click three points on the floor"

    places = _places_property(3)
    selected = _SELECTED

    def change(self, scene: bpy.types.Scene, shot: Path, places: np.ndarray) -> np.ndarray:
        """The change that moves the points into z = 0."""
        return alignment.level(places, *_centres(scene, shot))


class SPLANNEQUIN_OT_align_origin(_Aligns, bpy.types.Operator):
    """Click a point. The solve is moved so that the point lies at the scene's origin"""

    bl_idname = "splannequin.align_origin"
    bl_label = "Set Origin"
    bl_options = {"REGISTER", "UNDO"}
    count = 1
    prompt = "Click the point for the origin"

    places = _places_property(1)
    selected = _SELECTED

    def change(self, scene: bpy.types.Scene, shot: Path, places: np.ndarray) -> np.ndarray:
        """The change that moves the point to the origin."""
        return alignment.to_origin(places[0])


class SPLANNEQUIN_OT_align_scale(_Aligns, bpy.types.Operator):
    """Click two points and enter their distance. The solve is scaled about the scene's origin to match it"""

    bl_idname = "splannequin.align_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}
    count = 2
    prompt = "Click two points with a known distance"

    places = _places_property(2)
    selected = _SELECTED
    distance = FloatProperty(
        name="Distance",
        description="Distance between the two points",
        default=1.0,
        min=1e-6,
        soft_max=1000.0,
        subtype="DISTANCE",
        unit="LENGTH",
        options={"SKIP_SAVE"},
    )

    def change(self, scene: bpy.types.Scene, shot: Path, places: np.ndarray) -> np.ndarray:
        """The change that scales all axes by the same factor."""
        return alignment.scaled(places, self.distance)

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Applies the change to the root and marks the shot's scale as known."""
        outcome = super().execute(context)
        entry = scene_objects.of(scene_in(context), _shot_of(scene_in(context)))
        if outcome == {"FINISHED"} and entry is not None:
            entry.scaled = True
        return outcome

    def picked(self, context: bpy.types.Context) -> Outcome:
        """Asks for the distance in a new operator call, because this call still handles mouse events."""
        ops: Any = bpy.ops  # our operators are not in the stubs
        ops.splannequin.align_scale("INVOKE_DEFAULT", places=list(self.places))
        return {"CANCELLED"}

    def ready(self, context: bpy.types.Context) -> Outcome:
        """Asks for the distance, starting with the current one."""
        try:
            first, second = self._places(context, _shot_of(scene_in(context)))
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}"))
            return {"CANCELLED"}
        self.places = np.concatenate([first, second]).tolist()
        self.distance = float(np.linalg.norm(second - first))
        return context.window_manager.invoke_props_dialog(self)


def view_under(window: bpy.types.Window, x: int, y: int) -> tuple[Any, Any] | None:
    """(region, RegionView3D) of the 3D view at a window position in pixels; None outside or over its sidebar."""
    for area in window.screen.areas:
        if area.type != "VIEW_3D":
            continue
        over = [r for r in area.regions if 0 <= x - r.x < r.width and 0 <= y - r.y < r.height and r.width > 1]
        if any(r.type != "WINDOW" for r in over):
            return None
        for region in over:
            return region, region.data
    return None


def stop() -> None:
    """Ends the clicking and its drawing."""
    global _picking
    if _picking is not None and _picking.handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_picking.handler, "WINDOW")
    _picking = None


def _redraw(window: bpy.types.Window) -> None:
    for area in window.screen.areas:
        if area.type == "VIEW_3D":
            area.tag_redraw()


def _draw() -> None:
    """Draw handler: draws the clicked points with their numbers, and the point under the mouse, in a region."""
    context = bpy.context
    root = cameras.find(scene_in(context), _picking.shot, "EMPTY") if _picking is not None else None
    if _picking is None or root is None or context.region_data is None:
        return
    scale = context.preferences.system.ui_scale
    matrix = np.array(context.region_data.perspective_matrix @ root.matrix_world, dtype=np.float64)
    size = (context.region.width, context.region.height)
    gpu.state.blend_set("ALPHA")
    for numbers, colour in (([_picking.under], (1.0, 1.0, 1.0, 1.0)), (_picking.picked, (1.0, 0.6, 0.1, 1.0))):
        at, before = alignment.seen(_picking.xyz[[i for i in numbers if i >= 0]], matrix, size)
        for number, (x, y) in enumerate(at[before], start=1):
            _dot((float(x), float(y)), 6.0 * scale, (0.0, 0.0, 0.0, 0.8))
            _dot((float(x), float(y)), 4.5 * scale, colour)
            if numbers is _picking.picked:
                blf.size(0, 14.0 * scale)
                blf.color(0, *colour)
                blf.position(0, float(x) + 9.0 * scale, float(y) + 5.0 * scale, 0.0)
                blf.draw(0, str(number))
    gpu.state.blend_set("NONE")


def _dot(at: tuple[float, float], radius: float, colour: tuple[float, float, float, float]) -> None:
    """Draws a disc as triangles, because not every system draws large points in the same way."""
    turns = np.linspace(0.0, 2.0 * np.pi, 17)
    rim = np.stack([np.cos(turns), np.sin(turns)], axis=1) * radius + at
    corners = np.concatenate([np.insert(rim[i : i + 2], 0, at, axis=0) for i in range(16)])
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "TRIS", {"pos": corners.astype(np.float32)})  # pyright: ignore[reportArgumentType]
    shader.uniform_float("color", colour)
    batch.draw(shader)


def draw(layout: bpy.types.UILayout) -> None:
    """Draws the three buttons, each with a second button for selected objects."""
    column = layout.column(align=True)
    for operator in ("align_floor", "align_origin", "align_scale"):
        row = column.row(align=True)
        row.operator(f"splannequin.{operator}")
        row.operator(f"splannequin.{operator}", text="", icon="RESTRICT_SELECT_OFF").selected = True


def register() -> None:
    """Does nothing: there is no clicking yet."""


def unregister() -> None:
    """Ends the clicking."""
    stop()


CLASSES = (SPLANNEQUIN_OT_align_floor, SPLANNEQUIN_OT_align_origin, SPLANNEQUIN_OT_align_scale)
