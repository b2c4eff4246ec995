"""The sidebar tab "Splannequin" in the 3D view: five steps in order, with state and next action.

The tab is one Blender panel. Each step is a layout panel in it, which `folds` opens and closes. Drawing reads the
job timer's stored state, and the disk only for a new shot, a job's log and, every few seconds, the backend and paces.
"""

from __future__ import annotations

import os
from typing import Any, cast

import bpy

from ...torch_backend import contract
from ..access import Icon, scene_in, settings_of
from ..process import job_timer, jobs, steps
from ..shot import selection
from ..translations import tr
from . import icons
from .sentences import wrap

# Lines of a step's state that are always shown. The others are in a sub-panel, so that the tab fits a 1080p screen.
_LINES = 2


class StepPanel:
    """Base class of the five panels: state, settings, one button, progress with Cancel, next action."""

    title = ""
    """Title in the step's header."""
    is_current = False
    """True while this step is drawn as the one to work on."""
    step = ""
    operator = ""
    folds = ""
    """Name prefix of the sub-panels in .blend files, which store their folding state."""

    def _watch(self, context: bpy.types.Context) -> job_timer.Watch | None:
        folder = selection.shot_folder(scene_in(context))
        return job_timer.watch_of(folder) if folder else None

    def _view(self, context: bpy.types.Context) -> steps.View:
        watch = self._watch(context)
        if watch is not None and selection.missing(scene_in(context), watch.state):
            return steps.View(
                False,
                steps.STEPS[self.step].makes_shot,
                [],
                "" if steps.STEPS[self.step].makes_shot else "Locate the shot first.",
            )
        return steps.STEPS[self.step].view(scene_in(context), watch.state if watch else None)

    def draw(self, context: bpy.types.Context, layout: bpy.types.UILayout, is_current: bool) -> None:
        """Draws the step's header, and its body if open. The next action appears only for the step to work on."""
        self.is_current = is_current
        parts = layout.panel_prop(settings_of(scene_in(context)), f"is_{self.step}_open")
        header, body = cast("tuple[bpy.types.UILayout, bpy.types.UILayout | None]", parts)  # None while it is collapsed
        view = self._view(context)
        header.label(text=self.title, icon=self._icon(context, view))
        if body is not None:
            self.draw_body(context, body)
        elif view.brief:
            brief = header.row()
            brief.alignment = "RIGHT"
            brief.active = False
            brief.label(text=tr(view.brief), translate=False)

    def _icon(self, context: bpy.types.Context, view: steps.View) -> Icon:
        """Icon for the state: running, failed, done, ready, or not ready."""
        watch = self._watch(context)
        job = watch.jobs.get(self.step) if watch else None
        if watch and watch.running() == self.step:
            icon = "SORTTIME"
        elif watch and (self.step in watch.failures or (job and job.state == "failed")):
            icon = "ERROR"
        elif view.done:
            icon = "CHECKMARK"
        else:
            icon = "RADIOBUT_ON" if view.ready else "RADIOBUT_OFF"
        return icon

    def draw_body(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws the body of the open step."""
        watch, view = self._watch(context), self._view(context)
        self.draw_trouble(context, layout)
        for line in view.state[:_LINES]:
            wrap(layout, context, line)
        details = sub_panel(layout, f"{self.folds}_details", "Details") if view.state[_LINES:] else None
        if details is not None:
            for line in view.state[_LINES:]:
                wrap(details, context, line)
        running = watch.running() if watch else None
        settings = layout.column()
        settings.enabled = view.ready and running is None
        self.draw_settings(context, settings)
        self.draw_always(context, layout)
        if watch and running == self.step:
            self._progress(context, layout, watch)
        else:
            self._button(context, layout, view, running)
            self._outcome(context, layout, watch, view.state)
            if running is None and view.advice and self.is_current:
                wrap(layout, context, view.advice, "INFO")
        body = sub_panel(layout, f"{self.folds}_more", "Advanced")
        if body is not None:
            body.enabled = running is None
            self.draw_advanced(context, body)

    def draw_trouble(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws problems that prevent the step, with an operator that solves them."""

    def draw_always(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws controls that stay enabled while a step runs."""

    def draw_settings(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws the settings above the step's button."""

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws settings that rarely need changes."""

    def _button(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, view: steps.View, running: str | None
    ) -> None:
        row = layout.row()
        row.scale_y = 1.0 if view.done else 1.4
        row.enabled = view.ready and running is None
        row.operator(self.operator, text=self._label(context, view), icon=icons.of(self.operator))

    def _label(self, context: bpy.types.Context, view: steps.View) -> str:
        """Label of the button."""
        step = steps.STEPS[self.step]
        return step.again if view.done else step.button

    def _progress(self, context: bpy.types.Context, layout: bpy.types.UILayout, watch: job_timer.Watch) -> None:
        work = watch.work
        if work is not None:
            row = layout.split(factor=0.7, align=True) if work.turns is not None else layout
            self._work_progress(row, context, work.progress)
            if work.turns is not None:
                row.operator("splannequin.cancel", text="Cancel", icon=icons.of("splannequin.cancel")).step = self.step
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
            detail.append(f"about {contract.duration(status.eta_seconds)} left")
        wrap(layout, context, ", ".join(tr(part) for part in detail) if detail else "The backend is starting.", "INFO")
        if started_elsewhere(job):
            wrap(layout, context, f"Started from {job.blend}.", "FILE_BLEND")

    def _work_progress(
        self, layout: bpy.types.UILayout, context: bpy.types.Context, now: job_timer.Progress | None
    ) -> None:
        """Draws the progress of work done in Blender."""
        if now is None:
            layout.progress(factor=0.0, type="BAR", text=tr("Starting"))
            return
        layout.progress(factor=now.done / max(now.total, 1), type="BAR", text=tr(now.text))
        if now.hint:
            wrap(layout, context, now.hint, "INFO")

    def _outcome(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, watch: job_timer.Watch | None, shown: list[str]
    ) -> None:
        """Draws the error or the changes of the last job, without warnings in `shown`."""
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
            if job is not None and steps.STEPS[self.step].log(job) is not None:
                box.operator("splannequin.open_log", text="Open Log", icon="TEXT").step = self.step
            return
        if job is not None and job.state == "cancelled" and not self._paused(context):
            wrap(layout, context, "Cancelled. Finished work is kept. Start the step again to continue.", "CANCEL")
        for line in new_warnings(job.warnings if job is not None else [], shown):
            wrap(layout, context, line, "ERROR")
        for note in watch.notes.get(self.step, []):
            wrap(layout, context, note, "DOT")

    def _paused(self, context: bpy.types.Context) -> bool:
        """True if the panel already explains how to resume a stopped job."""
        return False


def started_elsewhere(job: jobs.Job) -> bool:
    """True if a job was started from another .blend than the open one."""
    return job.blend not in ("", os.path.basename(bpy.data.filepath))


def new_warnings(warnings: list[tuple[str, str]], shown: list[str]) -> list[str]:
    """A job's warnings as lines, without those that the step's state already shows."""
    return [f"{message} {hint}".strip() for message, hint in warnings if message not in shown]


def sub_panel(layout: bpy.types.UILayout, name: str, label: str, folded: bool = True) -> Any | None:
    """A collapsible part of a panel, initially collapsed if `folded`; None while it is collapsed."""
    header, body = layout.panel(f"splannequin_{name}", default_closed=folded)
    header.label(text=label)
    return body
