"""The Train step: its backend request, and its texts on the panel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..access import settings_of
from ..process import backend, jobs
from ..process.steps import Step, View
from ..scene import paths
from ..shot import inventory, selection
from ..shot.shot_state import ShotState
from . import operators, panel, pictures, training

if TYPE_CHECKING:
    import bpy


class Train(Step):
    """Learns the scene and its motion."""

    name = "train"
    label = "Train"
    kind = "train"
    button = "Train"
    again = "Continue Training"
    needs = "Solve the camera first."
    panel = panel.PANEL
    classes = operators.CLASSES
    parts = (pictures,)

    def params(self, scene: bpy.types.Scene) -> contract.TrainParams:
        """Training parameters for a new run, or for the next part of an existing run."""
        props, folder = settings_of(scene), selection.shot_folder(scene)
        state = inventory.read(folder) if folder is not None else None
        depth = paths.absolute(props.depth)
        return training.params(state, props.run_name, props.preset, props.extend_steps, backend.device(), depth)

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of Train: the quality of the run."""
        if state is None or not state.solve:
            return View(False, False, [], self.needs)
        run = state.runs.get(settings_of(scene).run_name)
        if run is None and settings_of(scene).run_name in state.unfinished:
            return View(False, True, [], "Resume it, or pick another run.")
        if run is None:
            return View(False, True, [], "Learn the scene and what moves in it.")
        psnr, moving = run.get("heldout_psnr_db"), run.get("moving_share") or 0.0
        quality = f"{psnr:.1f} dB on held-out frames" if psnr is not None else "no held-out frames"
        size = f"{run['gaussians']:,} Gaussians, {100 * moving:.1f} % may move"
        verdict, depth = contract.verdict_of(run), contract.depth_line(run)
        lines = [*(verdict.lines() if verdict is not None else ()), f"Run {settings_of(scene).run_name}: {quality}"]
        lines += [size, depth] if depth else [size]
        return View(True, True, lines, "", verdict.word.capitalize() if verdict else "")

    def began(self, job: jobs.Job) -> None:
        """Removes cached images. A repeated training writes new ones under the same names."""
        pictures.forget()


STEP = Train()
