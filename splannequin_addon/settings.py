"""Settings of the artist, stored in the scene and so in the .blend. Each step's settings are in its package."""

from __future__ import annotations

import bpy

from .access import scene_holding
from .bake.settings import BakeSettings
from .footage.settings import ImportSettings
from .freeze.settings import FreezeSettings
from .properties import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty
from .shot import scene_objects, selection
from .solve.settings import SolveSettings
from .train.settings import TrainSettings
from .ui import folds


def _chosen(props: SPLANNEQUIN_PG_scene, context: bpy.types.Context) -> None:
    """Update callback: another shot of the list was selected."""
    selection.choose(scene_holding(props), props.active_shot)


class ShotSettings(ImportSettings, SolveSettings, TrainSettings, FreezeSettings):
    """Settings of one shot. They are stored in the list of shots while another shot is selected."""


class SPLANNEQUIN_PG_shot(ShotSettings, bpy.types.PropertyGroup):
    """Settings of a shot of the scene that is not the chosen one."""

    scene_settings = StringProperty(
        name="Scene Settings",
        description="Resolution, frame rate and frame range of the scene while this shot was chosen",
        options={"HIDDEN"},
    )


class SPLANNEQUIN_PG_scene(ShotSettings, BakeSettings, folds.Folds, bpy.types.PropertyGroup):
    """The chosen shot of the scene, and what is the scene's own."""

    set_up_scene = BoolProperty(
        name="Fit Scene to Clip",
        description="Set the scene's resolution, frame rate and frame range to the clip's. Off: only a new "
        "scene is set "
        "up, an edited scene is not changed",
        default=False,
        options=set(),
    )
    shots = CollectionProperty(
        name="Shots",
        description="All shots of the scene if there are several",
        type=SPLANNEQUIN_PG_shot,
        options=set(),
    )
    active_shot = IntProperty(
        name="Shot", description="Shot that the steps work on", default=0, min=0, options=set(), update=_chosen
    )
    loaded_shot = IntProperty(
        name="Loaded",
        description="Shot in the list whose settings the scene currently has",
        default=0,
        options={"HIDDEN"},
    )
    camera_before = PointerProperty(
        name="Previous Camera",
        description="Camera of the scene before a shot's camera replaced it",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    world_before = PointerProperty(
        name="Previous World",
        description="World of the scene before a shot's light replaced it",
        type=bpy.types.World,
        options={"HIDDEN"},
    )
    made = CollectionProperty(
        name="Made",
        description="Data that was added to this scene, by shot",
        type=scene_objects.SPLANNEQUIN_PG_made,
        options=set(),
    )


def register() -> None:
    """Registers the property groups and adds them to the scene type."""
    bpy.utils.register_class(scene_objects.SPLANNEQUIN_PG_splats)
    bpy.utils.register_class(scene_objects.SPLANNEQUIN_PG_surface)
    bpy.utils.register_class(scene_objects.SPLANNEQUIN_PG_made)
    bpy.utils.register_class(SPLANNEQUIN_PG_shot)
    bpy.utils.register_class(SPLANNEQUIN_PG_scene)
    bpy.types.Scene.splannequin = bpy.props.PointerProperty(type=SPLANNEQUIN_PG_scene)  # pyright: ignore[reportAttributeAccessIssue]


def unregister() -> None:
    """Undoes `register`."""
    del bpy.types.Scene.splannequin  # pyright: ignore[reportAttributeAccessIssue]
    bpy.utils.unregister_class(SPLANNEQUIN_PG_scene)
    bpy.utils.unregister_class(SPLANNEQUIN_PG_shot)
    bpy.utils.unregister_class(scene_objects.SPLANNEQUIN_PG_made)
    bpy.utils.unregister_class(scene_objects.SPLANNEQUIN_PG_surface)
    bpy.utils.unregister_class(scene_objects.SPLANNEQUIN_PG_splats)
