"""Settings of the solve."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from .. import compat
from ..properties import BoolProperty, EnumProperty, FloatProperty, PointerProperty, StringProperty

MASK_SOURCES = [
    ("NONE", "None", "No mask"),
    ("FILE", "File", "One image for all frames, an image of a numbered sequence, or a video"),
    ("ALPHA", "Alpha", "The clip's alpha channel, if it has one: transparent areas are ignored, people are opaque"),
    ("DRAWN", "Drawn", "A mask of this file, drawn over the clip in the Movie Clip editor"),
]
"""Sources of a mask. The order is stored in .blend files: append new ones."""
BURNT_IN = ("FOUND", "Burnt In", "Burnt-in logo or caption that the import found in the clip; empty if there is none")
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
        description="Solve the camera here, or use cameras that another program solved for the same clip",
        items=[
            ("SOLVE", "Solve", "Solve the camera from the clip"),
            (
                "FILE",
                "File",
                "A COLMAP folder, a nerfstudio transforms.json, a camera path, or an Alembic, FBX or USD file",
            ),
            ("TRACKING", "Blender Tracking", "The solved camera of a movie clip of this file"),
            (
                "SCENE",
                "Scene Camera",
                "An animated camera of this scene, such as a matchmove, read frame by frame with its lens",
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
        description="White is ignored: one image for all frames, an image of a numbered sequence, or a video",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    ignore_drawn = PointerProperty(
        name="Drawn Mask to Ignore",
        description="The area inside the mask is ignored",
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
        description="White may move: one image for all frames, an image of a numbered sequence, or a video",
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    people_drawn = PointerProperty(
        name="Drawn Mask of People",
        description="The area inside the mask may move",
        type=bpy.types.Mask,
        options=set(),
    )
    scene_camera = PointerProperty(
        name="Scene Camera",
        description="Animated camera that matches the clip's camera; frame n of the scene is frame n of the clip",
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
