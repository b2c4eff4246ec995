"""The button of a mask that the import offers: what is burnt into the clip."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..access import Outcome, scene_in, settings_of
from ..shot import inventory, selection
from ..translations import tr
from ..ui import icons
from ..ui.sentences import wrap


def _offered(scene: bpy.types.Scene) -> Path | None:
    """The mask of what is burnt into the scene's clip; None if nothing is."""
    shot = selection.shot_folder(scene)
    return None if shot is None else inventory.burnt_in(shot)


class SPLANNEQUIN_OT_ignore_burnt_in(bpy.types.Operator):
    """Have ignored what is burnt into the clip and stands still on the picture, a logo or a caption: the camera is not
    solved by it, it is not learnt, and no frame is filled with it"""

    bl_idname = "splannequin.ignore_burnt_in"
    bl_label = "Ignore What Is Burnt In"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Off where the import found nothing."""
        if _offered(scene_in(context)) is None:
            cls.poll_message_set(tr("Nothing was found to be burnt into the clip"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Chooses its mask."""
        mask, props = _offered(scene_in(context)), settings_of(scene_in(context))
        if mask is None:
            return {"CANCELLED"}
        props.ignore_from, props.ignore_path = "FILE", str(mask)
        return {"FINISHED"}


def draw(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Says what was found, with the button; nothing if another mask is chosen, or nothing was found."""
    scene = scene_in(context)
    if settings_of(scene).ignore_from == "NONE" and _offered(scene) is not None:
        wrap(layout, context, "Something seems to be burnt into the clip: a logo, a caption?", "INFO")
        name = "splannequin.ignore_burnt_in"
        layout.operator(name, icon=icons.of(name))


CLASSES = (SPLANNEQUIN_OT_ignore_burnt_in,)
