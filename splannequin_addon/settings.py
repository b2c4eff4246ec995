"""What the artist sets, kept in the scene: it travels with the .blend."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..torch_backend import contract
from . import compat
from .shot import chosen, made
from .translations import tr

PRESETS: list[tuple[str, str, str]] = contract.panel(contract.TrainParams, "preset")["items"]
"""(identifier, name, tooltip) of each."""


def names_of(props: Any, kind: str) -> list[tuple[str, str]]:
    """(name, what it is) of the runs or takes of the shot that `props` names, for the field's list."""
    from .process import supervisor

    folder = chosen.shot_folder(props.id_data)
    state = supervisor.watch_of(folder).state if folder else None
    if state is None:
        return []
    if kind == "runs":
        return [
            (name, tr(f"{run.get('heldout_psnr_db') or 0:.1f} dB, {run.get('gaussians', 0):,} Gaussians"))
            for name, run in state.runs.items()
        ]
    return [(name, tr(f"t* {take['t_star_frame']}, run {take['run']}")) for name, take in state.takes.items()]


def _third_of(steps: int) -> int:
    return round(steps / 3)


def _preset_chosen(props: Any, context: Any) -> None:
    """More steps are a third of the preset's unless the artist says otherwise."""
    props.extend_steps = _third_of(contract.PRESET_STEPS[props.preset])


def _chosen(props: Any, context: Any) -> None:
    """Another shot of the list was clicked."""
    from .shot import chosen

    chosen.choose(props.id_data, props.active_shot)


class ShotSettings:
    """One shot and what is to be done with it. What is named here is put away when another shot is chosen."""

    clip: StringProperty(
        **contract.panel(contract.ImportParams, "source"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    shot_path: StringProperty(
        name="Shot Folder",
        description="Folder that keeps everything of this shot; empty: made beside the clip",
        subtype="DIR_PATH",
        options=compat.PATH_OPTIONS,
    )
    shot_seen: StringProperty(
        name="Shot Seen",
        description="Shot folder that was there when this file was last at work: it can be missed",
        subtype="DIR_PATH",
        options=compat.PATH_OPTIONS | {"HIDDEN"},
    )
    use_range: BoolProperty(
        name="Only a Range", description="Import a part of the clip instead of all of it", default=False, options=set()
    )
    first: IntProperty(
        **contract.panel(contract.ImportParams, "first", 1),
        options=set(),
    )
    last: IntProperty(
        **contract.panel(contract.ImportParams, "last", 250),
        options=set(),
    )
    solve_step: IntProperty(
        **contract.panel(contract.ImportParams, "step"),
        min=0,
        soft_max=10,
        options=set(),
    )
    fps: FloatProperty(
        **contract.panel(contract.ImportParams, "fps"),
        min=0.0,
        soft_max=120.0,
        options=set(),
    )
    camera_model: EnumProperty(
        **contract.panel(contract.SolveParams, "camera_model"),
        options=set(),
    )
    cameras_from: EnumProperty(
        name="Cameras From",
        description="Solve the camera here, or take cameras that another program found for the same clip",
        items=[
            ("SOLVE", "Solve", "Find the camera from the clip"),
            ("FILE", "File", "A COLMAP folder, a nerfstudio transforms.json or a camera path"),
            ("TRACKING", "Blender Tracking", "The solved camera of a movie clip of this file"),
        ],
        options=set(),
    )
    cameras_path: StringProperty(
        **contract.panel(contract.SolveParams, "cameras"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    tracking_clip: PointerProperty(
        name="Tracked Clip",
        description="Movie clip whose camera is solved; it should show the same frames as the shot's clip",
        type=bpy.types.MovieClip,
        options=set(),
    )
    preset: EnumProperty(
        **contract.panel(contract.TrainParams, "preset"),
        options=set(),
        update=_preset_chosen,
    )
    extend_steps: IntProperty(
        **contract.panel(contract.TrainParams, "extend", _third_of(contract.PRESET_STEPS["preview"])),
        min=10,
        soft_max=30_000,
        options=set(),
    )
    run_name: StringProperty(
        **contract.panel(contract.TrainParams, "run"),
        options=set(),
        search=lambda props, context, text: names_of(props, "runs"),
        search_options={"SUGGESTION"},
    )
    choose_t_star: BoolProperty(
        name="Choose the Instant",
        description="Set the frame at which time stands still yourself; off: the best supported one is taken",
        default=False,
        options=set(),
    )
    t_star: IntProperty(
        **contract.panel(contract.FreezeParams, "t_star", 1),
        options={"ANIMATABLE"},
    )
    path_camera: PointerProperty(
        name="Camera",
        description="Animated camera to see the frozen instant from; empty: the clip's own move",
        type=bpy.types.Object,
        poll=lambda _, item: item.type == "CAMERA",
        options=set(),
    )
    detail: BoolProperty(
        **contract.panel(contract.FreezeParams, "detail"),
        options=set(),
    )
    develop: BoolProperty(
        **contract.panel(contract.FreezeParams, "develop"),
        options=set(),
    )
    freeze_width: IntProperty(
        **contract.panel(contract.FreezeParams, "width"),
        min=0,
        max=16384,
        options=set(),
    )
    overscan: EnumProperty(
        name="Overscan",
        description="Picture beyond the frame, for the way back into the original's lens distortion. The compositor "
        "shows the frame as without it",
        items=[
            ("OFF", "Off", "Frozen frames end where the plate ends"),
            ("LENS", "What the Lens Needs", "As much more on every side as the original, distorted frame shows"),
        ],
        options=set(),
    )
    live_show: EnumProperty(
        name="Show",
        description="What is drawn over the view while scrubbing",
        items=[
            ("color", "Picture", "The frozen people and place"),
            ("guesses", "Guesses", "The picture, tinted where no frame near t* saw what is shown"),
            ("support", "Support", "White where frames near t* saw what is shown, black where it is a guess"),
            ("motion", "Motion", "White where something moves in the clip"),
        ],
        options=set(),
    )
    take_name: StringProperty(
        **contract.panel(contract.FreezeParams, "take"),
        options=set(),
        search=lambda props, context, text: names_of(props, "takes"),
        search_options={"SUGGESTION"},
    )


class SPLANNEQUIN_PG_shot(ShotSettings, bpy.types.PropertyGroup):
    """Settings of a shot of the scene that is not the chosen one."""

    scene_settings: StringProperty(
        name="Scene Settings",
        description="Size, rate and range of the scene while this shot was chosen",
        options={"HIDDEN"},
    )


class SPLANNEQUIN_PG_scene(ShotSettings, bpy.types.PropertyGroup):
    """The chosen shot of the scene, and what is the scene's own."""

    set_up_scene: BoolProperty(
        name="Fit Scene to Clip",
        description="Set resolution, frame rate and frame range of the scene to the clip's. "
        "Off: only a new scene is set up, one you have worked in is left alone",
        default=False,
        options=set(),
    )
    keep_colours: BoolProperty(
        name="Keep Plate Colours",
        description="Set the view transform to Standard and dither to 0, so that pictures leave with the colours they "
        "came in with. Blender's default view changes them",
        default=True,
        options=set(),
    )
    insert_at: EnumProperty(
        name="Insert",
        description="Where the freeze goes in a compositor that you have built",
        items=[
            ("AUTO", "Automatic", "As the plate where a node shows it, else before the output"),
            ("PLATE", "As Plate", "Behind the node that shows the plate, so that your grade goes on from there"),
            ("OUTPUT", "Before Output", "Behind everything else"),
        ],
        default="AUTO",
        options=set(),
    )
    shots: CollectionProperty(
        name="Shots",
        description="All shots of the scene if there are several",
        type=SPLANNEQUIN_PG_shot,
        options=set(),
    )
    active_shot: IntProperty(
        name="Shot", description="The shot that the steps are about", default=0, min=0, options=set(), update=_chosen
    )
    loaded_shot: IntProperty(
        name="Loaded", description="Shot of the list whose settings are the scene's", default=0, options={"HIDDEN"}
    )
    camera_before: PointerProperty(
        name="Camera Before",
        description="Camera of the scene before a shot's was put in its place",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    made: CollectionProperty(
        name="Made", description="What was put into this scene, by shot", type=made.SPLANNEQUIN_PG_made, options=set()
    )


def register() -> None:
    """Registers the property groups and hangs them on the scene."""
    bpy.utils.register_class(made.SPLANNEQUIN_PG_made)
    bpy.utils.register_class(SPLANNEQUIN_PG_shot)
    bpy.utils.register_class(SPLANNEQUIN_PG_scene)
    bpy.types.Scene.splannequin = PointerProperty(type=SPLANNEQUIN_PG_scene)


def unregister() -> None:
    """Undoes `register`."""
    del bpy.types.Scene.splannequin
    bpy.utils.unregister_class(SPLANNEQUIN_PG_scene)
    bpy.utils.unregister_class(SPLANNEQUIN_PG_shot)
    bpy.utils.unregister_class(made.SPLANNEQUIN_PG_made)
