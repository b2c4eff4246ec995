"""The Bake step: its backend request, the changes when it ends, and its texts on the panel."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import library_of, present, settings_of
from ..freeze import takes
from ..process import backend, job_timer, jobs, steps
from ..process.steps import Step, View
from ..scene import paths, scene_setup, session
from ..shot import scene_objects, selection
from ..shot.shot_state import ShotState
from . import farm, freeze_group, insertion, matte_node, operators, panel, progress, shown_take


class Bake(Step):
    """The take in the scene's compositor, and its render. The job freezes the take's missing frames."""

    name = "bake"
    label = "Bake"
    kind = "freeze"
    button = "Bake and Render"
    again = "Bake Again"
    needs = "Freeze first."
    panel = panel.PANEL
    classes = (*operators.CLASSES, *farm.CLASSES, *matte_node.CLASSES)
    parts = (progress,)

    def params(self, scene: bpy.types.Scene) -> contract.FreezeParams:
        """The parameters that the take was frozen with, for the frames of the scene's range."""
        props, folder = settings_of(scene), selection.shot_folder(scene)
        params = takes.params_of(scene)
        if folder is None:
            return params
        stored = takes.take_params(folder, props.take_name, params.t_star)
        if stored is not None and props.choose_t_star:
            stored.t_star_per_frame = params.t_star_per_frame
        params = stored or params
        params.device = backend.device()
        params.first, params.last, params.step = scene.frame_start, scene.frame_end, scene.frame_step
        return params

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of Bake, which depends on whether the scene's compositor shows the freeze."""
        props = settings_of(scene)
        if state is None or (props.take_name not in state.takes and props.run_name not in state.runs):
            return View(False, False, [], self.needs)
        if props.take_name not in state.takes:
            advice = "Freezes the scene's range, inserts it before your compositor's output and renders."
            return View(False, True, [], advice)
        tree = compat.compositor_tree(scene)
        if tree is None or freeze_group.group_node(tree) is None:
            return View(False, True, [], "Insert the freeze before your compositor's output and render.")
        found, take = freeze_group.shown(scene), shown_take.shown(scene, state.folder)
        if found is not None and take != settings_of(scene).take_name:
            shown = f"take {take}" if take else f"another shot, {scene_objects.name_of(found[0].parent.parent)}"
            lines = [f"Your compositor shows {shown}, which was baked last."]
            return View(False, True, lines, "Baking replaces it with this take.")
        lines = ["The freeze is in your compositor."]
        if shown_take.stale_scale(scene, state.folder):
            lines.append("The shot was scaled after the bake. Its depth is outdated until you bake again.")
        if not scene_setup.keeps_plate_colours(scene):
            lines.append(
                f"The view transform {present(scene.view_settings).view_transform} changes the plate's colours."
            )
        return View(True, True, lines, f"Frames go to {scene.render.filepath}")

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Inserts the take into the compositor."""
        return insertion.insert_freeze(scene, job.shot, job.params["take"])

    def arrive(self, scene: bpy.types.Scene, job: jobs.Job) -> bool:
        """Inserts and renders the take in steps run by the timer.

        Changes only the scene that started the job. If that scene no longer exists, all scenes that use the shot are
        changed.
        """
        name, take = steps.scene_of(job), str(job.params["take"])
        named = next((s for s in bpy.data.scenes if s.name == name and not library_of(s)), None)
        target = session.scene_of(job.scene_uid) or named  # by name in another file, or after a restart
        if target is None:
            insertion.bring_in(scene, job.shot, take, alone=False)
        elif target in selection.scenes_of(job.shot):
            insertion.bring_in(target, job.shot, take)
        else:
            job_timer.watch_of(job.shot).notes[self.name] = [self.late(job)]
        return True

    def late(self, job: jobs.Job) -> str:
        """Note about a job that ended late: its frames need another bake.

        Selecting a shot starts no render and keeps the other take in the compositor.
        """
        return "The shot's frames were rendered in the meantime. Bake again to insert them into your compositor."

    def in_use(self, shot: Path, folder: Path) -> str:
        """The reason why a take cannot be deleted: this file shows its frames. Empty if it does not."""
        if shown(folder):
            return "The compositor shows this take. Bake another take or remove the shot from the scene first."
        return ""

    def is_present(self, scene: bpy.types.Scene, shot: Path) -> bool:
        """True if the compositor shows a take of the shot."""
        return _baked(scene) == shot

    def remove(self, scene: bpy.types.Scene, shot: Path, remaining: list[Path]) -> list[str]:
        """Removes the freeze from the compositor, unless it belongs to another shot."""
        gone = _baked(scene) not in remaining and insertion.remove(scene)
        return ["The freeze was removed from the compositor."] if gone else []

    def scaled(self, scene: bpy.types.Scene, shot: Path) -> list[str]:
        """Updates the depth factor in the compositor, since depth is in scene units."""
        return shown_take.follow_scale(scene, shot)


def _baked(scene: bpy.types.Scene) -> Path | None:
    """The shot whose take the compositor shows."""
    found = freeze_group.shown(scene)
    return found[0].parent.parent if found is not None else None


def shown(take: Path) -> bool:
    """True if a used image of this file shows a frame of the take."""
    wanted = os.path.abspath(take)
    used = (image.filepath for image in bpy.data.images if image.users and image.filepath)
    return any(paths.same(os.path.dirname(paths.absolute(file)), wanted) for file in used)


STEP = Bake()
