"""What the artist sets, kept in the scene: it travels with the .blend."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

from . import compat

PRESETS = [
    ("preview", "Preview", "Small and quick: to see whether the shot holds, minutes on a laptop"),
    ("standard", "Standard", "For most shots"),
    ("final", "Final", "Largest pictures and most Gaussians: takes longest"),
]


def names_of(props: Any, kind: str) -> list[tuple[str, str]]:
    """(name, what it is) of the runs or takes of the shot that `props` names, for the field's list."""
    from . import steps, supervisor  # they import this package's parts in turn

    folder = steps.shot_folder(props.id_data)
    state = supervisor.watch_of(folder).state if folder else None
    if state is None:
        return []
    if kind == "runs":
        return [
            (name, f"{run.get('heldout_psnr_db') or 0:.1f} dB, {run.get('gaussians', 0):,} Gaussians")
            for name, run in state.runs.items()
        ]
    return [(name, f"t* {take['t_star_frame']}, run {take['run']}") for name, take in state.takes.items()]


class SPLANNEQUIN_PG_scene(bpy.types.PropertyGroup):
    """One shot of the scene and what is to be done with it."""

    clip: StringProperty(
        name="Clip",
        description="Video file, or one image of a numbered sequence, of people holding still",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    shot_path: StringProperty(
        name="Shot Folder",
        description="Folder that keeps everything of this shot; empty: made beside the clip",
        subtype="DIR_PATH",
        options=compat.PATH_OPTIONS,
    )
    use_range: BoolProperty(
        name="Only a Range", description="Import a part of the clip instead of all of it", default=False, options=set()
    )
    first: IntProperty(name="First", description="First frame number of the clip to import", default=1, options=set())
    last: IntProperty(name="Last", description="Last frame number to import, inclusive", default=250, options=set())
    camera_model: EnumProperty(
        name="Lens",
        description="How the lens bends straight lines",
        items=[
            ("SIMPLE_RADIAL", "Ordinary", "One coefficient: phones, most cameras"),
            ("OPENCV", "Strong", "Four coefficients: action cameras, very wide lenses"),
        ],
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
        name="Cameras",
        description="Folder of a COLMAP model or one of its files, a transforms.json, or a camera path. "
        "Pictures are matched to the clip's frames by the number in their names",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    tracking_clip: PointerProperty(
        name="Tracked Clip",
        description="Movie clip whose camera is solved; it should show the same frames as the shot's clip",
        type=bpy.types.MovieClip,
        options=set(),
    )
    preset: EnumProperty(name="Preset", description="How much to spend on training", items=PRESETS, options=set())
    run_name: StringProperty(
        name="Run",
        description="Name of the training run; a new name keeps the old",
        default="main",
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
        name="t*",
        description="Frame number of the clip at which time stands still. Keyed, it is followed frame by frame: "
        "freeze, hold and release",
        default=1,
        options={"ANIMATABLE"},
    )
    path_camera: PointerProperty(
        name="Camera",
        description="Animated camera to see the frozen instant from; empty: the clip's own move",
        type=bpy.types.Object,
        poll=lambda _, item: item.type == "CAMERA",
        options=set(),
    )
    freeze_width: IntProperty(
        name="Width",
        description="Width in pixels of the frozen frames; 0: as trained, or as the scene renders from a camera "
        "of your own",
        default=0,
        min=0,
        max=16384,
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
        name="Take",
        description="Name of the frozen frames; a new name keeps the old",
        default="freeze",
        options=set(),
        search=lambda props, context, text: names_of(props, "takes"),
        search_options={"SUGGESTION"},
    )
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


def register() -> None:
    """Registers the property group and hangs it on the scene."""
    bpy.utils.register_class(SPLANNEQUIN_PG_scene)
    bpy.types.Scene.splannequin = PointerProperty(type=SPLANNEQUIN_PG_scene)


def unregister() -> None:
    """Undoes `register`."""
    del bpy.types.Scene.splannequin
    bpy.utils.unregister_class(SPLANNEQUIN_PG_scene)
