"""The five buttons. Headless, a button's `execute` blocks until the work is done; in a window the timer follows it."""

from __future__ import annotations

from typing import Any

import bpy

from ...torch_backend import contract
from ..bake import freeze_group, rendering
from ..freeze import own_camera, viewport
from ..process import backend, steps, supervisor
from ..shot import chosen, markers
from ..translations import tr


class _StepOperator:
    """What the five share: begin the job, then wait for it or have it followed."""

    step = ""

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Off while a step of this shot runs."""
        folder = chosen.shot_folder(context.scene)
        if folder is not None and supervisor.watch_of(folder).running():
            cls.poll_message_set(tr("A step of this shot is running"))  # type: ignore[attr-defined]
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Runs the step."""
        scene = context.scene
        try:
            job = steps.begin(scene, self.step, self.params(scene))
            supervisor.follow(self.step, job)
            if not bpy.app.background:
                return {"FINISHED"}
            steps.wait(job)
            notes = self.after(scene, job)
        except contract.Cancelled:
            self.report({"WARNING"}, "Cancelled: finished work is kept")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        except (contract.JobError, ValueError, OSError, RuntimeError) as error:
            folder = chosen.shot_folder(scene)
            sentence = getattr(error, "message", str(error))
            if folder is not None:
                supervisor.watch_of(folder).failures[self.step] = (sentence, getattr(error, "hint", ""))
            self.report({"ERROR"}, tr(f"{sentence} {getattr(error, 'hint', '')}".strip()))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        for note in notes:
            self.report({"INFO"}, tr(note))  # type: ignore[attr-defined]
        return {"FINISHED"}

    def params(self, scene: Any) -> Any:
        """What the job is asked for; None: what the scene's settings say."""
        return None

    def after(self, scene: Any, job: Any) -> list[str]:
        """What follows the job when blocking; returns what changed, in words."""
        return steps.finish(scene, self.step, job)


def _read_camera(turns: Any, scene: Any, step: str) -> Any:
    """Reads a camera all at once; returns what a step asks for from it."""
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return steps.freeze_from(scene, end.value, step)


def _turns(scene: Any, folder: Any) -> Any:
    """`cameras.sample_path` of the artist's camera, at the size of the take that is to be baked."""
    width = steps.params_of(scene, "bake").width
    return own_camera.sample_path(scene, steps.own_camera(scene), folder, width)


class SPLANNEQUIN_OT_import_clip(_StepOperator, bpy.types.Operator):
    """Take the clip's frames into the shot folder and check them"""

    bl_idname = "splannequin.import_clip"
    bl_label = "Import Clip"
    bl_options = {"REGISTER"}
    step = "footage"


class SPLANNEQUIN_OT_solve_camera(_StepOperator, bpy.types.Operator):
    """Find where the camera was on every frame, and bring it in as an animated camera with the plate behind it"""

    bl_idname = "splannequin.solve_camera"
    bl_label = "Solve Camera"
    bl_options = {"REGISTER"}
    step = "camera"


class SPLANNEQUIN_OT_train(_StepOperator, bpy.types.Operator):
    """Learn the scene and what moves in it from the clip"""

    bl_idname = "splannequin.train"
    bl_label = "Train"
    bl_options = {"REGISTER"}
    step = "train"


class SPLANNEQUIN_OT_freeze(_StepOperator, bpy.types.Operator):
    """Render time standing still at t*: from every pose of the clip, or from an animated camera of your own"""

    bl_idname = "splannequin.freeze"
    bl_label = "Freeze"
    bl_options = {"REGISTER"}
    step = "freeze"

    def execute(self, context: Any) -> set[str]:
        """Runs the step. In a window a camera of the artist's is read a few frames per turn of the timer."""
        scene = context.scene
        name, folder = steps.own_camera(scene), chosen.shot_folder(scene)
        if not name or folder is None or bpy.app.background:
            return super().execute(context)
        supervisor.sample(scene, folder, own_camera.sample_path(scene, name, folder, scene.splannequin.freeze_width))
        return {"FINISHED"}

    def params(self, scene: Any) -> Any:
        """Reads the artist's camera, if one is chosen, all at once."""
        name, folder = steps.own_camera(scene), chosen.shot_folder(scene)
        if not name or folder is None:
            return None
        return _read_camera(
            own_camera.sample_path(scene, name, folder, scene.splannequin.freeze_width), scene, "freeze"
        )


class SPLANNEQUIN_OT_bake(_StepOperator, bpy.types.Operator):
    """Freeze those frames of the scene's range that are missing or stale, put the freeze before the output of the
    scene's compositor, and render the range to the scene's output path"""

    bl_idname = "splannequin.bake"
    bl_label = "Bake and Render"
    bl_options = {"REGISTER"}
    step = "bake"

    def execute(self, context: Any) -> set[str]:
        """Bakes; a complete take needs no backend."""
        scene = context.scene
        folder = chosen.shot_folder(scene)
        take = scene.splannequin.take_name
        if folder is None or backend.available() or not steps.complete(folder, take, rendering.frames_of(scene)):
            if folder is not None and not bpy.app.background and steps.follows_camera(scene):
                width = steps.params_of(scene, "bake").width
                supervisor.sample(
                    scene, folder, own_camera.sample_path(scene, steps.own_camera(scene), folder, width), "bake"
                )
                return {"FINISHED"}
            return super().execute(context)
        if not bpy.app.background:
            supervisor.bring_in(scene, folder, take)
            return {"FINISHED"}
        outcome = _edit(self, context, "bake", lambda scene, shot: steps.insert_freeze(scene, shot, take))
        if outcome == {"FINISHED"}:
            try:
                bpy.ops.splannequin.render("EXEC_DEFAULT")
            except RuntimeError as error:
                self.report({"ERROR"}, str(error).strip())
                return {"CANCELLED"}
        return outcome

    def params(self, scene: Any) -> Any:
        """Reads the artist's camera again, if the take is seen from one: what moved since is stale."""
        folder = chosen.shot_folder(scene)
        if folder is None or not steps.follows_camera(scene):
            return None
        return _read_camera(_turns(scene, folder), scene, "bake")

    def after(self, scene: Any, job: Any) -> list[str]:
        """Inserts the freeze, then renders."""
        notes = super().after(scene, job)
        notes += rendering.choose_output(scene, job.shot, job.params["take"])
        bpy.ops.render.render(animation=True, scene=scene.name)
        return notes


class SPLANNEQUIN_OT_render(bpy.types.Operator):
    """Render the scene's range through the compositor to its output path"""

    bl_idname = "splannequin.render"
    bl_label = "Render Baked Shot"
    bl_options = {"REGISTER"}

    def execute(self, context: Any) -> set[str]:
        """Blocks until the frames are on disk."""
        return self._render(context, "EXEC_DEFAULT")

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Renders in the background of the window, as Blender's own Render Animation does."""
        return self._render(context, "INVOKE_DEFAULT")

    def _render(self, context: Any, how: str) -> set[str]:
        scene = context.scene
        folder = chosen.shot_folder(scene)
        if folder is None:
            self.report({"ERROR"}, "No shot is chosen: import a clip first")
            return {"CANCELLED"}
        notes = rendering.choose_output(scene, folder, scene.splannequin.take_name)
        if notes:
            supervisor.undo_step("bake")
        supervisor.render_began(folder, len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step)))
        try:
            refused = "CANCELLED" in bpy.ops.render.render(how, animation=True, scene=scene.name) and "it was cancelled"
        except RuntimeError as error:
            refused = str(error).strip()
        if refused:
            supervisor.watch_of(folder).rendered = None  # nothing else would tell the panel that no render runs
            self.report({"ERROR"}, tr(f"Blender did not render the scene: {refused}"))
            return {"CANCELLED"}
        for note in notes:
            self.report({"INFO"}, tr(note))
        return {"FINISHED"}


class SPLANNEQUIN_OT_load_camera(bpy.types.Operator):
    """Bring the solved camera, its plate and the points into this scene, in place of an earlier solve of this shot"""

    bl_idname = "splannequin.load_camera"
    bl_label = "Load Camera"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Builds camera and points."""
        outcome = _edit(self, context, "camera", steps.load_camera)
        if outcome == {"FINISHED"} and context.window is not None:
            supervisor.look_through_camera(context.window)
        return outcome


class SPLANNEQUIN_OT_insert_freeze(bpy.types.Operator):
    """Put the frozen take before the output of the scene's compositor, or update it, without rendering"""

    bl_idname = "splannequin.insert_freeze"
    bl_label = "Insert Freeze in Compositor"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Inserts or updates the group."""
        take = context.scene.splannequin.take_name
        return _edit(self, context, "bake", lambda scene, shot: steps.insert_freeze(scene, shot, take))


class SPLANNEQUIN_OT_freeze_as_warp(bpy.types.Operator):
    """Freeze your own plate, whatever is led into the group, instead of showing the take's frames: it keeps its own
    grade, highlights and grain. Press again to show the take's frames"""

    bl_idname = "splannequin.freeze_as_warp"
    bl_label = "Freeze as Warp"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Inserts or updates the group, the other way."""
        take, warp = context.scene.splannequin.take_name, not freeze_group.wants_warp(context.scene)
        return _edit(self, context, "bake", lambda scene, shot: steps.insert_freeze(scene, shot, take, warp))


class SPLANNEQUIN_OT_combine_cg(bpy.types.Operator):
    """Lead the scene's own render into the freeze, so that your objects stand in front of and behind the frozen people
    by depth. Sets the film transparent and the depth pass on"""

    bl_idname = "splannequin.combine_cg"
    bl_label = "Combine with Scene's Objects"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Adds one Render Layers node and two links."""
        return _edit(self, context, "bake", steps.combine_cg)


class SPLANNEQUIN_OT_remove_shot(bpy.types.Operator):
    """Take camera, points and the compositor group of this shot out of the file, and give the scene its own settings
    back. The shot folder on disk stays"""

    bl_idname = "splannequin.remove_shot"
    bl_label = "Remove Shot from Scene"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Removes what Splannequin put into the file."""

        def remove(scene: Any, shot: Any) -> list[str]:
            notes = steps.remove_all(scene, shot)
            supervisor.watch_of(shot).notes.clear()  # they tell of what is no longer there
            return notes

        return _edit(self, context, "bake", remove)


class SPLANNEQUIN_OT_t_star_here(bpy.types.Operator):
    """Let time stand still at the current frame"""

    bl_idname = "splannequin.t_star_here"
    bl_label = "Set t* from Current Frame"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Takes the current frame, held within the clip's range."""
        scene = context.scene
        folder = chosen.shot_folder(scene)
        frame = scene.frame_current
        state = supervisor.watch_of(folder).state if folder else None
        if state is not None and state.frames:
            first, last = state.frame_range
            frame = min(max(frame, first), last)
        scene.splannequin.t_star = frame
        scene.splannequin.choose_t_star = True
        return {"FINISHED"}


class SPLANNEQUIN_OT_t_star_marker(bpy.types.Operator):
    """Show t* as a marker on the timeline, to be dragged; press again to take it away"""

    bl_idname = "splannequin.t_star_marker"
    bl_label = "Marker for t*"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Adds or removes the marker."""
        markers.toggle(context.scene)
        return {"FINISHED"}


class SPLANNEQUIN_OT_live(bpy.types.Operator):
    """Draw the frozen instant over the 3D view while you scrub t* and move the view; press again to stop"""

    bl_idname = "splannequin.live"
    bl_label = "Scrub in View"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Off without a trained run, and where there is no view."""
        if viewport.session() is not None:
            return True  # it can be stopped, whatever became of the run
        if bpy.app.background:
            cls.poll_message_set(tr("There is no 3D view"))
            return False
        folder = chosen.shot_folder(context.scene)
        state = supervisor.watch_of(folder).state if folder else None
        if state is None or context.scene.splannequin.run_name not in state.runs:
            cls.poll_message_set(tr("Train first"))
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Starts or stops the session."""
        if viewport.session() is not None:
            viewport.end()
            return {"FINISHED"}
        try:
            viewport.begin(context.scene)
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_suggested_instant(bpy.types.Operator):
    """Set t* to the previous or next suggested instant: one that saw most of what moves, and whose plate is sharp"""

    bl_idname = "splannequin.suggested_instant"
    bl_label = "Suggested Instant"
    bl_options = {"REGISTER", "UNDO"}

    step: bpy.props.IntProperty(name="Step", description="1: the next one, -1: the one before", default=1)

    @classmethod
    def poll(cls, context: Any) -> bool:
        """On while scrubbing: the backend ranks the instants."""
        if not viewport.suggestions():
            cls.poll_message_set(tr("Suggestions come with Scrub in View"))
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Takes the nearest suggestion on that side; at the end, the first on the other."""
        props = context.scene.splannequin
        frames = sorted(s["frame"] for s in viewport.suggestions())
        now = viewport.instant(context.scene)
        beyond = [f for f in frames if now is None or (f - now) * self.step > 0]
        ordered = beyond or frames
        props.t_star = ordered[0] if self.step > 0 else ordered[-1]
        props.choose_t_star = True
        return {"FINISHED"}


def _edit(operator: Any, context: Any, step: str, change: Any) -> set[str]:
    """Runs a change of the scene; says what was done or why not."""
    folder = chosen.shot_folder(context.scene)
    if folder is None:
        operator.report({"ERROR"}, "No shot is chosen: import a clip first")
        return {"CANCELLED"}
    try:
        notes = change(context.scene, folder)
    except (contract.JobError, OSError, ValueError) as error:
        operator.report({"ERROR"}, tr(f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()))
        return {"CANCELLED"}
    supervisor.watch_of(folder).notes[step] = notes
    supervisor.redraw()
    for note in notes:
        operator.report({"INFO"}, tr(note))
    return {"FINISHED"}


CLASSES = (
    SPLANNEQUIN_OT_import_clip,
    SPLANNEQUIN_OT_solve_camera,
    SPLANNEQUIN_OT_train,
    SPLANNEQUIN_OT_freeze,
    SPLANNEQUIN_OT_bake,
    SPLANNEQUIN_OT_render,
    SPLANNEQUIN_OT_load_camera,
    SPLANNEQUIN_OT_insert_freeze,
    SPLANNEQUIN_OT_freeze_as_warp,
    SPLANNEQUIN_OT_combine_cg,
    SPLANNEQUIN_OT_remove_shot,
    SPLANNEQUIN_OT_t_star_here,
    SPLANNEQUIN_OT_t_star_marker,
    SPLANNEQUIN_OT_live,
    SPLANNEQUIN_OT_suggested_instant,
)
