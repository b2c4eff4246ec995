"""Settings of the solve."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from .. import compat
from ..properties import BoolProperty, EnumProperty, FloatProperty, PointerProperty, StringProperty

MASK_SOURCES = [
    ("NONE", "None", "No mask"),
    ("FILE", "File", "A picture for all frames, a picture of a numbered sequence, or a video"),
    ("ALPHA", "Alpha", "The alpha of the clip, if it has one: ignored is what is transparent, people are opaque"),
    ("DRAWN", "Drawn", "A mask of this file, drawn over the clip in the Movie Clip editor"),
]
"""Sources of a mask. The order is stored in .blend files: append new ones."""
BURNT_IN = ("FOUND", "Burnt In", "A logo or a caption, if the import found one burnt into the clip; else nothing")
"""Additional source of the mask of ignored areas."""


class SolveSettings:
    """The lens of a shot, the source of its cameras, and its masks."""

    camera_model = EnumProperty(
        **contract.panel(contract.SolveParams, "camera_model"),
        options=set(),
    )
    focal_mm = FloatProperty(
        **contract.panel(contract.SolveParams, "focal_mm"),
        min=0.0,
        max=5000.0,
        soft_max=300.0,
        options=set(),
    )
    sensor_mm = FloatProperty(
        **contract.panel(contract.SolveParams, "sensor_mm"),
        min=1.0,
        max=200.0,
        options=set(),
    )
    refine_focal = BoolProperty(
        **contract.panel(contract.SolveParams, "refine_focal"),
        options=set(),
    )
    st_map = StringProperty(
        **contract.panel(contract.SolveParams, "st_map"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    st_map_way = EnumProperty(
        **contract.panel(contract.SolveParams, "st_map_way"),
        options=set(),
    )
    st_map_layer = StringProperty(
        **contract.panel(contract.SolveParams, "st_map_layer"),
        options=set(),
    )
    retry = BoolProperty(
        **contract.panel(contract.SolveParams, "retry"),
        options=set(),
    )
    cameras_from = EnumProperty(
        name="Cameras From",
        description="Solve the camera here, or take cameras that another program found for the same clip",
        items=[
            ("SOLVE", "Solve", "Find the camera from the clip"),
            (
                "FILE",
                "File",
                "A COLMAP folder, a nerfstudio transforms.json, a camera path, or an Alembic, FBX or USD file",
            ),
            ("TRACKING", "Blender Tracking", "The solved camera of a movie clip of this file"),
            (
                "SCENE",
                "Scene Camera",
                "An animated camera of this scene, such as a matchmove: frame by frame, with its lens",
            ),
        ],
        options=set(),
    )
    cameras_path = StringProperty(
        **contract.panel(contract.SolveParams, "cameras"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    ignore_from = EnumProperty(
        **contract.panel(contract.SolveParams, "ignore_mask", BURNT_IN[0]),
        items=[*MASK_SOURCES, BURNT_IN],
        options=set(),
    )
    ignore_path = StringProperty(
        name="Mask to Ignore",
        description="White is ignored: one picture for all frames, a picture of a numbered sequence, or a video",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    ignore_drawn = PointerProperty(
        name="Drawn Mask to Ignore",
        description="What is inside is ignored",
        type=bpy.types.Mask,
        options=set(),
    )
    people_from = EnumProperty(
        **contract.panel(contract.SolveParams, "people_mask", "NONE"),
        items=MASK_SOURCES,
        options=set(),
    )
    people_path = StringProperty(
        name="Mask of People",
        description="White may move: one picture for all frames, a picture of a numbered sequence, or a video",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    people_drawn = PointerProperty(
        name="Drawn Mask of People",
        description="What is inside may move",
        type=bpy.types.Mask,
        options=set(),
    )
    scene_camera = PointerProperty(
        name="Scene Camera",
        description="Animated camera that stands where the clip's was; frame n of the scene is frame n of the clip",
        type=bpy.types.Object,
        poll=lambda _, item: getattr(item, "type", "") == "CAMERA",
        options=set(),
    )
    tracking_clip = PointerProperty(
        name="Tracked Clip",
        description="Movie clip whose camera is solved; it should show the same frames as the shot's clip",
        type=bpy.types.MovieClip,
        options=set(),
    )
