"""The panel of the Train step."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import scene_in, settings_of
from ..process import all_steps, steps
from ..scene import paths
from ..shot.shot_state import ShotState
from ..translations import tr
from ..ui import listing, step_panel
from ..ui.sentences import cells, wrap
from . import estimates, pictures, training
from .settings import PRESETS

_PRESET_WIDTHS = (0.32, 0.17, 0.25, 0.26)


class TrainPanel(step_panel.StepPanel):
    """Step 3: training."""

    title = "3  Train"
    step = "train"
    operator = "splannequin.train"
    folds = "train"

    def draw_settings(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The preset, and what the button will do to an existing run."""
        props = settings_of(scene_in(context))
        watch, plan = self._watch(context), self._plan(context)
        running = watch.running() if watch is not None else None
        if running != self.step:  # a running training needs the room for its progress
            self._presets(context, layout, watch.state if watch is not None else None)
        if watch is None or running is not None:
            return
        if plan.kind == "extend":
            layout.prop(props, "extend_steps")
        if plan.words:
            wrap(layout, context, plan.words, "PAUSE" if self._paused(context) else "INFO")

    def _presets(self, context: bpy.types.Context, layout: bpy.types.UILayout, state: ShotState | None) -> None:
        """A button for each preset, with its width, steps and duration on this machine."""
        props, pace = settings_of(scene_in(context)), all_steps.paces().get("train")
        rows, basis = estimates.costs(state, pace)
        column = layout.column(align=True)
        head = cells(column.row(align=True), _PRESET_WIDTHS)
        for place, text in zip(head, ("Preset", "Pixels", "Steps", "Time"), strict=True):
            place.label(text=text)
        names = {name: label for name, label, _ in PRESETS}
        for row in rows:
            columns = cells(column.row(align=True), _PRESET_WIDTHS)
            # Our translation: Blender's German word for Final is too long for the column.
            label = tr(names[row.preset])
            columns[0].prop_enum(props, "preset", row.preset, text=label, translate=False)
            spent = "-" if row.seconds is None else contract.duration(row.seconds) + ("" if row.measured else " ?")
            for place, text in zip(columns[1:], (str(row.width or "-"), f"{row.steps / 1000:g}k", spent), strict=True):
                place.label(text=text, translate=False)
        if basis is None and pace is not None:
            words = "A ? marks an estimate from earlier trainings on this computer."
        elif basis is None:
            words = (
                "Preview took 1.5 to 3.5 minutes on two cores without a graphics card. Times for this computer are "
                "shown after the first run."
            )
        else:
            where = "graphics card" if basis.get("device") == "cuda" else "processor"
            words = (
                f"Times measured in run {basis.get('run', '')} on the {where}. A ? marks an estimate from pixels and "
                "steps."
            )
        wrap(layout, context, words)

    def _plan(self, context: bpy.types.Context) -> training.Plan:
        props, watch = settings_of(scene_in(context)), self._watch(context)
        depth = paths.absolute(props.depth)
        return training.plan(watch.state if watch else None, props.run_name, props.preset, depth)

    def _label(self, context: bpy.types.Context, view: steps.View) -> str:
        return self._plan(context).button

    def _paused(self, context: bpy.types.Context) -> bool:
        return self._plan(context).kind in ("resume", "extension")

    def draw_body(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The step's body, runs, and images of the training."""
        super().draw_body(context, layout)
        watch = self._watch(context)
        if watch is None or watch.state is None:
            return
        self._runs(context, layout, watch.state)
        name, job = settings_of(scene_in(context)).run_name, watch.jobs.get("train")
        run = watch.state.runs.get(name) or watch.state.unfinished.get(name) or {}
        going = job is not None and watch.running() == "train"
        if going and job is not None:
            picture, points = training.preview(run, job.images.get("preview")), training.history(run, job.history)
        elif run:
            picture, points = run.get("preview"), run.get("history", [])
        else:
            return
        shown = "train_pictures" if going else "train_pictures_kept"  # separate folding states
        body = step_panel.sub_panel(layout, shown, "Progress", folded=not going)
        if body is None:
            return
        icon = pictures.icon_of(picture) if picture else 0
        if icon:
            body.template_icon(icon_value=icon, scale=8.0)
        icon = pictures.plot(points)
        if icon:
            body.template_icon(icon_value=icon, scale=5.0)
        if points:
            (_, first), (seconds, last) = points[0], points[-1]
            wrap(
                body,
                context,
                f"{first:.1f} to {last:.1f} dB on held-out frames, in {contract.duration(seconds)}",
                "NONE",
            )

    def _runs(self, context: bpy.types.Context, layout: bpy.types.UILayout, state: ShotState) -> None:
        """The list of all runs of the shot, for comparison and selection."""
        if not state.listed("run"):
            return
        body = step_panel.sub_panel(layout, "runs", "Runs")
        if body is not None:
            listing.draw(body, "run", state, settings_of(scene_in(context)).run_name)
            for damage in state.damaged["run"].values():
                wrap(body, context, damage, "ERROR")

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The run's name, and depth maps."""
        props = settings_of(scene_in(context))
        layout.prop(props, "run_name")
        layout.prop(props, "depth")


PANEL = TrainPanel()
