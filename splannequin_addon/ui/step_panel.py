"""The sidebar tab "Splannequin" in the 3D view: five steps in order, each with its state and what comes next.

Drawing only reads what the supervisor keeps; it touches the disk when a shot is met for the first time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..bake import freeze_group, shown_take
from ..freeze import viewport
from ..process import backend, steps, supervisor
from ..scene import scene_setup
from ..settings import PRESETS
from ..shot import chosen, made, markers
from ..shot.shot_state import ShotState
from ..solve import align_operators, cameras, guesses, mattes
from ..train import estimates, pictures, training
from ..translations import tr
from . import icons, job_operators, listing, preferences
from .sentences import cells, wrap

CATEGORY = "Splannequin"
_PRESET_WIDTHS = (0.32, 0.17, 0.25, 0.26)


@dataclass
class View:
    """What one step shows."""

    done: bool
    """It has been done."""
    ready: bool
    """What it needs is there."""
    state: list[str]
    """What there is, a few short lines."""
    advice: str
    """One sentence: what comes next."""


def view_footage(scene: Any, state: ShotState | None) -> View:
    """Footage: what was imported."""
    if state is None or not state.frames:
        chosen = bool(scene.splannequin.clip)
        return View(False, True, [], "Import the clip." if chosen else "Choose a clip of people holding still.")
    (width, height), (first, last) = state.size, state.frame_range
    lines = [f"{state.frames} frames, {first} to {last}", f"{width} x {height}, {state.info.get('fps', 0):g} fps"]
    return View(True, True, lines, "Next: solve the camera.")


def view_camera(scene: Any, state: ShotState | None) -> View:
    """Camera: how good the solve is."""
    if state is None or not state.frames:
        return View(False, False, [], steps.STEPS["camera"].needs)
    if not state.solve:
        return View(False, True, [], "Find where the camera was on every frame.")
    told = state.solve.get("result", state.solve)
    lines = [line for line in (told.get("quality"), guesses.told(told)) if line]
    if cameras.find(scene, state.folder, "CAMERA") is None:
        return View(True, True, lines, "The solve is not in this scene: load it.")
    return View(True, True, lines, "Look through the camera, then train.")


def view_train(scene: Any, state: ShotState | None) -> View:
    """Train: how good the run is."""
    if state is None or not state.solve:
        return View(False, False, [], steps.STEPS["train"].needs)
    run = state.runs.get(scene.splannequin.run_name)
    if run is None and scene.splannequin.run_name in state.unfinished:
        return View(False, True, [], "Resume it, or pick another run.")
    if run is None:
        return View(False, True, [], "Learn the scene and what moves in it.")
    psnr, moving = run.get("heldout_psnr_db"), run.get("moving_share") or 0.0
    quality = f"{psnr:.1f} dB on frames kept out" if psnr is not None else "no frames kept out"
    size = f"{run['gaussians']:,} Gaussians, {100 * moving:.1f} % may move"
    verdict = contract.verdict_lines(run)
    if run.get("quality") == "Poor" and not verdict:  # trained by an older version
        verdict = ["It is poor: take a range in which nobody walks, or solve the camera again."]
    lines = [f"Run {scene.splannequin.run_name}: {quality}", size, *verdict]
    return View(True, True, lines, "Next: freeze an instant.")


def view_freeze(scene: Any, state: ShotState | None) -> View:
    """Freeze: which frames there are."""
    if state is None or scene.splannequin.run_name not in state.runs:
        return View(False, False, [], steps.STEPS["freeze"].needs)
    take = state.takes.get(scene.splannequin.take_name)
    if take is None:
        return View(False, True, [], "Render the clip's move with time standing still.")
    frames = f"Take {take['take']}: {take['frame_count']} frames, {take['width']} x {take['height']}"
    instant = f"Time stands still at frame {take['t_star_frame']}"
    across, down = take.get("margin", (0, 0))
    beyond = [f"Overscan: {across} pixels on each side, {down} above and below"] if across or down else []
    lines = [frames, *beyond, instant, *contract.verdict_lines(take)]
    return View(True, True, lines, "Next: bake it into your compositor.")


def view_bake(scene: Any, state: ShotState | None) -> View:
    """Bake: whether the freeze is in the scene's compositor."""
    if state is None or scene.splannequin.take_name not in state.takes:
        return View(False, False, [], steps.STEPS["bake"].needs)
    tree = compat.compositor_tree(scene)
    if tree is None or freeze_group.group_node(tree) is None:
        return View(False, True, [], "Put the freeze before your compositor's output and render.")
    there, take = freeze_group.shown(scene), shown_take.shown(scene, state.folder)
    if there is not None and take != scene.splannequin.take_name:
        shown = f"take {take}" if take else f"another shot, {made.name_of(there[0].parent.parent)}"
        lines = [f"Your compositor shows {shown}: the one that was baked last."]
        return View(False, True, lines, "Baking puts this take in its place.")
    lines = ["The freeze is in your compositor.", *unsure(state.takes[scene.splannequin.take_name])]
    if shown_take.stale_scale(scene, state.folder):
        lines.append("The shot was scaled since: its depth is stale until you bake again.")
    if not scene_setup.keeps_plate_colours(scene):
        lines.append(f"The view transform {scene.view_settings.view_transform} changes the plate's colours.")
    return View(True, True, lines, f"Frames go to {scene.render.filepath}")


def unsure(take: dict[str, Any]) -> list[str]:
    """What a take's verdict says, if that is not that all is well: there is no need to hear it again."""
    verdict = contract.verdict_of(take)
    return [] if verdict is None or verdict.word == "good" else verdict.lines()


VIEWS = {"footage": view_footage, "camera": view_camera, "train": view_train, "freeze": view_freeze, "bake": view_bake}


class _StepPanel:
    """What the five panels share. State, settings, one button, progress with Cancel, what comes next."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY
    step = ""
    operator = ""

    def _watch(self, context: Any) -> supervisor.Watch | None:
        folder = chosen.shot_folder(context.scene)
        return supervisor.watch_of(folder) if folder else None

    def _view(self, context: Any) -> View:
        watch = self._watch(context)
        if watch is not None and chosen.missing(context.scene, watch.state):
            return View(False, self.step == "footage", [], "" if self.step == "footage" else "Locate the shot first.")
        return VIEWS[self.step](context.scene, watch.state if watch else None)

    def _next_done(self, context: Any) -> bool:
        """True if the step after this one is done: what comes next need not be said any more."""
        names = list(VIEWS)
        after = names[names.index(self.step) + 1 :]
        watch = self._watch(context)
        return bool(after) and VIEWS[after[0]](context.scene, watch.state if watch else None).done

    def draw_header(self, context: Any) -> None:
        """An icon for the state: a tick, at work, failed, next, or not yet."""
        watch = self._watch(context)
        view = self._view(context)
        job = watch.jobs.get(self.step) if watch else None
        if watch and watch.running() == self.step:
            icon = "SORTTIME"
        elif watch and (self.step in watch.failures or (job and job.state == "failed")):
            icon = "ERROR"
        elif view.done:
            icon = "CHECKMARK"
        else:
            icon = "RADIOBUT_ON" if view.ready else "RADIOBUT_OFF"
        self.layout.label(text="", icon=icon)  # type: ignore[attr-defined]

    def draw(self, context: Any) -> None:
        """The step's body."""
        layout = self.layout  # type: ignore[attr-defined]
        watch, view = self._watch(context), self._view(context)
        self.draw_trouble(context, layout)
        for line in view.state:
            wrap(layout, context, line)
        running = watch.running() if watch else None
        settings = layout.column()
        settings.enabled = view.ready and running is None
        self.draw_settings(context, settings)
        self.draw_always(context, layout)
        if watch and running == self.step:
            self._progress(context, watch)
        else:
            self._button(context, layout, view, running)
            self._outcome(context, layout, watch, view.state)
            if running is None and view.advice and not (view.done and self._next_done(context)):
                wrap(layout, context, view.advice, "INFO")
        body = sub_panel(layout, f"{self.step}_more", "Advanced")
        if body is not None:
            body.enabled = running is None
            self.draw_advanced(context, body)

    def draw_trouble(self, context: Any, layout: Any) -> None:
        """What keeps the step from being done at all, with the button that helps."""

    def draw_always(self, context: Any, layout: Any) -> None:
        """What stays in reach while a step runs."""

    def draw_settings(self, context: Any, layout: Any) -> None:
        """The settings that an artist needs."""

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """The settings that need no touching."""

    def _button(self, context: Any, layout: Any, view: View, running: str | None) -> None:
        row = layout.row()
        row.scale_y = 1.0 if view.done else 1.4
        row.enabled = view.ready and running is None
        row.operator(self.operator, text=self._label(context, view), icon=icons.of(self.operator))

    def _label(self, context: Any, view: View) -> str:
        """What the button says."""
        step = steps.STEPS[self.step]
        return step.again if view.done else step.button

    def _progress(self, context: Any, watch: supervisor.Watch) -> None:
        layout = self.layout  # type: ignore[attr-defined]
        if watch.rendered is not None:
            done, total = watch.rendered
            text = tr(f"Rendering, frame {done} of {total}")
            layout.progress(factor=done / max(total, 1), type="BAR", text=text)
            wrap(layout, context, "Press Esc in the render window to stop.", "INFO")
            return
        if watch.sampling is not None:
            done, total = watch.sampling.done, watch.sampling.total
            text = tr(f"Reading the camera, frame {done} of {total}")
            layout.progress(factor=done / max(total, 1), type="BAR", text=text)
            return
        job = watch.jobs[self.step]
        status = job.status
        row = layout.split(factor=0.7, align=True)
        text = f"{status.stage.capitalize()} {100 * status.fraction:.0f} %" if status and status.stage else "Starting"
        row.progress(factor=status.fraction if status else 0.0, type="BAR", text=tr(text))
        stop = "Pause" if self.step == "train" else "Cancel"
        row.operator("splannequin.cancel", text=stop, icon=icons.of("splannequin.cancel")).step = self.step
        detail = [status.message] if status and status.message else []
        if status and status.eta_seconds is not None:
            detail.append(f"about {minutes(status.eta_seconds)} left")
        wrap(layout, context, ", ".join(tr(part) for part in detail) if detail else "The backend is starting.", "INFO")

    def _outcome(self, context: Any, layout: Any, watch: supervisor.Watch | None, said: list[str]) -> None:
        """What went wrong, or what was changed, unless it was `said` above."""
        if watch is None:
            return
        job = watch.jobs.get(self.step)
        failure = watch.failures.get(self.step)
        if failure is None and job is not None and job.state == "failed" and job.status is not None:
            failure = (job.status.message, job.status.hint)
        if failure is not None:
            box = layout.box()
            box.alert = True
            wrap(box, context, failure[0], "ERROR")
            if failure[1]:
                wrap(box, context, failure[1], "BLANK1")
            if job_operators.log_of(watch, self.step) is not None:
                box.operator("splannequin.open_log", text="Open Log", icon="TEXT").step = self.step
            return
        if job is not None and job.state == "cancelled" and not self._paused(context):
            wrap(layout, context, "Cancelled. Finished work is kept: start it again to go on.", "CANCEL")
        for line in unsaid(job.warnings if job is not None else [], said):
            wrap(layout, context, line, "ERROR")
        for note in watch.notes.get(self.step, []):
            wrap(layout, context, note, "DOT")

    def _paused(self, context: Any) -> bool:
        """True if the panel says already that what was stopped can go on."""
        return False


def unsaid(warnings: list[tuple[str, str]], said: list[str]) -> list[str]:
    """A job's warnings as lines, without those that the step's state tells anyway, as it does a verdict."""
    return [f"{message} {hint}".strip() for message, hint in warnings if message not in said]


def can_load_camera(running: str | None) -> bool:
    """True unless a step runs that makes another solve; the others leave this one as it is."""
    return running not in ("footage", "camera")


def can_scrub(view: View, running: str | None) -> bool:
    """True if scrubbing may begin, and always while there is a session to be stopped."""
    return viewport.session() is not None or (view.ready and running is None)


def minutes(seconds: float) -> str:
    """A duration for people: "45 s", "3 min", "1.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class SPLANNEQUIN_PT_footage(_StepPanel, bpy.types.Panel):
    """Step 1: footage into a shot folder"""

    bl_label = "1  Footage"
    bl_idname = "SPLANNEQUIN_PT_footage"
    step = "footage"
    operator = "splannequin.import_clip"

    def draw_settings(self, context: Any, layout: Any) -> None:
        """Clip, range, shot folder."""
        props = context.scene.splannequin
        layout.prop(props, "clip", text="")
        row = layout.row(heading="Range")
        row.prop(props, "use_range", text="")
        span = row.row(align=True)
        span.enabled = props.use_range
        span.prop(props, "first", text="")
        span.prop(props, "last", text="")

    def draw_trouble(self, context: Any, layout: Any) -> None:
        """No backend, no shot folder: what to do about it."""
        self._backend_trouble(context, layout)
        watch = self._watch(context)
        if watch is not None and chosen.missing(context.scene, watch.state):
            box = layout.box()
            column = box.column(align=True)
            column.alert = True
            name = watch.shot.name
            wrap(column, context, f"The shot folder {name} is not there any more: moved, renamed or deleted.", "ERROR")
            box.operator("splannequin.locate_shot", text="Locate", icon=icons.of("splannequin.locate_shot"))

    def _backend_trouble(self, context: Any, layout: Any) -> None:
        """No backend, or one that is being set up."""
        trouble, setup = supervisor.backend_trouble(), preferences.running_setup()
        if setup is not None:
            wrap(layout, context, "The backend is being set up.", "IMPORT")
            for line in setup.said[-1:]:
                wrap(layout, context, line)
            layout.operator("splannequin.cancel_setup", icon=icons.of("splannequin.cancel_setup"))
        elif trouble is not None:
            box = layout.box()
            column = box.column(align=True)
            column.alert = True
            wrap(column, context, trouble.message, "ERROR")
            if not bpy.app.online_access:
                wrap(
                    column, context, "Blender may not go online: allow it in Preferences > System > Network.", "BLANK1"
                )
            box.operator("splannequin.set_up", icon=icons.of("splannequin.set_up"))
            box.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = backend.PACKAGE

    def _label(self, context: Any, view: View) -> str:
        watch = self._watch(context)
        gone = watch is not None and chosen.missing(context.scene, watch.state)
        return "Import Anew" if gone else super()._label(context, view)

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """Shot folder, which frames are solved, consent to set the scene up."""
        layout.prop(context.scene.splannequin, "shot_path", text="Folder")
        layout.prop(context.scene.splannequin, "solve_step")
        layout.prop(context.scene.splannequin, "fps")
        layout.prop(context.scene.splannequin, "set_up_scene")


class SPLANNEQUIN_PT_camera(_StepPanel, bpy.types.Panel):
    """Step 2: the camera"""

    bl_label = "2  Camera"
    bl_idname = "SPLANNEQUIN_PT_camera"
    step = "camera"
    operator = "splannequin.solve_camera"

    def draw(self, context: Any) -> None:
        """The step's body, and where the solve stands in the scene."""
        super().draw(context)
        watch = self._watch(context)
        body = sub_panel(self.layout, "camera_motion", "Motion Matte")  # type: ignore[attr-defined]
        if body is not None:
            mattes.draw(body)
        if watch is None or cameras.find(context.scene, watch.shot, "EMPTY") is None:
            return
        if not align_operators.scaled(context.scene, watch.shot):
            layout = self.layout  # type: ignore[attr-defined]
            wrap(layout, context, "The scale is arbitrary: a clip does not tell it.", "INFO")
            layout.operator("splannequin.align_scale", icon=icons.of("splannequin.align_scale")).selected = False
        body = sub_panel(self.layout, "camera_alignment", "Alignment")  # type: ignore[attr-defined]
        if body is not None:
            align_operators.draw(body)

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """The lens, where cameras come from, and where they go."""
        props = context.scene.splannequin
        layout.prop(props, "camera_model")
        layout.prop(props, "cameras_from")
        if props.cameras_from == "FILE":
            layout.prop(props, "cameras_path", text="")
        elif props.cameras_from == "TRACKING":
            layout.prop(props, "tracking_clip", text="")
        for name in ("splannequin.export_cameras", "splannequin.write_stmaps"):
            layout.operator(name, icon=icons.of(name))

    def _button(self, context: Any, layout: Any, view: View, running: str | None) -> None:
        watch = self._watch(context)
        if view.done and watch and cameras.find(context.scene, watch.shot, "CAMERA") is None:
            row = layout.row()
            row.scale_y = 1.4
            row.enabled = can_load_camera(running)
            row.operator("splannequin.load_camera", icon=icons.of("splannequin.load_camera"))
            return
        super()._button(context, layout, view, running)


class SPLANNEQUIN_PT_train(_StepPanel, bpy.types.Panel):
    """Step 3: training"""

    bl_label = "3  Train"
    bl_idname = "SPLANNEQUIN_PT_train"
    step = "train"
    operator = "splannequin.train"

    def draw_settings(self, context: Any, layout: Any) -> None:
        """The preset; what the button will do to the run that is there."""
        props = context.scene.splannequin
        watch, plan = self._watch(context), self._plan(context)
        self._presets(context, layout, watch.state if watch is not None else None)
        if watch is None or watch.running() is not None:
            return
        if plan.kind == "extend":
            layout.prop(props, "extend_steps")
        if plan.words:
            wrap(layout, context, plan.words, "PAUSE" if self._paused(context) else "INFO")

    def _presets(self, context: Any, layout: Any, state: ShotState | None) -> None:
        """A button for each preset: how large, how many steps, how long on this machine."""
        props, (rows, told) = context.scene.splannequin, estimates.costs(state)
        column = layout.column(align=True)
        head = cells(column.row(align=True), _PRESET_WIDTHS)
        for place, text in zip(head, ("Preset", "Pixels", "Steps", "Time"), strict=True):
            place.label(text=text)
        names = {name: label for name, label, _ in PRESETS}
        for row in rows:
            columns = cells(column.row(align=True), _PRESET_WIDTHS)
            columns[0].prop_enum(props, "preset", row.preset, text=names[row.preset])
            spent = "-" if row.seconds is None else minutes(row.seconds) + ("" if row.measured else " ?")
            for place, text in zip(columns[1:], (str(row.width), f"{row.steps / 1000:g}k", spent), strict=True):
                place.label(text=text, translate=False)
        if told is None:
            words = "Preview took 150 s on two cores without a graphics card. Times here come with the first run."
        else:
            where = "graphics card" if told.get("device") == "cuda" else "processor"
            words = f"By what run {told.get('run', '')} took on the {where}. With a ?: an estimate by pixels and steps."
        wrap(layout, context, words)

    def _plan(self, context: Any) -> training.Plan:
        props, watch = context.scene.splannequin, self._watch(context)
        return training.plan(watch.state if watch else None, props.run_name, props.preset)

    def _label(self, context: Any, view: View) -> str:
        return self._plan(context).button

    def _paused(self, context: Any) -> bool:
        return self._plan(context).kind in ("resume", "extension")

    def draw(self, context: Any) -> None:
        """The step's body, and the training in pictures."""
        super().draw(context)
        watch = self._watch(context)
        if watch is None or watch.state is None:
            return
        self._runs(context, watch.state)
        name, job = context.scene.splannequin.run_name, watch.jobs.get("train")
        run = watch.state.runs.get(name) or watch.state.unfinished.get(name) or {}
        going = job is not None and watch.running() == "train"
        if going and job is not None:
            picture, points = job.images.get("preview"), training.history(run, job.history)
        elif run:
            picture, points = run.get("preview"), run.get("history", [])
        else:
            return
        body = sub_panel(self.layout, "train_pictures", "Progress", folded=False)  # type: ignore[attr-defined]
        if body is None:
            return
        icon = pictures.icon_of(Path(picture)) if picture else 0
        if icon:
            body.template_icon(icon_value=icon, scale=8.0)
        icon = pictures.plot(points)
        if icon:
            body.template_icon(icon_value=icon, scale=5.0)
        if points:
            (_, first), (seconds, last) = points[0], points[-1]
            wrap(body, context, f"{first:.1f} to {last:.1f} dB on frames kept out, in {minutes(seconds)}", "NONE")

    def _runs(self, context: Any, state: ShotState) -> None:
        """All runs of the shot, to compare and pick."""
        if not state.listed("run"):
            return
        body = sub_panel(self.layout, "runs", "Runs")  # type: ignore[attr-defined]
        if body is not None:
            listing.draw(body, "run", state, context.scene.splannequin.run_name)
            for told in state.damaged["run"].values():
                wrap(body, context, told, "ERROR")

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """The run's name."""
        layout.prop(context.scene.splannequin, "run_name")


class SPLANNEQUIN_PT_freeze(_StepPanel, bpy.types.Panel):
    """Step 4: the freeze"""

    bl_label = "4  Freeze"
    bl_idname = "SPLANNEQUIN_PT_freeze"
    step = "freeze"
    operator = "splannequin.freeze"

    def draw_settings(self, context: Any, layout: Any) -> None:
        """The instant."""
        props = context.scene.splannequin
        row = layout.row()
        if props.choose_t_star:
            row.prop(props, "choose_t_star", text="t*")
            row.prop(props, "t_star", text="")
        else:
            at = self._suggested(context)
            words = tr(f"t*: {at}, suggested") if at is not None else tr("t* as suggested")
            row.prop(props, "choose_t_star", text=words, translate=False)
        row.operator("splannequin.t_star_here", text="", icon="EYEDROPPER")
        shown = context.scene.timeline_markers.get(markers.NAME) is not None
        row.operator("splannequin.t_star_marker", text="", icon="MARKER_HLT" if shown else "MARKER", depress=shown)

    def _suggested(self, context: Any) -> int | None:
        """The instant that is taken while none is chosen, once it is known: scrubbing asks for it, so does Freeze."""
        session, watch, props = viewport.session(), self._watch(context), context.scene.splannequin
        at = viewport.instant(context.scene) if session is not None and watch and session.shot == watch.shot else None
        if at is not None:
            return round(at)
        take = watch.state.takes.get(props.take_name) if watch is not None and watch.state is not None else None
        return props.t_star if take is not None and take["t_star_frame"] == props.t_star else None

    def draw_always(self, context: Any, layout: Any) -> None:
        """Scrubbing: it can be stopped whatever runs, and whatever became of the shot."""
        watch, live = self._watch(context), layout.column()
        live.enabled = can_scrub(self._view(context), watch.running() if watch else None)
        self._live(context, live)

    def draw(self, context: Any) -> None:
        """The step's body, and the takes to compare."""
        super().draw(context)
        watch = self._watch(context)
        if watch is None or watch.state is None or not watch.state.listed("take"):
            return
        body = sub_panel(self.layout, "takes", "Takes")  # type: ignore[attr-defined]
        if body is not None:
            listing.draw(body, "take", watch.state, context.scene.splannequin.take_name)
            for told in watch.state.damaged["take"].values():
                wrap(body, context, told, "ERROR")

    def _live(self, context: Any, layout: Any) -> None:
        """Scrubbing: on or off, what is shown, suggestions and why."""
        session = viewport.session()
        row = layout.row(align=True)
        icon = "PAUSE" if session is not None else "HIDE_OFF"
        text = "Stop Scrubbing" if session is not None else "Scrub in View"
        row.operator("splannequin.live", text=text, icon=icon, depress=session is not None)
        if session is None:
            told = viewport.failure()
            if told is not None:
                wrap(layout, context, f"{told[0]} {told[1]}".strip(), "ERROR")
            return
        row.operator("splannequin.suggested_instant", text="", icon="TRIA_LEFT").step = -1
        row.operator("splannequin.suggested_instant", text="", icon="TRIA_RIGHT").step = 1
        layout.row().prop(context.scene.splannequin, "live_show", expand=True)
        wrap(layout, context, viewport.reason(context.scene), "INFO")

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """The take's name, what it is made of, its size, and where it is seen from."""
        layout.prop(context.scene.splannequin, "take_name")
        layout.prop(context.scene.splannequin, "detail")
        layout.prop(context.scene.splannequin, "develop")
        layout.prop(context.scene.splannequin, "freeze_width")
        layout.prop(context.scene.splannequin, "overscan")
        layout.prop(context.scene.splannequin, "path_camera")
        camera = context.scene.splannequin.path_camera
        if camera is not None and camera.data.dof.use_dof:
            wrap(
                layout,
                context,
                "Frozen frames are sharp throughout: the camera's depth of field is not in them.",
                "INFO",
            )


class SPLANNEQUIN_PT_bake(_StepPanel, bpy.types.Panel):
    """Step 5: bake"""

    bl_label = "5  Bake"
    bl_idname = "SPLANNEQUIN_PT_bake"
    step = "bake"
    operator = "splannequin.bake"

    def draw_settings(self, context: Any, layout: Any) -> None:
        """Which take, and which of its frames: Blender's own range and step."""
        layout.prop(context.scene.splannequin, "take_name")
        row = layout.row(align=True)
        row.prop(context.scene, "frame_start", text="First")
        row.prop(context.scene, "frame_end", text="Last")
        row.prop(context.scene, "frame_step", text="Step")

    def draw_advanced(self, context: Any, layout: Any) -> None:
        """Colours, and the parts of the step one by one."""
        layout.prop(context.scene.splannequin, "keep_colours")
        layout.prop(context.scene.splannequin, "insert_at")
        name = "splannequin.insert_freeze"
        layout.operator(name, text="Insert in Compositor Only", icon=icons.of(name))
        for name in ("splannequin.freeze_as_warp", "splannequin.combine_cg", "splannequin.remove_shot"):
            layout.operator(name, icon=icons.of(name))


def sub_panel(layout: Any, name: str, label: str, folded: bool = True) -> Any | None:
    """A part of a panel that can be folded away, `folded` at first; None while it is."""
    header, body = layout.panel(f"splannequin_{name}", default_closed=folded)
    header.label(text=label)
    return body


CLASSES = (
    SPLANNEQUIN_PT_footage,
    SPLANNEQUIN_PT_camera,
    SPLANNEQUIN_PT_train,
    SPLANNEQUIN_PT_freeze,
    SPLANNEQUIN_PT_bake,
)
